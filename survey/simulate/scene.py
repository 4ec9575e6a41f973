"""A simulated laboratory: a survey with known truth, and what ideal instruments would read in it.

Everything here is plain matrix lines and OpenCV's projection, on purpose not the code of ``adjust``, so that a mistake
there cannot hide by being made twice.
"""

from collections.abc import Mapping
from functools import cached_property, reduce
from typing import Any

import cv2
import numpy as np
from gtsam import Pose3

from adjust.frames.lens_times import block_starts, crop_starts
from adjust.model.boards import BOARD
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, ImageBlock, PositionRef
from adjust.model.result import ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey, Target
from survey.simulate.courses import Courses, Late, rolls

Truth = dict[ParameterName, Pose3 | FloatArray]
BROWN = ("fx", "fy", "skew", "u0", "v0", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_OPENCV_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
_AXIS_NUMBER = {"x": 0, "y": 1, "z": 2}
_WAVES = {n: tuple(f"{kind}_{n}_" for kind in ("angle", "axial", "radial", "tilt")) for n in (1, 2)}
_UNIT: FloatArray = np.eye(4)
_WIDEST_TANGENT = 1.2  # beyond, a Brown polynomial may fold points back into the image


def rotation_about(axis: str, angle: float | FloatArray) -> FloatArray:
    """(4, 4) right-handed turn by ``angle`` rad about a named axis; (n, 4, 4) by (n,) angles."""
    i = _AXIS_NUMBER[axis]
    j, k = (i + 1) % 3, (i + 2) % 3
    matrix, sine = _units(angle), np.sin(angle)
    turned = matrix.T  # by column and row, whether of one or of many
    turned[j, j] = turned[k, k] = np.cos(angle)
    turned[j, k], turned[k, j] = sine, -sine
    return matrix


def shift_along(axis: str, distance: float | FloatArray) -> FloatArray:
    """(4, 4) shift by ``distance`` m along a named axis; (n, 4, 4) by (n,) distances."""
    matrix = _units(distance)
    matrix.T[3, _AXIS_NUMBER[axis]] = distance
    return matrix


def _units(each: float | FloatArray) -> FloatArray:
    if isinstance(each, float):  # one
        return _UNIT.copy()
    units = np.empty((*np.shape(each), 4, 4))
    units[...] = _UNIT
    return units


def transform(matrix: FloatArray, x: FloatArray) -> FloatArray:
    """Points (n, 3) m through a (4, 4) rigid motion, or each through its own of (n, 4, 4)."""
    turned = x @ matrix[:3, :3].T if matrix.ndim == 2 else np.einsum("nij,nj->ni", matrix[:, :3, :3], x)
    moved: FloatArray = turned + matrix[..., :3, 3]
    return moved


def _warped(target: Target, warp: FloatArray, temperature: float) -> FloatArray:
    """Points of a board as it is, (n, 3) m, in the words of ``adjust.model.boards``."""
    x = target.x_in_target.copy()
    names = target.warp.names if target.warp is not None else ("warp_x", "warp_y")
    w = dict.fromkeys(BOARD, 0.0) | dict(zip(names, warp.tolist(), strict=True))
    span = np.ptp(x[:, :2], axis=0)
    u, v = ((x[:, :2] - x[:, :2].min(axis=0)) / np.where(span > 0.0, span, 1.0)).T
    grown = w["expansion"] * (temperature - target.reference_temperature) * x
    x[:, 2] += w["warp_x"] * 4.0 * u * (1.0 - u) + w["warp_y"] * 4.0 * v * (1.0 - v)
    x[:, 2] += w["warp_xy"] * (2.0 * u - 1.0) * (2.0 * v - 1.0)
    x[:, 0] += w["scale_x"] * x[:, 0] + w["shear"] * x[:, 1]
    x[:, 1] += w["scale_y"] * x[:, 1]
    x += grown
    return x


def _moving(axis: str, number: int, geometry: Mapping[str, float], angle: FloatArray) -> FloatArray:
    """(..., 4, 4): what the harmonics of an axis add to its turn by angles, in the words of ``adjust.model.tables``."""
    waves = [name for name in geometry if name.startswith(_WAVES[number])]
    if not waves:
        return _UNIT
    error: float | FloatArray = 0.0
    along: float | FloatArray = 0.0
    whirl: dict[str, Any] = {"radial": 0.0j, "tilt": 0.0j}  # of one angle or of many
    for name in waves:
        (kind, *rest), value = name.split("_"), geometry[name]
        order = int(rest[2].replace("m", "-").replace("p", ""))
        if kind in whirl:
            whirl[kind] += value * (1j if rest[1] == "im" else 1.0) * np.exp(1j * order * angle)
        elif kind == "angle":
            error += value * (np.cos if rest[1] == "cos" else np.sin)(order * angle)
        else:
            along += value * (np.cos if rest[1] == "cos" else np.sin)(order * angle)
    x, y = "yzx"["xyz".index(axis)], "zxy"["xyz".index(axis)]
    shift = shift_along(x, whirl["radial"].real) @ shift_along(y, whirl["radial"].imag) @ shift_along(axis, along)
    tilt = rotation_about(x, whirl["tilt"].real) @ rotation_about(y, whirl["tilt"].imag)
    moved: FloatArray = shift @ tilt @ rotation_about(axis, error)
    return moved


@frozen(eq=False)
class Scene:
    """A survey and its true values; the methods say what is where and what a camera would see.

    Where several times after an epoch are asked for, every (4, 4) is (n, 4, 4).
    """

    survey: Survey
    truth: Truth

    @cached_property
    def courses(self) -> Courses:
        """Where things are between the epochs."""
        return Courses(self.survey, self.truth)

    def pose(self, *name: str, late: Late = 0.0) -> FloatArray:
        """The true value (4, 4) of a pose, or where it is a time after its epoch."""
        if len(name) == 3 and np.any(late):
            return self.courses.pose(name, late)
        pose = self.truth[name]
        if not isinstance(pose, Pose3):
            raise TypeError(f"the truth of {name} is not a pose")
        matrix: FloatArray = pose.matrix()
        return matrix

    def vector(self, *name: str) -> FloatArray:
        """The true value of a parameter that is not a pose, (n,)."""
        value = self.truth[name]
        if isinstance(value, Pose3):
            raise TypeError(f"the truth of {name} is a pose")
        return value

    def table_from_mount(self, table_id: str, angles: FloatArray) -> FloatArray:
        """(4, 4) at angles (k,), (n, 4, 4) at (n, k): the chain as ``adjust.model.survey.Table`` writes it."""
        table = self.survey.tables_by_id[table_id]
        g = dict(zip(table.geometry.names, self.vector("table_geometry", table_id).tolist(), strict=True))
        if len(table.axes) == 1:
            a, axis = angles[..., 0], table.axes[0]
            return _moving(axis, 1, g, a) @ rotation_about(axis, a + g["zero_1"])
        outer, inner = table.axes
        third = next(axis for axis in "xyz" if axis not in (outer, inner))
        a, b = angles[..., 0], angles[..., 1]
        chain = (
            _moving(outer, 1, g, a), rotation_about(outer, a + g["zero_1"]), shift_along(third, g["axis_offset"]),
            rotation_about(third, g["non_orthogonality"]), _moving(inner, 2, g, b),
            rotation_about(inner, b + g["zero_2"]),
        )  # fmt: skip
        return reduce(np.matmul, [m for m in chain if m is not _UNIT])

    def world_from_station(self, station_id: str, epoch_id: str | None = None, late: Late = 0.0) -> FloatArray:
        """(4, 4) at an epoch, or a time after it: by the table where it was read then, else the station's own pose."""
        station = self.survey.stations_by_id[station_id]
        if station.motion == "fixed":
            return self.pose("world_from_station", station_id)
        if epoch_id is None:
            raise ValueError(f"station {station_id} moves; an epoch is needed")
        reading = ("table_angles", str(station.table_id), epoch_id)
        if station.motion == "epoch" or reading not in self.truth:
            return self.pose("world_from_station", station_id, epoch_id, late=late)
        return self.world_from_turned(station_id, self.angles(reading[1], epoch_id, late))

    def world_from_turned(self, station_id: str, angles: FloatArray) -> FloatArray:
        """(4, 4) of a station whose table stands at angles (k,) rad, (n, 4, 4) at (n, k)."""
        table_id = str(self.survey.stations_by_id[station_id].table_id)
        world_from_mount = self.pose("world_from_table", table_id) @ self.table_from_mount(table_id, angles)
        return np.asarray(world_from_mount @ self.pose("mount_from_station", station_id))

    def angles(self, table_id: str, epoch_id: str, late: Late = 0.0) -> FloatArray:
        """(k,) rad of a table at an epoch, or a time after it."""
        name = ("table_angles", table_id, epoch_id)
        return self.courses.angles(name, late) if np.any(late) else self.vector(*name)

    def world_from_camera(self, camera_id: str, epoch_id: str | None = None, late: Late = 0.0) -> FloatArray:
        """(4, 4) of a camera at an epoch, or a time after it."""
        station_id = self.survey.cameras_by_id[camera_id].station_id
        return self.world_from_station(station_id, epoch_id, late) @ self.pose("station_from_camera", camera_id)

    def world_from_target(self, target_id: str, epoch_id: str | None = None, late: Late = 0.0) -> FloatArray:
        """(4, 4) of a target at an epoch, or a time after it."""
        target = self.survey.targets_by_id[target_id]
        name: tuple[str, ...] = ("carrier_from_target", target_id)
        if target.motion == "epoch":
            name = (*name, str(epoch_id))
        on = target.station_id
        carrier = np.eye(4) if on is None else self.world_from_station(on, epoch_id, late)
        return carrier @ self.pose(*name, late=late)

    def target_points(
        self, target_id: str, epoch_id: str | None = None, late: Late = 0.0, points: IntArray | slice = slice(None)
    ) -> FloatArray:
        """The target's points in the world, (n, 3) m, or some of them."""
        target = self.survey.targets_by_id[target_id]
        warp, warmth = ("warp", target_id), self.survey.temperatures.get(str(epoch_id), target.reference_temperature)
        x = _warped(target, self.vector(*warp), warmth) if warp in self.truth else target.x_in_target
        return transform(self.world_from_target(target_id, epoch_id, late), x[points])

    def world_points(self) -> FloatArray:
        """All of the survey's points, (n, 3) m, in its order."""
        return np.array([self.vector("point", p.point_id) for p in self.survey.points]).reshape(-1, 3)

    def _lens(self, camera_id: str, epoch_id: str) -> dict[str, float]:
        """The parameters of a lens as it was at an epoch."""
        lens = dict(zip(BROWN, self.vector("lens", camera_id).tolist(), strict=True))
        drift = self.survey.cameras_by_id[camera_id].lens.drift
        if drift is None:
            return lens
        name: ParameterName = ("lens_drift", camera_id)
        factor, reference = 1.0, drift.reference_temperature
        if reference is not None:
            factor = self.survey.temperatures[epoch_id] - reference
        else:
            name = (*name, block_starts(self.survey, self.survey.cameras_by_id[camera_id])[epoch_id] or "")
        if name in self.truth:
            for parameter, value in zip(drift.parameters, self.vector(*name).tolist(), strict=True):
                lens[parameter] += factor * value
        return lens

    def image(self, block: ImageBlock) -> FloatArray:
        """Image coordinates (n, 2) px of what a block shows when its camera truly exposes, row by row."""
        camera, epoch = self.survey.cameras_by_id[block.camera_id], block.epoch_id
        name = ("camera_clock", block.camera_id)
        uv = self._seen(block, self.courses.late(name, camera.clock, epoch))
        if not rolls(camera):
            return uv
        middle = 0.5 * (camera.image_size[1] - 1)
        for _ in range(4):  # a row is where the point is when it is read
            uv = self._seen(block, self.courses.late(name, camera.clock, epoch, uv[:, 1] - middle))
        return uv

    def _seen(self, block: ImageBlock, late: Late) -> FloatArray:
        name, epoch, points = block.target_id, block.epoch_id, block.point_idx
        x = self.world_points()[points] if name is None else self.target_points(name, epoch, late, points)
        return self.project(block.camera_id, epoch, x, late)

    def project(self, camera_id: str, epoch_id: str, x_in_world: FloatArray, late: Late = 0.0) -> FloatArray:
        """Image coordinates (n, 2) px by OpenCV, NaN where a point is behind the camera or far outside its field."""
        camera_from_world = np.linalg.inv(self.world_from_camera(camera_id, epoch_id, late)).astype(np.float64)
        return self.pixels(camera_id, epoch_id, transform(camera_from_world, x_in_world))

    def pixels(self, camera_id: str, epoch_id: str, x: FloatArray) -> FloatArray:
        """The same of points (n, 3) m in the camera."""
        ahead = (x[:, 2] > 1e-3) & (np.hypot(x[:, 0], x[:, 1]) < _WIDEST_TANGENT * x[:, 2])
        uv = np.full((len(x), 2), np.nan)
        if not ahead.any():
            return uv
        lens = self._lens(camera_id, epoch_id)
        matrix = np.array([[lens["fx"], lens["skew"], lens["u0"]], [0.0, lens["fy"], lens["v0"]], [0.0, 0.0, 1.0]])
        distortion = np.array([lens[name] for name in _OPENCV_DISTORTION])
        # OpenCV ignores the skew of its camera matrix, so its part is added here from the normalized coordinates
        distorted = cv2.projectPoints(x[ahead], np.zeros(3), np.zeros(3), np.eye(3), distortion)[0].reshape(-1, 2)
        uv[ahead] = distorted @ matrix[:2, :2].T + matrix[:2, 2]
        return self._cropped(camera_id, epoch_id, uv)

    def _cropped(self, camera_id: str, epoch_id: str, uv: FloatArray) -> FloatArray:
        """Pixels of the image as it was cropped by then, from those of the whole."""
        camera = self.survey.cameras_by_id[camera_id]
        start = crop_starts(self.survey, camera).get(epoch_id) if camera.lens.crops else None
        if start is None:
            return uv
        name = ("lens_crop", camera_id, start)
        given = np.asarray(camera.lens.crops[start].parameters.values, dtype=float)
        scale, *edges = self.vector(*name) if name in self.truth else given
        return np.asarray(scale * (uv + 0.5 - edges) - 0.5)

    def inside(self, camera_id: str, uv: FloatArray, margin_px: float) -> BoolArray:
        """Which of the image points (..., 2) lie in the image, at least ``margin_px`` from its border."""
        size = np.array(self.survey.cameras_by_id[camera_id].image_size, dtype=float)
        with np.errstate(invalid="ignore"):
            within: BoolArray = np.all((uv >= margin_px) & (uv <= size - 1.0 - margin_px), axis=-1)
        return within

    def world_from_frame(self, frame: FrameRef, late: Late = 0.0) -> FloatArray:
        """(4, 4) of any named frame, of stations also a time after their epoch."""
        if frame.kind == "world":
            return np.eye(4)
        if frame.kind == "station":
            return self.world_from_station(frame.frame_id, frame.epoch_id, late if frame.epoch_id else 0.0)
        if frame.kind == "camera":
            return self.world_from_camera(frame.frame_id, frame.epoch_id)
        if frame.kind == "target":
            return self.world_from_target(frame.frame_id, frame.epoch_id)
        if frame.kind == "mount":
            angles = self.vector("table_angles", frame.frame_id, str(frame.epoch_id))
            return self.pose("world_from_table", frame.frame_id) @ self.table_from_mount(frame.frame_id, angles)
        return self.pose("world_from_table", frame.frame_id)

    def position(self, ref: PositionRef) -> FloatArray:
        """World coordinates (3,) m of a position."""
        if ref.frame is None:
            return self.vector("point", str(ref.point_id))
        if ref.point_id is None:
            origin: FloatArray = self.world_from_frame(ref.frame)[:3, 3]
            return origin
        target = self.survey.targets_by_id[ref.frame.frame_id]
        x: FloatArray = self.target_points(target.target_id, ref.frame.epoch_id)[target.point_ids.index(ref.point_id)]
        return x
