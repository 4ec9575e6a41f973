"""How GTSAM eliminates a linear system: by Cholesky, or by QR where that still resolves what Cholesky refuses."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import gtsam

_Found = TypeVar("_Found")


@dataclass(frozen=True, eq=False)
class Elimination:
    """An order of elimination and its method."""

    ordering: gtsam.Ordering
    use_qr: bool = False

    def of(self, run: Callable[..., _Found]) -> _Found | None:
        """What an algorithm of GTSAM's finds in this way; None where it takes the system for indeterminate."""
        try:
            return run(*((self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)))
        except RuntimeError as error:  # GTSAM's exception for it has no type of its own in Python
            if "ndetermin" not in str(error):
                raise
            return None

    def solution(self, linear: gtsam.GaussianFactorGraph) -> tuple[gtsam.VectorValues, float] | None:
        """The solution and by how much it lowers chi-square; None where this method finds the system indeterminate."""
        delta = self.of(linear.optimize)
        return None if delta is None else (delta, -float(delta.dot(linear.gradientAtZero())))

    def tree(self, linear: gtsam.GaussianFactorGraph) -> tuple[gtsam.GaussianBayesTree, gtsam.VectorValues] | None:
        """The Bayes tree and its solution; None as above."""
        try:
            how = (self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)
            tree = linear.eliminateMultifrontal(*how)
            return tree, tree.optimize()
        except RuntimeError:
            return None
