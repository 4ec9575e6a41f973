"""The job ``detect``: points of targets and spots in the images of a project.

Who owns what: rows of an image and of a target that is looked for in it belong to detection, and are replaced when the
image is another one; all other rows, and those that a person has changed since, belong to that person and stay. What a
person decided about a row that is replaced (``used = false``) goes into ``observations/exclusions.csv``.
"""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from adjust.lenses.crops import possible_sizes
from adjust.model.errors import SurveyError, listed
from adjust.model.observations import ImageBlock
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write, time_text
from survey.jobs.detecting.board_sizes import wrong_sizes
from survey.jobs.detecting.image_defects import defect_warnings, defects
from survey.jobs.detecting.outcome import DetectOutcome, missed
from survey.project import Definition, Project, SpotBlock, read_definition
from survey.project.detected import (
    DETECTED_FILE,
    DetectedImage,
    ImageKey,
    ImageNews,
    detected_text,
    file_of,
    image_news,
    named,
    read_detected,
)
from survey.project.exclusions import EXCLUSIONS_FILE, Exclusion, Name, Row, appended, in_force, read_exclusions
from survey.project.images import Sought, sought_in
from survey.project.project import IMAGES_FOLDER, OBSERVATIONS_FOLDER
from survey.project.tables.image_points import image_point_columns, spot_columns
from survey.project.tables.layouts import IMAGE_POINTS, SPOTS
from survey.project.tables.rows import RowTable, read_rows, rows_of

if TYPE_CHECKING:  # brings in OpenCV, which a folder that is detected already does without
    from survey.detection import ImageReport

PICTURES = "detected"


def _without_folder(folder: Path, texts: Mapping[str, str]) -> dict[str, str]:
    """As they stay true where the folder is moved."""
    return {name: text.removeprefix(f"{folder}/") for name, text in texts.items()}


@dataclass(eq=False)
class _State:
    """A project before detection: its definition, tables as text, and what is known of its images."""

    definition: Definition
    sought: Mapping[ImageKey, Sought]
    points: RowTable
    spots: RowTable
    known: dict[ImageKey, DetectedImage]
    news: ImageNews
    notes: list[str] = field(default_factory=list)

    def edited(self, key: ImageKey) -> bool:
        """Whether rows that detection wrote for an image are other ones now."""
        entry = self.known.get(key)
        return entry is not None and entry.rows != "" and entry.rows != self.rows_digest(key)

    def file(self, key: ImageKey) -> DetectedImage:
        """The file of an image as it is now."""
        path = self.definition.images[key]
        return file_of(path, path.relative_to(self.definition.folder).as_posix())

    def rows_digest(self, key: ImageKey) -> str:
        """A hash of the rows of an image that belong to detection."""
        return self.points.digest(key) + self.spots.digest(key)


def _state(folder: Path) -> _State:
    definition = read_definition(folder)
    place = folder / OBSERVATIONS_FOLDER
    points, spots = read_rows(place, IMAGE_POINTS), read_rows(place, SPOTS)
    known, sought = read_detected(place), sought_in(definition)
    news = image_news(definition.images, known, {*points.images, *spots.images},
                      {key: one.digest() for key, one in sought.items()})  # fmt: skip
    return _State(definition, sought, points, spots, known, news)


def detect_job(
    folder: Path, *, jobs: int | None = None, pictures: bool = False, progress: bool = True, everything: bool = False,
    told: "Callable[[ImageReport], None] | None" = None, place: Path | None = None,
) -> DetectOutcome:  # fmt: skip
    """Find targets and spots in the images of a project that are new or have changed, and write their tables.

    everything: in the others too, but for rows that people have changed since. pictures: also write the images that are
    looked at, with what was found. told: called with what became of each image, as it comes. place: where what is new
    is made, of who is changing the folder already. Raises SurveyError where there is nothing to look at or for.
    """
    from survey.detection import DetectionTask, SpotOptions, detect_images

    folder = Path(folder)
    with changing(folder) if place is None else nullcontext(place) as made:
        state = _state(folder)
        _require_something(folder, state)
        wanted = _wanted(state, everything)
        tasks = [
            DetectionTask(state.definition.images[key], *key, dict(one.targets),
                          None if one.spots_px is None else SpotOptions(diameter_px=one.spots_px))
            for key in wanted for one in [state.sought[key]]
        ]  # fmt: skip
        files = {key: state.file(key) for key in wanted}
        dropped = _without_image(state, files, everything)
        reports = detect_images(tasks, jobs, progress, made / PICTURES if pictures else None, told)
        blocks, spots = _blocks(state.definition, reports)
        kept = {*state.points.images, *state.spots.images} - set(wanted) - dropped
        wrong, bad = wrong_sizes(folder, state.definition, reports), defects(reports)
        if not blocks and not spots and not kept:
            raise _nothing_found(folder, reports, wrong, bad)
        names = _write(folder, made, state, wanted, dropped, blocks, spots)
        now = _known_now(state, files, reports, _without_folder(folder, wrong), bad)
        known = {key: entry for key, entry in now.items() if key not in dropped}
        atomic_write(made / OBSERVATIONS_FOLDER / DETECTED_FILE, detected_text(known))
        replace_parts(folder, gone=[name.with_suffix(".parquet").as_posix() for name in names])
        gone = [key for key in state.news.gone if key not in dropped]
        if gone:
            state.notes.append(f"gone, their points are used as before: {named(gone)}")
        same = len([key for key in state.definition.images if key not in files])
        paths, said = tuple(folder / n for n in names), defect_warnings(bad)
        return DetectOutcome(folder, tuple(reports), paths, same, tuple(state.notes), wrong, said)


def _require_something(folder: Path, state: _State) -> None:
    if not state.definition.images:
        raise SurveyError(f"{folder}/{IMAGES_FOLDER}: no images; put them at images/<camera_id>/<epoch_id>.png")
    if not state.sought:
        raise SurveyError(
            f"{folder}/survey.toml: nothing to look for; name a target that can be detected (checkerboard, charuco, "
            "marker_grid, marker_block) or a table [spots]"
        )


def _nothing_found(
    folder: Path, reports: "Sequence[ImageReport]", wrong: Mapping[str, str], bad: Mapping[ImageKey, str]
) -> SurveyError:
    each = listed([f"{r.path}: {r.message}" for r in reports], 10, "\n  ")
    lines = "\n  ".join([*defect_warnings(bad), each])
    said = f"{folder}: no target and no spot was found in {len(reports)} images:\n  {lines}"
    return SurveyError("\n".join(wrong.values()) if wrong else said)


def _wanted(state: _State, everything: bool) -> list[ImageKey]:
    """Images to look at; says which rows of people stay, and which go."""
    news = state.news
    changed = set(news.changed)
    todo = {*news.to_detect, *news.unseen} | (set(state.sought) if everything else set())
    wanted, stay = [], []
    for key in state.definition.images:
        if key not in todo or key not in state.sought:
            continue
        if state.edited(key) and key not in changed:
            stay.append(key)
        else:
            wanted.append(key)
    if stay:
        state.notes.append(f"rows were changed by hand since they were detected, and stay: {named(stay)} (remove the "
                           "rows of an image to have its points found anew)")  # fmt: skip
    lost = [key for key in wanted if key in changed and state.edited(key)]
    if lost:
        state.notes.append(f"rows were changed by hand, but the image is another one now; replaced: {named(lost)}")
    if news.by_hand:
        state.notes.append(f"other images than before, whose points were given; check them: {named(news.by_hand)}")
    return wanted


def _without_image(state: _State, files: Mapping[ImageKey, DetectedImage], everything: bool) -> set[ImageKey]:
    """Images that are gone and whose rows go too: they have another name now, or all is to be found anew.

    Rows that were given, or that people have changed, stay in any case.
    """
    names = {entry.sha256: key for key, entry in files.items()}
    dropped: set[ImageKey] = set()
    for key in state.news.gone:
        entry = state.known[key]
        if entry.status == "given" or state.edited(key):
            continue
        if entry.sha256 in names:
            state.notes.append(f"{'/'.join(key)} is {'/'.join(names[entry.sha256])} now: the same image")
            dropped.add(key)
        elif everything:
            state.notes.append(f"{'/'.join(key)} is gone, and its points with it")
            dropped.add(key)
    return dropped


def _write(
    folder: Path, place: Path, state: _State, wanted: Sequence[ImageKey], dropped: set[ImageKey],
    blocks: list[ImageBlock], spots: list[SpotBlock],
) -> list[Path]:  # fmt: skip
    """Write the tables with the rows of ``wanted`` replaced and without those of ``dropped``; their paths."""
    targets = {key: set(state.sought[key].targets) for key in wanted}
    gone = state.points.taken(lambda key, target: key in dropped or target in targets.get(key, ()))
    _keep_decisions(folder, place, state, gone)
    found = rows_of(IMAGE_POINTS, image_point_columns(blocks, state.definition.survey))
    state.points = state.points.without(gone).with_rows(found.with_cells_of(gone, "group"))
    files = {Path(OBSERVATIONS_FOLDER, "image_points.csv"): state.points.text()}
    if state.definition.spots_request is not None:
        keys = {*wanted, *dropped}
        old = state.spots.taken(lambda key, _: key in keys)
        state.spots = state.spots.without(old).with_rows(rows_of(SPOTS, spot_columns(spots)))
        files[Path(OBSERVATIONS_FOLDER, "spots.csv")] = state.spots.text()
    # an empty table is written too: one of an earlier run must not stay behind
    for name, text in files.items():
        atomic_write(place / name, text)
    return list(files)


def _keep_decisions(folder: Path, place: Path, state: _State, gone: RowTable) -> None:
    """``used = false`` of rows that go becomes rows of exclusions.csv."""
    marked = gone.marked_unused()
    per_image = Counter((camera, epoch) for camera, epoch, *_ in marked)
    whole = {key for key, n in per_image.items() if n == state.points.images[key]}
    names = [Name("image", "/".join(row[:2])) if row[:2] in whole else
             Name("image_point", "/".join(part for part in row if part)) for row in marked]  # fmt: skip
    if not names:
        return
    path = folder / OBSERVATIONS_FOLDER / EXCLUSIONS_FILE
    there = in_force(read_exclusions(path.parent)[0])
    now = time_text()
    said = Exclusion(Name("image_point", ""), "used = false in image_points.csv", "", now)
    rows = [Row(True, replace(said, name=name)) for name in dict.fromkeys(names) if name not in there]
    if rows:
        atomic_write(place / OBSERVATIONS_FOLDER / EXCLUSIONS_FILE, appended(path, rows))
        state.notes.append(f"{len(marked)} image points that image_points.csv marked used = false stay left out: "
                           f"{OBSERVATIONS_FOLDER}/{EXCLUSIONS_FILE} lists them now")  # fmt: skip


def _known_now(
    state: _State, files: Mapping[ImageKey, DetectedImage], reports: "Sequence[ImageReport]",
    wrong_sizes: Mapping[str, str], defects: Mapping[ImageKey, str],
) -> dict[ImageKey, DetectedImage]:  # fmt: skip
    """What is known of all images from now on; of images that are gone while their points are used, too."""
    known = {key: entry for key, entry in state.known.items() if key in state.news.gone}
    known |= state.news.same or {}
    for report in reports:
        key = (report.camera_id, report.epoch_id)
        known[key] = replace(
            files[key], looked_for=state.sought[key].digest(), status=report.status, message=report.message,
            rows=state.rows_digest(key), n_image_points=sum(map(len, report.detections.values())),
            n_spots=0 if report.spots is None else len(report.spots),
            wrong_size=next((text for t, text in wrong_sizes.items() if t in missed(report)), ""),
            defect=defects.get(key, ""),
        )  # fmt: skip
    return known | _given(state, known)


def _given(state: _State, known: Mapping[ImageKey, DetectedImage]) -> dict[ImageKey, DetectedImage]:
    """Images that have not been looked at, with the points that they have."""
    return {
        key: replace(state.file(key), status="given", n_image_points=state.points.images[key],
                     n_spots=state.spots.images[key])
        for key in state.definition.images if key not in known
    }  # fmt: skip


def remember_images(project: Project, place: Path) -> Mapping[ImageKey, DetectedImage]:
    """Make the list of images anew in ``place`` where their hashes are not known, or were made of older times.

    Nothing is looked for: points that are there count as given. For who is changing the folder. What is known now.
    """
    known_all = not project.image_notes and set(project.detected) == set(project.images)
    if known_all and read_detected(project.folder / OBSERVATIONS_FOLDER) == project.detected:
        return project.detected
    state = _state(project.folder)
    old = {*state.news.gone, *state.news.changed, *state.news.by_hand}  # these stay noticed
    known = {key: entry for key, entry in state.known.items() if key in old}
    known |= state.news.same or {}
    known |= _given(state, known)
    if known != state.known:
        atomic_write(place / OBSERVATIONS_FOLDER / DETECTED_FILE, detected_text(known))
    return known


def _blocks(definition: Definition, reports: "Sequence[ImageReport]") -> tuple[list[ImageBlock], list[SpotBlock]]:
    sizes = {c.camera_id: possible_sizes(c) for c in definition.survey.cameras}
    blocks, spots = [], []
    for report in reports:
        size = report.image_size
        if size is not None and size not in sizes[report.camera_id]:
            said = " or ".join(f"{width} x {height}" for width, height in dict.fromkeys(sizes[report.camera_id]))
            raise SurveyError(
                f"{report.path}: the image is {size[0]} x {size[1]} px, but survey.toml says camera "
                f"{report.camera_id!r} has {said}; correct image_size_px or take the right image"
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
