"""Covariances of all stations and the statistics of all pairs of a network, by position, from the one Bayes tree."""

from collections.abc import Sequence
from functools import cached_property

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.observations.pairs import PairStatistics
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.solve import Minimum
from adjust.precision.precision import Precision
from adjust.relay.motions import Motions


class NetworkPrecision:
    """A priori covariances (sigma0 = 1) in the datum of the network, tangent on the right of ``world_from_station``.

    of_survey: the same by the names of the survey's unknowns.
    """

    def __init__(self, network: PoseNetwork, minimum: Minimum) -> None:
        self.network = network
        self.of_survey = Precision(minimum.graph, minimum.solved)
        self.world_from_station = Motions(minimum.rotations, None if network.rotation_only else minimum.translations)

    @cached_property
    def _keys(self) -> IntArray:
        """GTSAM's variable of every station (N,), -1 for what is held or in no pair."""
        by_name = self.of_survey.graph.unknowns.by_name
        found = (by_name.get(("world_from_station", s)) for s in self.network.station_ids)
        return np.array([-1 if u is None else u.key for u in found], dtype=np.int64)

    @cached_property
    def station_cov(self) -> FloatArray:
        """Covariances (N, dim, dim) of all stations."""
        d, free = self.network.dim, np.flatnonzero(self._keys >= 0)
        out = np.zeros((self.network.n_stations, d, d))
        out[free] = self.of_survey.covs(self._keys[free], 6)[:, :d, :d]
        return out

    def joint(self, stations: Sequence[int]) -> FloatArray:
        """Joint covariance (k dim, k dim) of stations by position, in the network's datum."""
        d, keys = self.network.dim, self._keys[list(stations)]
        free = np.flatnonzero(keys >= 0)
        out = np.zeros((len(stations) * d,) * 2)
        if len(free):
            rows = (d * free[:, None] + np.arange(d)).ravel()
            own = (6 * np.arange(len(free))[:, None] + np.arange(d)).ravel()
            names = [("world_from_station", self.network.station_ids[stations[i]]) for i in free.tolist()]
            out[np.ix_(rows, rows)] = self.of_survey.joint(names)[np.ix_(own, own)]
        return out

    def relative(self, a: int, b: int) -> tuple[FloatArray, FloatArray]:
        """``b_from_a`` (4, 4) between any two stations, and its covariance (dim, dim) in the tangent of a.

        It does not depend on the datum.
        """
        if a == b:
            return np.eye(4), np.zeros((self.network.dim,) * 2)
        both = self.world_from_station
        b_from_a = both[np.array([b])].inverse() @ both[np.array([a])]
        J = np.hstack([np.eye(self.network.dim), -b_from_a.inverse().adjoint()[0]])
        out = np.eye(4)
        out[:3, :3] = b_from_a.rotation[0]
        if b_from_a.translation is not None:
            out[:3, 3] = b_from_a.translation[0]
        return out, np.asarray(J @ self.joint([a, b]) @ J.T)

    @cached_property
    def pairs(self) -> PairStatistics:
        """Statistics of all pairs, in use or not."""
        return self.of_survey.pairs.first(self.network.dim)
