"""A laboratory while it is being laid out: things with their true place, then the images taken in it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache

import cv2
import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock, TableReading
from adjust.model.survey import Camera, FloatArray, LensParameter, Point, PoseParameter, Station, Survey, Table, Target
from adjust.spatial.averaging import wrapped
from adjust.spatial.rigid import rigid
from survey.project.targets import TargetKind
from survey.simulate.scene import BROWN, Scene, Truth, rotation_about, transform

HELD = PoseParameter(Pose3(), "held")
FREE_LENS = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
IMAGE_SIZE = (1280, 1024)
ARCSEC = np.pi / 180.0 / 3600.0
_HYPOT, _ACOS, _ATAN2 = (np.vectorize(f, otypes=[float]) for f in (math.hypot, math.acos, math.atan2))
"""Not NumPy's own, whose last digit depends on the processor: equal seeds give equal surveys."""


@frozen
class Shot:
    """One image to be taken: the targets that are meant to be in it, and whether the lights are off and beacons lit."""

    camera_id: str
    epoch_id: str
    target_ids: tuple[str, ...] = ()
    beacons: bool = False


@dataclass(eq=False)
class Draft:
    """The parts of a survey and their truth, gathered step by step; ``scene`` freezes them."""

    rng: np.random.Generator
    truth: Truth = field(default_factory=dict)
    cameras: list[Camera] = field(default_factory=list)
    stations: list[Station] = field(default_factory=list)
    tables: list[Table] = field(default_factory=list)
    targets: list[Target] = field(default_factory=list)
    kinds: dict[str, TargetKind] = field(default_factory=dict)
    points: list[Point] = field(default_factory=list)
    table_epochs: list[str] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)

    def scene(self) -> Scene:
        """What there is so far, without observations."""
        survey = Survey(
            cameras=tuple(self.cameras),
            stations=tuple(self.stations),
            tables=tuple(self.tables),
            targets=tuple(self.targets),
            points=tuple(self.points),
        )
        return Scene(survey, self.truth)

    def add_camera(
        self,
        camera_id: str,
        station_id: str,
        lens: dict[str, float],
        station_from_camera: FloatArray,
        held: bool = False,
    ) -> None:
        """A camera of known lens and place; ``held`` where it defines the frame of its station."""
        pose = Pose3(station_from_camera)
        self.truth["lens", camera_id] = np.array([lens.get(name, 0.0) for name in BROWN])
        self.truth["station_from_camera", camera_id] = pose
        parameter = PoseParameter(pose, "held") if held else PoseParameter()
        self.cameras.append(Camera(camera_id, station_id, IMAGE_SIZE, LensParameter("brown", FREE_LENS), parameter))

    def add_target(
        self,
        target_id: str,
        kind: TargetKind,
        world_from_target: FloatArray | None,
        held: bool = False,
    ) -> None:
        """A target that stands in the world, or is held by hand where ``world_from_target`` is None."""
        ids, x = kind.points()
        self.kinds[target_id] = kind
        if world_from_target is None:
            self.targets.append(Target(target_id, ids, x, motion="epoch"))
            return
        pose = Pose3(world_from_target)
        self.truth["carrier_from_target", target_id] = pose
        parameter = PoseParameter(pose, "held") if held else PoseParameter()
        self.targets.append(Target(target_id, ids, x, carrier_from_target=parameter))

    def outline_visible(
        self, shot: Shot, target_id: str, outline_in_target: FloatArray, margin_px: float
    ) -> bool:
        """Whether the whole outline (n, 3) m of a target lies in the image."""
        scene = self.scene()
        x = transform(scene.world_from_target(target_id, shot.epoch_id), outline_in_target)
        return bool(scene.inside(shot.camera_id, scene.project(shot.camera_id, shot.epoch_id, x), margin_px).all())


@cache
def outline(kind: TargetKind, border_m: float) -> FloatArray:
    """Points (16, 3) m around a flat target, ``border_m`` outside its outermost points."""
    x = kind.points()[1]
    low, high = x[:, :2].min(axis=0) - border_m, x[:, :2].max(axis=0) + border_m
    steps = np.linspace(0.0, 1.0, 5)[:-1]
    sides = [(s, 0.0) for s in steps] + [(1.0, s) for s in steps]
    sides += [(1.0 - s, 1.0) for s in steps] + [(0.0, 1.0 - s) for s in steps]
    flat = low + np.array(sides) * (high - low)
    return np.column_stack([flat, np.zeros(len(flat))])


@cache
def centre(kind: TargetKind) -> FloatArray:
    """Middle of a target's points, (3,) m."""
    x = kind.points()[1]
    middle: FloatArray = (x.min(axis=0) + x.max(axis=0)) / 2.0
    return middle


def looking_at(direction: FloatArray, down: FloatArray) -> FloatArray:
    """(3, 3) with z along ``direction`` and y as near to ``down`` as that allows: the attitude of an upright camera."""
    z = direction / np.linalg.norm(direction)
    x = np.cross(down, z)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def rotation_vector(degrees: FloatArray) -> FloatArray:
    """(3, 3) of a rotation vector in degrees."""
    matrix: FloatArray = cv2.Rodrigues(np.radians(np.asarray(degrees, dtype=float)))[0]
    return matrix


def pixel_in_cell(number: int, place_in_cell: FloatArray) -> FloatArray:
    """Places (..., 2) px in one of nine cells of the image, so that a series of images fills the whole frame.

    place_in_cell: (..., 2), from 0 to 1.
    """
    order = (4, 0, 8, 2, 6, 1, 7, 3, 5)[number % 9]
    cell = np.array([order % 3, order // 3], dtype=float)
    place: FloatArray = (cell + place_in_cell) / 3.0 * np.array(IMAGE_SIZE)
    return place


def ray(truth: Truth, camera_id: str, pixel: FloatArray) -> FloatArray:
    """Directions (..., 3) in the camera of image points (..., 2), distortion left aside."""
    lens = truth["lens", camera_id]
    if isinstance(lens, Pose3):
        raise TypeError("a lens is not a pose")
    direction = np.ones((*pixel.shape[:-1], 3))
    direction[..., :2] = (pixel - lens[3:5]) / lens[:2]  # of fx, fy, skew, u0, v0
    return _unit(direction)


def _unit(direction: FloatArray) -> FloatArray:
    unit: FloatArray = direction / np.sqrt(np.vecdot(direction, direction))[..., None]
    return unit


def hand_pose(
    draft: Draft, camera_id: str, kind: TargetKind, number: int, distance_m: tuple[float, float]
) -> FloatArray:
    """(4, 4) camera_from_target as a person would hold it: anywhere in the frame, tilted up to 45 deg, any roll."""
    rng = draft.rng
    distance = rng.uniform(*distance_m)
    azimuth, tilt = rng.uniform(0.0, 360.0), rng.uniform(5.0, 45.0)
    tilted = rotation_vector(tilt * np.array([np.cos(np.radians(azimuth)), np.sin(np.radians(azimuth)), 0.0]))
    roll = rotation_about("z", np.radians(rng.choice([0.0, 0.0, 90.0, 180.0]) + rng.uniform(-25.0, 25.0)))[:3, :3]
    rotation = tilted @ roll
    place = ray(draft.truth, camera_id, pixel_in_cell(number, rng.uniform(0.0, 1.0, 2))) * distance
    return rigid(rotation, place - rotation @ centre(kind))


def table_angles(direction_in_mount: FloatArray, direction_in_table: FloatArray, face: int) -> FloatArray:
    """Angles (..., 2) rad that turn directions (..., 3) of the mount into those of an ideal table, axes x then z.

    ``Rx(a1) Rz(a2) d = b``: the x component fixes a2 (two faces, 0 and 1, as of a theodolite), the other two then a1.
    NaN where no angles do.
    """
    d, b = np.moveaxis(_unit(direction_in_mount), -1, 0), np.moveaxis(_unit(direction_in_table), -1, 0)
    reach = _HYPOT(d[0], d[1])
    a2 = (1.0 - 2.0 * face) * _ACOS(np.where(np.abs(b[0]) <= reach, b[0] / reach, np.nan)) - _ATAN2(d[1], d[0])
    a1 = _ATAN2(b[2], b[1]) - _ATAN2(d[2], np.sin(a2) * d[0] + np.cos(a2) * d[1])
    return wrapped(np.stack([a1, a2], axis=-1))


def image_blocks(scene: Scene, shots: Sequence[Shot], sigma_px: float, margin_px: float = 5.0) -> list[ImageBlock]:
    """Error-free image points of all shots: one block per target seen, one for the beacons."""
    blocks = []
    for shot in shots:
        seen: list[tuple[str | None, FloatArray]] = [
            (target_id, scene.target_points(target_id, shot.epoch_id)) for target_id in shot.target_ids
        ]
        if shot.beacons:
            seen.append((None, scene.world_points()))
        for target_id, x in seen:
            uv = scene.project(shot.camera_id, shot.epoch_id, x)
            idx = np.flatnonzero(scene.inside(shot.camera_id, uv, margin_px))
            if len(idx) == 0:
                continue
            cov = np.broadcast_to(sigma_px**2 * np.eye(2), (len(idx), 2, 2)).copy()
            blocks.append(ImageBlock(shot.camera_id, shot.epoch_id, target_id, idx, uv[idx], cov))
    return blocks


def table_readings(draft: Draft, table_id: str, sigma_rad: float) -> list[TableReading]:
    """Error-free readings of all epochs at which the table stood still."""
    scene = draft.scene()
    cov = sigma_rad**2 * np.eye(2)
    return [
        TableReading(table_id, epoch_id, scene.vector("table_angles", table_id, epoch_id), cov)
        for epoch_id in draft.table_epochs
    ]
