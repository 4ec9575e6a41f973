"""A growing graph of pose factors kept solved: a Bayes tree that is updated where it changes."""

from collections.abc import Sequence

import gtsam
from gtsam import Pose3

_MOST_TOUCHED = 24


class Tree:
    """iSAM2 over the latest stations only; by Cholesky until that refuses a weak one (a long corridor), then by QR.

    What iSAM2 does at an update costs a little for every station it holds. So when ``2 section`` stations are in the
    tree the older ones are settled: eliminated exactly, and represented by their linear factor on the stations that
    they touch. An addition to a settled station brings all of them back.
    """

    def __init__(self, relinearize: float, wildfire: float, section: int) -> None:
        self.relinearize, self.wildfire, self.section = relinearize, wildfire, section
        self.settled: dict[int, Pose3] = {}
        self.active: list[int] = []
        self.all = gtsam.NonlinearFactorGraph()
        self.limit, self.use_qr = 2 * section, False
        self._restart()

    def _restart(self) -> None:
        parameters = gtsam.ISAM2Params()
        parameters.setRelinearizeThreshold(self.relinearize)
        parameters.relinearizeSkip = 1
        parameters.enablePartialRelinearizationCheck = True  # looks only where the step changed, not at every station
        parameters.setFactorization("QR" if self.use_qr else "CHOLESKY")
        inner = gtsam.ISAM2GaussNewtonParams()
        inner.setWildfireThreshold(self.wildfire)
        parameters.setOptimizationParams(inner)
        self.isam = gtsam.ISAM2(parameters)
        self.place: dict[int, int] = {}  # number in the tree by our own number of a factor

    def update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, removed: Sequence[int] = ()
    ) -> list[int]:
        """Add factors and start values, drop factors by number; numbers of the new ones."""
        old = not self.settled.keys().isdisjoint(graph.keyVector())
        if self.settled and (old or any(n not in self.place for n in removed)):
            self._bring_back(self.isam.calculateEstimate())
        first, new = self.all.size(), list(values.keys())
        if not self.all.size():  # a network to begin with may be added to anywhere
            self.limit = max(self.limit, 2 * len(new))
        self.all.push_back(graph)
        gone = [self.place.pop(n) for n in removed]
        for n in removed:
            self.all.remove(n)
        numbers = list(range(first, self.all.size()))
        self.active += new
        self._into_tree(graph, values, numbers, gone)
        if len(self.active) > self.limit:
            self._settle()
        return numbers

    def _into_tree(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, own: Sequence[int], gone: Sequence[int] = ()
    ) -> None:
        """Put factors with our own numbers (-1 of what is none of ours) into the tree.

        Where Cholesky refuses, everything is eliminated by QR from then on.
        """
        try:
            result = self.isam.update(graph, values, list(gone))
        except RuntimeError as error:
            if self.use_qr or "ndetermin" not in str(error):
                raise
            self.use_qr = True
            self._bring_back(gtsam.Values(self.isam.getLinearizationPoint()))
        else:
            new = zip(own, result.getNewFactorsIndices(), strict=True)
            self.place |= {n: int(place) for n, place in new if n >= 0}

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
        self.limit = 2 * self.section
        self._into_tree(stay, _chosen(values, self.active), own_numbers)

    def _bring_back(self, values: gtsam.Values) -> None:
        """All stations and factors into one tree again; values: of those that are in it."""
        for key, pose in self.settled.items():
            values.insert(key, pose)
        self.active = [*self.settled, *self.active]
        self.settled = {}
        graph, own_numbers = gtsam.NonlinearFactorGraph(), []
        for n in range(self.all.size()):
            if self.all.exists(n):
                graph.push_back(self.all.at(n))
                own_numbers.append(n)
        self._restart()
        self.limit = max(2 * self.section, 2 * len(self.active))  # not at every turn
        self._into_tree(graph, values, own_numbers)

    def estimate(self, key: int) -> Pose3:
        """Present value of one pose."""
        return self.settled[key] if key in self.settled else self.isam.calculateEstimatePose3(key)

    def values(self) -> gtsam.Values:
        """Present values of all poses."""
        values = self.isam.calculateEstimate()
        for key, pose in self.settled.items():
            values.insert(key, pose)
        return values


def _chosen(values: gtsam.Values, keys: Sequence[int]) -> gtsam.Values:
    out = gtsam.Values()
    for key in keys:
        out.insert(key, values.atPose3(key))
    return out
