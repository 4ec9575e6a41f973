"""Angles of a table at which a board fills a camera's image, from what is roughly known of lens and poses."""

import math
from collections.abc import Sequence

import numpy as np
from gtsam import Pose3

from adjust.lenses.models import camera_constants, lens_model, monotone_radius_px, project
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, Camera, FloatArray, PoseParameter, Station, Survey, Target
from adjust.start.network import table_from_mount
from capture.plan.table import AxisPlan, TablePlan

_CELLS = (12, 10)
_LEAST_GAIN = 0.5  # of a cell: what a pose must add before poses are taken for the sake of their angle


@frozen
class CoverRequest:
    """How to cover: number of poses, margin at the border (px), steps per axis in the search, steepest view (rad)."""

    count: int = 12
    margin_px: float = 12.0
    steps: int = 41
    steepest: float = math.radians(65.0)


def cover_board(
    survey: Survey, camera: Camera, target: Target, table: TablePlan, request: CoverRequest
) -> FloatArray:
    """Angles (m, n) rad, m <= count, in an order with short ways.

    From a lattice within the table's limits those views are kept that show the whole target; of these the one is taken
    that covers most of what is not covered yet, counting a second and third view of a cell for less, until there are
    enough. Raises ValueError where something is not known or the target is never seen whole.
    """
    coarse = _lattice(table, request.steps)
    visible = [row for row in coarse if _view(survey, camera, target, row, request) is not None]
    if not visible:
        raise ValueError(
            f"camera {camera.camera_id!r} never sees {target.target_id!r} whole within the table's limits; check the "
            "approximate poses in the survey, or widen the limits"
        )
    fine = _refined(np.array(visible), table, request.steps)
    views = [(row, _view(survey, camera, target, row, request)) for row in fine]
    seen = [(row, _cells(uv, camera)) for row, uv in views if uv is not None]
    angles = np.array([row for row, _ in seen])
    return _short_way(angles[_greedy(np.array([mask for _, mask in seen]), angles, request.count)])


def _lattice(table: TablePlan, steps: int) -> FloatArray:
    values = [np.linspace(a.axis.lower, _end(a), steps) for a in table.axes]
    return np.stack([grid.ravel() for grid in np.meshgrid(*values, indexing="ij")], axis=1)


def _end(axis: AxisPlan) -> float:
    return min(axis.axis.upper, axis.axis.lower + 2 * math.pi)


def _refined(angles: FloatArray, table: TablePlan, steps: int) -> FloatArray:
    """Steps six times as fine around angles (m, n), out to their neighbours, within the limits."""
    step = np.array([(_end(a) - a.axis.lower) / (steps - 1) for a in table.axes])
    offsets = np.stack([g.ravel() for g in np.meshgrid(*[np.arange(-5, 6) / 6] * len(step), indexing="ij")], axis=1)
    lower, upper = (np.array([getattr(a.axis, end) for a in table.axes]) for end in ("lower", "upper"))
    rows = np.clip((angles[:, None] + offsets * step).reshape(-1, len(step)), lower, upper)
    return np.asarray(np.unique(np.round(rows, 6), axis=0).clip(lower, upper))


def _known(parameter: PoseParameter, name: str) -> FloatArray:
    if parameter.value is None:
        if parameter.treatment == "held":
            return np.eye(4)
        raise ValueError(f"{name} has no approximate value in the survey; give it translation_mm and a rotation")
    matrix: FloatArray = parameter.value.matrix()
    return matrix


def _world_from_station(survey: Survey, station: Station, angles: FloatArray) -> FloatArray:
    if station.motion == "fixed":
        return _known(station.world_from_station, f"world_from_station of {station.station_id!r}")
    if station.motion == "epoch":
        raise ValueError(f"station {station.station_id!r} is moved by hand: no table angles help")
    table = survey.tables_by_id[station.table_id or ""]
    world_from_table = _known(table.world_from_table, f"world_from_table of {table.table_id!r}")
    mount_from_station = _known(station.mount_from_station, f"mount_from_station of {station.station_id!r}")
    return np.asarray(world_from_table @ table_from_mount(table, [angles])[0] @ mount_from_station)


def _camera_from_target(survey: Survey, camera: Camera, target: Target, angles: FloatArray) -> FloatArray:
    stations = survey.stations_by_id
    world_from_station = _world_from_station(survey, stations[camera.station_id], angles)
    world_from_camera = world_from_station @ _known(
        camera.station_from_camera, f"station_from_camera of {camera.camera_id!r}"
    )
    if target.motion == "epoch":
        raise ValueError(f"target {target.target_id!r} is held by hand: no table angles help")
    world_from_target = _known(target.carrier_from_target, f"the pose of target {target.target_id!r}")
    if target.station_id is not None:
        world_from_target = _world_from_station(survey, stations[target.station_id], angles) @ world_from_target
    return np.asarray(Pose3(world_from_camera).inverse().matrix() @ world_from_target)


def _view(
    survey: Survey, camera: Camera, target: Target, angles: FloatArray, request: CoverRequest
) -> FloatArray | None:
    """Image points (n, 2) px of the whole target, None where a part of it is not seen or it is seen too obliquely."""
    camera_from_target = _camera_from_target(survey, camera, target, angles)
    x = target.x_in_target @ camera_from_target[:3, :3].T + camera_from_target[:3, 3]
    if (x[:, 2] < 1e-3).any() or not _front(camera_from_target, x, request.steepest):
        return None
    if camera.lens.values is None:
        raise ValueError(f"the lens of camera {camera.camera_id!r} has no approximate values in the survey")
    model, constants = lens_model(camera.lens.model), camera_constants(camera)
    width, height = camera.image_size
    # a distorted lens folds points from far outside back into the image: the field's edge by its own inverse
    reach = math.hypot(width, height) / camera.lens.values[0] * (constants[0] if model.in_mm else 1.0)
    if (np.hypot(x[:, 0], x[:, 1]) > reach * x[:, 2]).any():
        return None
    uv = project(model, camera.lens.values, constants, x)
    radius = np.linalg.norm(uv - constants[1:3], axis=1)
    if radius.max() > monotone_radius_px(model, camera.lens.values, constants):
        return None
    inside: BoolArray = (uv >= request.margin_px) & (uv <= np.array([width, height]) - 1 - request.margin_px)
    return uv if inside.all() else None


def _front(camera_from_target: FloatArray, x: FloatArray, steepest: float) -> bool:
    """Whether the target shows its front: z points away from the camera where x is right and y down."""
    centre = x.mean(axis=0)
    normal = camera_from_target[:3, 2]
    return bool(normal @ centre / np.linalg.norm(centre) > math.cos(steepest))


def _cells(uv: FloatArray, camera: Camera) -> FloatArray:
    """Which cells of the image the points lie in, flat."""
    columns, rows = _CELLS
    cell = np.floor(uv / np.array(camera.image_size) * (columns, rows)).astype(int)
    mask = np.zeros((rows, columns))
    mask[np.clip(cell[:, 1], 0, rows - 1), np.clip(cell[:, 0], 0, columns - 1)] = 1.0
    return mask.ravel()


def _greedy(masks: FloatArray, angles: FloatArray, count: int) -> list[int]:
    """Rows that cover best; once all is covered often, those farthest from the ones taken already."""
    views = np.zeros(masks.shape[1])
    chosen: list[int] = []
    for _ in range(min(count, len(masks))):
        gain = masks @ (0.25**views)
        gain[chosen] = -1.0
        best = int(np.argmax(gain))
        if chosen and gain[best] < _LEAST_GAIN:
            far = np.min(np.linalg.norm(angles[:, None] - angles[chosen][None], axis=2), axis=1)
            best = int(np.argmax(far))
        chosen.append(best)
        views += masks[best]
    return chosen


def _short_way(angles: FloatArray) -> FloatArray:
    """The nearest next one, from the first."""
    left: Sequence[int] = list(range(1, len(angles)))
    order = [0]
    while left:
        nearest = min(left, key=lambda i: float(np.abs(angles[i] - angles[order[-1]]).max()))
        order.append(nearest)
        left = [i for i in left if i != nearest]
    return angles[order]
