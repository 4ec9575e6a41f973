"""Large pose networks: ``python -m tests.benchmarks.networks [grow NX NY | batch NX NY]``, full size by default.

grow: stations added one at a time, time per addition and largest difference to the batch solution. batch: a grid from
nothing to its minimum with all variances and tests; time, memory, v'Pv within its chi-square band, gradient.
"""

import argparse
import resource
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import FloatArray
from adjust.pose_network import NetworkSolution, PoseNetwork, pose_network, solve_network
from adjust.pose_network.session import NetworkSession
from adjust.spatial.rigid_motions import Motions
from tests.adjust.pose_networks import network_jacobians, simulate


def as_pair(network: PoseNetwork, e: int) -> Pair:
    """A pair of the arrays as an observation."""
    a, b = (FrameRef("station", network.station_ids[i[e]]) for i in (network.a_idx, network.b_idx))
    return Pair(network.pair_ids[e], a, b, Pose3(Rot3(network.rotations[e]), network.translations[e]), network.cov[e])


def first_stations(network: PoseNetwork) -> PoseNetwork:
    """The first two stations and the pair between them, the first one held as in the whole."""
    e = [k for k in range(network.n_pairs) if {network.a_idx[k], network.b_idx[k]} == {0, 1}][:1]
    first = np.eye(4)
    first[:3, :3], first[:3, 3] = network.station_rotations[0], network.station_translations[0]
    return pose_network(network.station_ids[:2], [network.pair_ids[k] for k in e], network.a_idx[e], network.b_idx[e],
                        network.rotations[e], network.translations[e], network.cov[e], held={0: first})  # fmt: skip


def additions(network: PoseNetwork) -> list[list[Pair]]:
    """For every station from the third on, its pairs to earlier ones."""
    later = np.maximum(network.a_idx, network.b_idx)
    order = np.argsort(later, kind="stable")
    steps: list[list[Pair]] = [[] for _ in range(network.n_stations)]
    for e in order.tolist():
        steps[later[e]].append(as_pair(network, e))
    return steps[2:]


def difference(
    poses: tuple[FloatArray, FloatArray], network: PoseNetwork, batch: NetworkSolution
) -> tuple[float, float]:
    """Largest difference to a batch solution: in m, and in sigmas of the station."""
    order = np.array([network.index_of[s] for s in batch.network.station_ids])
    mine = Motions(poses[0][order], poses[1][order])
    d = (Motions(batch.rotations, batch.translations).inverse() @ mine).log()[1:]
    sigma = np.sqrt(np.diagonal(batch.precision.station_cov[1:], axis1=1, axis2=2))
    return float(np.linalg.norm(d[:, 3:], axis=1).max()), float((np.abs(d) / sigma).max())


@dataclass(frozen=True, eq=False)
class Grown:
    """ms: (k,) of processor time per addition, which a busy machine disturbs least.

    before, after: largest difference to batch (m, sigma) before and after finishing.
    """

    ms: FloatArray
    before: tuple[float, float]
    after: tuple[float, float]
    finish_s: float
    batch_s: float

    def __str__(self) -> str:
        k = min(1000, len(self.ms) // 3)
        rows = [("all", self.ms), (f"first {k}", self.ms[:k]), (f"last {k}", self.ms[-k:])]
        text = [f"{name}: median {np.median(x):.2f} ms, p95 {np.quantile(x, 0.95):.2f} ms, worst {x.max():.1f} ms"
                for name, x in rows]  # fmt: skip
        text.append(f"largest difference to batch {self.before[0]:.2g} m = {self.before[1]:.2g} sigma, after finishing "
                    f"({self.finish_s:.2f} s; batch from nothing {self.batch_s:.2f} s) {self.after[0]:.2g} m = "
                    f"{self.after[1]:.2g} sigma")  # fmt: skip
        return "\n".join(text)


def grow(nx: int, ny: int) -> Grown:
    """Add the stations of a corridor one at a time."""
    network = simulate(nx, ny).network
    session = NetworkSession(first_stations(network))
    ms = []
    for step in additions(network):
        begin = time.process_time()
        session.add(step)
        ms.append(1e3 * (time.process_time() - begin))
    present = session.poses()
    begin = time.perf_counter()
    finished = session.finish()
    finish_s = time.perf_counter() - begin
    begin = time.perf_counter()
    batch = solve_network(network)
    batch_s = time.perf_counter() - begin
    after = difference((finished.rotations, finished.translations), finished.network, batch)
    return Grown(np.array(ms), difference(present, finished.network, batch), after, finish_s, batch_s)


@dataclass(frozen=True, eq=False)
class Batch:
    """gradient: largest component over the largest it could be. redundancy_sum: of all redundancy numbers."""

    solution: NetworkSolution
    solve_s: float
    precision_s: float
    gradient: float
    redundancy_sum: float
    memory_gb: float

    def __str__(self) -> str:
        s = self.solution
        test = s.global_test(1e-3)
        band = f"{test.lower:.0f} to {test.upper:.0f}" if test else "none"
        sigma = np.sqrt(np.diagonal(s.precision.station_cov[:, 3:, 3:], axis1=1, axis2=2).max())
        return (
            f"{s.network.n_stations} stations, {s.network.n_pairs} pairs: solved in {self.solve_s:.1f} s, "
            f"{s.iterations} iterations, v'Pv {s.omega:.2f}, redundancy {s.redundancy}, band {band}, relative gradient "
            f"{self.gradient:.1g}, last step {s.max_step:.1g} sigma\nall variances and tests {self.precision_s:.1f} s, "
            f"sum of redundancy numbers {self.redundancy_sum:.4f}, largest sigma {sigma:.3g} m, {self.memory_gb:.2f} GB"
        )


def batch(nx: int, ny: int) -> Batch:
    """Solve a grid from nothing, with all variances and tests."""
    network = simulate(nx, ny).network
    begin = time.perf_counter()
    solution = solve_network(network)
    middle = time.perf_counter()
    total = float(solution.precision.pairs.redundancy.sum())
    end = time.perf_counter()
    if not np.isfinite(solution.precision.station_cov).all():
        raise ValueError("variances are missing")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return Batch(solution, middle - begin, end - middle, gradient(solution), total, memory)


def gradient(solution: NetworkSolution) -> float:
    """Largest component of the gradient over the norms of its column and of the residuals, by plain sums."""
    network = solution.network
    r, by_b, by_a, _ = network_jacobians(network, Motions(solution.rotations, solution.translations))
    W = network.whitening
    e = np.einsum("nij,nj->ni", W, r)
    g, size = np.zeros((2, network.n_stations, 6))
    for station, J in ((network.b_idx, W @ by_b), (network.a_idx, W @ by_a)):
        np.add.at(g, station, np.einsum("nji,nj->ni", J, e))
        np.add.at(size, station, (J**2).sum(axis=1))
    free = ~network.constants
    return float((np.abs(g) / np.sqrt(size))[free].max() / np.linalg.norm(e))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=["grow", "batch"])
    parser.add_argument("size", nargs="*", type=int)
    chosen = parser.parse_args(arguments)
    runs = [("grow", 5000, 2), ("batch", 10000, 10), ("batch", 25000, 4)]
    if chosen.what:
        runs = [(chosen.what, *chosen.size)]
    for what, nx, ny in runs:
        print(f"{what} {nx} x {ny}", flush=True)
        print(grow(nx, ny) if what == "grow" else batch(nx, ny), flush=True)


if __name__ == "__main__":
    main()
