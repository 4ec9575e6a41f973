"""Large pose networks: ``python -m tests.benchmarks.networks [grow|late|batch NX NY]``, full size by default.

grow: stations added one at a time, time per addition and largest difference to the batch solution. late: the last ones
into a solved network, by a session and all at once. batch: a grid from nothing to its minimum with all variances and
tests; time, memory, v'Pv within its chi-square band, gradient.
"""

import argparse
import resource
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.pose_network import PoseNetwork
from adjust.pose_network.start import carried
from adjust.precision.precision import global_test
from adjust.relay.session import NetworkSession
from adjust.spatial.rigid_motions import Motions
from tests.adjust.pose_networks import Solved, network_jacobians, simulate, solve_network

T = TypeVar("T")


def as_pair(network: PoseNetwork, e: int) -> Pair:
    """A pair of the arrays as an observation."""
    a, b = (FrameRef("station", network.station_ids[i[e]]) for i in (network.a_idx, network.b_idx))
    return Pair(network.pair_ids[e], a, b, Pose3(Rot3(network.rotations[e]), network.translations[e]), network.cov[e])


def first_stations(network: PoseNetwork) -> Survey:
    """The first two stations and the pair between them, the first one held as in the whole."""
    whole = network.as_survey
    pair = next(p for p in whole.pairs if {p.a.frame_id, p.b.frame_id} == set(network.station_ids[:2]))
    return replace(whole, stations=whole.stations[:2], pairs=(pair,))


def additions(network: PoseNetwork) -> list[list[Pair]]:
    """For every station from the third on, its pairs to earlier ones."""
    later = np.maximum(network.a_idx, network.b_idx)
    order = np.argsort(later, kind="stable")
    steps: list[list[Pair]] = [[] for _ in range(network.n_stations)]
    for e in order.tolist():
        steps[later[e]].append(as_pair(network, e))
    return steps[2:]


def difference(poses: Mapping[str, Pose3], batch: Solved) -> tuple[float, float]:
    """Largest difference to a batch solution: in m, and in sigmas of the station."""
    T = np.array([poses[s].matrix() for s in batch.network.station_ids])
    mine = Motions(T[:, :3, :3], T[:, :3, 3])
    free = ~batch.network.constants
    d = (Motions(batch.rotations, batch.translations).inverse() @ mine).log()[free]
    sigma = np.sqrt(np.diagonal(batch.station_cov[free], axis1=1, axis2=2))
    return float(np.linalg.norm(d[:, 3:], axis=1).max()), float((np.abs(d) / sigma).max())


def adjusted(finished: Adjustment) -> dict[str, Pose3]:
    """Adjusted ``world_from_station`` by station."""
    return {n[1]: e.value for n, e in finished.estimates.items() if isinstance(e.value, Pose3)}


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
    return Grown(np.array(ms), difference(present, batch), difference(adjusted(finished), batch), finish_s, batch_s)


@dataclass(frozen=True, eq=False)
class Batch:
    """gradient: largest component over the largest it could be. redundancy_sum: of all redundancy numbers."""

    solution: Solved
    solve_s: float
    precision_s: float
    gradient: float
    redundancy_sum: float
    memory_gb: float

    def __str__(self) -> str:
        s = self.solution
        test = global_test(s.omega, s.redundancy, 1e-3)
        band = f"{test.lower:.0f} to {test.upper:.0f}" if test else "none"
        sigma = np.sqrt(np.diagonal(s.station_cov[:, 3:, 3:], axis1=1, axis2=2).max())
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
    total = float(solution.pairs.redundancy.sum())
    end = time.perf_counter()
    if not np.isfinite(solution.station_cov).all():
        raise ValueError("variances are missing")
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    return Batch(solution, middle - begin, end - middle, gradient(solution), total, memory)


def gradient(solution: Solved) -> float:
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


def late(nx: int, ny: int, n: int = 20) -> str:
    """The last stations into a solved network: by a session, and by one adjustment from the values before."""
    network = simulate(nx, ny).network
    whole, new = network.as_survey, [pair for step in additions(network)[-n:] for pair in step]
    names, ids = set(network.station_ids[-n:]), {pair.pair_id for pair in new}
    first = replace(whole, stations=tuple(s for s in whole.stations if s.station_id not in names),
                    pairs=tuple(p for p in whole.pairs if p.pair_id not in ids))  # fmt: skip
    before = adjust(first)
    session, begin = timed(lambda: NetworkSession(before))
    _, add = timed(lambda: session.add(new))
    finished, finish = timed(session.finish)

    def at_once() -> Adjustment:
        poses = adjusted(before) | carried(adjusted(before), new)
        return adjust(whole, StartValues({}, {("world_from_station", s): p for s, p in poses.items()}, {}))

    solved, once = timed(at_once)
    assert abs(finished.omega - solved.omega) < 1e-9 * solved.omega
    parts = f"its tree {begin:.2f}, the addition {add:.3f}, finishing {finish:.2f}"
    return (f"{n} stations more, seconds of processor time: a session {begin + add + finish:.2f} ({parts}), at once "
            f"from the last solution {once:.2f}")  # fmt: skip


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What it gives, and the seconds of processor time that it takes."""
    begin = time.process_time()
    return work(), time.process_time() - begin


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="?", choices=["grow", "late", "batch"])
    parser.add_argument("size", nargs="*", type=int)
    chosen = parser.parse_args(arguments)
    runs = [("grow", 5000, 2), ("late", 5000, 2), ("batch", 10000, 10), ("batch", 25000, 4)]
    if chosen.what:
        runs = [(chosen.what, *chosen.size)]
    for what, nx, ny in runs:
        print(f"{what} {nx} x {ny}", flush=True)
        print({"grow": grow, "late": late, "batch": batch}[what](nx, ny), flush=True)


if __name__ == "__main__":
    main()
