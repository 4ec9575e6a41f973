"""Large simulated networks of stations as cases: grown one station at a time, or solved from nothing."""

from collections.abc import Callable
from dataclasses import dataclass

from adjust.model.survey import IntArray
from tests.benchmarks import networks
from tests.benchmarks.cases import Arrays
from tests.benchmarks.outcome import Competitor, Outcome


@dataclass(frozen=True, eq=False)
class Stations(Arrays):
    """A corridor of nx rows of ny stations."""

    nx: IntArray
    ny: IntArray


def grown(case: Stations) -> Competitor:
    """Stations added one by one, then finished."""

    def run() -> Outcome:
        done = networks.grow(int(case.nx), int(case.ny))
        numbers = {"before_m": done.before[0], "before_sigma": done.before[1], "after_sigma": done.after[1],
                   "batch_s": done.batch_s}  # fmt: skip
        return Outcome({"additions": float(done.ms.sum()) / 1e3, "finish": done.finish_s}, {"ms": done.ms}, "", numbers)

    return run


def from_nothing(case: Stations) -> Competitor:
    """Least squares, all variances, redundancy numbers and tests."""

    def run() -> Outcome:
        done = networks.batch(int(case.nx), int(case.ny))
        s = done.solution
        numbers = {"omega": s.omega, "redundancy": float(s.redundancy), "redundancy_sum": done.redundancy_sum,
                   "pairs": float(s.network.n_pairs), "gradient": done.gradient}  # fmt: skip
        stages = {"start, solve": done.solve_s, "precision": done.precision_s}
        return Outcome(stages, {}, f"{s.iterations} steps", numbers)

    return run


GROWN, BATCH = "ours: one by one", "ours: from nothing"
STATIONS: dict[str, Callable[[Stations], Competitor]] = {GROWN: grown, BATCH: from_nothing}
