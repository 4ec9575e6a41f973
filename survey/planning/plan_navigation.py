"""Where the head will be navigated, how well its pose must be known, and where beacons could be: of ``plan.toml``."""

import math
from typing import Literal

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, Survey
from survey.folder.units import to_si
from survey.planning.plan_readings import few, planned_poses
from survey.project.declared.node import Node
from survey.project.declared.poses import rotation_from_euler

Criterion = Literal["worst", "mean"]
_CRITERIA: tuple[Criterion, ...] = ("worst", "mean")
_NAVIGATION_KEYS = (
    *("station", "sigma_px", "volume_mm", "steps", "attitudes_euler_xyz_deg", "turn_about", "turn_steps", "poses"),
    *("required_rotation_deg", "required_translation_mm", "beacon_sigma_mm", "room_mm", "spacing_mm", "criterion"),
    *("at_least", "camera_sigma_mm", "camera_sigma_deg", "places", "epochs"),
)


@frozen(eq=False)
class NavigationPlan:
    """Where the head will be, how well its pose must be known (rad, m per component), and where beacons could be.

    poses: world_from_station. epochs: patterns of planned epochs, whose poses come after these.
    places: (m, 3) m candidate places of beacons. sigmas of a spot (px), of a beacon, of the
    cameras' places (m) and attitudes (rad) on the head.
    """

    station_id: str | None
    poses: tuple[Pose3, ...]
    required_rotation: float
    required_translation: float
    places: FloatArray
    sigma_px: float
    beacon_sigma: float
    camera_sigma: tuple[float, float]
    criterion: Criterion
    at_least: int
    spacing: float
    epochs: tuple[str, ...] = ()


def read_navigation(node: Node, survey: Survey) -> NavigationPlan:
    """The table [navigation] of ``plan.toml``. Raises SurveyError."""
    node.allow(*_NAVIGATION_KEYS)
    stations = tuple(dict.fromkeys(c.station_id for c in survey.cameras))
    poses = _navigation_poses(node)
    if not poses and not node.has("epochs"):
        raise node.error("say where the head will be: poses, volume_mm with attitudes, or planned epochs")
    return NavigationPlan(
        node.reference("station", stations, "station") if node.has("station") else None,
        poses,
        node.si("required_rotation_deg", 0.17, positive=True),
        node.si("required_translation_mm", 1.0, positive=True),
        _beacon_places(node),
        node.number("sigma_px", 0.2, positive=True),
        node.si("beacon_sigma_mm", 0.4, positive=True),
        (
            node.si("camera_sigma_mm", 0.1, positive=True),
            node.si("camera_sigma_deg", 0.01, positive=True),
        ),
        node.choice("criterion", _CRITERIA, "worst"),
        node.integer("at_least", 1, 3),
        node.si("spacing_mm", 0.0),
        node.names("epochs", ()),
    )


def _navigation_poses(node: Node) -> tuple[Pose3, ...]:
    out = planned_poses(node)
    if not node.has("volume_mm"):
        return tuple(out)
    box = to_si(node.numbers("volume_mm", (3, 2)), "mm")
    steps = [int(v) for v in node.numbers("steps", (3,), [2, 2, 2])]
    attitudes = _attitudes(node)
    few(node, math.prod(max(n, 1) for n in steps) * len(attitudes), "steps")
    lines = [np.linspace(low, high, n) if n > 1 else np.array([0.5 * (low + high)])
             for (low, high), n in zip(box.tolist(), steps, strict=True)]  # fmt: skip
    places = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1)
    return (*out, *(Pose3(R, x) for x in places.reshape(-1, 3) for R in attitudes))


def _attitudes(node: Node) -> list[Rot3]:
    rows = node.value("attitudes_euler_xyz_deg", [[0.0, 0.0, 0.0]])
    n = len(rows) if isinstance(rows, list) else 1
    first = [rotation_from_euler(a) for a in to_si(node.numbers("attitudes_euler_xyz_deg", (n, 3), rows), "deg")]
    if not node.has("turn_about"):
        return first
    axis = "xyz".index(node.choice("turn_about", ("x", "y", "z")))
    count = node.integer("turn_steps", 1, 8)
    few(node, count * len(first), "turn_steps")
    turns = [rotation_from_euler(np.eye(3)[axis] * 2 * np.pi * k / count) for k in range(count)]
    return [turn * start for start in first for turn in turns]


def _beacon_places(node: Node) -> FloatArray:
    """Candidate places: a grid over the six walls of ``room_mm``, its step ``places`` per wall and edge."""
    if not node.has("room_mm"):
        return np.zeros((0, 3))
    box = to_si(node.numbers("room_mm", (3, 2)), "mm")
    n = node.integer("places", 2, 6)
    few(node, 6 * n**2, "places")
    inner = box[:, :1] + (np.arange(n) + 0.5) / n * (box[:, 1:] - box[:, :1])  # none of them in a corner
    out = []
    for axis in range(3):
        u, v = (i for i in range(3) if i != axis)
        grid = np.stack(np.meshgrid(inner[u], inner[v], indexing="ij"), axis=-1).reshape(-1, 2)
        for wall in box[axis]:
            x = np.empty((len(grid), 3))
            x[:, axis], x[:, u], x[:, v] = wall, grid[:, 0], grid[:, 1]
            out.append(x)
    return np.concatenate(out)
