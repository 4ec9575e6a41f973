"""Start values of points from readings alone."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.observations import Distance, PositionRef, Reading
from adjust.model.survey import Datum, Point, PointParameter, Setup, Survey
from adjust.start.positions import given_points
from adjust.start.readings.places import positions, settled
from adjust.start.readings.start import find_points
from tests.adjust.terrestrial_networks import P, Truth, measured, polar_network, start_near

POLAR = (("direction", 1e-5), ("zenith", 1e-5), ("slope_distance", 5e-4))


def stripped(survey: Survey) -> Survey:
    """Without the coordinates of what is free; heights and other components that are held stay."""
    points = []
    for p in survey.points:
        x = p.x_in_world
        if x.treatment != "held":
            kept = np.array([c in x.held for c in "xyz"])
            x = replace(x, value=np.where(kept, x.value, np.nan) if kept.any() else None)
        points.append(Point(p.point_id, x))
    return replace(survey, points=tuple(points))


def kinds_only(survey: Survey, *kinds: str) -> Survey:
    return replace(survey, readings=tuple(r for r in survey.readings if r.kind in kinds))


def check(survey: Survey, truth: Truth, limit: float, missing: int = 0) -> None:
    """All points found within ``limit`` (m), and the adjustment from there fits."""
    bare = stripped(survey)
    found = find_points(bare, given_points(bare))
    away = [np.linalg.norm(found[n[1]] - x) for n, x in truth.items() if n[0] == "point"]
    assert max(away) < limit
    result = adjust(bare)
    assert result.global_test is not None
    assert result.omega < 1.5 * result.global_test.upper


@pytest.mark.parametrize("plane", [False, True])
def test_polar_points_and_intersections(plane: bool) -> None:
    survey, truth = polar_network(3, plane=plane, stations=8, extra=False)
    survey = measured(survey, truth, 1)
    check(survey, truth, 0.005)
    check(kinds_only(survey, "direction", "zenith"), truth, 0.05)


@pytest.mark.slow
def test_trilateration_in_a_plane() -> None:
    survey, truth = polar_network(3, plane=True, stations=8, extra=False, held=3)
    survey = kinds_only(measured(survey, truth, 1), "horizontal_distance")
    check(survey, truth, 0.01)


def test_distances_in_space_alone() -> None:
    """Slope distances between all points, three of them known: the mirror image is told by a fourth."""
    rng = np.random.default_rng(2)
    x = rng.uniform((0, 0, 0), (20, 15, 8), (9, 3))
    truth = {("point", f"P{i}"): q for i, q in enumerate(x)}
    points = tuple(Point(f"P{i}", PointParameter(q, "held") if i < 4 else PointParameter()) for i, q in enumerate(x))
    distances = tuple(
        Distance(f"d{i}-{j}", PositionRef(f"P{i}"), PositionRef(f"P{j}"),
                 float(np.linalg.norm(x[i] - x[j])) + 1e-3 * rng.standard_normal(), 1e-3)
        for i in range(4, 9) for j in range(i)
    )  # fmt: skip
    check(Survey(points=points, distances=distances), truth, 0.05)


def test_resection_by_directions_alone() -> None:
    """A free station that sees four known points, and from it a polar point that nothing else reaches."""
    survey, truth = polar_network(6, held=5, n=7, stations=6, extra=False)
    survey = measured(survey, truth, 2)
    kept = tuple(r for r in survey.readings if r.at.point_id == "P5"
                 and (r.kind != "slope_distance" or r.to.point_id == "P6"))  # fmt: skip
    check(replace(survey, readings=kept), truth, 0.02)


def traverse() -> tuple[Survey, Truth]:
    x = np.array([[0, 0, 0], [30, 10, 1], [60, 0, 2], [90, 15, 1], [120, 5, 0]], float)
    truth: dict = {("point", f"P{i}"): q for i, q in enumerate(x)}
    readings = []
    for i in range(5):
        truth["orientation", f"S{i}"] = np.array([1.0 + i])
        for j in (i - 1, i + 1):
            readings += [Reading(f"{kind}{i}{j}", kind, P(f"P{i}"), P(f"P{j}"), 0.0, sigma, f"S{i}",
                                 instrument_height=1.5) for kind, sigma in POLAR if 0 <= j < 5]  # fmt: skip
    parameters = [PointParameter(q, "held") if i in (0, 4) else PointParameter() for i, q in enumerate(x)]
    points = tuple(Point(f"P{i}", p) for i, p in enumerate(parameters))
    survey = Survey(points=points, setups=tuple(Setup(f"S{i}") for i in range(5)), readings=tuple(readings))
    return measured(survey, truth, 3), truth


def test_traverse_without_any_orientation() -> None:
    survey, truth = traverse()
    check(survey, truth, 0.01)


def test_levelling_from_a_benchmark() -> None:
    heights = np.array([0.0, 1.2, 3.1, 2.0, 5.5])
    truth = {("point", f"P{i}"): np.array([10.0 * i, 0.0, z]) for i, z in enumerate(heights)}
    points = tuple(
        Point(f"P{i}", PointParameter(truth["point", f"P{i}"], "held") if i == 0
              else PointParameter(truth["point", f"P{i}"], held=("x", "y"))) for i in range(5)
    )  # fmt: skip
    readings = tuple(Reading(f"{i}{j}", "height_difference", P(f"P{i}"), P(f"P{j}"), 0.0, 1e-3)
                     for i, j in ((0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (1, 3)))  # fmt: skip
    check(measured(Survey(points=points, readings=readings), truth, 1), truth, 0.01)


def test_free_network_without_any_coordinates() -> None:
    survey, truth = traverse()
    free = replace(survey, points=tuple(Point(p.point_id) for p in survey.points), datum=Datum("inner"))
    result = adjust(free)
    assert result.datum_defect == 4
    x = {n: e.value for n, e in result.estimates.items() if n[0] == "point"}
    length = np.linalg.norm(x["point", "P0"] - x["point", "P4"])
    assert length == pytest.approx(np.linalg.norm(truth["point", "P0"] - truth["point", "P4"]), abs=0.01)


def test_a_point_that_one_direction_reaches_is_named() -> None:
    survey, truth = polar_network(3, extra=False)
    survey = stripped(measured(survey, truth, 1))
    one = next(r for r in survey.readings if r.kind == "direction" and (r.at, r.to) == (P("P0"), P("P7")))
    kept = (*(r for r in survey.readings if r.to.point_id != "P7"), one)
    with pytest.raises(SurveyError, match="point 'P7' is reached by one direction from P0 only"):
        adjust(replace(survey, readings=kept))
    none = tuple(r for r in survey.readings if r.to.point_id != "P7")
    with pytest.raises(SurveyError, match="point 'P7' is reached by nothing"):
        adjust(replace(survey, readings=none))


def test_one_wrong_reading_does_not_spoil_the_start() -> None:
    """A direction off by 30 degrees among many: the points it reaches are reached by others too."""
    survey, truth = polar_network(3, stations=6, extra=False)
    survey = measured(survey, truth, 1)
    readings = tuple(replace(r, value=r.value + 0.5) if r.reading_id == "direction4-7" else r for r in survey.readings)
    bare = stripped(replace(survey, readings=readings))
    found = find_points(bare, given_points(bare))
    assert max(np.linalg.norm(found[n[1]] - x) for n, x in truth.items() if n[0] == "point") < 0.02


def test_convergence_from_coordinates_rounded_to_metres() -> None:
    survey, truth = polar_network(5, n=20, stations=8)
    survey = measured(survey, truth, 2)
    start = start_near(survey, truth, 0)
    rounded = replace(start, points={k: np.round(x) for k, x in start.points.items()})
    exact, rough = adjust(survey, start), adjust(survey, rounded)
    assert rough.omega == pytest.approx(exact.omega, rel=1e-9)
    assert rough.iterations < 10


def test_places_are_where_the_lines_cross_one_or_two() -> None:
    """Two circles cross twice, a third decides; two rays cross once; directions from the place: the resection."""
    z, known = 3.0 + 4.0j, [0j, 10.0 + 1.0j, 2.0 + 9.0j, -4.0 + 7.0j]
    circles = [(o, abs(z - o)) for o in known]
    rays = [(o, float(np.angle(z - o))) for o in known]
    seen = [(o, float(np.angle(o - z)) + 0.7) for o in known]
    both = sorted(positions([], circles[:2], []), key=lambda p: abs(p - z))
    mirrored = known[1] / np.conj(known[1]) * np.conj(z)  # on the other side of the line through both centres
    np.testing.assert_allclose(both, [z, mirrored], atol=1e-9)
    for asked in (([], circles[:3], []), (rays[:2], [], []), ([], [], [seen]), (rays[:1], circles[1:2], [seen[1:3]])):
        np.testing.assert_allclose(positions(*asked), [z], atol=1e-9)
    assert positions([], circles[:1] * 2, []) == []  # all round the circle


def test_minima_are_found_where_what_is_missed_stays_large() -> None:
    """A distance that is wrong by half, from far away: where the derivative of the sum of squares is zero."""
    centres = np.array([[0.0, 0.0], [10.0, 1.0], [2.0, 9.0]])
    lengths = np.linalg.norm(np.array([3.0, 4.0]) - centres, axis=1) * [1.0, 1.0, 1.5]

    def evaluate(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        to = x[:, None] - centres
        length = np.linalg.norm(to, axis=2)
        return length - lengths, to / length[..., None]

    _, misses, by_x = settled(evaluate, np.array([[40.0, -30.0], [4.0, 4.0], [-500.0, 2.0]]), 60)
    assert np.linalg.norm(misses, axis=1).min() > 0.5
    np.testing.assert_allclose(np.einsum("sni,sn->si", by_x, misses), 0.0, atol=1e-7)
