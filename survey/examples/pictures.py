"""The images of a simulated survey: each shot rendered with everything that stands before the camera."""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
from gtsam import Pose3
from tqdm import tqdm

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from survey.project.targets import PointList
from survey.simulate.draft import Draft, Shot
from survey.simulate.facets import PlacedTarget
from survey.simulate.rendering import Beacons, GrayImage, Imaging, may_be_seen, render, scene_camera
from survey.simulate.scene import Scene, transform

# a gray sensor with some gain in a room of ordinary light
DAY = Imaging(blur_px=0.9, noise_gray=4.0, background_gray=105.0, gradient=(0.18, -0.12))
NIGHT = Imaging(blur_px=0.9, noise_gray=2.0, background_gray=6.0)
BEACON_DIAMETER_M = 0.006
# noise does not repeat itself: a search for repetitions takes three times as long and makes no smaller file
_PNG = (
    *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY),
    *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_UP),
)


def write_images(draft: Draft, folder: Path, seed: int, jobs: int | None, progress: bool) -> None:
    """Render all shots of a draft into ``folder/<camera_id>/<epoch_id>.png``, several at a time.

    Threads are enough: rendering, noise and PNG compression run outside the interpreter's lock.
    """
    scene = draft.scene()
    shots = sorted(enumerate(draft.shots), key=lambda item: item[1].camera_id)  # a camera's rays are used again
    for camera_id in {shot.camera_id for shot in draft.shots}:
        (folder / camera_id).mkdir(parents=True, exist_ok=True)

    def write(item: tuple[int, Shot]) -> None:
        number, shot = item
        image = picture(draft, scene, shot, seed=1000 * seed + number)
        path = folder / shot.camera_id / f"{shot.epoch_id}.png"
        if not cv2.imwrite(str(path), image, _PNG):
            raise SurveyError(f"{path}: cannot be written; is the disk full, or the folder protected?")

    with (
        ThreadPoolExecutor(jobs or os.cpu_count() or 1) as pool,
        tqdm(total=len(shots), desc="rendering", unit="image", disable=not progress) as bar,
    ):
        for _ in pool.map(write, shots):
            bar.update()


def picture(draft: Draft, scene: Scene, shot: Shot, seed: int) -> GrayImage:
    """One image (height, width), 8 bit: targets by day, beacons by night.

    Plates on the walls are hung for the epochs that are meant to show them.
    """
    camera = scene_camera(scene, shot.camera_id)
    camera_from_world = np.linalg.inv(scene.world_from_camera(shot.camera_id, shot.epoch_id)).astype(np.float64)
    if shot.beacons:
        beacons = Beacons(transform(camera_from_world, scene.world_points()), BEACON_DIAMETER_M, 230.0)
        return render(camera, beacons=beacons, imaging=NIGHT, seed=seed)
    return render(camera, _placed(draft, scene, shot, camera_from_world), imaging=DAY, seed=seed)


def _placed(draft: Draft, scene: Scene, shot: Shot, camera_from_world: FloatArray) -> Sequence[PlacedTarget]:
    placed = []
    for target in scene.survey.targets:
        kind = draft.kinds[target.target_id]
        if target.target_id not in shot.target_ids or isinstance(kind, PointList):
            continue
        pose = Pose3(camera_from_world @ scene.world_from_target(target.target_id, shot.epoch_id))
        if may_be_seen(scene_camera(scene, shot.camera_id), pose, target.x_in_target):
            placed.append(PlacedTarget(kind, pose))
    return placed
