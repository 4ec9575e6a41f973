"""What a picture of a survey shows, in world coordinates: cameras, stations, tables, targets, points.

Also the view in space, to be turned around on the screen: lines, points and ellipsoids as plain values for the page.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from gtsam import Pose3
from markupsafe import Markup

from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Target
from survey.report import drawing as d
from survey.report.markup import json_script, part
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import Scale

_MOST_EPOCHS = 24
_MOST_POINTS = 500
_MOST_NAMES = 80


@dataclass(frozen=True, eq=False)
class Spot:
    """A position (3,) m with its covariance (3, 3) m^2, a posteriori where the report is; ``kind`` point or station."""

    label: str
    kind: str
    x: FloatArray
    cov: FloatArray


@dataclass(frozen=True, eq=False)
class Shot:
    """A camera where it stood: ``world_from_camera``, half angles of its field of view; ``main`` of the first epoch."""

    camera_idx: int
    label: str
    pose: Pose3
    half_angles: tuple[float, float]
    main: bool


@dataclass(eq=False)
class Scene:
    """Everything to be drawn: outlines are closed polygons (k, 3) m, moves the origins of stations at single epochs."""

    spots: list[Spot] = field(default_factory=list)
    shots: list[Shot] = field(default_factory=list)
    outlines: list[tuple[str, FloatArray]] = field(default_factory=list)
    clouds: list[tuple[str, FloatArray]] = field(default_factory=list)
    tables: list[tuple[str, Pose3, tuple[str, ...]]] = field(default_factory=list)
    moves: list[FloatArray] = field(default_factory=list)
    n_left_out: int = 0

    def spot_places(self) -> FloatArray:
        """Of all spots, (n, 3)."""
        return np.array([s.x for s in self.spots]).reshape(-1, 3)

    def spot_covs(self) -> FloatArray:
        """Of all spots, (n, 3, 3)."""
        return np.array([s.cov for s in self.spots]).reshape(-1, 3, 3)

    def positions(self) -> FloatArray:
        """Everything with a place, (n, 3)."""
        parts = [self.spot_places()]
        parts.append(np.array([np.asarray(s.pose.translation()) for s in self.shots]).reshape(-1, 3))
        parts += [x for _, x in self.outlines + self.clouds]
        parts.append(np.array(self.moves).reshape(-1, 3))
        parts.append(np.array([np.asarray(p.translation()) for _, p, _ in self.tables]).reshape(-1, 3))
        return np.concatenate(parts)


def scene_of(adjustment: Adjustment, scale: Scale) -> Scene:
    """The scene at the adjusted values; of many epochs an even selection."""
    frames, scene = AdjustedFrames(adjustment), Scene()
    epochs = list(dict.fromkeys(b.epoch_id for b in adjustment.survey.image_blocks)) or [""]
    shown = [epochs[i] for i in np.unique(np.linspace(0, len(epochs) - 1, min(len(epochs), _MOST_EPOCHS)).astype(int))]
    _add_cameras(scene, adjustment, frames, shown)
    _add_stations(scene, adjustment, scale)
    _add_targets(scene, adjustment, frames, shown)
    for table in adjustment.survey.tables:
        pose = frames.world_from(FrameRef("table", table.table_id))
        if pose is not None:
            scene.tables.append((table.table_id, pose, table.axes))
    _add_points(scene, adjustment, scale)
    return scene


def _add_points(scene: Scene, adjustment: Adjustment, scale: Scale) -> None:
    points = [e for name, e in adjustment.estimates.items() if name[0] == "point"]
    every = max(1, -(-len(points) // _MOST_POINTS))
    scene.n_left_out = len(points) - len(points[::every])
    for estimate in points[::every]:
        x = np.asarray(estimate.value, dtype=float)
        scene.spots.append(Spot(estimate.name[1], "point", x, scale.factor**2 * estimate.cov))


def _add_cameras(scene: Scene, adjustment: Adjustment, frames: AdjustedFrames, epochs: list[str]) -> None:
    seen = {(b.camera_id, b.epoch_id) for b in adjustment.survey.image_blocks}
    for i, camera in enumerate(adjustment.survey.cameras):
        half_angles = _half_angles(adjustment, camera.camera_id)
        for epoch in epochs:
            # the first epoch shows all cameras together, the others only those that took an image
            main = epoch == epochs[0]
            pose = frames.world_from(FrameRef("camera", camera.camera_id, epoch))
            if pose is None or not (main or (camera.camera_id, epoch) in seen):
                continue
            if main or not any(s.pose.equals(pose, 1e-9) for s in scene.shots):
                scene.shots.append(Shot(i, camera.camera_id, pose, half_angles, main))


def _half_angles(adjustment: Adjustment, camera_id: str) -> tuple[float, float]:
    """Half the field of view from an fx in pixels, a drawing's 25 degrees where the lens names none."""
    camera = next(c for c in adjustment.survey.cameras if c.camera_id == camera_id)
    estimate = adjustment.estimates.get(("lens", camera_id))
    width, height = camera.image_size
    if estimate is None or isinstance(estimate.value, Pose3) or "fx" not in estimate.components:
        return np.radians(25.0), np.radians(25.0 * height / width)
    fx = float(estimate.value[estimate.components.index("fx")])
    return float(np.arctan(0.5 * width / fx)), float(np.arctan(0.5 * height / fx))


def _add_stations(scene: Scene, adjustment: Adjustment, scale: Scale) -> None:
    for name, estimate in adjustment.estimates.items():
        if name[0] == "world_from_station" and isinstance(estimate.value, Pose3):
            R = estimate.value.rotation().matrix()
            cov = scale.factor**2 * R @ estimate.cov[3:, 3:] @ R.T
            x = np.asarray(estimate.value.translation())
            if len(name) == 2:
                scene.spots.append(Spot(name[1], "station", x, cov))
            else:
                scene.moves.append(x)


def _add_targets(scene: Scene, adjustment: Adjustment, frames: AdjustedFrames, epochs: list[str]) -> None:
    for target in adjustment.survey.targets:
        for epoch in epochs if target.motion == "epoch" else epochs[:1]:
            pose = frames.world_from(FrameRef("target", target.target_id, epoch))
            if pose is None:
                continue
            label = target.target_id if epoch == epochs[0] else ""
            flat = np.ptp(target.x_in_target[:, 2]) < 1e-3 * max(float(np.ptp(target.x_in_target, axis=0).max()), 1e-9)
            if flat and len(target.x_in_target) > 3:
                scene.outlines.append((label, pose.transformFrom(_corners(target).T).T))
            else:
                scene.clouds.append((label, pose.transformFrom(np.asarray(target.x_in_target, dtype=float).T).T))


def _corners(target: Target) -> FloatArray:
    (x0, y0, z0), (x1, y1, _) = target.x_in_target.min(axis=0), target.x_in_target.max(axis=0)
    return np.array([(x0, y0, z0), (x1, y0, z0), (x1, y1, z0), (x0, y1, z0)])


def enlargement(scene: Scene, ellipsoid: float, extent: float) -> float:
    """How much ellipsoids are enlarged, a round number: a typical one to 3.5 %, the largest to 20 % of the extent."""
    largest = np.linalg.eigvalsh(scene.spot_covs())[:, -1]
    if not (largest > 0.0).any():
        return 1.0
    semi_axes = ellipsoid * np.sqrt(largest[largest > 0.0])
    return d.round_below(extent * min(0.035 / float(np.median(semi_axes)), 0.2 / float(semi_axes.max())))


def space(scene: Scene, ellipsoid: float) -> Markup:
    """Canvas, slider and data; nothing for an empty scene. ``ellipsoid``: semi-axes of the region, in sigmas."""
    everything = scene.positions()
    if not len(everything):
        return Markup()
    low, high = everything.min(axis=0), everything.max(axis=0)
    reach = max(float(np.linalg.norm(high - low)) / 2.0, 1e-3)
    data = {
        "middle": rounded(0.5 * (low + high)),
        "reach": reach,
        "enlarged": enlargement(scene, ellipsoid, 2.0 * reach),
        "lines": _ground(low, high) + _lines(scene, reach),
        "spots": _spots(scene, ellipsoid),
        "labels": _names(scene),
    }
    return part("space", of="report.html") + json_script("space-data", data)


def rounded(x: FloatArray) -> Any:
    """Coordinates to a hundredth of a millimetre: enough for a picture."""
    return np.round(x, 5).tolist()


def _spots(scene: Scene, ellipsoid: float) -> list[dict[str, Any]]:
    variances, vectors = np.linalg.eigh(scene.spot_covs())
    axes = np.swapaxes(vectors * (ellipsoid * np.sqrt(np.clip(variances, 0.0, None)))[:, None], 1, 2)
    # seven significant digits: enlarged ellipsoids stay round, and equal input gives equal bytes
    shown = ([[float(f"{a:.7g}") for a in axis] for axis in of_one] for of_one in axes.tolist())
    return [
        {"x": x, "axes": own, "colour": d.RED if s.kind == "point" else d.GREEN}
        for s, x, own in zip(scene.spots, rounded(scene.spot_places()), shown, strict=True)
    ]


def _line(x: FloatArray, colour: str, width: float, alpha: float = 1.0) -> dict[str, Any]:
    return {"x": rounded(x), "colour": colour, "width": width, "alpha": alpha}


def _ground(low: FloatArray, high: FloatArray) -> list[dict[str, Any]]:
    step = d.round_below(float((high - low)[:2].max()) / 4.0)
    out = []
    for axis in (0, 1):
        other = 1 - axis
        for at in np.arange(np.ceil(low[axis] / step), np.floor(high[axis] / step) + 1) * step:
            ends = np.array([low, low])
            ends[:, axis], ends[1, other] = at, high[other]
            out.append(_line(ends, d.GRID, 1.0))
    return out


def _lines(scene: Scene, reach: float) -> list[dict[str, Any]]:
    out = [_line(np.vstack([x, x[:1]]), d.INK, 1.2) for _, x in scene.outlines]
    for i, colour in enumerate((d.X_AXIS, d.Y_AXIS, d.Z_AXIS)):
        out.append(_line(np.array([np.zeros(3), 0.14 * reach * np.eye(3)[i]]), colour, 2.0))
    for _, pose, axes in scene.tables:
        for axis in axes:
            end = 0.12 * reach * np.eye(3)["xyz".index(axis)]
            out.append(_line(pose.transformFrom(np.column_stack([-end, end])).T, d.INK, 1.2))
    for shot in scene.shots:
        colour = d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)]
        out += [_line(x, colour, 1.1 if shot.main else 0.8, 1.0 if shot.main else 0.4) for x in _frustum(shot, reach)]
    cross = 0.006 * reach * np.eye(3)
    for _, cloud in scene.clouds:
        out += [_line(np.array([x - c, x + c]), d.INK, 1.0) for x in cloud for c in cross]
    return out


def _frustum(shot: Shot, reach: float) -> list[FloatArray]:
    depth = 0.15 * reach
    if not shot.main:
        return [shot.pose.transformFrom(np.array([(0.0, 0.0, 0.0), (0.0, 0.0, 1.3 * depth)]).T).T]
    tx, ty = np.tan(shot.half_angles)
    rim = depth * np.array([(-tx, -ty, 1.0), (tx, -ty, 1.0), (tx, ty, 1.0), (-tx, ty, 1.0), (-tx, -ty, 1.0)])
    corners = shot.pose.transformFrom(rim.T).T
    eye = np.asarray(shot.pose.translation())
    return [corners, *(np.array([eye, corner]) for corner in corners[:4])]


def _names(scene: Scene) -> list[dict[str, Any]]:
    out = [(label, x.mean(axis=0), d.INK) for label, x in scene.outlines + scene.clouds if label]
    for shot in scene.shots:
        if shot.main:
            colour = d.CAMERA_COLOURS[shot.camera_idx % len(d.CAMERA_COLOURS)]
            out.append((shot.label, np.asarray(shot.pose.translation()), colour))
    out += [(table_id, np.asarray(pose.translation()), d.INK) for table_id, pose, _ in scene.tables]
    out += [(s.label, s.x, d.RED if s.kind == "point" else d.GREEN) for s in scene.spots if s.label]
    return [{"text": text, "x": rounded(x), "colour": colour} for text, x, colour in out[:_MOST_NAMES]]
