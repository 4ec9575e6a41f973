"""Published pose graphs: ours with all covariances and tests, GTSAM's own optimisers with all marginals."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import gtsam
import numpy as np
from gtsam import BetweenFactorPose3, Pose3, PriorFactorPose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.survey import FloatArray, IntArray
from adjust.pose_network import PoseNetwork
from adjust.pose_network.start import find_network_start
from tests.adjust.pose_networks import network_of_file, pose_network, solve_network
from tests.benchmarks.cases import Arrays
from tests.benchmarks.outcome import Competitor, Outcome

HELD_SIGMA = 1e-4  # of the prior that stands for the held station in GTSAM's graph: rad and m


@dataclass(frozen=True, eq=False)
class PoseGraph(Arrays):
    """Pairs ``b_from_a``: a, b (E,), rotations (E, 3, 3), translations (E, 3) m, cov (E, 6, 6).

    start: (N, 4, 4) ``world_from_station``; station 0 is held there.
    """

    a: IntArray
    b: IntArray
    rotations: FloatArray
    translations: FloatArray
    cov: FloatArray
    start: FloatArray


def read(path: Path, block_diagonal: bool = False) -> PoseGraph:
    """A g2o file, with the start that ours finds."""
    network = network_of_file(path, block_diagonal=block_diagonal)
    start = np.tile(np.eye(4), (network.n_stations, 1, 1))
    start[:, :3, :3], start[:, :3, 3] = find_network_start(network)
    return PoseGraph(
        network.a_idx, network.b_idx, network.rotations, network.translations, network.cov, start
    )  # fmt: skip


def _network(case: PoseGraph) -> PoseNetwork:
    stations, pairs = (tuple(map(str, range(n))) for n in (len(case.start), len(case.a)))
    return pose_network(stations, pairs, case.a, case.b, case.rotations, case.translations, case.cov,
                        held={0: case.start[0]})  # fmt: skip


def ours(case: PoseGraph) -> Competitor:
    """Least squares, covariances of all stations, redundancy numbers and tests of all pairs."""
    network, start = _network(case), (case.start[:, :3, :3], case.start[:, :3, 3])

    def run() -> Outcome:
        t0 = perf_counter()
        solution = solve_network(network.with_used(network.used), start)
        t1 = perf_counter()
        cov = solution.station_cov
        t2 = perf_counter()
        redundancy = float(solution.pairs.redundancy.sum())
        t3 = perf_counter()
        poses = np.tile(np.eye(4), (network.n_stations, 1, 1))
        poses[:, :3, :3], poses[:, :3, 3] = solution.rotations, solution.translations
        numbers = {"omega": solution.omega, "redundancy": redundancy}
        return Outcome({"solve": t1 - t0, "covariances": t2 - t1, "tests": t3 - t2}, {"poses": poses, "cov": cov},
                       f"{solution.iterations} steps", numbers)  # fmt: skip

    return run


def torus_g2o(n_pairs: int, seed: int = 0) -> str:
    """A closed grid on a torus as a g2o file: half as many stations as pairs, sigmas of 10 mrad and 5 cm."""
    k = round(np.sqrt(n_pairs / 2.0))
    u, v = (2.0 * np.pi * x.ravel() / k for x in np.mgrid[:k, :k])
    out = np.stack([np.cos(u) * np.cos(v), np.sin(u) * np.cos(v), np.sin(v)], axis=1)
    along = np.stack([-np.sin(u), np.cos(u), np.zeros_like(u)], axis=1)
    R = np.stack([along, np.cross(out, along), out], axis=2)
    ring = np.stack([np.cos(u), np.sin(u), np.zeros_like(u)], axis=1)
    t, number = k * (0.5 * ring + 0.2 * out), np.arange(k * k).reshape(k, k)
    rng, tangent = np.random.default_rng(seed), np.repeat((0.01, 0.05), 3)
    information = " ".join(f"{1.0 / tangent[i - 3] ** 2 if i == j else 0:g}" for i in range(6) for j in range(i, 6))
    lines = []
    for axis in (0, 1):
        a, b = number.ravel(), np.roll(number, -1, axis).ravel()
        noise = Rotation.from_rotvec(rng.normal(0.0, 0.01, (len(a), 3)))
        turn = Rotation.from_matrix(np.swapaxes(R[a], 1, 2) @ R[b]) * noise
        shift = np.einsum("nji,nj->ni", R[a], t[b] - t[a]) + rng.normal(0.0, 0.05, (len(a), 3))
        rows = np.hstack([shift, turn.as_quat()]).tolist()
        lines += [f"EDGE_SE3:QUAT {i} {j} {' '.join(map(repr, row))} {information}" for i, j, row in zip(
            a.tolist(), b.tolist(), rows, strict=True)]  # fmt: skip
    return "\n".join(lines) + "\n"


def plain_solve(case: PoseGraph) -> Callable[[], object]:
    """The same least squares alone, its graph built from what a network is."""
    start = case.start[:, :3, :3], case.start[:, :3, 3]
    return lambda: solve_network(_network(case), start)


def gtsam_solve(case: PoseGraph, gauss_newton: bool, marginals: bool) -> Competitor:
    """GTSAM's own factors, one of its optimisers, and its marginals."""
    def run() -> Outcome:
        t0 = perf_counter()
        graph, values = _native(case)
        t1 = perf_counter()
        optimizer = _optimizer(graph, values, gauss_newton)
        result = optimizer.optimize()
        t2 = perf_counter()
        stages, solution = {"build": t1 - t0, "solve": t2 - t1}, {}
        if marginals:
            found = gtsam.Marginals(graph, result)
            solution["cov"] = np.array([found.marginalCovariance(i) for i in range(len(case.start))])
            stages["covariances"] = perf_counter() - t2
        solution["poses"] = np.array([result.atPose3(i).matrix() for i in range(len(case.start))])
        return Outcome(stages, solution, f"{optimizer.iterations()} steps", {"omega": 2.0 * graph.error(result)})

    return run


def _native(case: PoseGraph) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    rows = zip(case.a.tolist(), case.b.tolist(), case.rotations, case.translations, case.cov, strict=True)
    for a, b, R, t, cov in rows:
        noise = gtsam.noiseModel.Gaussian.Covariance(cov)
        graph.push_back(BetweenFactorPose3(b, a, Pose3(Rot3(R), t), noise))
    for i, pose in enumerate(case.start):
        values.insert(i, Pose3(pose))
    held = gtsam.noiseModel.Isotropic.Sigma(6, HELD_SIGMA)
    graph.push_back(PriorFactorPose3(0, Pose3(case.start[0]), held))
    return graph, values


def _optimizer(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, gauss_newton: bool):
    parameters = gtsam.GaussNewtonParams() if gauss_newton else gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-10)
    parameters.setAbsoluteErrorTol(1e-10)
    make = gtsam.GaussNewtonOptimizer if gauss_newton else gtsam.LevenbergMarquardtOptimizer
    return make(graph, values, parameters)


def difference(case: PoseGraph, mine: dict[str, FloatArray], other: dict[str, FloatArray]) -> float:
    """Largest difference of the other poses from ours, in our sigmas."""
    largest = 0.0
    for A, B, cov in zip(mine["poses"][1:], other["poses"][1:], mine["cov"][1:], strict=True):
        d = Pose3.Logmap(Pose3(A).between(Pose3(B)))
        largest = max(largest, float((np.abs(d) / np.sqrt(np.diag(cov))).max()))
    return largest


OURS, GAUSS_NEWTON = "ours: solve, covariances, tests", "GTSAM Gauss-Newton: solve, marginals"
LEVENBERG = "GTSAM Levenberg-Marquardt: solve only"
GRAPHS: dict[str, Callable[[PoseGraph], Competitor]] = {
    OURS: ours,
    GAUSS_NEWTON: lambda case: gtsam_solve(case, True, True),
    LEVENBERG: lambda case: gtsam_solve(case, False, False),
}
