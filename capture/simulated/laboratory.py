"""The simulated laboratory: head with three cameras on a two-axis table, board, and beacons, all of known place.

``SimulatedLab.image`` gives what a camera sees at given angles of the table. Light is physical: what a pixel gets grows
with the exposure time, so the room needs 10 ms, and at 0.25 ms it is dark and the beacons alone show.
"""

from collections import OrderedDict
from dataclasses import field, replace
from itertools import count

import numpy as np
import numpy.typing as npt
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.simulate.draft import Draft
from survey.simulate.facets import PlacedTarget
from survey.simulate.parts import BOARD, add_beacons, add_head, add_table, shoot_board_from_table, turn_to_walls
from survey.simulate.rendering import Beacons, GrayImage, Imaging, may_be_seen, render, scene_camera
from survey.simulate.scene import Scene, Truth, transform

CAMERA_IDS = ("X", "Y", "Z")
TABLE_ID = "turntable"
IMAGE_SIZE = (640, 512)
ROOM_EXPOSURE_US, BEACON_EXPOSURE_US = 10000.0, 250.0
_BEACON_DIAMETER_M = 0.010
_BEACON_GRAY = 200.0  # of a large source like a beacon, at the beacons' exposure
_NOISE_GRAY = 4.0
_BLUR_PX = 0.8
_ROOM = Imaging(blur_px=_BLUR_PX, noise_gray=0.0, background_gray=105.0, bits=16)
_DARK = Imaging(blur_px=_BLUR_PX, noise_gray=0.0, background_gray=0.0, oversampling=1, samples=21, bits=16)
_FULL = 65535.0 / 255.0
_KEPT = 32  # images without noise that are kept for the next call
_NOW = "now"
_NON_ORTHOGONALITY_ARCSEC, _AXIS_OFFSET_MM = 60.0, 0.35
_Light = tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]


@frozen
class LabPose:
    """A position of the table that is worth an image: what to take there, and of what."""

    epoch_id: str
    axis1_rad: float
    axis2_rad: float
    camera_ids: tuple[str, ...]
    exposure_us: float


@frozen
class LabSize:
    """How many positions there are: with the board, for each camera, and with beacons."""

    n_board: int = 11
    n_beacon: int = 0


@frozen(eq=False)
class SimulatedLab:
    """See the module. ``noise_seed``: of the noise of the images, one for each process that plays a camera."""

    draft: Draft
    seed: int
    poses: tuple[LabPose, ...]
    noise_seed: int = 0
    _light: OrderedDict[tuple[str, float, float], _Light] = field(default_factory=OrderedDict, repr=False)
    _numbers: dict[str, "count[int]"] = field(default_factory=dict, repr=False)

    @property
    def truth(self) -> Truth:
        """True values by name."""
        return self.draft.truth

    def image(
        self,
        camera_id: str,
        angles_rad: tuple[float, float],
        exposure_us: float = ROOM_EXPOSURE_US,
        gain_db: float = 0.0,
    ) -> GrayImage:
        """The image (512, 640) uint8 of a camera with the table at ``angles_rad``; every call has noise of its own."""
        room, beacons = self._light_at(camera_id, angles_rad)
        gain = 10.0 ** (gain_db / 20.0)
        image = room * np.float32(gain * exposure_us / ROOM_EXPOSURE_US)
        image += beacons * np.float32(gain * exposure_us / BEACON_EXPOSURE_US)
        number = next(self._numbers.setdefault(camera_id, count()))
        rng = np.random.default_rng((self.noise_seed, CAMERA_IDS.index(camera_id), number))
        image += np.float32(_NOISE_GRAY) * rng.standard_normal(image.shape, dtype=np.float32)
        return np.asarray(np.clip(np.rint(image), 0.0, 255.0), np.uint8)

    def warm_up(self) -> None:
        """Render a board and beacons once: the first time the rays of all pixels are found and libraries loaded."""
        for pose in self.poses[:1]:
            self._light_at(pose.camera_ids[0], (pose.axis1_rad, pose.axis2_rad))

    def _light_at(self, camera_id: str, angles_rad: tuple[float, float]) -> _Light:
        key = (camera_id, round(angles_rad[0], 9), round(angles_rad[1], 9))
        if key in self._light:
            self._light.move_to_end(key)
            return self._light[key]
        light = self._rendered(camera_id, np.array(angles_rad))
        self._light[key] = light
        while len(self._light) > _KEPT:
            self._light.popitem(last=False)
        return light

    def _rendered(self, camera_id: str, angles_rad: FloatArray) -> _Light:
        """Grey values of the room, and of the beacons alone, each at its own exposure."""
        if camera_id not in CAMERA_IDS:
            raise SurveyError(f"camera {camera_id!r}: the simulated laboratory has {', '.join(CAMERA_IDS)}")
        scene = self._scene(angles_rad)
        camera = scene_camera(scene, camera_id)
        camera_from_world = np.linalg.inv(scene.world_from_camera(camera_id, _NOW)).astype(np.float64)
        board = scene.world_from_target("board", _NOW)
        pose = Pose3(camera_from_world @ board)
        placed = [PlacedTarget(BOARD, pose)] if may_be_seen(camera, pose, BOARD.points()[1]) else []
        room = render(camera, placed, imaging=_ROOM)
        x = transform(camera_from_world, scene.world_points())
        if not len(x):
            return np.asarray(room / _FULL, np.float32), np.zeros(room.shape, np.float32)
        dark = [replace(p, dark_gray=0.0, bright_gray=0.0) for p in placed]
        beacons = render(camera, dark, Beacons(x, _BEACON_DIAMETER_M, _BEACON_GRAY), _DARK)
        return np.asarray(room / _FULL, np.float32), np.asarray(beacons / _FULL, np.float32)

    def _scene(self, angles_rad: FloatArray) -> Scene:
        base = self.draft.scene()
        return Scene(base.survey, {**self.truth, ("table_angles", TABLE_ID, _NOW): angles_rad})


_DEFAULT = LabSize()


def make_lab(seed: int, size: LabSize = _DEFAULT) -> SimulatedLab:
    """The laboratory of that seed, with positions of the table worth an image; equal arguments give equal ones."""
    draft = _room(seed, beacons=size.n_beacon > 0)
    for camera_id in CAMERA_IDS:
        shoot_board_from_table(draft, camera_id, size.n_board)
    walls = turn_to_walls(draft, "n", size.n_beacon)
    seen = {shot.epoch_id: (shot.camera_id,) for shot in draft.shots}
    poses = []
    for epoch_id in draft.table_epochs:
        axis1, axis2 = draft.scene().vector("table_angles", TABLE_ID, epoch_id)
        exposure_us = BEACON_EXPOSURE_US if epoch_id in walls else ROOM_EXPOSURE_US
        poses.append(LabPose(epoch_id, float(axis1), float(axis2), seen.get(epoch_id, CAMERA_IDS), exposure_us))
    return furnished_lab(seed, tuple(poses))


def furnished_lab(seed: int, poses: tuple[LabPose, ...], noise_seed: int = 0) -> SimulatedLab:
    """The laboratory of that seed, its positions known already."""
    draft = _room(seed, beacons=any(p.exposure_us == BEACON_EXPOSURE_US for p in poses))
    _halve_images(draft)
    return SimulatedLab(draft, seed, poses, noise_seed)


def _room(seed: int, beacons: bool) -> Draft:
    draft = Draft(np.random.default_rng(seed))
    add_head(draft, len(CAMERA_IDS))
    add_table(draft, _NON_ORTHOGONALITY_ARCSEC, _AXIS_OFFSET_MM)
    if beacons:
        add_beacons(draft)
    return draft


def _halve_images(draft: Draft) -> None:
    """Pixels twice as wide and high, over the same sensor."""
    for number, camera in enumerate(draft.cameras):
        lens = np.array(draft.scene().vector("lens", camera.camera_id))
        lens[:3] /= 2.0
        lens[3:5] = (lens[3:5] + 0.5) / 2.0 - 0.5  # the origin is the centre of the first pixel
        draft.truth["lens", camera.camera_id] = lens
        draft.cameras[number] = replace(camera, image_size=IMAGE_SIZE)
