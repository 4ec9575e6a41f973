"""The jobs behind the commands: read, detect, adjust, write."""

import os
import platform
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from adjust.adjustment import AdjustOptions, adjust
from adjust.errors import IndeterminateError, SurveyError
from adjust.lost_points import without_lost_points
from adjust.model import IntArray, Survey
from adjust.observations import ImageBlock
from adjust.result import Adjustment
from adjust.statistics.cleaned import adjust_cleaned
from survey.board_sizes import wrong_sizes
from survey.checked import checked
from survey.cleaning import clean_options
from survey.files import Definition, Project, SpotBlock, read, read_definition, write_image_points, write_spots
from survey.files.project import RESULTS
from survey.identify import Identification, identify_spots, without_points
from survey.quantities import USUAL, scale_of
from survey.replacing import changing, replace_parts
from survey.results import ENGLISH_PAGE, ReportOptions, RunInfo, make_results, solution_dict, summary_text
from survey.statistics import Statistics, statistics_of
from survey.symmetric_boards import consistent_turns
from survey.targets import DetectableTarget, PointList

if TYPE_CHECKING:  # brings in OpenCV, which a folder that is detected already does without
    from survey.detection import DetectionTask, ImageReport

PICTURES = "detected"
_PACKAGES = ("labsurvey", "gtsam", "numpy", "scipy", "opencv-contrib-python-headless", "numba")


@dataclass(frozen=True)
class DetectOutcome:
    """What detection did: one report per image, and the files written. wrong_sizes: by target id, said once each."""

    folder: Path
    reports: "tuple[ImageReport, ...]"
    paths: tuple[Path, ...]
    wrong_sizes: Mapping[str, str] = field(default_factory=dict)

    @property
    def messages(self) -> tuple[str, ...]:
        """One line per image."""
        return tuple(f"{r.path}: {r.status}{': ' + r.message if r.message else ''}" for r in self.reports)

    @property
    def problems(self) -> tuple[str, ...]:
        """Boards of a wrong size; then the images in which nothing was found for another reason, or not readable."""
        lines = (m for m, r in zip(self.messages, self.reports, strict=True) if r.status != "found" and self._news(r))
        return (*self.wrong_sizes.values(), *lines)

    def _news(self, report: "ImageReport") -> bool:
        missed = {t for t, d in report.detections.items() if not len(d)}
        return report.status == "failed" or not missed or not missed <= self.wrong_sizes.keys()

    def summary(self) -> dict[str, Any]:
        """Counts as plain values."""
        return {
            "folder": str(self.folder),
            "images": len(self.reports),
            "found": sum(r.status == "found" for r in self.reports),
            "nothing": sum(r.status == "nothing" for r in self.reports),
            "failed": sum(r.status == "failed" for r in self.reports),
            "image_points": sum(len(d) for r in self.reports for d in r.detections.values()),
            "spots": sum(len(r.spots) for r in self.reports if r.spots is not None),
            "warnings": list(self.wrong_sizes.values()),
            "written": [str(p) for p in self.paths],
        }

    def text(self) -> str:
        """The counts, and every image that gave nothing, for people."""
        s = self.summary()
        head = f"{self.folder}: {s['found']} of {s['images']} images show {s['image_points']} target points"
        head += f" and {s['spots']} spots" if s["spots"] else ""
        return "\n".join([head, *(f"  {line}" for line in self.problems)])


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
            "written": {name: str(path) for name, path in self.paths.items()},
        }

    def text(self) -> str:
        """The summary for people."""
        return summary_text(self.adjustment, self.run, self.solution)

    def at(self, target: Path) -> "AdjustOutcome":
        """The same with its files where they are now."""
        return replace(self, paths={name: target / RESULTS / name for name in self.paths})


def detect_job(
    folder: Path, *, jobs: int | None = None, pictures: bool = False, progress: bool = True
) -> DetectOutcome:
    """Find targets and spots in all images of a project, and write their tables.

    Raises SurveyError where there is nothing to look at or to look for.
    """
    with changing(folder) as place:
        return _detect(Path(folder), place, jobs, pictures, progress)


def _detect(folder: Path, place: Path, jobs: int | None, pictures: bool, progress: bool) -> DetectOutcome:
    from survey.detection import detect_images

    definition = read_definition(folder)
    tasks = list(_tasks(definition))
    if not definition.images:
        raise SurveyError(f"{folder}/images: no images; put them at images/<camera_id>/<epoch_id>.png")
    if not tasks:
        raise SurveyError(
            f"{folder}/survey.toml: nothing to look for; name a target that can be detected (checkerboard, charuco, "
            "marker_grid, marker_block) or a table [spots]"
        )
    reports = detect_images(tasks, jobs=jobs, progress=progress, pictures=place / PICTURES if pictures else None)
    blocks, spots = _blocks(definition, reports)
    wrong = wrong_sizes(folder, definition, reports)
    if not blocks and not spots:
        if wrong:
            raise SurveyError("\n".join(wrong.values()))
        lines = "\n".join(f"  {r.path}: {r.message}" for r in reports[:10])
        raise SurveyError(f"{folder}: no target and no spot was found in {len(reports)} images:\n{lines}")
    # an empty table is written too: one of an earlier run must not stay behind
    files = [write_image_points(place, blocks, definition.survey)]
    files += [write_spots(place, spots)] if definition.spots_request is not None else []
    names = [path.relative_to(place) for path in files]
    replace_parts(folder, gone=[name.with_suffix(".parquet").as_posix() for name in names])
    return DetectOutcome(folder, tuple(reports), tuple(folder / name for name in names), wrong)


def _tasks(definition: Definition) -> "Iterator[DetectionTask]":
    """Every image with what may be in it: all targets, except on images that are reserved for spots."""
    from survey.detection import DetectionTask, SpotOptions

    request = definition.spots_request
    targets: dict[str, DetectableTarget] = {
        target_id: kind for target_id, kind in definition.target_kinds.items() if not isinstance(kind, PointList)
    }
    for (camera_id, epoch_id), path in definition.images.items():
        wanted = request is not None and camera_id in request.cameras
        reserved = wanted and request is not None and request.epochs is not None and epoch_id in request.epochs
        spots = None
        if wanted and request is not None and (reserved or (request.epochs is None and not targets)):
            spots = SpotOptions(diameter_px=request.diameter_px)
        only = definition.target_cameras
        here = {} if reserved else {t: k for t, k in targets.items() if camera_id in only.get(t, (camera_id,))}
        if here or spots:
            yield DetectionTask(path, camera_id, epoch_id, here, spots)


def _blocks(definition: Definition, reports: "Sequence[ImageReport]") -> tuple[list[ImageBlock], list[SpotBlock]]:
    sizes = {c.camera_id: c.image_size for c in definition.survey.cameras}
    blocks, spots = [], []
    for report in reports:
        size = report.image_size
        if size is not None and size != sizes[report.camera_id]:
            raise SurveyError(
                f"{report.path}: the image is {size[0]} x {size[1]} px, but survey.toml says camera "
                f"{report.camera_id!r} has {sizes[report.camera_id][0]} x {sizes[report.camera_id][1]}; correct "
                "image_size_px or take the right image"
            )
        for target_id, found in report.detections.items():
            if len(found):
                blocks.append(
                    ImageBlock(report.camera_id, report.epoch_id, target_id, found.point_idx, found.uv, found.cov)
                )
        if report.spots is not None and len(report.spots):
            names = tuple(f"s{i + 1}" for i in range(len(report.spots)))
            spots.append(SpotBlock(report.camera_id, report.epoch_id, names, report.spots.uv, report.spots.cov))
    return blocks, spots


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
) -> AdjustOutcome:
    """The main job: detect where that has not been done, adjust everything, write the results. Raises SurveyError."""
    clock, folder = Clock(), Path(folder)
    target = folder if out is None else Path(out)
    messages: tuple[str, ...] = ()
    with changing(target) as place:

        def detected() -> tuple[str, ...]:
            with clock.step("detect"):
                if out is None:
                    return _detect(folder, place, None, False, progress).problems
                return detect_job(folder, progress=progress).problems

        if redetect:
            messages = detected()
        with clock.step("read"):
            project = read(folder)
        if project.images and not redetect and not (project.survey.image_blocks or project.spots):
            messages = detected()
            with clock.step("read"):
                project = read(folder)
        with clock.step("adjust"):
            adjustment = adjust_project(project, progress)
        notes = tuple(f"detection: {m}" for m in messages)
        adjustment = replace(adjustment, warnings=adjustment.warnings + notes)
        outcome = made(project, adjustment, place, clock, report)
        replace_parts(target)
    return outcome.at(target)


def made(
    project: Project, adjustment: Adjustment, place: Path, clock: Clock, report: ReportOptions = ENGLISH_PAGE
) -> AdjustOutcome:
    """The statistics of an adjusted project, and its result files made in ``place``."""
    run = run_info(project, clock.seconds)
    with clock.step("statistics"):
        found = statistics_of(adjustment, project.options.tolerances, scale_of(adjustment, run.sigmas))
    with clock.step("report"):
        solution = solution_dict(adjustment, run, found)
        paths = make_results(place, adjustment, run, solution, found, report)
    return AdjustOutcome(adjustment, run, solution, paths, found)


def adjust_project(project: Project, progress: bool) -> Adjustment:
    """Adjust what was read. Raises SurveyError."""
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
    options = AdjustOptions(project.options.alpha, project.options.reject_blocks, project.options.reject_points)
    survey, turned = consistent_turns(survey, project.target_kinds)
    project = replace(project, survey=survey)
    with tqdm(desc="adjusting", unit=" steps", disable=not progress, file=sys.stderr, leave=False) as bar:

        def step(_iteration: int, omega: float) -> None:
            bar.set_postfix_str(f"v'Pv = {omega:.6g}")
            bar.update()

        notes = turned
        if project.spots:
            found = _identify(project, options, step)
            notes += found.notes
            if found.unidentified:
                notes += (f"{found.unidentified} of {found.identified + found.unidentified} spots are no known beacon",)
            survey = replace(survey, image_blocks=survey.image_blocks + found.blocks)
            survey = _seen_points(survey)
        how = clean_options(project.options)
        result = checked(survey, lambda: without_lost_points(survey, lambda part: adjust_cleaned(part, how, step)))
    return replace(result, warnings=result.warnings + notes)


def _identify(project: Project, options: AdjustOptions, step: Callable[[int, float], None]) -> Identification:
    gate = project.spots_request.gate_px if project.spots_request is not None else 15.0
    try:
        first = adjust(without_points(project.survey), options=options, progress=step)
    except IndeterminateError as error:
        raise SurveyError(
            f"{project.folder}/observations: the spots cannot be identified, because cameras and stations are not "
            f"determined without them; name the spots' beacons in image_points.csv, or hold a board\n({error})"
        ) from error
    return identify_spots(project.survey, first, project.spots, gate)


def _seen_points(survey: Survey) -> Survey:
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


def run_info(project: Project, seconds: dict[str, float]) -> RunInfo:
    """What was run, for result files."""
    versions = {"python": platform.python_version()}
    for package in _PACKAGES:
        try:
            versions[package] = version(package)
        except PackageNotFoundError:
            continue
    chosen = replace(project.options, tolerances=(), identification=())
    options = {k: v for k, v in asdict(chosen).items() if v not in ((), None)} | {"datum": project.survey.datum.kind}
    date = datetime.now(UTC).isoformat(timespec="seconds")
    # the name alone: results of a copied folder stay the same; by its bytes: a terminal without UTF-8 garbles it
    name = os.fsencode(project.folder.resolve().name).decode("utf-8", "replace")
    said = project.options.identification
    sigmas = project.options.sigmas or USUAL
    return RunInfo(name, project.title, project.inputs, options, versions, date, seconds, sigmas, said)
