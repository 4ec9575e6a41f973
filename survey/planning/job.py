"""The job behind ``labsurvey plan``: predict, choose, budget, simulate, place beacons, and write the page."""

import sys
import time
from pathlib import Path

from tqdm import tqdm

from adjust.design import (
    Budget,
    Tolerance,
    Trials,
    budget,
    exact,
    expect,
    run_trials,
    select,
    tolerances,
    weak_directions,
)
from adjust.design.selection import Criterion
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import json_text
from survey.jobs.adjusting.steps import adjust_project
from survey.planning.building import Planned, build_plan
from survey.planning.navigation import plan_navigation
from survey.planning.page import plan_page
from survey.planning.plan_file import read_plan
from survey.planning.summary import PlanResult, plan_summary
from survey.planning.text import plan_text
from survey.planning.wanted import required_sigmas, wanted_components
from survey.project import Project, atomic_write, read
from survey.project.project import RESULTS
from survey.solution.network.counts import network_dict, pair_network


@frozen
class PlanRequest:
    """What is asked of a plan.

    wanted: patterns of components (none: those of plan.toml, else everything). add: how many candidates to choose.
    trials: of the Monte Carlo; workers: processes for them, None for one per core. navigation: precision of the
    navigated poses; place: how many beacons to place for them.
    """

    wanted: tuple[str, ...] = ()
    add: int = 5
    criterion: Criterion = "D"
    trials: int = 0
    seed: int = 0
    workers: int | None = None
    navigation: bool = False
    place: int = 0


class PlanningOutcome(PlanResult):
    """What was planned, told."""

    def summary(self) -> dict[str, object]:
        """As plain values."""
        return plan_summary(self)

    def text(self) -> str:
        """For people."""
        return plan_text(self)


def planning_job(
    folder: Path, request: PlanRequest = PlanRequest(), *, out: Path | None = None, progress: bool = True
) -> PlanningOutcome:
    """Plan what plan.toml lists beside what is measured already; writes ``results/plan.html`` and ``plan.json``.

    Raises SurveyError, and IndeterminateError naming what the plan leaves open.
    """
    target = Path(out or folder)
    with changing(target) as place:
        outcome = _planned(Path(folder), request, progress)
        names = _make(outcome, place / RESULTS)
        replace_parts(target)
    outcome.paths.update({name: target / RESULTS / name for name in names})
    return outcome


def _planned(folder: Path, request: PlanRequest, progress: bool) -> PlanningOutcome:
    begin = time.perf_counter()
    project = read(folder)
    plan = read_plan(folder, project.survey)
    existing, notes = _existing(project, progress)
    planned = build_plan(project, plan, existing, notes)
    built = time.perf_counter()
    expected = expect(planned.survey, planned.start)
    wanted = wanted_components(expected, request.wanted or plan.wanted)
    solved = time.perf_counter()
    selection = None
    if planned.candidates and request.add:
        selection = select(
            planned.survey, planned.start, planned.candidates, wanted, request.add, request.criterion, expected
        )
    required = required_sigmas(expected, plan.required)
    shares: Budget | None = None
    allowed: tuple[Tolerance, ...] = ()
    if required and not expected.datum_defect:
        shares = budget(expected, tuple(required))
        allowed = tolerances(shares, dict(enumerate(required.values())))
    chosen = time.perf_counter()
    trials = _trials(planned, expected, request, progress) if request.trials else None
    network = network_dict(pair_network(planned.survey)) if planned.survey.pairs else None
    navigation = None
    if request.navigation or request.place:
        navigation = plan_navigation(plan, expected, request.place)
    seconds = {"predict": built - begin, "expect": solved - built, "choose": chosen - solved,
               "simulate and navigate": time.perf_counter() - chosen}  # fmt: skip
    return PlanningOutcome(
        folder, project.title, plan, planned, expected, weak_directions(expected), wanted, selection, required, shares,
        allowed, trials, network, navigation, seconds,
    )  # fmt: skip


def _existing(project: Project, progress: bool) -> tuple[Adjustment | None, list[str]]:
    """What is observed already, adjusted for its values; without, where it does not suffice for that."""
    survey = project.survey
    terrestrial = (survey.readings, survey.coordinate_differences, survey.levels, survey.on_surfaces)
    if not (survey.image_blocks or project.spots or survey.pairs or any(terrestrial)):
        lying = len(project.images)
        return None, [f"{lying} images without detections are not counted; detect them first"] if lying else []
    try:
        return adjust_project(project, progress), []
    except SurveyError as error:
        first = str(error).splitlines()[0]
        return None, [f"what is measured so far cannot be adjusted alone ({first}); values are those of survey.toml"]


def _trials(planned: Planned, expected: Adjustment, request: PlanRequest, progress: bool) -> Trials:
    ideal = exact(planned.survey, planned.start)
    with tqdm(total=request.trials, desc="simulating", unit="survey", disable=not progress, file=sys.stderr) as bar:

        def step(done: int) -> None:
            bar.update(done - bar.n)

        return run_trials(ideal, planned.start, expected, request.trials, request.seed, request.workers, step)


def _make(outcome: PlanningOutcome, place: Path) -> tuple[str, ...]:
    atomic_write(place / "plan.html", plan_page(outcome))
    content = {k: v for k, v in outcome.summary().items() if k not in ("folder", "written", "seconds")}
    atomic_write(place / "plan.json", json_text(content))
    return ("plan.html", "plan.json")
