"""Two ways to keep a growing graph solved: a Bayes tree that is updated where it changes, or batch iterations."""

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np
from gtsam import Pose3

_STEPS = 6


class Growth(Protocol):
    """A graph of pose factors that grows and stays solved."""

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: Sequence[int] = ()
    ) -> tuple[list[int], int]:
        """Add factors and start values, drop factors by number; numbers of the new ones, variables solved anew."""

    def estimate(self, key: int) -> Pose3:
        """Present value of one pose."""

    def values(self) -> gtsam.Values:
        """Present values of all poses."""

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """All factors by number, with gaps where some were dropped."""


class Tree:
    """iSAM2, eliminating by QR."""

    def __init__(self, relinearize: float, wildfire: float) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(relinearize)
        parameters.relinearizeSkip = 1
        parameters.enablePartialRelinearizationCheck = True  # looks only where the step changed, not at every station
        parameters.setFactorization("QR")
        parameters.enableAdaptiveReorder = False
        inner = gtsam.ISAM2GaussNewtonParams()
        inner.setWildfireThreshold(wildfire)
        parameters.setOptimizationParams(inner)
        self.isam = gtsam.ISAM2(parameters)

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: Sequence[int] = ()
    ) -> tuple[list[int], int]:
        """See :class:`Growth`."""
        result = self.isam.update(graph, values, list(removed))
        return [int(n) for n in result.getNewFactorsIndices()], int(result.getVariablesReeliminated())

    def estimate(self, key: int) -> Pose3:
        """See :class:`Growth`."""
        return self.isam.calculateEstimatePose3(key)

    def values(self) -> gtsam.Values:
        """See :class:`Growth`."""
        return self.isam.calculateEstimate()

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See :class:`Growth`."""
        return self.isam.getFactorsUnsafe()


class Batch:
    """Gauss-Newton over everything at every addition, from the present values: exact, and cheap on small networks."""

    def __init__(self, small: float) -> None:
        self.graph, self.present = gtsam.NonlinearFactorGraph(), gtsam.Values()
        self.small, self.use_qr = small, False

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: Sequence[int] = ()
    ) -> tuple[list[int], int]:
        """See :class:`Growth`."""
        for n in removed:
            self.graph.remove(n)
        first = self.graph.size()
        self.graph.push_back(graph)
        self.present.insert(values)
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(self.graph)
        for _ in range(_STEPS):
            delta = self._step(ordering)
            self.present = self.present.retract(delta)
            if float(np.abs(delta.vector()).max(initial=0.0)) < self.small:
                break
        return list(range(first, self.graph.size())), self.present.size()

    def _step(self, ordering: gtsam.Ordering) -> gtsam.VectorValues:
        linear = self.graph.linearize(self.present)
        if not self.use_qr:
            try:
                return linear.optimize(ordering)
            except RuntimeError as error:
                if "ndetermin" not in str(error):
                    raise
                self.use_qr = True  # GTSAM's Cholesky refuses pivots of weak networks that QR still resolves
        return linear.optimize(ordering, gtsam.EliminateQR)

    def estimate(self, key: int) -> Pose3:
        """See :class:`Growth`."""
        return self.present.atPose3(key)

    def values(self) -> gtsam.Values:
        """See :class:`Growth`."""
        return self.present

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See :class:`Growth`."""
        return self.graph


def moved_over(old: Growth, new: Growth) -> dict[int, int]:
    """Put everything of one into the other, still empty; new number by old number of every factor."""
    graph, factors, numbers = gtsam.NonlinearFactorGraph(), old.factors(), {}
    for n in range(factors.size()):
        if factors.exists(n):
            numbers[n] = graph.size()
            graph.push_back(factors.at(n))
    new.update(graph, old.values())
    return numbers
