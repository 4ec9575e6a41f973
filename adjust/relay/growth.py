"""Two ways to keep a growing graph solved: a Bayes tree that is updated where it changes, or batch iterations."""

from collections.abc import Sequence
from typing import Protocol

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.graph.elimination import Elimination

_STEPS = 6
_MOST_TOUCHED = 24


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
    """iSAM2, eliminating by QR, over the latest stations only.

    What iSAM2 does at an update costs a little for every station it holds. So when ``2 section`` stations are in the
    tree the older ones are settled: eliminated exactly, and represented by their linear factor on the stations that
    they touch. An addition to a settled station brings all of them back.
    """

    def __init__(self, relinearize: float, wildfire: float, section: int) -> None:
        self.relinearize, self.wildfire, self.section = relinearize, wildfire, section
        self.settled: dict[int, Pose3] = {}
        self.active: list[int] = []
        self.all = gtsam.NonlinearFactorGraph()
        self.limit = 2 * section
        self._restart()

    def _restart(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(self.relinearize)
        parameters.relinearizeSkip = 1
        parameters.enablePartialRelinearizationCheck = True  # looks only where the step changed, not at every station
        parameters.setFactorization("QR")
        inner = gtsam.ISAM2GaussNewtonParams()
        inner.setWildfireThreshold(self.wildfire)
        parameters.setOptimizationParams(inner)
        self.isam = gtsam.ISAM2(parameters)
        self.place: dict[int, int] = {}  # number in the tree by our own number of a factor

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: Sequence[int] = ()
    ) -> tuple[list[int], int]:
        """See :class:`Growth`."""
        old = not self.settled.keys().isdisjoint(graph.keyVector())
        if self.settled and (old or any(n not in self.place for n in removed)):
            self._bring_back()
        first, new = self.all.size(), list(values.keys())
        if not self.all.size():  # a network to begin with may be added to anywhere
            self.limit = max(self.limit, 2 * len(new))
        self.all.push_back(graph)
        result = self.isam.update(graph, values, [self.place.pop(n) for n in removed])
        for n in removed:
            self.all.remove(n)
        numbers = list(range(first, self.all.size()))
        self.place |= dict(zip(numbers, (int(n) for n in result.getNewFactorsIndices()), strict=True))
        self.active += new
        if len(self.active) > self.limit:
            self._settle()
        return numbers, int(result.getVariablesReeliminated())

    def _settle(self) -> None:
        """Eliminate all stations but the latest; not where too many of these are touched by the others."""
        values, factors = self.isam.calculateEstimate(), self.isam.getFactorsUnsafe()
        keep = set(self.active[-self.section :])
        gone = [k for k in self.active if k not in keep]
        number = {n: own for own, n in self.place.items()}
        left, stay, own_numbers = gtsam.NonlinearFactorGraph(), gtsam.NonlinearFactorGraph(), []
        for n in range(factors.size()):
            if not factors.exists(n):
                continue
            factor = factors.at(n)
            if keep.issuperset(factor.keys()):
                stay.push_back(factor)
                own_numbers.append(number.get(n, -1))
            else:
                left.push_back(factor)
        if len(keep.intersection(left.keyVector())) > _MOST_TOUCHED:
            self.limit *= 2
            return
        _, rest = left.linearize(values).eliminatePartialMultifrontal(gone, gtsam.EliminateQR)
        for i in range(rest.size()):
            summary = rest.at(i)
            if summary is not None and len(summary.keys()):
                stay.push_back(gtsam.LinearContainerFactor(summary, _chosen(values, list(summary.keys()))))
                own_numbers.append(-1)
        self.settled |= {k: values.atPose3(k) for k in gone}
        self.active = self.active[-self.section :]
        self._restart()
        found = self.isam.update(stay, _chosen(values, self.active)).getNewFactorsIndices()
        self.place = {own: int(n) for own, n in zip(own_numbers, found, strict=True) if own >= 0}
        self.limit = 2 * self.section

    def _bring_back(self) -> None:
        """All stations and factors into one tree again."""
        values = self.values()
        self.active = [*self.settled, *self.active]
        self.settled = {}
        graph, own_numbers = gtsam.NonlinearFactorGraph(), []
        for n in range(self.all.size()):
            if self.all.exists(n):
                graph.push_back(self.all.at(n))
                own_numbers.append(n)
        self._restart()
        found = self.isam.update(graph, values).getNewFactorsIndices()
        self.place = {own: int(n) for own, n in zip(own_numbers, found, strict=True)}
        self.limit = max(2 * self.section, 2 * len(self.active))  # not at every turn

    def estimate(self, key: int) -> Pose3:
        """See :class:`Growth`."""
        return self.settled[key] if key in self.settled else self.isam.calculateEstimatePose3(key)

    def values(self) -> gtsam.Values:
        """See :class:`Growth`."""
        values = self.isam.calculateEstimate()
        for key, pose in self.settled.items():
            values.insert(key, pose)
        return values

    def factors(self) -> gtsam.NonlinearFactorGraph:
        """See :class:`Growth`."""
        return self.all


def _chosen(values: gtsam.Values, keys: Sequence[int]) -> gtsam.Values:
    out = gtsam.Values()
    for key in keys:
        out.insert(key, values.atPose3(key))
    return out


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
        found = Elimination(ordering, self.use_qr).of(linear.optimize)
        if found is None:
            self.use_qr = True  # GTSAM's Cholesky refuses pivots of weak networks that QR still resolves
            found = linear.optimize(ordering, gtsam.EliminateQR)
        return found

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
