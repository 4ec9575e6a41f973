"""Readings of total stations, theodolites and levels: equations, derivatives, statistics, errors."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, PositionRef, Reading, ReadingCovariance
from adjust.model.survey import (
    INSTRUMENT,
    TILT,
    Bearings,
    Instrument,
    Point,
    PointParameter,
    PoseParameter,
    Setup,
    Station,
    Survey,
    VectorParameter,
    VectorPrior,
    Vertical,
)
from tests.adjust import helpers as h
from tests.adjust.terrestrial_networks import P, dense, measured, polar_network, start_near, wrapped

SLANTED = np.array([0.1, -0.2, np.sqrt(1.0 - 0.05)])
CONVENTIONS = (Bearings(), Bearings("y", False), Bearings("x", True), Bearings("x", False))
EVERYTHING = VectorParameter(INSTRUMENT, np.array([0.01, 1e-4, 0.13, 1e-4]), free=INSTRUMENT)


def world(east: float, north: float, up: float = 0.0) -> np.ndarray:
    return np.array([east, north, up])


def value_of(kind: str, a: np.ndarray, b: np.ndarray, bearings: Bearings = CONVENTIONS[0], **more: float) -> float:
    """What the core predicts for one reading from a to b: the observed value is zero, so it is the residual."""
    points = (Point("A", PointParameter(a, "held")), Point("B", PointParameter(b)))
    reading = Reading("r", kind, P("A"), P("B"), 0.0, 1.0, **more)
    graph = GraphBuilder(Survey(points=points, readings=(reading,), bearings=bearings), {}).build(
        StartValues({}, {}, {"A": a, "B": b})
    )
    graph.prepare(graph.start, jacobians=True)
    assert graph.terrestrial is not None
    return float(graph.terrestrial.residual[0])


def test_bearings_count_as_they_say() -> None:
    """A target due east of north by 30 degrees, in the four conventions; zenith, distances and height by hand."""
    a, b = world(100.0, 200.0, 3.0), world(100.0 + 5.0, 200.0 + 5.0 * np.sqrt(3.0), 4.0)
    angles = {(b.zero, b.clockwise): np.rad2deg(value_of("azimuth", a, *[world(105.0, 200.0 + 5.0 * np.sqrt(3.0), 4.0)],
                                                         bearings=b)) for b in CONVENTIONS}  # fmt: skip
    assert angles == pytest.approx({("y", True): 30.0, ("y", False): -30.0, ("x", True): -60.0, ("x", False): 60.0})
    assert value_of("horizontal_distance", a, b) == pytest.approx(10.0)
    assert value_of("slope_distance", a, b) == pytest.approx(np.sqrt(101.0))
    assert value_of("zenith", a, b) == pytest.approx(np.arctan2(10.0, 1.0))
    heights = {"instrument_height": 1.5, "target_height": 0.2}
    assert value_of("height_difference", a, b, **heights) == pytest.approx(1.0 + 0.2 - 1.5)
    assert value_of("zenith", a, b, **heights) == pytest.approx(np.arctan2(10.0, -0.3))


@pytest.mark.slow
@pytest.mark.parametrize("bearings", CONVENTIONS, ids=lambda b: f"{b.zero}-{b.clockwise}")
@pytest.mark.parametrize("radius", [None, 400.0, 6.38e6])
def test_predictions_are_those_of_plain_matrices(bearings: Bearings, radius: float | None) -> None:
    """Every kind of reading with a slanted, tilted vertical, curved or not, and all instrument and centring errors."""
    survey, truth = everything(bearings, radius)
    survey = measured(survey, truth, None)
    start = start_near(survey, truth, 0)
    start = replace(start, vectors=start.vectors | {k: v for k, v in truth.items() if k[0] == "orientation"})
    graph = GraphBuilder(survey, {}).build(start)
    graph.prepare(graph.start, jacobians=False)
    assert graph.terrestrial is not None
    assert np.abs(graph.terrestrial.residual).max() < 1e-8 if radius == 6.38e6 else 1e-12
    oriented = GraphBuilder(survey, {}).build(start_near(survey, truth, 0))
    for i in range(4):
        key = oriented.unknowns.by_name["orientation", f"S{i}"].key
        off = oriented.start.atVector(key) - truth["orientation", f"S{i}"]
        assert abs(np.angle(np.exp(1j * off[0]))) < 1e-9


def everything(bearings: Bearings, radius: float | None) -> tuple[Survey, dict]:
    vertical = Vertical(SLANTED, VectorParameter(TILT, np.zeros(2), free=TILT), radius=radius)
    values = EVERYTHING.values * np.array([1.0, 1.0, 1.0 if radius else 0.0, 1.0])
    free = INSTRUMENT if radius else tuple(x for x in INSTRUMENT if x != "refraction")
    survey, truth = polar_network(
        1, bearings=bearings, vertical=vertical, instrument=VectorParameter(INSTRUMENT, values, free=free),
        setup=Setup("", "T", centring_sigma=1e-3, height_sigma=1e-3),
    )  # fmt: skip
    truth["vertical",] = np.array([0.02, -0.03])
    truth["instrument", "T"] = values
    truth |= {("centring", f"S{i}"): np.array([1e-3, 2e-3, -3e-3]) for i in range(4)}
    return survey, truth


@pytest.mark.slow
@pytest.mark.parametrize("radius", [None, 400.0])
def test_jacobians_away_from_zero_error(radius: float | None) -> None:
    survey, truth = everything(Bearings("x", True), radius)
    survey = measured(survey, truth, None)
    graph = GraphBuilder(survey, {}).build(start_near(survey, truth, 0))
    values = h.disturbed(graph.start, graph, 3)
    found = []
    for i in range(graph.graph.size()):
        if np.linalg.norm(h.whitened_residual(graph.graph.at(i), values)) > 1e-3:
            found.append(h.jacobian_mismatch(graph.graph.at(i), graph, values))
    assert len(found) >= 30
    assert max(found) < 1e-9


def test_a_chunk_asked_alone_says_what_the_batch_says() -> None:
    """GTSAM's own optimisers copy the values: each factor must then evaluate itself."""
    survey, truth = everything(Bearings(), 400.0)
    survey = correlated(measured(survey, truth, 3))
    graph = GraphBuilder(survey, {}).build(start_near(survey, truth, 1, 0.01))
    graph.prepare(graph.start, jacobians=True)
    together = [graph.graph.at(i).linearize(graph.start).jacobian() for i in range(graph.graph.size())]
    other = gtsam.Values(graph.start)
    for i, (A, b) in enumerate(together):
        alone = graph.graph.at(i).linearize(other).jacobian()
        np.testing.assert_allclose(alone[0], A, rtol=1e-12, atol=1e-9)
        np.testing.assert_allclose(alone[1], b, rtol=1e-9, atol=1e-9)


def correlated(survey: Survey) -> Survey:
    rng = np.random.default_rng(0)
    some = survey.readings[:5]
    L = 0.3 * rng.normal(size=(5, 5)) + np.eye(5)
    sigmas = np.array([r.sigma for r in some])
    block = ReadingCovariance(tuple(r.reading_id for r in some), L @ L.T * np.outer(sigmas, sigmas))
    readings = tuple(replace(r, used=i != 20) for i, r in enumerate(survey.readings))
    return replace(survey, readings=readings, reading_covariances=(block,))


@pytest.mark.parametrize("plane", [False, True])
def test_solution_and_statistics_are_those_of_one_dense_matrix(plane: bool) -> None:
    """With a correlated block and an unused reading, from coordinates half a metre off."""
    survey, truth = polar_network(2, plane=plane, n=6, stations=3)
    survey = measured(correlated(survey), truth, 5)
    start = start_near(survey, truth, 1, points=0.5)
    if plane:
        start = replace(start, points={k: x * (1.0, 1.0, 0.0) for k, x in start.points.items()})
    result = adjust(survey, start)
    full = dense(survey, result)
    A, v, C, used = full.A, full.v, full.C, full.used
    weights = np.linalg.inv(C[np.ix_(used, used)])
    Q = np.linalg.inv(A[used].T @ weights @ A[used])
    assert np.abs(Q @ A[used].T @ weights @ v[used]).max() < 1e-11
    assert result.omega == pytest.approx(v[used] @ weights @ v[used], rel=1e-9)
    assert result.redundancy == used.sum() - A.shape[1] == pytest.approx(sum(g.redundancy for g in result.groups))
    for name, place in full.place.items():
        kept = [i for i, s in enumerate(result.estimates[name].status) if s != "held"]
        cov = result.estimates[name].cov[np.ix_(kept, kept)]
        np.testing.assert_allclose(cov, Q[place, place], rtol=1e-7, atol=1e-16)
    found = result.reading_residuals
    assert found is not None
    Qv = C + np.where(used, -1.0, 1.0)[:, None] * (A @ Q @ A.T)
    inside = np.ix_(used, used)
    np.testing.assert_allclose(found.redundancy[used], np.diag(Qv[inside] @ weights), atol=1e-9)
    seen = used & (np.diag(Qv) > 1e-6 * np.diag(C))
    np.testing.assert_allclose(found.standardized[seen], (v / np.sqrt(np.diag(Qv)))[seen], atol=1e-6)
    tests = (weights @ v[used]) ** 2 / np.diag(weights @ Qv[inside] @ weights)
    np.testing.assert_allclose(found.test[seen], tests[seen[used]], rtol=1e-6, atol=1e-8)
    (alone,) = np.flatnonzero(~used)
    assert found.redundancy[alone] == 0.0
    assert found.test[alone] == pytest.approx(v[alone] ** 2 / Qv[alone, alone], rel=1e-8)
    one = result.other_residuals[3]
    assert (one.ids[0], one.redundancy[0]) == (survey.readings[3].reading_id, found.redundancy[3])


def test_differences_of_angles_are_wrapped() -> None:
    """Directions written a full turn away, or just across the cut, change nothing."""
    survey, truth = polar_network(5)
    survey = measured(survey, truth, 1)
    turned = replace(survey, readings=tuple(
        replace(r, value=r.value + 2.0 * np.pi * (i % 3 - 1)) if r.kind in ("direction", "azimuth", "angle") else r
        for i, r in enumerate(survey.readings)
    ))  # fmt: skip
    start = start_near(survey, truth, 1, points=0.1)
    assert adjust(turned, start).omega == pytest.approx(adjust(survey, start).omega, rel=1e-9)


def test_instrument_errors_come_back() -> None:
    """Offset, scale, index and refraction in one net, with a prior on the scale: within four of their sigmas."""
    prior = VectorPrior(("distance_scale",), np.zeros(1), np.array([[1e-8]]))
    parameter = VectorParameter(INSTRUMENT, np.zeros(4), free=INSTRUMENT, prior=prior)
    survey, truth = polar_network(7, n=12, stations=6, held=4, instrument=parameter, vertical=Vertical(radius=6.38e6))
    truth["instrument", "T"] = np.array([0.003, 5e-5, 8.0, 1e-4])  # of refraction as over 60 m it can be seen
    survey = measured(survey, truth, 4)
    result = adjust(survey, replace(start_near(survey, truth, 1, points=0.05), vectors={}))
    found = result.estimates["instrument", "T"]
    sigmas = np.sqrt(np.diag(found.cov))
    assert np.abs((found.value - truth["instrument", "T"]) / sigmas).max() < 4.0
    assert sigmas[0] < 3e-4
    assert found.status == ("free", "prior", "free", "free")
    assert any(o.kind == "prior" and o.ids == ("instrument", "T") for o in result.other_residuals)


def test_tilted_vertical_comes_back() -> None:
    free = Vertical(tilt=VectorParameter(TILT, np.zeros(2), free=TILT))
    survey, truth = polar_network(8, held=4, vertical=free)
    truth["vertical",] = np.array([0.004, -0.002])
    survey = measured(survey, truth, 2)
    result = adjust(survey, replace(start_near(survey, truth, 1, points=0.05), vectors={}))
    found = result.estimates[("vertical",)]
    assert np.abs((found.value - truth["vertical",]) / np.sqrt(np.diag(found.cov))).max() < 4.0
    assert np.sqrt(np.diag(found.cov)).max() < 2e-5


def test_a_tilted_scanner_on_a_station() -> None:
    """Not levelled: readings in the axes of a station with a free pose; pose against a closed form from its truth."""
    rng = np.random.default_rng(3)
    x = rng.uniform(-8, 8, (9, 3))
    pose = Pose3(Rot3.RzRyRx(0.4, -0.7, 2.0), (1.0, -2.0, 0.5))
    at = PositionRef(frame=FrameRef("station", "scanner"))
    kinds = (("direction", 2e-5), ("zenith", 2e-5), ("slope_distance", 1e-4))
    readings = tuple(
        Reading(f"{kind}{i}", kind, at, P(f"P{i}"), 0.0, sigma, "S0") for i in range(9) for kind, sigma in kinds
    )
    for bearings in CONVENTIONS:
        survey = Survey(
            points=tuple(Point(f"P{i}", PointParameter(q, "held")) for i, q in enumerate(x)), readings=readings,
            setups=(Setup("S0", levelled=False),), stations=(Station("scanner"),), bearings=bearings,
        )  # fmt: skip
        truth = {("point", f"P{i}"): q for i, q in enumerate(x)}
        truth |= {("world_from_station", "scanner"): pose, ("orientation", "S0"): np.array([0.0])}
        survey = measured(survey, truth, 6)
        # its own zero direction is the station's axis: the orientation would only repeat the turn about its z axis
        station = Station("scanner", world_from_station=PoseParameter(pose.compose(Pose3.Expmap(0.01 * np.ones(6)))))
        start = StartValues({}, {("world_from_station", "scanner"): station.world_from_station.value}, {})
        free = adjust(replace(survey, stations=(station,)), start)
        assert free.estimates["orientation", "S0"].status == ("held",)
        held = replace(survey, stations=(Station("scanner", world_from_station=PoseParameter(pose, held=("rz",))),))
        result = adjust(held, start)
        assert result.estimates["orientation", "S0"].status == ("free",)
        assert (free.n_unknowns, free.redundancy) == (result.n_unknowns, result.redundancy)
        assert free.sigma0 == pytest.approx(result.sigma0, rel=1e-9)
        found = result.estimates["world_from_station", "scanner"]
        off = Pose3.Logmap(pose.between(found.value))
        kept = [0, 1, 3, 4, 5]
        assert np.sqrt(off[kept] @ np.linalg.solve(found.cov[np.ix_(kept, kept)], off[kept])) < 4.5
        assert result.global_test is not None
        assert result.global_test.omega < 45.0


def test_centring_of_the_target_widens_short_sights() -> None:
    """sigma^2 + (c / d)^2 for a direction over d; horizontal distances sigma^2 + c^2, at the adjusted coordinates."""
    survey, truth = polar_network(2, plane=True)
    survey = measured(survey, truth, 1)
    c = 0.001
    widened = replace(survey, readings=tuple(replace(r, target_centring_sigma=c) for r in survey.readings))
    start = start_near(survey, truth, 1, points=0.3)
    start = replace(start, points={k: x * (1.0, 1.0, 0.0) for k, x in start.points.items()})
    result = adjust(widened, start)
    x = {n[1]: e.value for n, e in result.estimates.items() if n[0] == "point"}
    assert result.reading_residuals is not None
    for r, sigma in zip(widened.readings, result.reading_residuals.sigma, strict=True):
        d = np.linalg.norm(x[r.to.point_id] - x[r.at.point_id])
        across = {"direction": 1.0 / d, "azimuth": 1.0 / d, "horizontal_distance": 1.0}
        if r.kind in across:
            assert sigma == pytest.approx(np.hypot(r.sigma, c * across[r.kind]), rel=1e-7)
        else:
            e = np.linalg.norm(x[r.second.point_id] - x[r.at.point_id])
            assert sigma == pytest.approx(np.sqrt(r.sigma**2 + (c / d) ** 2 + (c / e) ** 2), rel=1e-7)


def broken(survey: Survey, **changes: object) -> Survey:
    return replace(survey, readings=(replace(survey.readings[0], **changes), *survey.readings[1:]))


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"setup_id": "S9"}, "setup 'S9' is used"),
        ({"setup_id": ""}, "a direction needs a setup"),
        ({"to": PositionRef("P0")}, "two of its positions are the same"),
        ({"to": PositionRef("X")}, "'X' is observed but not part"),
        ({"sigma": 0.0}, "positive sigma"),
        ({"value": float("nan")}, "give a number"),
        ({"kind": "angle"}, "an angle needs its second target"),
        ({"second": PositionRef("P3")}, "only angles have a second target"),
    ],
)
def test_readings_that_cannot_be_are_named(changes: dict[str, object], words: str) -> None:
    survey, truth = polar_network(2)
    with pytest.raises(SurveyError, match=words):
        adjust(broken(measured(survey, truth, 1), **changes), start_near(survey, truth, 1))


def test_readings_between_held_points_only_show_their_errors() -> None:
    """They adjust nothing, count with redundancy one, and their residuals are their true errors."""
    survey, truth = polar_network(2)
    survey = measured(survey, truth, 1)
    length = float(np.linalg.norm(truth["point", "P1"] - truth["point", "P0"]))
    more = Reading("fixed", "slope_distance", P("P0"), P("P1"), length + 0.003, 0.001)
    extended = replace(survey, readings=(*survey.readings, more))
    alone, both = (adjust(s, start_near(s, truth, 1)) for s in (survey, extended))
    assert both.redundancy == alone.redundancy + 1
    assert both.omega == pytest.approx(alone.omega + 9.0, rel=1e-9)
    last = both.other_residuals[-1]
    assert (last.redundancy[0], last.standardized[0]) == pytest.approx((1.0, -3.0))


def test_heights_say_nothing_in_a_plane_network() -> None:
    survey, truth = polar_network(2, plane=True)
    survey = measured(survey, truth, 1)
    start = start_near(survey, truth, 1)
    for kind in ("zenith", "height_difference"):
        extra = Reading("up", kind, P("P4"), P("P5"), 1.5, 1e-4)
        with pytest.raises(SurveyError, match="as in a plane network"):
            adjust(replace(survey, readings=(*survey.readings, extra)), start)


def test_refraction_needs_a_radius_and_covariances_must_fit() -> None:
    survey, truth = polar_network(2, instrument=VectorParameter(INSTRUMENT, np.zeros(4), free=("refraction",)))
    with pytest.raises(SurveyError, match="give the vertical a radius"):
        adjust(measured(survey, truth, 1), start_near(survey, truth, 1))
    survey, truth = polar_network(2)
    survey = measured(survey, truth, 1)
    ids = tuple(r.reading_id for r in survey.readings[:2])
    for block, words in (
        (ReadingCovariance(("?", ids[0]), np.eye(2)), "there is no reading '\\?'"),
        (ReadingCovariance((ids[0], ids[0]), np.eye(2)), "stands in it once"),
        (ReadingCovariance(ids, np.eye(3)), "symmetric square"),
        (ReadingCovariance(ids, np.array([[1.0, 2.0], [2.0, 1.0]])), "not positive definite"),
    ):
        with pytest.raises(SurveyError, match=words):
            adjust(replace(survey, reading_covariances=(block,)), start_near(survey, truth, 1))
    with pytest.raises(SurveyError, match="instrument 'T' is not part"):
        adjust(replace(survey, instruments=()), start_near(survey, truth, 1))
    twice = replace(survey, instruments=(Instrument("T"), Instrument("T")))
    with pytest.raises(SurveyError, match="instrument 'T' is there twice"):
        adjust(twice, start_near(survey, truth, 1))


def test_a_station_above_its_target_at_the_start_is_named() -> None:
    survey, truth = polar_network(2)
    survey = measured(survey, truth, 1)
    start = start_near(survey, truth, 1)
    bad = replace(start, points=start.points | {"P5": start.points["P0"] + (0.0, 0.0, 1.0)})
    with pytest.raises(SurveyError, match="at the start values"):
        adjust(survey, bad)


def test_a_missing_datum_names_what_floats() -> None:
    survey, truth = polar_network(2, held=0, extra=False)
    with pytest.raises(SurveyError, match="position along world x, y, z and the rotation about world z") as error:
        adjust(measured(survey, truth, 1), start_near(survey, truth, 1))
    assert "scale" not in str(error.value)


def test_wrapping_helper() -> None:
    assert wrapped(np.array([7.0]))[0] == pytest.approx(7.0 - 2.0 * np.pi)
