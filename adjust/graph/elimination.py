"""How GTSAM eliminates a linear system: by Cholesky, or by QR where that still resolves what Cholesky refuses."""

from dataclasses import dataclass

import gtsam


@dataclass(frozen=True, eq=False)
class Elimination:
    """An order of elimination and its method."""

    ordering: gtsam.Ordering
    use_qr: bool = False

    def solution(self, linear: gtsam.GaussianFactorGraph) -> tuple[gtsam.VectorValues, float] | None:
        """The solution and by how much it lowers chi-square; None where this method finds the system indeterminate."""
        try:
            how = (self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)
            delta = linear.optimize(*how)
        except RuntimeError as error:  # GTSAM's exception for it has no type of its own in Python
            if "ndetermin" not in str(error):
                raise
            return None
        return delta, -float(delta.dot(linear.gradientAtZero()))

    def tree(self, linear: gtsam.GaussianFactorGraph) -> tuple[gtsam.GaussianBayesTree, gtsam.VectorValues] | None:
        """The Bayes tree and its solution; None as above."""
        try:
            how = (self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)
            tree = linear.eliminateMultifrontal(*how)
            return tree, tree.optimize()
        except RuntimeError:
            return None
