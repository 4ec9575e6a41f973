"""Readings together with cameras and a table in one graph; honest covariances over many simulated networks."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.graph.solver import solve
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, PositionRef, Reading, ReadingCovariance
from adjust.model.result import Adjustment
from adjust.model.survey import (
    INSTRUMENT,
    Datum,
    PoseParameter,
    Setup,
    Station,
    Survey,
    VectorParameter,
    VectorPrior,
    Vertical,
)
from adjust.precision.precision import Precision
from survey.simulate import beacons
from tests.adjust import helpers as h
from tests.adjust.terrestrial_networks import P, Truth, measured, polar_network, start_near
from tests.sizes import size

pytestmark = pytest.mark.slow

TRIALS = size(100, 20)
POLAR = (("direction", 2e-5), ("zenith", 2e-5), ("slope_distance", 2e-4))


def squared(survey: Survey, truth: Truth, start: StartValues, names: list[tuple[str, ...]]) -> float:
    """d' inv(C) d of the points ``names`` in one solution."""
    graph = h.build(survey, start)
    precision = Precision(graph, solve(graph))
    values, by_name = precision.solved.values, graph.unknowns.by_name
    d = np.concatenate([values.atPoint3(by_name[n].key) - truth[n] for n in names])
    return float(d @ np.linalg.solve(precision.joint(names), d))


def test_covariances_of_a_free_network_are_the_scatter_of_resolved_noise() -> None:
    """The mean of d' inv(C) d within 3.5 sigma of its degrees of freedom, in the datum of the truth."""
    survey, truth = polar_network(1, n=6, stations=3, held=0, extra=False, datum=Datum("inner"))
    names: list[tuple[str, ...]] = [("point", "P4"), ("point", "P5")]
    start = start_near(survey, truth, 0)
    ideal = measured(survey, truth, None)
    rng = np.random.default_rng(11)
    found = []
    for _ in range(TRIALS):
        readings = tuple(replace(r, value=r.value + r.sigma * rng.standard_normal()) for r in ideal.readings)
        found.append(squared(replace(ideal, readings=readings), truth, start, names))
    assert np.mean(found) == pytest.approx(6.0, abs=3.5 * np.sqrt(12.0 / TRIALS))


def test_covariances_with_centring_refraction_and_correlated_readings() -> None:
    """Every trial draws new centring errors and a new coefficient of refraction by their priors."""
    prior = VectorPrior(("refraction",), np.array([0.13]), np.array([[25.0]]))
    instrument = VectorParameter(INSTRUMENT, np.array([0.0, 0.0, 0.13, 0.0]), free=("refraction",), prior=prior)
    survey, truth = polar_network(
        4, n=6, stations=3, held=3, instrument=instrument, vertical=Vertical(radius=6.38e6),
        setup=Setup("", "T", centring_sigma=0.001, height_sigma=0.0005),
    )  # fmt: skip
    first = survey.readings[:12]
    sigmas = np.array([r.sigma for r in first])
    cov = np.outer(sigmas, sigmas) * (0.6 + 0.4 * np.eye(12))
    survey = replace(survey, reading_covariances=(ReadingCovariance(tuple(r.reading_id for r in first), cov),))
    start = replace(start_near(survey, truth, 0), vectors={})
    rng = np.random.default_rng(8)
    found = []
    for i in range(TRIALS):
        drawn = {("centring", f"S{s}"): rng.normal(size=3) * (0.001, 0.001, 0.0005) for s in range(3)}
        drawn["instrument", "T"] = np.array([0.0, 0.0, 0.13 + 5.0 * rng.standard_normal(), 0.0])
        found.append(squared(measured(survey, truth | drawn, i), truth, start, [("point", "P5")]))
    assert np.mean(found) == pytest.approx(3.0, abs=3.5 * np.sqrt(6.0 / TRIALS))


# -- one lab -----------------------------------------------------------------------------------------------------------


def laboratory(seed: int) -> tuple[Survey, Truth]:
    """A head on a table that sees beacons, and a total station on a pillar that measures the beacons too."""
    survey, truth = beacons(seed, n_table_epochs=4, n_free_epochs=2, n_night_epochs=3)
    pose = Pose3(Rot3(), np.array([0.8, -0.6, 0.2]))
    pillar = Station("pillar", world_from_station=PoseParameter(pose, held=("rx", "ry", "rz")))
    at = PositionRef(frame=FrameRef("station", "pillar"))
    ids = [p.point_id for p in survey.points if p.x_in_world.treatment != "held"][:8]
    readings = tuple(Reading(f"{kind}-{n}", kind, at, P(n), 0.0, sigma, "T1", group="total station")
                     for n in ids for kind, sigma in POLAR)  # fmt: skip
    values = truth | {("world_from_station", "pillar"): pose, ("orientation", "T1"): np.array([0.7])}
    more = replace(survey, stations=(*survey.stations, pillar), setups=(Setup("T1"),), readings=readings)
    return measured(more, values, seed), values


def start_of(truth: Truth, survey: Survey) -> StartValues:
    start = h.start_at(truth)
    poses = {k: v for k, v in start.poses.items() if survey.readings or k[1] != "pillar"}
    return replace(start, poses=poses)


def without_readings(survey: Survey) -> Survey:
    stations = tuple(s for s in survey.stations if s.station_id != "pillar")
    return replace(survey, stations=stations, setups=(), readings=())


def sigmas(result: Adjustment) -> dict[str, float]:
    return {n[1]: float(np.sqrt(np.trace(e.cov))) for n, e in result.estimates.items() if n[0] == "point"}


def test_cameras_table_beacons_and_total_station_in_one_graph() -> None:
    """Removing the total station leaves the cameras' solution; together every beacon is known better."""
    survey, truth = laboratory(2)
    joint = adjust(survey, start_of(truth, survey))
    alone = adjust(without_readings(survey), start_of(truth, without_readings(survey)))
    assert joint.redundancy - alone.redundancy == len(survey.readings) - 4  # a position and an orientation
    assert {g.group for g in joint.groups} - {g.group for g in alone.groups} == {"total station"}
    assert joint.global_test is not None
    assert joint.omega < 1.3 * joint.global_test.upper
    with_readings = {r.to.point_id for r in survey.readings}
    ratio = {n: sigmas(joint)[n] / s for n, s in sigmas(alone).items() if s > 0.0}
    assert max(ratio.values()) < 1.0 + 1e-6
    assert max(ratio[n] for n in with_readings) < 0.9
    unused = replace(survey, readings=tuple(replace(r, used=False) for r in survey.readings))
    with pytest.raises(SurveyError, match="nothing observes"):
        adjust(unused, start_of(truth, survey))
    place = joint.estimates["world_from_station", "pillar"]
    d = place.value.translation() - truth["world_from_station", "pillar"].translation()
    assert d @ np.linalg.solve(place.cov[3:, 3:], d) < 20.0


def test_jacobians_through_frames() -> None:
    """Readings from a station's origin to beacons, and to a camera's origin on the moving table."""
    survey, truth = laboratory(3)
    block = survey.image_blocks[0]
    frame = PositionRef(frame=FrameRef("camera", block.camera_id, block.epoch_id))
    at = survey.readings[0].at
    more = tuple(Reading(f"{kind}-camera", kind, at, frame, 0.3, sigma, "T1") for kind, sigma in POLAR)
    survey = replace(survey, readings=(*survey.readings, *more))
    graph = h.build(survey, start_of(truth, survey))
    values = h.disturbed(graph.start, graph, 5, 0.1)
    assert graph.terrestrial is not None
    n_images = graph.graph.size()
    keys = {tuple(c.keys) for c in graph.terrestrial.layout.chunks}
    mine = [f for f in (graph.graph.at(i) for i in range(n_images)) if tuple(f.keys()) in keys]
    assert len(mine) == len(keys) == 9
    assert max(len(k) for k in keys) > 3
    assert max(h.jacobian_mismatch(f, graph, values) for f in mine) < 1e-7
