"""Targets in one image, and in many in parallel: one that fails is reported, the others go on; pictures of it."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import field
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
import numpy as np
from tqdm import tqdm

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from adjust.native.parallel import cores
from survey.detection.checkerboard import find_checkerboard
from survey.detection.gray import AnyImage, Gray8, Gray32, for_finding, gray_values, read_image
from survey.detection.markers import SeenMarkers, find_charuco, find_markers
from survey.detection.results import Detection, ImageReport, SpotOptions, Spots
from survey.detection.spots import detect_spots, outside_targets
from survey.project.targets import Charuco, Checkerboard, DetectableTarget


def detect_image(image: AnyImage, target: DetectableTarget) -> Detection:
    """Points of the target in an image, (h, w) grey or (h, w, 3) BGR, of 8 or 16 bit or float.

    Empty with a ``reason`` where the target is not found. Raises SurveyError for what is no image and for a target
    that cannot exist (unknown dictionary, marker larger than its square).
    """
    return detect_targets(image, {"": target})[""]


def detect_targets(image: AnyImage, targets: Mapping[str, DetectableTarget]) -> dict[str, Detection]:
    """:func:`detect_image` for several targets by id; what they need of the image is made once."""
    if not targets:
        return {}
    gray = gray_values(image)
    gray8 = for_finding(np.asarray(image, np.uint8) if image.dtype == np.uint8 and image.ndim == 2 else gray)
    seen = SeenMarkers(gray8)
    return {target_id: _detected(gray, gray8, seen, target) for target_id, target in targets.items()}


def _detected(gray: Gray32, gray8: Gray8, seen: SeenMarkers, target: DetectableTarget) -> Detection:
    if isinstance(target, Checkerboard):
        return find_checkerboard(gray, gray8, target)
    if isinstance(target, Charuco):
        return find_charuco(gray, gray8, target)
    return find_markers(gray, seen, target)


_MOST_THREADS = 8  # so many keep busy beside Python's lock, which is free for nine tenths of the time
_IMAGES_PER_PROCESS = 50  # a process takes some seconds to start, the time of that many images


@frozen(eq=False)
class DetectionTask:
    """One image and what to look for in it: targets by id, and spots where options are given."""

    path: Path
    camera_id: str
    epoch_id: str
    targets: Mapping[str, DetectableTarget] = field(default_factory=dict)
    spots: SpotOptions | None = None


def detect_images(
    tasks: Sequence[DetectionTask], jobs: int | None = None, progress: bool = True, pictures: Path | None = None,
    told: Callable[[ImageReport], None] | None = None,
) -> list[ImageReport]:  # fmt: skip
    """Reports of all tasks, in their order.

    jobs: processes. None: as many threads as there are processors, and processes instead where these are many and
    images too. Processes are spawned: a script that calls this with more than one guards its main part by
    ``if __name__ == "__main__"``.
    progress: a bar on stderr. pictures: folder for a PNG of each image that was read, with what was found in it.
    told: called with each report as it comes.
    """
    if pictures is not None:
        pictures.mkdir(parents=True, exist_ok=True)
    run, n = _in_processes, min(jobs or cores(), len(tasks) if jobs else len(tasks) // _IMAGES_PER_PROCESS)
    if jobs is None and n <= _MOST_THREADS:
        run, n = _in_threads, min(cores(), _MOST_THREADS, len(tasks))
    if n <= 1:
        run = _here
    reports: dict[int, ImageReport] = {}
    with tqdm(total=len(tasks), desc="detect", unit="image", disable=not progress) as bar:
        for position, report in run(tasks, n, pictures):
            reports[position] = report
            bar.update()
            if told is not None:
                told(report)
    return [reports[position] for position in range(len(tasks))]


_Found = Iterator[tuple[int, ImageReport]]


def _here(tasks: Sequence[DetectionTask], n: int, pictures: Path | None) -> _Found:
    yield from enumerate(detect_task(task, pictures) for task in tasks)


def _in_threads(tasks: Sequence[DetectionTask], n: int, pictures: Path | None) -> _Found:
    """What takes time holds no lock: OpenCV's finders and the compiled fits."""
    before = cv2.getNumThreads()
    _one_thread()
    try:
        with ThreadPoolExecutor(n) as pool:
            yield from _of(pool, tasks, pictures)
    finally:
        cv2.setNumThreads(before)


def _in_processes(tasks: Sequence[DetectionTask], n: int, pictures: Path | None) -> _Found:
    with ProcessPoolExecutor(n, get_context("spawn"), initializer=_one_thread) as pool:
        yield from _of(pool, tasks, pictures)


def _of(pool: Executor, tasks: Sequence[DetectionTask], pictures: Path | None) -> _Found:
    """The reports as they come."""
    work = partial(detect_task, pictures=pictures)
    futures = {pool.submit(work, task): position for position, task in enumerate(tasks)}
    for future in as_completed(futures):
        position = futures[future]
        try:
            yield position, future.result()
        except BrokenProcessPool:
            task = tasks[position]
            message = f"{task.path}: a detection process ended abruptly (memory?); run again with fewer jobs"
            yield position, ImageReport(task.path, task.camera_id, task.epoch_id, "failed", message)


def _one_thread() -> None:
    cv2.setNumThreads(1)


def detect_task(task: DetectionTask, pictures: Path | None = None) -> ImageReport:
    """The report of one image; what its owner can mend becomes its message, not an error."""
    try:
        image = read_image(task.path)
        detections = detect_targets(image, task.targets)
        spots = None if task.spots is None else outside_targets(detect_spots(image, task.spots), detections.values())
        report = ImageReport(
            task.path,
            task.camera_id,
            task.epoch_id,
            "found" if any(map(len, detections.values())) or (spots is not None and len(spots)) else "nothing",
            "; ".join(f"{target_id}: {d.reason}" for target_id, d in detections.items() if not len(d)),
            detections,
            spots,
            (image.shape[1], image.shape[0]),
        )
        if pictures is not None:
            write_picture(pictures / f"{task.camera_id}_{task.epoch_id}.png", image, report, task.targets)
    except (SurveyError, OSError, cv2.error) as error:
        message = str(error) if str(task.path) in str(error) else f"{task.path}: {error}"
        return ImageReport(task.path, task.camera_id, task.epoch_id, "failed", message)
    return report


_COLOURS = ((60, 200, 60), (60, 60, 255), (255, 140, 30), (200, 60, 200), (30, 190, 230))  # B G R
_SPOT_COLOUR = (0, 200, 255)


def write_picture(path: Path, image: AnyImage, report: ImageReport, targets: Mapping[str, DetectableTarget]) -> None:
    """Writes a PNG of the image, twice as large where it is small, with every point and its id."""
    scale = 2 if max(image.shape[:2]) <= 1000 else 1
    gray = np.repeat(np.repeat(for_finding(gray_values(image)), scale, axis=0), scale, axis=1)
    canvas = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)
    lines = []
    for k, (target_id, detection) in enumerate(report.detections.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        _draw_points(canvas, detection, targets[target_id].points()[0], colour, scale)
        lines.append((f"{target_id}: {_summary(detection)}", colour))
    if report.spots is not None:
        _draw_spots(canvas, report.spots, scale)
        lines.append((f"{len(report.spots)} spots", _SPOT_COLOUR))
    cv2.rectangle(canvas, (0, 0), (560, 12 + 20 * len(lines)), (0, 0, 0), cv2.FILLED)
    for k, (text, colour) in enumerate(lines):
        _text(canvas, text, (8, 22 + 20 * k), colour, 0.55)
    if not cv2.imwrite(str(path), canvas):
        raise SurveyError(f"{path}: the picture could not be written; check the folder")


def _summary(detection: Detection) -> str:
    if not len(detection):
        return detection.reason
    sigma = float(np.sqrt(np.median(np.trace(detection.cov, axis1=1, axis2=2)) / 2.0))
    return f"{len(detection)} points, sigma {sigma:.3f} px, blur {detection.blur_px:.2f} px"


def _draw_points(
    canvas: Gray8, detection: Detection, point_ids: tuple[str, ...], colour: tuple[int, int, int], scale: int
) -> None:
    for (u, v), k in zip(_places(detection.uv, scale), detection.point_idx.tolist(), strict=True):
        cv2.circle(canvas, (u, v), 5 * 16, colour, 1, cv2.LINE_AA, 4)
        _text(canvas, point_ids[k], (u // 16 + 6, v // 16 - 4), colour, 0.33)


def _draw_spots(canvas: Gray8, spots: Spots, scale: int) -> None:
    for k, ((u, v), diameter) in enumerate(zip(_places(spots.uv, scale), spots.diameter_px.tolist(), strict=True)):
        radius = round(16.0 * scale * (diameter / 2.0 + 2.0))
        cv2.circle(canvas, (u, v), radius, _SPOT_COLOUR, 1, cv2.LINE_AA, 4)
        _text(canvas, f"s{k}", (u // 16 + 8, v // 16 - 6), _SPOT_COLOUR, 0.4)


def _places(uv: FloatArray, scale: int) -> list[list[int]]:
    """In 1/16 pixel of the picture, as OpenCV draws."""
    return list(np.rint(((uv + 0.5) * scale - 0.5) * 16.0).astype(int).tolist())


def _text(canvas: Gray8, text: str, place: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
