"""Free networks of readings, and solutions moved to another datum without solving again."""

from collections.abc import Sequence
from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.graph.building import GraphBuilder
from adjust.graph.datum import gauges, inner_datum
from adjust.graph.solver import solve
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import (
    INSTRUMENT,
    TILT,
    Bearings,
    Datum,
    FloatArray,
    Survey,
    VectorParameter,
    VectorPrior,
    Vertical,
)
from adjust.precision.other_datum import in_datum
from adjust.precision.precision import Precision
from tests.adjust import helpers as h
from tests.adjust.terrestrial_networks import Truth, dense, measured, polar_network, start_near

FREE_TILT = Vertical(tilt=VectorParameter(TILT, np.zeros(2), free=TILT))
ROUND = replace(FREE_TILT, radius=60.0)
PRIOR = VectorPrior(TILT, np.zeros(2), (5.0 * np.radians(1 / 3600)) ** 2 * np.eye(2))
KNOWN_TILT = Vertical(tilt=VectorParameter(TILT, np.zeros(2), TILT, PRIOR), radius=6.371e6)
SOME = Datum("inner", points=("P0", "P3", "P5"))


def free_network(kinds: tuple[str, ...], flat_heights: bool = False, **options: object) -> tuple[Survey, Truth]:
    survey, truth = polar_network(4, held=0, extra=False, datum=Datum("inner"), **options)
    kept = tuple(r for r in survey.readings if r.kind in kinds)
    if flat_heights:  # heights of instruments are lengths: with them angles alone tell the scale
        kept = tuple(replace(r, instrument_height=0.0, target_height=0.0) for r in kept)
    return measured(replace(survey, readings=kept), truth, 1), truth


def solution(survey: Survey, truth: Truth, datum: Datum) -> Adjustment:
    start = start_near(survey, truth, 1, points=0.01)
    if all(p.x_in_world.held for p in survey.points):
        start = replace(start, points={k: x * (1.0, 1.0, 0.0) for k, x in start.points.items()})
    return adjust(replace(survey, datum=datum), start)


def pseudo_inverse(survey: Survey, result: Adjustment, datum: tuple[str, ...]) -> tuple[FloatArray, dict]:
    """Q of the plain dense system, with the inner constraints of these points: its own null space tells them."""
    full = dense(survey, result)
    W = full.A / np.sqrt(np.diag(full.C))[:, None]
    scale = np.linalg.norm(W, axis=0)
    _, s, Vt = np.linalg.svd(W / scale)
    null = Vt[s < 1e-9 * s[0]].T / scale[:, None]
    assert null.shape[1] == result.datum_defect
    mask = np.zeros(len(null))
    for name, place in full.place.items():
        if name[0] == "point" and name[1] in datum:
            mask[place] = 1.0
    R = (null * mask[:, None]).T
    R /= np.linalg.norm(R, axis=1)[:, None] / np.median(scale)
    k = len(R)
    bordered = np.block([[W.T @ W, R.T], [R, np.zeros((k, k))]])
    return np.linalg.inv(bordered)[: len(null), : len(null)], full.place


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kinds", "options", "defect"),
    [
        (("direction", "zenith", "slope_distance"), {}, 4),
        (("direction", "zenith"), {"flat_heights": True}, 5),
        (("direction", "zenith"), {}, 4),
        (("direction", "zenith", "slope_distance"), {"vertical": FREE_TILT}, 6),
        (("direction", "zenith", "slope_distance"), {"bearings": Bearings("x", False)}, 4),
        (("direction", "horizontal_distance"), {"plane": True}, 3),
        (("direction",), {"plane": True, "stations": 6}, 4),
        (
            ("direction", "zenith", "slope_distance"),
            {"instrument": VectorParameter(INSTRUMENT, np.zeros(4), free=("distance_scale",)), "flat_heights": True},
            5,
        ),
    ],
)
@pytest.mark.parametrize("datum", [Datum("inner"), SOME])
def test_covariances_are_those_of_the_dense_pseudo_inverse(
    kinds: tuple[str, ...], options: dict, defect: int, datum: Datum
) -> None:
    """Scale and orientation defects too: the orientations, the tilt and the scale unknown move along."""
    survey, truth = free_network(kinds, **({"n": 6, "stations": 3} | options))
    result = solution(survey, truth, datum)
    assert result.datum_defect == defect
    Q, place = pseudo_inverse(survey, result, datum.points or tuple(p.point_id for p in survey.points))
    for name, at in place.items():
        kept = [i for i, s in enumerate(result.estimates[name].status) if s != "held"]
        size = np.abs(Q[at, at]).max()
        np.testing.assert_allclose(result.estimates[name].cov[np.ix_(kept, kept)], Q[at, at], atol=2e-6 * size)


def distances(result: Adjustment) -> FloatArray:
    x = np.array([e.value for n, e in result.estimates.items() if n[0] == "point"])
    return np.linalg.norm(x[:, None] - x, axis=2)


def test_the_shape_does_not_depend_on_the_datum() -> None:
    survey, truth = free_network(("direction", "zenith", "slope_distance"))
    held = replace(
        survey.points[0], x_in_world=replace(survey.points[0].x_in_world, treatment="held", value=truth["point", "P0"])
    )
    azimuth = replace(survey.readings[0], reading_id="north", kind="azimuth", value=0.3, setup_id="")
    given = replace(survey, points=(held, *survey.points[1:]), readings=(*survey.readings, azimuth), datum=Datum())
    found = [solution(survey, truth, datum) for datum in (Datum("inner"), SOME)]
    found.append(adjust(given, start_near(given, truth, 1)))
    for other in found[1:]:
        assert np.abs(distances(other) - distances(found[0])).max() < 1e-9
        assert other.omega == pytest.approx(found[0].omega, rel=1e-9)
        np.testing.assert_allclose(other.reading_residuals.redundancy[: len(survey.readings)],
                                   found[0].reading_residuals.redundancy, atol=1e-8)  # fmt: skip


def test_another_datum_without_solving_again() -> None:
    """Coordinates, orientations and joint covariances equal those of a second adjustment."""
    survey, truth = free_network(("direction", "zenith", "slope_distance"))
    reference = start_near(survey, truth, 1, points=0.01).points
    first, again = solution(survey, truth, Datum("inner")), solution(survey, truth, SOME)
    moved = in_datum(first, SOME, reference)
    assert (moved.datum_defect, moved.n_unknowns, moved.omega) == (4, first.n_unknowns, first.omega)
    for name, estimate in again.estimates.items():
        np.testing.assert_allclose(moved.estimates[name].value, estimate.value, atol=1e-10)
        np.testing.assert_allclose(moved.estimates[name].cov, estimate.cov, rtol=1e-6, atol=1e-16)
    names = [("point", "P1"), ("orientation", "S2"), ("point", "P7")]
    joint = again.precision.joint(names)
    np.testing.assert_allclose(moved.precision.joint(names), joint, atol=1e-8 * np.abs(joint).max())
    assert np.abs(again.estimates["point", "P1"].cov - first.estimates["point", "P1"].cov).max() > 1e-9


def test_held_points_get_their_covariance_in_an_inner_datum() -> None:
    """From the smallest datum (a held point, an observed azimuth) to the inner one over all points."""
    survey, truth = free_network(("direction", "zenith", "slope_distance"))
    azimuth = replace(survey.readings[0], reading_id="north", kind="azimuth", value=0.0, setup_id="")
    survey = measured(replace(survey, readings=(*survey.readings, azimuth)), truth, 2)
    held = replace(survey.points[0], x_in_world=replace(survey.points[0].x_in_world, treatment="held"))
    given = replace(survey, points=(held, *survey.points[1:]), datum=Datum())
    result = adjust(given, start_near(given, truth, 1))
    assert not result.estimates["point", "P0"].cov.any()
    moved, again = in_datum(result, Datum("inner")), solution(survey, truth, Datum("inner"))
    assert moved.datum_defect == again.datum_defect == 3
    for i in range(8):
        cov = again.estimates["point", f"P{i}"].cov
        np.testing.assert_allclose(moved.estimates["point", f"P{i}"].cov, cov, atol=1e-5 * np.abs(cov).max())
    # held points stand in a joint covariance of whole parameters too, with no error before
    names = [("point", "P1"), ("point", "P0"), ("orientation", "S2")]
    before = result.joint(names)
    assert not before[3:6].any()
    np.testing.assert_allclose(before[np.ix_([0, 1, 2, 6], [0, 1, 2, 6])], result.precision.joint([names[0], names[2]]))
    expected = again.joint(names)
    np.testing.assert_allclose(moved.joint(names), expected, atol=1e-5 * np.abs(expected).max())
    with pytest.raises(SurveyError, match="was moved to another datum"):
        in_datum(moved, Datum("inner"))


def test_a_datum_that_is_observed_cannot_be_chosen() -> None:
    survey, truth = polar_network(4, held=3, extra=False)
    survey = measured(survey, truth, 1)
    result = adjust(survey, start_near(survey, truth, 1))
    with pytest.raises(SurveyError, match="of kind 'inner' only"):
        in_datum(result, Datum())
    with pytest.raises(SurveyError, match="cannot carry"):
        in_datum(result, Datum("inner", points=("P4",)))


@pytest.mark.parametrize(("vertical", "unseen"), [(FREE_TILT, range(7)), (ROUND, (0, 1, 3, 4, 5))])
def test_whole_survey_motions_change_no_reading(vertical: Vertical, unseen: Sequence[int]) -> None:
    """The seven motions, with orientation, tilt and scale unknowns, leave all predictions as they are.

    Round level surfaces show heights and scale by their curvature.
    """
    instrument = VectorParameter(INSTRUMENT, np.array([0.0, 1e-4, 0.0, 0.0]), free=("distance_scale",))
    survey, truth = polar_network(3, held=0, extra=False, instrument=instrument, vertical=vertical)
    truth["vertical",] = np.array([0.01, -0.02])
    level = tuple(replace(r, instrument_height=0.0, target_height=0.0) for r in survey.readings)
    survey = measured(replace(survey, readings=level), truth, None)
    graph = GraphBuilder(survey, {}).build(start_near(survey, truth, 0))
    graph.prepare(graph.start, jacobians=True)
    assert graph.terrestrial is not None
    motions = {key: gauges(graph, [key], graph.start) for key in graph.unknowns.by_key}
    for i in unseen:
        moved = gtsam.VectorValues()
        for key, motion in motions.items():
            moved.insert(key, 1e-6 * motion[:, i])
        graph.terrestrial.evaluate(graph.start.retract(moved))
        assert np.abs(graph.terrestrial.residual).max() < 1e-9, i


def test_inner_datum_where_level_surfaces_are_round_and_their_tilt_is_nearly_known() -> None:
    """Along a level surface nothing changes, whatever is known of the plumb line: four directions are left open."""
    survey, truth = free_network(("direction", "zenith", "slope_distance"), vertical=KNOWN_TILT)
    result = solution(survey, truth, Datum("inner"))
    assert result.datum_defect == 4
    plane, _ = free_network(("direction", "zenith", "slope_distance"))
    assert solution(plane, truth, Datum("inner")).datum_defect == 4
    sigmas = np.array([np.sqrt(np.diag(result.estimates["point", f"P{i}"].cov)) for i in range(8)])
    assert sigmas.max() < 0.01


@pytest.mark.slow
def test_inner_datum_over_points_that_only_images_see() -> None:
    """Points stay hidden in their batch, and have the covariances of the dense inverse all the same."""
    survey, truth = h.network(5, held=0, distances=2, n_points=20, n_epochs=8)
    survey = replace(survey, datum=Datum("inner"))
    graph = GraphBuilder(survey, h.start_at(truth).lenses).build(h.start_at(truth))
    (bundle,) = graph.bundles
    assert len(bundle.reduced) >= 16
    assert len(bundle.hidden_poses) >= 6
    h.check_against_dense(survey, h.start_at(truth), 1e-7)


def test_minimal_datum_is_as_large_as_the_defect() -> None:
    survey, truth = free_network(("direction", "zenith", "slope_distance"))
    graph = GraphBuilder(survey, {}).build(start_near(survey, truth, 1))
    datum = inner_datum(graph, graph.prepare(graph.start, jacobians=True))
    assert datum is not None
    assert sum(len(components) for components, _ in datum.minimal.values()) == datum.defect == 4
    assert len(datum.rows) == 8
    done = solve(graph)
    assert Precision(graph, done).transformation is not None
