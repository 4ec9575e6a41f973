"""What a picture of a survey shows, in world coordinates: cameras, stations, tables, targets, points.

Also the view in space, to be turned around on the screen: lines, points and ellipsoids as plain values for the page.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from gtsam import Pose3
from markupsafe import Markup

from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Target
from survey.folder.plain import plain
from survey.report import drawing as d
from survey.report.markup import json_of, json_script, part
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import Scale

_MOST_EPOCHS = 24
_MOST_SPOTS = 500
"""Points, and stations, that are drawn: all, or an even selection of either."""
T = TypeVar("T")


@frozen(eq=False)
class Spot:
    """A position (3,) m with its covariance (3, 3) m^2, a posteriori where the report is; ``kind`` point or station."""

    label: str
    kind: str
    x: FloatArray
    cov: FloatArray


@frozen(eq=False)
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
    shown = _shown(adjustment)
    _add_cameras(scene, adjustment, frames, shown)
    _add_stations(scene, adjustment, scale)
    _add_targets(scene, adjustment, frames, shown)
    for table in adjustment.survey.tables:
        pose = frames.world_from(FrameRef("table", table.table_id))
        if pose is not None:
            scene.tables.append((table.table_id, pose, table.axes))
    _add_points(scene, adjustment, scale)
    return scene


def _shown(adjustment: Adjustment) -> list[str]:
    """Epochs that are drawn: all, or an even selection."""
    epochs = list(dict.fromkeys(b.epoch_id for b in adjustment.survey.image_blocks)) or [""]
    return [epochs[i] for i in np.unique(np.linspace(0, len(epochs) - 1, min(len(epochs), _MOST_EPOCHS)).astype(int))]


def _selected(scene: Scene, found: Sequence[T]) -> Sequence[T]:
    """What is drawn of these; how many are not is counted."""
    some = found[:: max(1, -(-len(found) // _MOST_SPOTS))]
    scene.n_left_out += len(found) - len(some)
    return some


def _add_points(scene: Scene, adjustment: Adjustment, scale: Scale) -> None:
    points = [e for name, e in adjustment.estimates.items() if name[0] == "point"]
    for estimate in _selected(scene, points):
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
    camera = adjustment.survey.cameras_by_id[camera_id]
    estimate = adjustment.estimates.get(("lens", camera_id))
    width, height = camera.image_size
    if estimate is None or isinstance(estimate.value, Pose3) or "fx" not in estimate.components:
        return np.radians(25.0), np.radians(25.0 * height / width)
    fx = float(estimate.value[estimate.components.index("fx")])
    return float(np.arctan(0.5 * width / fx)), float(np.arctan(0.5 * height / fx))


def _add_stations(scene: Scene, adjustment: Adjustment, scale: Scale) -> None:
    found = [(name, e.value, e.cov) for name, e in adjustment.estimates.items()
             if name[0] == "world_from_station" and isinstance(e.value, Pose3)]  # fmt: skip
    scene.moves += [np.asarray(pose.translation()) for name, pose, _ in found if len(name) > 2]
    fixed = _selected(scene, [(name[1], pose, cov) for name, pose, cov in found if len(name) == 2])
    R = np.array([pose.rotation().matrix() for _, pose, _ in fixed]).reshape(-1, 3, 3)
    covs = R @ np.array([cov[3:, 3:] for *_, cov in fixed]).reshape(-1, 3, 3) @ np.swapaxes(R, 1, 2)
    scene.spots += [Spot(label, "station", np.asarray(pose.translation()), cov)
                    for (label, pose, _), cov in zip(fixed, scale.factor**2 * covs, strict=True)]  # fmt: skip


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


def scene_values(adjustment: Adjustment, scale: Scale, drawn: Scene | None = None) -> dict[str, object]:
    """The scene as a page draws it, in the world (m), covariances (m^2) as sigmas are given.

    images: ``world_from_camera`` by image, three rows of four; of all images, or, where ``drawn`` is given already, of
    its epochs alone.
    """
    every = drawn is None
    drawn, frames = drawn or scene_of(adjustment, scale), AdjustedFrames(adjustment)
    taken = dict.fromkeys((b.camera_id, b.epoch_id) for b in adjustment.survey.image_blocks)
    shown = set(_shown(adjustment))
    poses = {key: frames.world_from(FrameRef("camera", *key)) for key in taken if every or key[1] in shown}
    return drawn_values(drawn, scale.ellipsoid, {"/".join(k): pose for k, pose in poses.items() if pose is not None})


def drawn_values(
    drawn: Scene, ellipsoid: float, images: Mapping[str, Pose3] = MappingProxyType({})
) -> dict[str, object]:
    """The same of any scene; images: ``world_from_camera`` by image."""
    return dict(plain({
        "ellipsoid": ellipsoid,
        "images": {name: pose.matrix()[:3].ravel() for name, pose in images.items()},
        "cameras": {s.label: {"index": s.camera_idx, "half_angles_rad": s.half_angles} for s in drawn.shots},
        "spots": [{"id": s.label, "kind": s.kind, "x": x, "cov": cov} for s, x, cov in zip(
            drawn.spots, drawn.spot_places().tolist(), drawn.spot_covs().reshape(-1, 9).tolist(), strict=True)],
        "outlines": [{"target": label, "x": x} for label, x in drawn.outlines],
        "clouds": [{"target": label, "x": x} for label, x in drawn.clouds],
        "tables": [{"id": table, "world_from_table": pose.matrix()[:3].ravel(), "axes": axes}
                   for table, pose, axes in drawn.tables],
        "moves": drawn.moves, "n_left_out": drawn.n_left_out,
    }))  # fmt: skip


def space(adjustment: Adjustment, scale: Scale, scene: Scene) -> Markup:
    """The place of the view in space and its data; nothing for an empty scene."""
    everything = scene.positions()
    if not len(everything):
        return Markup()
    extent = float(np.linalg.norm(np.ptp(everything, axis=0)))
    data = scene_values(adjustment, scale, scene) | {"enlarged": enlargement(scene, scale.ellipsoid, extent)}
    return part("space", of="report.html") + json_script("space-data", json_of(_short(data)))


def _short(value: object) -> object:
    """Numbers to seven significant digits: enlarged ellipsoids stay round, and equal input gives equal bytes."""
    if isinstance(value, float):
        return float(f"{value:.7g}")
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    return [_short(v) for v in value] if isinstance(value, list | tuple) else value
