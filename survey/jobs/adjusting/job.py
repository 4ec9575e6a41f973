"""The jobs behind the commands: read, detect, adjust, write."""

import os
import platform
import shlex
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from tqdm import tqdm

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.result import Adjustment
from adjust.model.survey import IntArray, Survey
from adjust.statistics.cleaned import adjust_cleaned
from adjust.statistics.lost_points import without_lost_points
from adjust.statistics.supported import lost_notes, supported
from survey.folder.replacing import changing, replace_parts
from survey.jobs.adjusting.explained import checked
from survey.jobs.adjusting.options import clean_options
from survey.jobs.adjusting.symmetric_boards import consistent_turns
from survey.jobs.detecting import detect_in, detect_job, remember_images
from survey.jobs.identify import Identification, identify_spots, without_points
from survey.project import Project, read
from survey.project.detected import DetectedImage
from survey.project.project import RESULTS
from survey.report.results import ENGLISH_PAGE, ReportOptions, RunInfo, make_results, solution_dict, summary_text
from survey.solution.quantities import USUAL, scale_of
from survey.solution.statistics import Statistics, statistics_of

_PACKAGES = ("labsurvey", "gtsam", "numpy", "scipy", "opencv-contrib-python-headless")


_OTHERS = ("table_readings", "pairs", "distances", "coordinates", "readings", "coordinate_differences", "levels",
           "alignments", "laser_spots", "on_surfaces")  # fmt: skip


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
    said = said or command_line("adjust", folder, redetect=redetect, method=chosen, out=out)
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
        with clock.step("adjust"):
            adjustment = adjust_project(project, progress)
        outcome = made(project, adjustment, place, clock, report, said, published=method == "published")
        replace_parts(target)
    return outcome.at(target)


def command_line(command: str, folder: Path, *words: str | Path, **flags: Any) -> str:
    """A command as it can be given again, with its options; folders by their names, as results may be moved."""
    said = [f"--{name}" if value is True else f"--{name} {_shown(value)}" for name, value in flags.items() if value]
    return " ".join(["labsurvey", command, _shown(folder), *map(_shown, words), *said])


def _shown(value: Any) -> str:
    return shlex.quote(_plain_name(value) if isinstance(value, Path) else
                       str(value).encode("utf-8", "surrogateescape").decode("utf-8", "replace"))  # fmt: skip


def _plain_name(folder: Path) -> str:
    """The name alone: results of a copied folder stay the same; by its bytes: a terminal without UTF-8 garbles it."""
    return os.fsencode(folder.resolve().name).decode("utf-8", "replace")


def image_warnings(images: Mapping[tuple[str, str], DetectedImage]) -> tuple[str, ...]:
    """Boards of a wrong size, once each; images in which nothing was found for another reason, or not readable.

    At every adjustment, not only at the first.
    """
    sizes = dict.fromkeys(entry.wrong_size for entry in images.values() if entry.wrong_size)
    return tuple(f"detection: {text}" for text in sizes) + tuple(
        f"detection: {entry.file}: {entry.status}{': ' + entry.message if entry.message else ''}"
        for entry in images.values()
        if entry.status == "failed" or (entry.status == "nothing" and not entry.wrong_size)
    )  # fmt: skip


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
    with clock.step("statistics"):
        found = statistics_of(adjustment, project.options.tolerances, scale_of(adjustment, run.sigmas))
    with clock.step("report"):
        solution = solution_dict(adjustment, run, found) | beside
        paths = make_results(place, adjustment, run, solution, found, report)
    return AdjustOutcome(adjustment, run, solution, paths, found)


Begin = Callable[[Survey], StartValues | None]


def adjust_project(
    project: Project, progress: bool, begin: Begin = lambda _: None, watch: Callable[[int, float], None] | None = None
) -> Adjustment:
    """Adjust what was read. begin: start values of a survey, found where it gives None. Raises SurveyError.

    watch: called with (iteration, v'Pv); what it raises ends the adjustment.
    """
    survey = project.survey
    observed = (
        survey.image_blocks, project.spots, survey.pairs, survey.distances, survey.coordinates, survey.readings,
        survey.coordinate_differences, survey.levels, survey.alignments, survey.laser_spots, survey.on_surfaces,
    )  # fmt: skip
    if not any(observed):
        raise SurveyError(
            f"{project.folder}: there is nothing to adjust; put images at images/<camera_id>/<epoch_id>.png or tables "
            "into observations/"
        )
    if project.options.pairs == "closed" and survey.pairs:
        from adjust.relay.closed import closed  # here: a survey without pairs starts without it

        survey = closed(survey, project.options.closures)
    options = AdjustOptions(project.options.alpha, project.options.reject_blocks, project.options.reject_points)
    survey, turned = consistent_turns(survey, project.target_kinds)
    project = replace(project, survey=survey)
    with tqdm(desc="adjusting", unit=" steps", disable=not progress, file=sys.stderr, leave=False) as bar:

        def step(iteration: int, omega: float) -> None:
            bar.set_postfix_str(f"v'Pv = {omega:.6g}")
            bar.update()
            if watch is not None:
                watch(iteration, omega)

        notes = turned
        if project.spots:
            found = _identify(project, options, step, begin)
            notes += found.notes
            if found.unidentified:
                notes += (f"{found.unidentified} of {found.identified + found.unidentified} spots are no known beacon",)
            survey = replace(survey, image_blocks=survey.image_blocks + found.blocks)
            survey = seen_points(survey)
        how = clean_options(project.options)
        survey, lost = supported(survey)
        result = checked(
            survey, lambda: without_lost_points(survey, lambda part: adjust_cleaned(part, how, step, begin(part)))
        )
    return told(project, survey, replace(result, warnings=result.warnings + notes + lost_notes(lost)))


def told(project: Project, given: Survey, adjustment: Adjustment) -> Adjustment:
    """An adjustment that says what was noticed when its project was read, and how much of ``given`` it left out."""
    warnings = adjustment.warnings + project.notes + project.image_notes + image_warnings(project.detected)
    images = sum(len(b.uv) if b.used is None else int(b.used.sum()) for b in given.image_blocks)
    images -= int(adjustment.image_residuals.used.sum())
    others = sum(o.used for kind in _OTHERS for o in getattr(given, kind))
    others -= sum(o.used for kind in _OTHERS for o in getattr(adjustment.survey, kind))
    return replace(adjustment, warnings=warnings, n_screened=images + others)


def _identify(
    project: Project, options: AdjustOptions, step: Callable[[int, float], None], begin: Begin
) -> Identification:
    gate = project.spots_request.gate_px if project.spots_request is not None else 15.0
    try:
        part = supported(without_points(project.survey))[0]
        first = adjust(part, begin(part), options, step)
    except IndeterminateError as error:
        raise SurveyError(
            f"{project.folder}/observations: the spots cannot be identified, because cameras and stations are not "
            f"determined without them; name the spots' beacons in image_points.csv, or hold a board\n({error})"
        ) from error
    return identify_spots(project.survey, first, project.spots, gate)


def seen_points(survey: Survey) -> Survey:
    """Leave out the beacons that nothing observes any more: a beacon may be hidden in all images."""
    observed = {survey.points[int(i)].point_id for b in survey.image_blocks if b.target_id is None for i in b.point_idx}
    observed |= {r.point_id for c in survey.coordinates for r in c.positions if r.frame is None}
    refs = [r for d in survey.coordinate_differences for r in (*d.at, *d.to)]
    refs += [o.position for o in survey.on_surfaces]
    refs += [r for x in survey.readings for r in (x.at, x.to, x.second) if r is not None]
    observed |= {r.point_id for r in refs if r.frame is None}
    kept = tuple(p for p in survey.points if p.point_id in observed or p.x_in_world.treatment != "free")
    if len(kept) == len(survey.points):
        return survey
    ids = {p.point_id: i for i, p in enumerate(kept)}
    blocks = tuple(
        b if b.target_id is not None
        else replace(b, point_idx=_reindexed(survey, b, ids))
        for b in survey.image_blocks
    )  # fmt: skip
    distances = tuple(
        d for d in survey.distances if all(r.frame is not None or r.point_id in ids for r in (d.a, d.b))
    )
    return replace(survey, points=kept, image_blocks=blocks, distances=distances)


def _reindexed(survey: Survey, block: ImageBlock, ids: dict[str, int]) -> IntArray:
    return np.array([ids[survey.points[int(i)].point_id] for i in block.point_idx], dtype=np.int64)


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
