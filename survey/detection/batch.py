"""Many images, in parallel; one that fails is reported and the others go on."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, field
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import cv2
from tqdm import tqdm

from adjust.model.errors import SurveyError
from adjust.native.parallel import cores
from survey.detection.detect import detect_targets
from survey.detection.gray import read_image
from survey.detection.pictures import write_picture
from survey.detection.results import ImageReport, SpotOptions
from survey.detection.spots import detect_spots, outside_targets
from survey.project.targets import DetectableTarget

_MOST_THREADS = 8  # so many keep busy beside Python's lock, which is free for nine tenths of the time
_IMAGES_PER_PROCESS = 50  # a process takes some seconds to start, the time of that many images


@dataclass(frozen=True, eq=False)
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
    most = cores()
    if jobs is None and min(most, len(tasks)) > 1:
        processes = min(most, len(tasks) // _IMAGES_PER_PROCESS)
        many = processes > _MOST_THREADS
        jobs, run = (processes, _in_processes) if many else (min(most, _MOST_THREADS), _in_threads)
    else:
        jobs = jobs or 1
        run = _in_processes if jobs > 1 and len(tasks) > 1 else _here
    reports: dict[int, ImageReport] = {}
    with tqdm(total=len(tasks), desc="detect", unit="image", disable=not progress) as bar:
        for position, report in run(tasks, jobs, pictures):
            reports[position] = report
            bar.update()
            if told is not None:
                told(report)
    return [reports[position] for position in range(len(tasks))]


def _here(tasks: Sequence[DetectionTask], jobs: int, pictures: Path | None) -> Iterator[tuple[int, ImageReport]]:
    for position, task in enumerate(tasks):
        yield position, detect_task(task, pictures)


def _in_threads(tasks: Sequence[DetectionTask], jobs: int, pictures: Path | None) -> Iterator[tuple[int, ImageReport]]:
    """What takes time holds no lock: OpenCV's finders and the compiled fits."""
    before = cv2.getNumThreads()
    _one_thread()
    try:
        with ThreadPoolExecutor(min(jobs, len(tasks))) as pool:
            futures = {pool.submit(detect_task, task, pictures): position for position, task in enumerate(tasks)}
            for future in as_completed(futures):
                yield futures[future], future.result()
    finally:
        cv2.setNumThreads(before)


def _in_processes(
    tasks: Sequence[DetectionTask], jobs: int, pictures: Path | None
) -> Iterator[tuple[int, ImageReport]]:
    work = partial(detect_task, pictures=pictures)
    with ProcessPoolExecutor(min(jobs, len(tasks)), get_context("spawn"), initializer=_one_thread) as pool:
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
