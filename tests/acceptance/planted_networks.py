"""Mistakes of networks, planted into surveys of readings, of measured poses, of a robot's poses."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.observations import FrameRef, PositionRef, Reading
from adjust.model.survey import FloatArray, Survey
from adjust.statistics.group_sums import scaled_survey
from survey.simulate.scene import Truth
from tests.acceptance.planted_images import Mistake, Plant, anything, of

Chosen = Callable[[Reading], bool]
SETUP = "S2"


def reread(chosen: Chosen, value: Callable[[float, float], float]) -> Plant:
    """Readings with other values: of the value and the size."""
    return lambda survey, _, size: replace(survey, readings=tuple(
        replace(r, value=value(r.value, size)) if chosen(r) else r
        for r in survey.readings))  # fmt: skip


def kind(*names: str, setup: str = "") -> Chosen:
    """Readings of these kinds, of one set-up or of all."""
    return lambda r: r.kind in names and (not setup or r.setup_id == setup)


def called(setup: str) -> Plant:
    """Two points called by each other's names as targets, in one set-up or in all; size: which pair."""
    pairs = (("P4", "P6"), ("P5", "P7"), ("P4", "P5"))

    def plant(survey: Survey, _: Truth, size: float) -> Survey:
        a, b = pairs[int(size)]
        other = {a: b, b: a}
        return replace(survey, readings=tuple(
            replace(r, to=PositionRef(other.get(str(r.to.point_id), r.to.point_id)))
            if (not setup or r.setup_id == setup) and r.at.point_id not in other else r
        for r in survey.readings))  # fmt: skip

    return plant


def with_given(survey: Survey, change: Callable[[str, FloatArray], FloatArray]) -> Survey:
    """Held coordinates of the points changed."""
    return replace(survey, points=tuple(
        p if p.x_in_world.treatment != "held" else
        replace(p, x_in_world=replace(p.x_in_world, value=change(p.point_id, np.asarray(p.x_in_world.value))))
        for p in survey.points))  # fmt: skip


def given_exchanged(survey: Survey, _: Truth, size: float) -> Survey:
    """Two of the given points have each other's coordinates; all others that are given: their number is the size."""
    x = {p.point_id: np.asarray(p.x_in_world.value) for p in survey.points}
    other = {"P0": "P1", "P1": "P0"}
    return with_given(survey, lambda n, v: x[other[n]] if n in other else v)


def more_held(count: int, plant: Plant) -> Plant:
    """The same after ``count`` points are held at their true coordinates."""

    def planted(survey: Survey, truth: Truth, size: float) -> Survey:
        held = {f"P{i}" for i in range(count)}
        points = tuple(
            replace(p, x_in_world=replace(p.x_in_world, value=np.asarray(truth["point", p.point_id]), treatment="held",
                                          held=()))
            if p.point_id in held else p for p in survey.points)  # fmt: skip
        return plant(replace(survey, points=points), truth, size)

    return planted


def slipped_given(survey: Survey, _: Truth, size: float) -> Survey:
    """The decimal point of the second given point's x has slipped."""
    return with_given(survey, lambda n, v: v * (size, 1.0, 1.0) if n == "P1" else v)


def other_axes(survey: Survey, _: Truth, size: float) -> Survey:
    """Given coordinates with x and y exchanged (0), in millimetres (1000) or read as such (0.001)."""
    M = np.eye(3)[[1, 0, 2]] if not size else size * np.eye(3)
    return with_given(survey, lambda _, v: M @ v)


def one_slip(survey: Survey, _: Truth, size: float) -> Survey:
    """One distance has a slipped decimal point."""
    name = next(r.reading_id for r in survey.readings if "distance" in r.kind and r.setup_id == SETUP)
    return replace(survey, readings=tuple(
        replace(r, value=size * r.value) if r.reading_id == name else r
        for r in survey.readings))  # fmt: skip


def height(field: str, chosen: Chosen) -> Plant:
    """A height that is wrong by ``size`` m."""
    return lambda survey, _, size: replace(survey, readings=tuple(
        replace(r, **{field: getattr(r, field) + size}) if chosen(r) else r
        for r in survey.readings))  # fmt: skip


def other_setup(survey: Survey, _: Truth, size: float) -> Survey:
    """Rows of set-up S2 to its last targets given to S1; size: of how many targets."""
    targets = {f"P{i}" for i in range(7, 7 - int(size), -1)}
    at = next(r.at for r in survey.readings if r.setup_id == "S1")
    heights = {r.setup_id: r.instrument_height for r in survey.readings}
    return replace(survey, readings=tuple(
        replace(r, setup_id="S1", at=at, instrument_height=heights["S1"])
        if r.setup_id == SETUP and r.to.point_id in targets and r.second is None else r
        for r in survey.readings))  # fmt: skip


def turned(survey: Survey, _: Truth, size: float) -> Survey:
    """The instrument of S2 was turned by ``size`` arcsec half way through its directions."""
    mine = [r.reading_id for r in survey.readings if r.setup_id == SETUP and r.kind == "direction"]
    last = set(mine[len(mine) // 2 :])
    return replace(survey, readings=tuple(
        replace(r, value=r.value + np.radians(size / 3600.0)) if r.reading_id in last else r
        for r in survey.readings))  # fmt: skip


def sigmas(group: str) -> Plant:
    """The sigmas of a group are ``size`` times what they should be."""
    return lambda survey, _, size: scaled_survey(survey, {group: size**2})


def odd(survey: Survey, _: Truth, size: float) -> Survey:
    """One distance with a sigma of next to nothing, whose error is that of the others."""
    name = next(r.reading_id for r in survey.readings if "distance" in r.kind and r.setup_id == SETUP)
    return replace(survey, readings=tuple(
        replace(r, sigma=size * r.sigma) if r.reading_id == name else r
        for r in survey.readings))  # fmt: skip


def correlated(survey: Survey, _: Truth, size: float) -> Survey:
    """Readings of each set-up and kind with an error in common, ``size`` times their own sigma, that nobody gives."""
    rng = np.random.default_rng(5)
    common = {(s, k): rng.standard_normal() for s in ("S0", "S1", "S2", "S3", "")
              for k in ("slope_distance", "horizontal_distance", "zenith")}  # fmt: skip
    return replace(survey, readings=tuple(
        replace(r, value=r.value + size * r.sigma * common.get((r.setup_id, r.kind), 0.0))
        for r in survey.readings))  # fmt: skip


# -- measured poses --------------------------------------------------------------------------------------------------

Motion = Pose3 | Rot3


def pairs(change: Callable[[Pose3], Pose3], chosen: Callable[[int, str, str], bool] = lambda *_: True) -> Plant:
    """Measured poses in another convention: of all, or of those chosen by number, id and group; size plays no part."""
    return lambda survey, _, size: replace(survey, pairs=tuple(
        replace(p, b_from_a=change(p.b_from_a)) if chosen(i, p.pair_id, p.group) else p
        for i, p in enumerate(survey.pairs)))  # fmt: skip


def some(change: Callable[[Pose3], Pose3]) -> Plant:
    """Of the number of the pair that the size says."""
    return lambda survey, truth, size: pairs(change, lambda i, *_: i == int(size))(survey, truth, size)


def inverted(m: Pose3) -> Pose3:
    return m.inverse()


def last_first(m: Pose3) -> Pose3:
    q = m.rotation().toQuaternion()
    return Pose3(Rot3.Quaternion(q.x(), q.y(), q.z(), q.w()), m.translation())


def rotation_back(m: Pose3) -> Pose3:
    return Pose3(m.rotation().inverse(), m.translation())


def euler_backwards(m: Pose3) -> Pose3:
    """Angles about x, y, z read as about z, y, x."""
    R = m.rotation().matrix()
    b = np.arcsin(R[0, 2])
    a, c = np.arctan2(-R[1, 2], R[2, 2]), np.arctan2(-R[0, 1], R[0, 0])
    return Pose3(Rot3.RzRyRx(a, b, c), m.translation())


def other_hand(m: Pose3) -> Pose3:
    S = np.diag([1.0, 1.0, -1.0])
    return Pose3(Rot3(S @ m.rotation().matrix() @ S), S @ m.translation())


def origin_of_b(m: Pose3) -> Pose3:
    return Pose3(m.rotation(), -(m.rotation().matrix().T @ m.translation()))


def in_unit(factor: float) -> Callable[[Pose3], Pose3]:
    return lambda m: Pose3(m.rotation(), factor * m.translation())


def shifted_poses(survey: Survey, _: Truth, size: float) -> Survey:
    """The robot's poses are ``size`` epochs late."""
    n, p = len(survey.pairs), survey.pairs
    by = int(size)
    return replace(survey, pairs=tuple(
        replace(x, b_from_a=p[(i - by) % n].b_from_a) for i, x in enumerate(p) if 0 <= i - by < n))  # fmt: skip


def poses_exchanged(survey: Survey, _: Truth, size: float) -> Survey:
    """Two of the robot's poses, ``size`` apart, changed places."""
    p = list(survey.pairs)
    a, b = 3, 3 + int(size)
    p[a], p[b] = replace(p[a], b_from_a=p[b].b_from_a), replace(p[b], b_from_a=p[a].b_from_a)
    return replace(survey, pairs=tuple(p))


def twice(survey: Survey, _: Truth, size: float) -> Survey:
    """A pose is there a second time, ``size`` mm elsewhere."""
    p = survey.pairs[4]
    other = p.b_from_a * Pose3(Rot3(), size / 1e3 * np.array([1.0, -0.5, 0.4]))
    return replace(survey, pairs=(*survey.pairs, replace(p, pair_id=f"{p.pair_id}b", b_from_a=other)))


def stations_exchanged(group: str) -> Plant:
    """Stations T3 and T6 are called by each other's names in the last pairs with either, a share of them."""
    other = {"T3": "T6", "T6": "T3"}

    def end(ref: FrameRef) -> FrameRef:
        return replace(ref, frame_id=other.get(ref.frame_id, ref.frame_id))

    def plant(survey: Survey, _: Truth, size: float) -> Survey:
        mine = [i for i, p in enumerate(survey.pairs) if {p.a.frame_id, p.b.frame_id} & {*other}]
        once = [i for i in mine if {survey.pairs[i].a.frame_id, survey.pairs[i].b.frame_id} != {*other}]
        last = {once[int(size)]} if group == "one" else set(mine[round((1.0 - size) * len(mine)) :])
        return replace(survey, pairs=tuple(
            replace(p, a=end(p.a), b=end(p.b)) if i in last else p for i, p in enumerate(survey.pairs)))  # fmt: skip

    return plant


def station_bumped(survey: Survey, _: Truth, size: float) -> Survey:
    """Station T4 was knocked by ``size`` mm after half of the pairs that have it."""
    mine = [i for i, p in enumerate(survey.pairs) if "T4" in (p.a.frame_id, p.b.frame_id)]
    late = set(mine[len(mine) // 2 :])
    knock = Pose3(Rot3.Rodrigues(size / 1e3 * np.array([0.1, 0.3, -0.2])), size / 1e3 * np.array([1.0, -0.5, 0.4]))
    return replace(survey, pairs=tuple(
        replace(p, b_from_a=p.b_from_a * knock if p.a.frame_id == "T4" else knock.inverse() * p.b_from_a)
        if i in late else p for i, p in enumerate(survey.pairs)))  # fmt: skip


BOTH, SPACE = ("hall", "plane"), ("hall",)
GON, INCH, FOOT = 1.0 / 0.9, 25.4, 0.3048
DISTANCES = ("slope_distance", "horizontal_distance")
ROBOTS = ("hand", "base")
ONE = (2.0, 7.0, 12.0)

NETWORK_MISTAKES = (
    Mistake("points exchanged", anything, BOTH, (0.0, 1.0, 2.0), called(SETUP), title="in one set-up"),
    Mistake("points exchanged", anything, BOTH, (0.0, 1.0, 2.0), called(""), title="as targets everywhere"),
    Mistake("given points exchanged", of("P0"), BOTH, (0.0,), more_held(3, given_exchanged)),
    Mistake("slipped decimal", of("P1"), BOTH, (0.1, 10.0, 0.01), more_held(3, slipped_given), title="of a coordinate"),
    Mistake("axes or unit of given coordinates", anything, BOTH, (0.0, 1e3, 1e-3), more_held(3, other_axes)),
    Mistake("slipped decimal", anything, BOTH, (0.1, 10.0, 100.0), one_slip, title="of a reading"),
    Mistake("unit of angles", anything, BOTH, (GON, 1.0 / GON), reread(kind("direction"), lambda v, s: s * v),
            title="of all directions"),
    Mistake("unit of angles", of(SETUP), BOTH, (GON, 1.0 / GON),
            reread(kind("direction", setup=SETUP), lambda v, s: s * v), title="of one set-up"),
    Mistake("unit of angles", anything, SPACE, (GON, 1.0 / GON), reread(kind("zenith"), lambda v, s: s * v),
            title="of zenith angles"),
    Mistake("angles from another zero", anything, SPACE, (90.0, 180.0, 360.0),
            reread(kind("zenith"), lambda v, s: np.radians(s) - v), title="everywhere"),
    Mistake("angles from another zero", of(SETUP), SPACE, (90.0, 180.0, 360.0),
            reread(kind("zenith", setup=SETUP), lambda v, s: np.radians(s) - v), title="in one set-up"),
    Mistake("sense of rotation", anything, BOTH, (0.0,),
            reread(kind("direction", "angle", "azimuth"), lambda v, s: -v), title="everywhere"),
    Mistake("sense of rotation", of(SETUP), BOTH, (0.0,), reread(kind("direction", setup=SETUP), lambda v, s: -v),
            title="in one set-up"),
    Mistake("unit of lengths", of(SETUP), BOTH, (1.0 / FOOT, 1e-3, 1e3),
            reread(kind(*DISTANCES, setup=SETUP), lambda v, s: s * v), title="of one set-up"),
    Mistake("unit of lengths", anything, BOTH, (1.0 / FOOT, 1e-3, 1e3),
            reread(kind(*DISTANCES, "height_difference"), lambda v, s: s * v), title="of all"),
    Mistake("sign of height differences", anything, SPACE, (0.0,), reread(kind("height_difference"), lambda v, s: -v)),
    Mistake("instrument height", anything, SPACE, (0.01, 0.1, 1.0),
            height("instrument_height", lambda r: r.setup_id == SETUP), ("target height",)),
    Mistake("target height", of("P2"), SPACE, (0.01, 0.1, 1.0),
            more_held(3, height("target_height", lambda r: r.to.point_id == "P2")), title="on a given point"),
    Mistake("prism constant", of(SETUP), BOTH, (0.004, 0.034, 0.2),
            reread(kind(*DISTANCES, setup=SETUP), lambda v, s: v + s), title="of one set-up"),
    Mistake("prism constant", anything, BOTH, (0.004, 0.034, 0.2), reread(kind(*DISTANCES), lambda v, s: v + s),
            title="of all"),
    Mistake("rows of another set-up", of(SETUP), BOTH, (1.0, 2.0, 3.0), other_setup),
    Mistake("set-up turned", of(SETUP), BOTH, (30.0, 120.0, 600.0), turned),
    Mistake("sigmas of a group", of("reading"), BOTH, (1 / 10, 1 / 4, 4.0), sigmas("reading")),
    Mistake("sigmas of a group", of("north"), ("poses",), (1 / 6, 4.0, 10.0), sigmas("north"),
            title="among others"),
    Mistake("odd sigma", anything, BOTH, (1e-2 / 2, 1e-3, 1e-4), odd),
    Mistake("correlated observations", anything, BOTH, (3.0, 6.0, 12.0), correlated),
    Mistake("pairs inverted", anything, ("hand", "base", "poses"), (0.0,), pairs(inverted), title="all"),
    Mistake("pairs inverted", anything, ("hand", "poses"), ONE, some(inverted), title="one"),
    Mistake("pairs inverted", of("north"), ("poses",), (0.0,), pairs(inverted, lambda i, n, g: g == "north"),
            title="of a group"),
    Mistake("pairs inverted", of("T4"), ("poses",), (0.0,), pairs(inverted, lambda i, n, g: "4" in n[1:].split("-")),
            title="of a station"),
    Mistake("unit of shifts", anything, ROBOTS, (0.0,), pairs(in_unit(1e-3)), title="m for mm"),
    Mistake("unit of shifts", anything, ROBOTS, (0.0,), pairs(in_unit(1e3)), title="mm for m"),
    Mistake("unit of shifts", anything, ROBOTS, (0.0,), pairs(in_unit(1.0 / 25.4)), title="inches for mm"),
    Mistake("unit of shifts", of("north"), ("poses",), (0.0,), pairs(in_unit(1e-3), lambda i, n, g: g == "north"),
            title="of a group"),
    Mistake("order of quaternions", anything, (*ROBOTS, "poses"), (0.0,), pairs(last_first), title="all"),
    Mistake("order of quaternions", anything, ("hand", "poses"), ONE, some(last_first), title="one"),
    Mistake("rotations inverted", anything, (*ROBOTS, "poses"), (0.0,), pairs(rotation_back)),
    Mistake("shift in other axes", anything, (*ROBOTS, "poses"), (0.0,), pairs(origin_of_b)),
    Mistake("order of Euler angles", anything, (*ROBOTS, "poses"), (0.0,), pairs(euler_backwards)),
    Mistake("left-handed frames", anything, ROBOTS, (0.0,), pairs(other_hand)),
    Mistake("epochs shifted", of("hand"), ROBOTS, (1.0, 2.0, -1.0), shifted_poses, title="of a robot"),
    Mistake("epochs exchanged", of("hand"), ROBOTS, (1.0, 3.0, 8.0), poses_exchanged, title="of a robot"),
    Mistake("the same twice", anything, ("hand", "poses"), (30.0, 100.0, 1000.0), twice),
    Mistake("stations exchanged", of("T3"), ("poses",), (0.2, 0.35, 0.5), stations_exchanged("since")),
    Mistake("stations exchanged", of("T3"), ("poses",), (1.0, 3.0, 6.0), stations_exchanged("one"),
            title="in one pair"),
    Mistake("station moved", of("T4"), ("poses",), (20.0, 60.0, 200.0), station_bumped, title="in a network of poses"),
)  # fmt: skip
