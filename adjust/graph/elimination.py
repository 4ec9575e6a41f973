"""How GTSAM eliminates a linear system: by Cholesky, or by QR where that still resolves what Cholesky refuses."""

from dataclasses import dataclass

import gtsam


@dataclass(frozen=True, eq=False)
class Elimination:
    """An order of elimination and its method."""

    ordering: gtsam.Ordering
    use_qr: bool = False

    def solution(self, linear: gtsam.GaussianFactorGraph) -> gtsam.VectorValues | None:
        """The solution; None where this method finds the system indeterminate."""
        try:
            return linear.optimize(self.ordering, gtsam.EliminateQR) if self.use_qr else linear.optimize(self.ordering)
        except RuntimeError as error:  # GTSAM's exception for it has no type of its own in Python
            if "ndetermin" not in str(error):
                raise
            return None

    def tree(self, linear: gtsam.GaussianFactorGraph) -> gtsam.GaussianBayesTree:
        """The Bayes tree."""
        if self.use_qr:
            return linear.eliminateMultifrontal(self.ordering, gtsam.EliminateQR)
        return linear.eliminateMultifrontal(self.ordering)
