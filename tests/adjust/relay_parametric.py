"""The parametric form of a relay network, one pose per station, as the product solves it: beside the conditions."""

from dataclasses import dataclass

import numpy as np

from adjust.pose_network import NetworkOptions
from adjust.relay.result import AdjustedPairs, adjusted_pairs
from adjust.spatial.rigid_motions import Motions
from tests.adjust.pose_networks import Solved, pose_network, solve_network
from tests.adjust.relay_networks import as_gtsam

OPTIONS = NetworkOptions(max_step=1e-9)


@dataclass(frozen=True, eq=False)
class Parametric:
    """Adjusted pairs, and the stations with their precision."""

    pairs: AdjustedPairs
    solution: Solved

    def pair(self, a_id, b_id):
        """``b_from_a`` of any two stations, measured or not, and its covariance."""
        b_from_a, cov = self.solution.relative(a_id, b_id)
        return as_gtsam(Motions(b_from_a[None, :3, :3], None if len(cov) == 3 else b_from_a[None, :3, 3]), 0), cov

    def station(self, station_id):
        """``world_from_station`` and its covariance in the datum."""
        network = self.solution.network
        i, pose = network.index_of[station_id], self.solution.pose(station_id)
        return pose if network.dim == 6 else pose.rotation(), self.solution.station_cov[i]


def adjust_parametric(network, held=None, inner=False, start=None, options=OPTIONS):
    """held: id of the station that defines the datum (None: the first). inner: inner constraints instead.

    start: motions of all stations to begin with.
    """
    top, dim, t = network.topology, network.dim, network.b_from_a.translation
    i = 0 if held is None else top.station_ids.index(held)
    datum = {"inner": range(top.n_stations)} if inner else {"held": {i: np.eye(4)}}
    net = pose_network(
        top.station_ids, top.pair_ids, top.a_idx, top.b_idx, network.b_from_a.rotation, t, network.cov, **datum
    )
    poses = None
    if start is not None:
        poses = start.rotation, np.zeros((top.n_stations, 3)) if start.translation is None else start.translation
    solution = solve_network(net, poses, options)
    here = solution.world_from_station
    b_from_a = here[top.b_idx].inverse() @ here[top.a_idx]
    by_b = -b_from_a.inverse().adjoint()

    def joint(index):
        stations = [int(s) for s in np.unique(np.concatenate([top.a_idx[list(index)], top.b_idx[list(index)]]))]
        J = np.zeros((len(index), dim, len(stations), dim))
        for row, e in enumerate(index):
            J[row, :, stations.index(top.a_idx[e])] = np.eye(dim)
            J[row, :, stations.index(top.b_idx[e])] = by_b[e]
        J = J.reshape(len(index) * dim, -1)
        return J @ solution.joint(stations) @ J.T

    cov = solution.pairs.adjusted_cov
    pairs = adjusted_pairs(network, b_from_a, cov, solution.redundancy, solution.iterations, joint)
    return Parametric(pairs, solution)
