"""What becomes of an adjusted project: its statistics, its result files, its place among the runs."""

from dataclasses import asdict, field, replace
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.native.parallel import Beside
from survey.folder.replacing import replace_parts
from survey.folder.text import atomic_write, time_text
from survey.jobs.excluding import author_name
from survey.project import Project
from survey.project.project import RESULTS
from survey.report.language import ENGLISH_PAGE, ReportOptions
from survey.report.results import RunInfo, begun_results, finished_results, summary_text
from survey.report.unsolved import JSON, PAGE, unsolved_files
from survey.solution.earlier.runs import Clock, installed_versions, plain_name, record_run
from survey.solution.quantities import USUAL, scale_of
from survey.solution.statistics import Statistics, statistics_of

UNSOLVED = (JSON, PAGE)
"""Files of an adjustment that failed."""


@frozen(eq=False)
class AdjustOutcome:
    """An adjusted project and where its results are. solution: all that ``solution.json`` holds."""

    adjustment: Adjustment
    run: RunInfo
    solution: dict[str, Any]
    paths: dict[str, Path] = field(default_factory=dict)
    statistics: Statistics | None = None

    def summary(self) -> dict[str, Any]:
        """``summary`` and ``warnings`` of the solution, with the paths written."""
        solution = self.solution
        return {
            "folder": self.run.folder,
            "summary": solution["summary"],
            "warnings": solution["warnings"],
            **{name: solution[name] for name in ("published",) if name in solution},
            "written": {name: str(path) for name, path in self.paths.items()},
        }

    def text(self) -> str:
        """The summary for people."""
        return summary_text(self.adjustment, self.run, self.solution)

    def at(self, target: Path) -> "AdjustOutcome":
        """The same with its files where they are now."""
        return replace(self, paths={name: target / RESULTS / name for name in self.paths})


def keep_failure(error: SurveyError, run: RunInfo, target: Path, place: Path, language: str) -> None:
    """Write what is known of an adjustment that failed to the results, and note that; an earlier solution stays.

    For who is changing ``target``, with ``place`` for what is new. Where it cannot be written the error is as it was.
    """
    files = unsolved_files(error, run, language)
    if not files:
        return
    try:
        (place / RESULTS).mkdir(parents=True, exist_ok=True)
        for name, content in files.items():
            atomic_write(place / RESULTS / name, content)
        replace_parts(target)
    except (OSError, SurveyError):
        return
    for name in files:
        error.add_note(f"written: {target / RESULTS / name}")


def kept_run(folder: Path, place: Path, project: Project, outcome: AdjustOutcome) -> tuple[str, ...]:
    """Keep what was adjusted among the runs of its project; the files of old runs that are to go."""
    who = author_name(project.options.identification)
    return record_run(folder, place, outcome.run, outcome.solution, who)


def made(
    project: Project, adjustment: Adjustment, place: Path, clock: Clock, report: ReportOptions = ENGLISH_PAGE,
    command: str = "", published: bool = False,
) -> AdjustOutcome:  # fmt: skip
    """The statistics of an adjusted project, and its result files made in ``place``. command: what asked for it.

    published: with the published methods beside it; raises SurveyError where none can be run.
    """
    run, beside = run_info(project, clock.seconds, command), {}
    if published:
        from survey.jobs.adjusting.published_methods import published_dict

        with clock.step("published methods"):
            beside = {"published": published_dict(adjustment, scale_of(adjustment, run.sigmas))}
    with Beside() as writing:
        with clock.step("report"):
            begun = begun_results(place, adjustment, run, report, writing, beside)
        with clock.step("statistics"):
            found = statistics_of(adjustment, project.options, scale_of(adjustment, run.sigmas))
        with clock.step("report"):
            solution, paths = finished_results(begun, adjustment, run, found, report)
    return AdjustOutcome(adjustment, run, solution, paths, found)


def run_info(project: Project, seconds: dict[str, float], command: str = "") -> RunInfo:
    """What was run, for result files. command: as it was given."""
    chosen = replace(project.options, tolerances=(), identification=())
    options = {k: v for k, v in asdict(chosen).items() if v not in ((), None)} | {"datum": project.survey.datum.kind}
    return RunInfo(
        plain_name(project.folder), project.title, project.inputs, options, installed_versions(), time_text(), seconds,
        project.options.sigmas or USUAL, project.options.identification, command,
        {"/".join(key): entry for key, entry in project.detected.items() if key in project.images},
        project.left_out, project.n_left_out, project.n_unused_in_files,
    )  # fmt: skip
