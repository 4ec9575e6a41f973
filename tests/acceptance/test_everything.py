"""One laboratory with everything in one graph: cameras, turntable, beacons, total station, caliper, levels, laser.

The head on its table calibrates before the board and turns to the beacons; a total station on two tripods reads the
beacons and the board; the caliper joins beacons; levels stand on the board's rail and on the table.
"""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import chi2

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import GraphBuilder, StartValues
from adjust.graph.solver import SolveOptions, solve
from adjust.model.errors import IndeterminateError
from adjust.model.observations import Distance, FrameRef, LaserSpot, Level, PositionRef, Reading
from adjust.model.result import Adjustment
from adjust.model.survey import (
    TILT,
    Beam,
    Bearings,
    Instrument,
    Point,
    Setup,
    Survey,
    VectorParameter,
    VectorPrior,
    Vertical,
)
from survey.simulate import beacons, resample
from tests.sizes import size

ARCSEC = np.pi / 648000
TABLE = ("world_from_table", "turntable")
UP = np.array([0.05, -0.99, 0.1]) / np.linalg.norm([0.05, -0.99, 0.1])
RUNS = size(60)


def laboratory() -> tuple[Survey, dict]:
    """The simulated survey with error-free readings added, and its truth."""
    survey, truth = beacons(5, n_night_epochs=5, n_table_epochs=4, n_free_epochs=2)
    truth = dict(truth)
    truth["point", "T1"], truth["point", "T2"] = np.array([0.9, 1.1, -1.9]), np.array([-1.1, 1.2, -1.3])
    truth["orientation", "T1a"], truth["orientation", "T2a"] = np.array([0.4]), np.array([-1.2])
    truth["instrument", "TS"] = np.array([0.0007, 0.0, 0.0, 0.0])
    truth["vertical",] = np.array([0.002, -0.003])
    truth["beam", "laser"] = np.array([0.01, -0.02, 0.02, 0.03])
    board = [PositionRef(name, FrameRef("target", "board")) for name in ("r0c0", "r0c5", "r4c0")]
    readings = []
    for station in ("T1", "T2"):
        other = PositionRef("T2" if station == "T1" else "T1")
        for to in (other, *board, *(PositionRef(p.point_id) for p in survey.points)):
            for kind, sigma in (("direction", 3 * ARCSEC), ("zenith", 4 * ARCSEC), ("slope_distance", 8e-4)):
                readings.append(Reading(f"{kind} {len(readings)}", kind, PositionRef(station), to, 0.0, sigma,
                                        f"{station}a", group="total station"))  # fmt: skip
    prior = VectorPrior(("distance_offset",), np.zeros(1), np.array([[1e-6]]))
    offset = VectorParameter(("distance_offset", "distance_scale", "refraction", "vertical_index"), np.zeros(4),
                             ("distance_offset",), prior)  # fmt: skip
    spots = ("t09", "t10", "t11", "t12")  # those at which the mount's z axis meets the board
    calipers = tuple(Distance(f"caliper {a}{b}", PositionRef(a), PositionRef(b), 1.0, 2e-4, "caliper")
                     for a, b in (("B01", "B02"), ("B03", "B04"), ("B05", "B06"), ("B09", "B10")))  # fmt: skip
    return replace(
        survey,
        points=(*survey.points, Point("T1"), Point("T2")),
        coordinates=(), distances=calipers,
        vertical=Vertical(UP, VectorParameter(TILT, np.zeros(2), TILT)), bearings=Bearings("x"),
        instruments=(Instrument("TS", offset),), setups=(Setup("T1a", "TS"), Setup("T2a", "TS")),
        readings=tuple(readings),
        levels=tuple(Level(f"board {i}", FrameRef("target", "board"), np.eye(3)[i], 0.0, 10 * ARCSEC) for i in (0, 2))
        + (Level("table", FrameRef("table", "turntable"), np.eye(3)[0], 0.0, 10 * ARCSEC),),
        beams=(Beam("laser", "mount", "turntable"),),
        laser_spots=tuple(LaserSpot(e, "laser", e, "board", np.zeros(2), 1e-8 * np.eye(2)) for e in spots),
    ), truth  # fmt: skip


def start_of(truth: dict) -> StartValues:
    return StartValues(
        {n[1]: v for n, v in truth.items() if n[0] == "lens"},
        {n: v for n, v in truth.items() if isinstance(v, Pose3)},
        {n[1]: v for n, v in truth.items() if n[0] == "point"},
        {n: v for n, v in truth.items() if n[0] not in ("lens", "point") and not isinstance(v, Pose3)},
    )


def graph_of(survey: Survey, truth: dict):
    start = start_of(truth)
    return GraphBuilder(survey, start.lenses).build(start)


def adjusted(survey: Survey, truth: dict) -> Adjustment:
    graph = graph_of(survey, truth)
    return assemble(graph, solve(graph), AdjustOptions())


def observed(survey: Survey, points: set[str]) -> Survey:
    """Only the points that are left."""
    ids = [p.point_id for p in survey.points]
    kept = tuple(p for p in survey.points if p.point_id in points)
    index = {p.point_id: i for i, p in enumerate(kept)}
    blocks = tuple(b if b.target_id else replace(b, point_idx=np.array([index[ids[int(i)]] for i in b.point_idx]))
                   for b in survey.image_blocks)  # fmt: skip
    return replace(survey, points=kept, image_blocks=blocks)


def without(survey: Survey, *groups: str) -> Survey:
    """The survey less some kinds of observation, and less what only they show."""
    beacon_ids = {p.point_id for p in survey.points if p.point_id.startswith("B")}
    points = set(beacon_ids)
    if "total station" in groups:
        survey = replace(survey, readings=(), setups=(), instruments=())
    else:
        points |= {"T1", "T2"}
    if "caliper" in groups:
        survey = replace(survey, distances=())
    if "levels" in groups:
        survey = replace(survey, levels=())
    if "laser" in groups:
        survey = replace(survey, laser_spots=(), beams=())
    if "cameras" in groups:
        survey = replace(survey, image_blocks=(), cameras=(), table_readings=(), stations=(), tables=(),
                         laser_spots=(), beams=(),
                         levels=tuple(x for x in survey.levels if x.frame.kind == "target"))  # fmt: skip
    return observed(survey, points)


@pytest.fixture(scope="module")
def lab():
    survey, truth = laboratory()
    return resample(survey, truth, 1), truth


@pytest.fixture(scope="module")
def joint(lab):
    return adjusted(*lab)


GROUPS = ("cameras", "total station", "caliper", "levels", "laser")


@pytest.fixture(scope="module")
def parts(lab):
    """Without one group each; without levels and total station nothing sees the vertical any more."""
    return {group: adjusted(without(lab[0], group), lab[1]) for group in GROUPS}


def test_everything_together_passes_its_global_test(joint) -> None:
    assert joint.global_test is not None
    assert joint.global_test.passed
    assert {g.group for g in joint.groups} >= {"image", "table", "total station", "caliper", "level", "laser"}
    assert sum(g.redundancy for g in joint.groups) == pytest.approx(joint.redundancy, abs=1e-4)


def test_nowhere_less_precise_than_without_a_group(joint, parts) -> None:
    """Of every unknown that both have: the difference of the covariances has no negative eigenvalue.

    Both are linearised at their own estimates, which changes a variance by up to some thousandth.
    """
    for group, part in parts.items():
        shared = [n for n in part.estimates if n in joint.estimates and n in part.precision.graph.unknowns.by_name]
        assert len(shared) > 8, group
        for name in shared:
            worse = part.estimates[name].cov - joint.estimates[name].cov
            size = np.abs(np.diag(part.estimates[name].cov)).max()
            scale = np.sqrt(np.maximum(np.diag(part.estimates[name].cov), 1e-12 * size))
            assert np.linalg.eigvalsh(worse / np.outer(scale, scale)).min() > -2e-3, (group, name)


def sigma(result: Adjustment, name: tuple[str, ...], rows: slice = slice(None)) -> float:
    return float(np.sqrt(np.trace(result.estimates[name].cov[rows, rows])))


def test_each_group_tells_what_it_should(joint, parts) -> None:
    """Beacons far from the cameras by the total station, the vertical by levels, the lenses by the images alone."""
    far = ("point", "B05")
    assert sigma(parts["total station"], far) > 2.0 * sigma(joint, far)
    assert ("lens", "X") not in parts["cameras"].estimates
    assert TABLE not in parts["cameras"].estimates
    assert ("beam", "laser") not in parts["laser"].estimates
    assert ("orientation", "T1a") not in parts["total station"].estimates
    # a level says nothing of lenses; the vertical it says much of
    lens = ("lens", "Z")
    assert sigma(parts["levels"], lens) == pytest.approx(sigma(joint, lens), rel=0.01)
    assert sigma(parts["levels"], ("vertical",)) > 1.02 * sigma(joint, ("vertical",))
    offset = ("instrument", "TS")
    assert sigma(parts["caliper"], offset) > 1.0001 * sigma(joint, offset)
    assert sigma(parts["laser"], TABLE, slice(0, 3)) >= sigma(joint, TABLE, slice(0, 3))
    # values move by what the covariances allow: difference of nested adjustments has the difference of covariances
    for group in ("total station", "cameras", "caliper"):
        a, b = parts[group].estimates[far], joint.estimates[far]
        d = np.asarray(a.value) - np.asarray(b.value)
        assert d @ np.linalg.pinv(a.cov - b.cov, rcond=1e-3) @ d < chi2.ppf(0.9999, 3), group


def test_a_free_vertical_that_nothing_observes_is_named(lab) -> None:
    with pytest.raises(IndeterminateError, match="nothing observes direction of the vertical; leave them out or hold"):
        adjusted(without(lab[0], "levels", "total station"), lab[1])


def test_caliper_and_total_station_alone_do_not_give_the_world(lab) -> None:
    """Without cameras and without the board's corners nothing ties the tripods to the board."""
    survey = without(lab[0], "cameras")
    survey = replace(survey, readings=tuple(r for r in survey.readings if r.to.frame is None), levels=())
    with pytest.raises(IndeterminateError, match="whole survey"):
        adjusted(survey, lab[1])


def test_covers_over_re_solved_noise(lab) -> None:
    """d' inv(C) d of table, beacons, tripods, head and instrument over fresh noise; omega as its redundancy."""
    survey, truth = lab
    names = [
        TABLE,
        ("mount_from_station", "head"),
        ("station_from_camera", "X"),
        ("point", "B01"),
        ("point", "B05"),
        ("point", "T1"),
        ("orientation", "T2a"),
        ("instrument", "TS"),
        ("vertical",),
        ("beam", "laser"),
    ]
    ideal = adjusted(survey, truth)
    free = [n for n in names if n in ideal.precision.graph.unknowns.by_name]
    Q = ideal.precision.joint(free)
    total = omega = 0.0
    for seed in range(RUNS):
        graph = graph_of(resample(survey, truth, 100 + seed), truth)
        done = solve(graph, SolveOptions(max_step=1e-3))  # a thousandth of a sigma is near enough here
        d = np.concatenate([_error(graph, done.values, name, truth) for name in free])
        total, omega = total + d @ np.linalg.solve(Q, d), omega + done.omega
    for value, freedom in ((total, RUNS * len(Q)), (omega, RUNS * ideal.redundancy)):
        low, high = chi2.ppf([0.0005, 0.9995], freedom)
        assert low < value < high


def _error(graph, values, name, truth) -> np.ndarray:
    unknown, true = graph.unknowns.by_name[name], truth[name]
    if unknown.kind == "pose":
        return np.asarray(Pose3.Logmap(true.between(values.atPose3(unknown.key))))
    if unknown.kind == "point":
        return np.asarray(values.atPoint3(unknown.key)) - true
    vector = graph.unknowns.vectors[name]
    at = [vector.names.index(x) for x in vector.free]
    return np.asarray(vector.full(values) - true)[at]
