"""Large simulated networks of stations as cases: grown one at a time, by ``labsurvey add``, or solved from nothing."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

from adjust.model.survey import IntArray, Survey
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.network import add_job
from survey.project import write_project
from tests.adjust.pose_networks import simulate
from tests.benchmarks import networks
from tests.benchmarks.cases import Arrays
from tests.benchmarks.outcome import Competitor, Outcome

LATE = 10
"""Stations that ``labsurvey add`` adds."""


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


def added(case: Stations) -> Competitor:
    """The command ``labsurvey add``: the last stations into an adjusted project, everything read and written."""

    def run() -> Outcome:
        whole = simulate(int(case.nx), int(case.ny)).network.as_survey
        old = {s.station_id for s in whole.stations[:-LATE]}
        inside = [p.a.frame_id in old and p.b.frame_id in old for p in whole.pairs]
        known, late = (tuple(p for p, i in zip(whole.pairs, inside, strict=True) if i == which)
                       for which in (True, False))  # fmt: skip
        with tempfile.TemporaryDirectory() as place:
            lab, new = Path(place) / "lab", Path(place) / "new"
            write_project(lab, Survey(stations=whole.stations[:-LATE], pairs=known))
            write_project(new, Survey(stations=whole.stations[-LATE:], pairs=late))
            sections = "".join(f"[stations.{s.station_id}]\n" for s in whole.stations[-LATE:])
            (new / "survey.toml").write_text(f"format = 1\n{sections}")
            adjust_job(lab, progress=False)
            begin = perf_counter()
            done = add_job(lab, new, progress=False)
            total = perf_counter() - begin
        stages = dict(done.outcome.run.seconds)
        numbers = {"sigma0": done.outcome.solution["summary"]["sigma0"], "pairs": float(len(whole.pairs))}
        return Outcome({**stages, "files": total - sum(stages.values())}, {}, done.start, numbers)

    return run


GROWN, BATCH, ADDED = "ours: one by one", "ours: from nothing", "labsurvey add"
STATIONS: dict[str, Callable[[Stations], Competitor]] = {GROWN: grown, BATCH: from_nothing, ADDED: added}
