"""A solved pose network."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.result import GlobalTest
from adjust.model.survey import FloatArray
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.precision import NetworkPrecision
from adjust.pose_network.solve import DEFAULTS, Minimum, NetworkOptions, Progress, minimize
from adjust.precision.precision import global_test


@dataclass(frozen=True, eq=False)
class NetworkSolution:
    """``world_from_station`` of all stations: rotations (N, 3, 3), translations (N, 3) m, zero in rotation networks.

    network: as solved. omega: v'Pv of the pairs in use and the priors.
    redundancy: observations less unknowns. iterations, max_step: of the last least squares.
    """

    network: PoseNetwork
    rotations: FloatArray
    translations: FloatArray
    omega: float
    redundancy: int
    iterations: int
    max_step: float
    minimum: Minimum

    @cached_property
    def precision(self) -> NetworkPrecision:
        """Covariances and tests, computed when first asked for."""
        return NetworkPrecision(self.network, self.minimum)

    @property
    def sigma0(self) -> float:
        """A posteriori standard deviation of unit weight, nan without redundancy."""
        return float(np.sqrt(self.omega / self.redundancy)) if self.redundancy > 0 else float("nan")

    def global_test(self, alpha: float = 0.05) -> GlobalTest | None:
        """Chi-square test of v'Pv; None without redundancy."""
        return global_test(self.omega, self.redundancy, alpha)

    def pose(self, station_id: str) -> Pose3:
        """``world_from_station`` of one station."""
        i = self.network.index_of[station_id]
        return Pose3(Rot3(self.rotations[i]), self.translations[i])

    def relative(self, a_id: str, b_id: str) -> tuple[FloatArray, FloatArray]:
        """``b_from_a`` (4, 4) and its covariance (dim, dim) in the tangent of a, whatever the datum."""
        index = self.network.index_of
        return self.precision.relative(index[a_id], index[b_id])


def solve_network(
    network: PoseNetwork, start: tuple[FloatArray, FloatArray] | None = None,
    options: NetworkOptions = DEFAULTS, progress: Progress | None = None,
) -> NetworkSolution:  # fmt: skip
    """Solve a network over its pairs in use, from nothing or from a start.

    Raises IndeterminateError naming the stations that float, NotConvergedError.
    """
    return as_solution(network, minimize(network, start, options, progress=progress))


def as_solution(network: PoseNetwork, minimum: Minimum) -> NetworkSolution:
    """The minimum with its counts."""
    used, graph, solved = network.used, minimum.graph, minimum.solved
    n_observations = int(network.sizes[used].sum()) + sum(len(i.components) for i in graph.singles if i.kind == "prior")
    defect = 0 if solved.datum is None else solved.datum.defect
    redundancy = n_observations - graph.unknowns.n_unknowns + defect
    return NetworkSolution(
        network, minimum.rotations, minimum.translations, minimum.omega, redundancy, solved.iterations,
        solved.max_step, minimum,
    )  # fmt: skip
