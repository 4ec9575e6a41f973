"""``plan.toml``: what is to be measured, what could be measured in addition, and the precision that is wanted."""

import math
from pathlib import Path
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.design import Candidate, Seeing
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, Survey
from survey.folder.text import id_problem
from survey.folder.units import to_si
from survey.planning.plan_navigation import NavigationPlan, read_navigation
from survey.planning.plan_readings import SINGLES, few, planned_poses, read_singles, tables_of
from survey.project.declared.node import Node, read_toml
from survey.project.tables.references import Names

PLAN_FILE = "plan.toml"
_EPOCH_KEYS = (
    *("name", "cameras", "targets", "points", "table", "angles_deg", "grid_deg", "station", "target", "poses"),
    *("count", "by_hand", "each_camera"),
)
_HAND_KEYS = ("camera", "target", "count", "distance_mm", "tilt_deg", "seed")
_SEEN_KEYS = ("margin_px", "nearest_mm", "farthest_mm", "widest_incidence_deg", "fewest_points", "two_sided")


@frozen(eq=False)
class Moment:
    """One planned epoch: what moves and where to, and which images are taken.

    angles: (k,) rad of ``table_id``. pose: of ``station_id`` (world_from_station) or ``target_id``
    (carrier_from_target).
    """

    epoch_id: str
    cameras: tuple[str, ...]
    targets: tuple[str, ...]
    points: bool
    table_id: str | None = None
    angles: FloatArray | None = None
    station_id: str | None = None
    target_id: str | None = None
    pose: Pose3 | None = None


@frozen
class ByHand:
    """Poses as a person would give them: a target anywhere in the frame of a camera, tilted, at some distance (m)."""

    camera_id: str
    target_id: str
    count: int
    distance: tuple[float, float]
    tilt: float
    seed: int


@frozen(eq=False)
class Moments:
    """A series of epochs; ``by_hand`` where their poses are still to be drawn."""

    moments: tuple[Moment, ...]
    by_hand: ByHand | None = None


@frozen(eq=False)
class NewPoint:
    """A beacon that could be added, with surveyed coordinates (sigma m) or without (nan)."""

    name: str
    x_in_world: FloatArray
    sigma: float


@frozen(eq=False)
class Measurements:
    """Epochs, single observations and new beacons, planned or possible; observations have no values yet."""

    epochs: tuple[Moments, ...] = ()
    singles: tuple[Candidate, ...] = ()
    points: tuple[NewPoint, ...] = ()


@frozen
class Requirement:
    """Sigmas (SI) that the components matching ``pattern`` must have, by unit: rad, m, px."""

    pattern: str
    sigma: dict[str, float]


@frozen(eq=False)
class Plan:
    """The whole file."""

    path: Path
    image_sigma_px: float | None
    seeing: Seeing
    planned: Measurements
    candidates: Measurements
    required: tuple[Requirement, ...] = ()
    wanted: tuple[str, ...] = ()
    navigation: NavigationPlan | None = None


def read_plan(folder: Path, survey: Survey) -> Plan:
    """Read ``plan.toml`` of a project folder. Raises SurveyError with file and line."""
    root, _ = read_toml(Path(folder) / PLAN_FILE)
    root.allow("image_sigma_px", "seen", "epochs", "candidates", "required", "wanted", "navigation", *SINGLES)
    names = Names.of(survey)
    candidates = root.table("candidates")
    candidates.allow("epochs", "points", *SINGLES)
    return Plan(
        path=Path(folder) / PLAN_FILE,
        image_sigma_px=root.si("image_sigma_px", None, True),
        seeing=_seeing(root.table("seen"), survey),
        planned=_measurements(root, survey, names, "p"),
        candidates=_measurements(candidates, survey, names, "c"),
        required=tuple(_requirement(node) for node in tables_of(root, "required")),
        wanted=root.names("wanted", ()),
        navigation=read_navigation(root.table("navigation"), survey) if root.has("navigation") else None,
    )


def _seeing(node: Node, survey: Survey) -> Seeing:
    node.allow(*_SEEN_KEYS)
    d = Seeing()
    targets = tuple(t.target_id for t in survey.targets)
    return Seeing(
        margin_px=node.number("margin_px", d.margin_px),
        nearest_m=node.si("nearest_mm", 1e3 * d.nearest_m, positive=True),
        farthest_m=node.si("farthest_mm", np.inf, True),
        widest_incidence=node.si("widest_incidence_deg", 70.0, positive=True),
        fewest_points=node.integer("fewest_points", 1, d.fewest_points),
        two_sided=node.references("two_sided", targets, "target", ()),
    )


def _measurements(node: Node, survey: Survey, names: Names, prefix: str) -> Measurements:
    return Measurements(
        tuple(_moments(n, survey, i) for i, n in enumerate(tables_of(node, "epochs"))),
        read_singles(node, names, prefix),
        tuple(_new_point(n, survey) for n in tables_of(node, "points")) if prefix == "c" else (),
    )


def _moments(node: Node, survey: Survey, number: int) -> Moments:
    node.allow(*_EPOCH_KEYS)
    prefix = node.text("name", f"p{number + 1}_")
    if problem := id_problem(prefix):
        raise node.error(problem, "name")
    cameras = node.references("cameras", (c.camera_id for c in survey.cameras), "camera",
                              tuple(c.camera_id for c in survey.cameras))  # fmt: skip
    targets = node.references("targets", (t.target_id for t in survey.targets), "target",
                              tuple(t.target_id for t in survey.targets))  # fmt: skip
    points = node.flag("points", bool(survey.points))
    kinds = [k for k in ("table", "poses", "count", "by_hand") if node.has(k)]
    if len(kinds) != 1:
        raise node.error("say what moves: one of table (with angles_deg or grid_deg), poses, by_hand, count")
    places, hand = _places(node, survey, kinds[0])
    each = [(c,) for c in cameras] if node.flag("each_camera", False) else [cameras]
    width = max(2, len(str(len(places))))
    moments = []
    for i, place in enumerate(places):
        for group in each:
            own = f"{prefix}{i + 1:0{width}d}" + (f"-{group[0]}" if len(each) > 1 else "")
            moments.append(Moment(own, group, targets, points, **place))
    return Moments(tuple(moments), hand)


def _places(node: Node, survey: Survey, kind: str) -> tuple[list[dict[str, Any]], ByHand | None]:
    """What moves where, one entry per epoch."""
    if kind == "count":
        return [{}] * few(node, node.integer("count", 1), "count"), None
    if kind == "by_hand":
        hand = _by_hand(node.table("by_hand"), survey)
        return [{}] * hand.count, hand
    if kind == "table":
        table = node.reference("table", (t.table_id for t in survey.tables), "table")
        axes = len(survey.tables_by_id[table].axes)
        return [{"table_id": table, "angles": a} for a in _angles(node, axes)], None
    if node.has("station") == node.has("target"):
        raise node.error("poses are of one thing; name a station or a target", "poses")
    key = "station" if node.has("station") else "target"
    known = [s.station_id for s in survey.stations] if key == "station" else [t.target_id for t in survey.targets]
    owner = node.reference(key, known, key)
    return [{f"{key}_id": owner, "pose": pose} for pose in planned_poses(node)], None


def _angles(node: Node, axes: int) -> list[FloatArray]:
    if node.has("angles_deg") == node.has("grid_deg"):
        raise node.error("give the table's angles once, as angles_deg or as grid_deg", "table")
    if node.has("angles_deg"):
        rows = node.value("angles_deg")
        n = len(rows) if isinstance(rows, list) else 0
        return list(to_si(node.numbers("angles_deg", (max(n, 1), axes)), "deg"))
    ranges = node.numbers("grid_deg", (axes, 3))
    for i, (low, high, step) in enumerate(ranges.tolist()):
        if step <= 0 or high < low:
            raise node.error(f"found [{low:g}, {high:g}, {step:g}]; expected [from, to, step] upwards", "grid_deg", i)
    few(node, math.prod((high - low) / step + 1.0 for low, high, step in ranges.tolist()), "grid_deg")
    lines = [np.arange(low, high + 1e-9, step) for low, high, step in ranges]
    grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, axes)
    return list(to_si(grid, "deg"))


def _by_hand(node: Node, survey: Survey) -> ByHand:
    node.allow(*_HAND_KEYS)
    near, far = to_si(node.numbers("distance_mm", (2,)), "mm").tolist()
    if not 0 < near <= far:
        raise node.error("expected [nearest, farthest]", "distance_mm")
    return ByHand(
        node.reference("camera", (c.camera_id for c in survey.cameras), "camera"),
        node.reference("target", (t.target_id for t in survey.targets), "target"),
        few(node, node.integer("count", 1), "count"), (near, far), node.si("tilt_deg", 40.0),
        node.integer("seed", 0, 1),
    )  # fmt: skip


def _new_point(node: Node, survey: Survey) -> NewPoint:
    node.allow("id", "x_mm", "sigma_mm")
    name = node.text("id")
    if problem := id_problem(name):
        raise node.error(problem, "id")
    if name in {p.point_id for p in survey.points}:
        raise node.error(f"{name!r} is a point of the survey already; give the new one another id", "id")
    return NewPoint(name, to_si(node.numbers("x_mm", (3,)), "mm"), node.si("sigma_mm", np.nan, True))


def _requirement(node: Node) -> Requirement:
    node.allow("of", "sigma_rotation_deg", "sigma_rotation_arcsec", "sigma_translation_mm", "sigma_mm", "sigma_px")
    sigma: dict[str, float] = {}
    for key, si in (("sigma_rotation_deg", "rad"), ("sigma_rotation_arcsec", "rad"), ("sigma_translation_mm", "m"),
                    ("sigma_mm", "m"), ("sigma_px", "px")):  # fmt: skip
        if node.has(key):
            if si in sigma:
                raise node.error("this sigma is given twice; keep one of the two", key)
            sigma[si] = node.si(key, positive=True)
    if not sigma:
        raise node.error("a requirement needs a sigma; add sigma_translation_mm, sigma_rotation_deg or sigma_px")
    return Requirement(node.text("of"), sigma)
