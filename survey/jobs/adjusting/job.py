"""The jobs behind the commands: read, detect, adjust, write."""

import os
import platform
import shlex
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.native.parallel import Beside
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.detecting import author_name, detect_in, detect_job, remember_images
from survey.project import Project, read
from survey.project.project import RESULTS
from survey.report.results import (
    ENGLISH_PAGE,
    ReportOptions,
    RunInfo,
    begun_results,
    finished_results,
    summary_text,
)  # fmt: skip
from survey.report.unsolved import JSON, PAGE, unsolved_files
from survey.solution.earlier.runs import record_run, remove_empty
from survey.solution.quantities import USUAL, scale_of
from survey.solution.statistics import Statistics, statistics_of

_PACKAGES = ("labsurvey", "gtsam", "numpy", "scipy", "opencv-contrib-python-headless")


@dataclass(frozen=True, eq=False)
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


class Clock:
    """How long each step took."""

    def __init__(self, seconds: Mapping[str, float] = MappingProxyType({})) -> None:
        self.seconds: dict[str, float] = dict(seconds)

    @contextmanager
    def step(self, name: str) -> Iterator[None]:
        """Time what is done inside."""
        begin = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - begin


def adjust_job(
    folder: Path,
    *,
    out: Path | None = None,
    progress: bool = True,
    redetect: bool = False,
    report: ReportOptions = ENGLISH_PAGE,
    method: str = "joint",
    said: str = "",
) -> AdjustOutcome:
    """The main job: detect where that has not been done, adjust everything, write the results. Raises SurveyError.

    method: "published" runs the published step-by-step methods too and sets them beside the adjustment. said: the
    command that asked for it, where it is not ``adjust``.
    """
    clock, folder = Clock(), Path(folder)
    target = folder if out is None else Path(out)
    chosen = None if method == "joint" else method
    said = said or command_line("adjust", folder, redetect=redetect, parquet=report.parquet, method=chosen, out=out)
    with changing(target) as place:

        def detected() -> None:
            with clock.step("detect"):
                if out is None:
                    detect_in(folder, place, jobs=None, pictures=False, progress=progress, everything=redetect)
                else:
                    detect_job(folder, progress=progress, everything=redetect)

        with clock.step("read"):
            project = read(folder)
        nothing_yet = bool(project.images) and not (project.survey.image_blocks or project.spots)
        if redetect or project.to_detect or (nothing_yet and not project.detected):
            detected()
            with clock.step("read"):
                project = read(folder)
        elif project.images and out is None:
            project = replace(project, detected=remember_images(folder, place))
        try:
            adjustment = adjust_project(project, progress, timed=clock.step)
        except SurveyError as error:
            keep_failure(error, run_info(project, clock.seconds, said), target, place, report.language)
            raise
        outcome = made(project, adjustment, place, clock, report, said, published=method == "published")
        gone = () if out is not None else kept_run(folder, place, project, outcome)
        replace_parts(target, gone=gone)
        for name in (JSON, PAGE):  # of a failure before
            (target / RESULTS / name).unlink(missing_ok=True)
    remove_empty(target, gone)
    return outcome.at(target)


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
    return record_run(folder, place, outcome.adjustment, outcome.run, outcome.solution, who)


def command_line(command: str, folder: Path, *words: str | Path, **flags: object) -> str:
    """A command as it can be given again, with its options; folders by their names, as results may be moved."""
    said = [f"--{name}" if value is True else f"--{name} {_shown(value)}" for name, value in flags.items() if value]
    return " ".join(["labsurvey", command, _shown(folder), *map(_shown, words), *said])


def _shown(value: object) -> str:
    return shlex.quote(_plain_name(value) if isinstance(value, Path) else
                       str(value).encode("utf-8", "surrogateescape").decode("utf-8", "replace"))  # fmt: skip


def _plain_name(folder: Path) -> str:
    """The name alone: results of a copied folder stay the same; by its bytes: a terminal without UTF-8 garbles it."""
    return os.fsencode(folder.resolve().name).decode("utf-8", "replace")


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
            found = statistics_of(adjustment, project.options.tolerances, scale_of(adjustment, run.sigmas))
        with clock.step("report"):
            solution, paths = finished_results(begun, adjustment, run, found, report)
    return AdjustOutcome(adjustment, run, solution, paths, found)


def run_info(project: Project, seconds: dict[str, float], command: str = "") -> RunInfo:
    """What was run, for result files. command: as it was given."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    chosen = replace(project.options, tolerances=(), identification=())
    options = {k: v for k, v in asdict(chosen).items() if v not in ((), None)} | {"datum": project.survey.datum.kind}
    date = datetime.now(UTC).isoformat(timespec="seconds")
    name = _plain_name(project.folder)
    said = project.options.identification
    sigmas = project.options.sigmas or USUAL
    images = {"/".join(key): entry for key, entry in project.detected.items() if key in project.images}
    return RunInfo(
        name, project.title, project.inputs, options, versions, date, seconds, sigmas, said, command=command,
        images=images, left_out=project.left_out, n_left_out=project.n_left_out,
        n_unused_in_files=project.n_unused_in_files,
    )  # fmt: skip
