"""Components that keep their value: plane networks, levellings, poses known in part."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Point3, Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.observations import Coordinates, Distance, FrameRef, PositionRef
from adjust.model.survey import Datum, Point, PointParameter, PoseParameter, Station, Survey

SIGMA = 0.002
PLANE = np.array([[0.0, 0.0, 1.5], [9.0, 1.0, 1.0], [8.0, 7.0, 2.0], [1.0, 6.0, 1.2], [4.0, 3.0, 1.8]])


def plane_network(seed: int) -> Survey:
    """Five points in a plane that does not pass the origin, and all ten distances."""
    rng = np.random.default_rng(seed)
    flat = PLANE.copy()
    flat[:, 2] = 1.5
    points = tuple(Point(f"P{i}", PointParameter(x, held=("z",))) for i, x in enumerate(flat))
    distances = tuple(
        Distance(f"d{i}{j}", PositionRef(f"P{i}"), PositionRef(f"P{j}"),
                 float(np.hypot(*(flat[i] - flat[j])[:2])) + SIGMA * rng.standard_normal(), SIGMA)
        for i in range(5) for j in range(i)
    )  # fmt: skip
    return Survey(points=points, distances=distances, datum=Datum("inner"))


def start_of(survey: Survey) -> StartValues:
    return StartValues({}, {}, {p.point_id: np.asarray(p.x_in_world.value) for p in survey.points})


def test_plane_free_network_equals_the_pseudo_inverse() -> None:
    """Coordinates and covariance against a dense plane least squares by numpy."""
    survey = plane_network(1)
    result = adjust(survey, start_of(survey))
    assert (result.n_unknowns, result.datum_defect, result.redundancy) == (10, 3, 3)
    x = np.array([np.asarray(p.x_in_world.value)[:2] for p in survey.points])
    x0 = x.copy()
    pairs = [(int(d.a.point_id[1:]), int(d.b.point_id[1:]), d.value) for d in survey.distances]
    for _ in range(6):
        A, b = np.zeros((10, 10)), np.zeros(10)
        for row, (i, j, value) in enumerate(pairs):
            u = (x[i] - x[j]) / np.linalg.norm(x[i] - x[j])
            A[row, 2 * i : 2 * i + 2], A[row, 2 * j : 2 * j + 2] = u, -u
            b[row] = value - np.linalg.norm(x[i] - x[j])
        x = x + (np.linalg.pinv(A, rcond=1e-9) @ b).reshape(5, 2)
    Q = np.linalg.pinv(A.T @ A, rcond=1e-12) * SIGMA**2
    for i in range(5):
        estimate = result.estimates[("point", f"P{i}")]
        shape = np.asarray(estimate.value)[:2] - np.mean([result.estimates[("point", f"P{k}")].value for k in range(5)],
                                                        axis=0)[:2]  # fmt: skip
        assert np.linalg.norm(shape) == pytest.approx(np.linalg.norm(x[i] - x.mean(axis=0)), abs=1e-9)
        assert estimate.value[2] == pytest.approx(1.5, abs=1e-12)
        assert estimate.status == ("free", "free", "held")
        np.testing.assert_allclose(estimate.cov[:2, :2], Q[2 * i : 2 * i + 2, 2 * i : 2 * i + 2], rtol=1e-5, atol=1e-13)
        assert not estimate.cov[2].any()
        assert not estimate.cov[:, 2].any()
    assert np.abs(x0 - x).max() > 1e-5


def test_levelling_has_one_defect() -> None:
    """With x and y held only the heights are unknown, and their mean is what is not determined."""
    values = [PointParameter(x, held=("x", "y")) for x in PLANE]
    points = tuple(Point(f"P{i}", v) for i, v in enumerate(values))
    distances = tuple(
        Distance(f"d{i}", PositionRef(f"P{i}"), PositionRef(f"P{j}"), float(np.linalg.norm(PLANE[i] - PLANE[j])), SIGMA)
        for i, j in ((0, 1), (1, 2), (2, 3), (3, 4), (4, 0), (0, 2))
    )
    survey = Survey(points=points, distances=distances, datum=Datum("inner"))
    result = adjust(survey, start_of(survey))
    assert (result.n_unknowns, result.datum_defect, result.redundancy) == (5, 1, 2)


def test_pose_held_in_part_is_exact_and_not_counted() -> None:
    """A station whose attitude and x are held moves along y and z alone, by what is observed."""
    pose = Pose3(Rot3.RzRyRx(0.1, -0.2, 0.3), Point3(1.0, 2.0, 3.0))
    held = ("rx", "ry", "rz", "tx")
    station = Station("S", world_from_station=PoseParameter(pose, held=held))
    seen = pose.transformFrom(np.array([0.05, 0.01, -0.02]))
    survey = Survey(
        stations=(station,), coordinates=(Coordinates((PositionRef(frame=FrameRef("station", "S")),), seen[None],
                                                      np.eye(3) * 1e-6),),
    )  # fmt: skip
    result = adjust(survey, StartValues({}, {("world_from_station", "S"): pose}, {}))
    estimate = result.estimates[("world_from_station", "S")]
    np.testing.assert_allclose(Pose3.Logmap(pose.between(estimate.value)), [0, 0, 0, 0, 0.01, -0.02], atol=1e-12)
    assert (result.n_unknowns, result.redundancy) == (2, 1)
    assert result.omega == pytest.approx(0.05**2 / 1e-6, rel=1e-9)
    np.testing.assert_allclose(np.diag(estimate.cov), [0, 0, 0, 0, 1e-6, 1e-6], rtol=1e-9)


def test_unknown_component_and_missing_value_are_named() -> None:
    survey = plane_network(2)
    for held, value, words in ((("w",), PLANE[0], "no component 'w'"), (("z",), None, "held without a value"),
                               (("x", "y", "z"), PLANE[0], "all components held")):  # fmt: skip
        broken = replace(survey, points=(Point("P0", PointParameter(value, held=held)), *survey.points[1:]))
        with pytest.raises(SurveyError, match=words):
            adjust(broken, start_of(survey))


def test_an_observation_of_what_is_held_counts_and_moves_nothing() -> None:
    """Its residual is what it is, its redundancy whole; without factors on unknowns GTSAM would eliminate nothing."""
    survey = replace(plane_network(2), datum=Datum())
    held = tuple(replace(p, x_in_world=replace(p.x_in_world, treatment="held")) for p in survey.points[:2])
    survey = replace(survey, points=held + survey.points[2:], distances=survey.distances[1:])
    off = np.asarray(held[0].x_in_world.value) + [0.003, -0.001, 0.0]
    seen = replace(survey, coordinates=(Coordinates((PositionRef("P0"),), off[None], np.eye(3) * SIGMA**2),))
    without, result = adjust(survey, start_of(survey)), adjust(seen, start_of(survey))
    assert result.omega - without.omega == pytest.approx((0.003**2 + 0.001**2) / SIGMA**2)
    assert result.redundancy - without.redundancy == 3
    (residual,) = (o for o in result.other_residuals if o.kind == "coordinates")
    np.testing.assert_allclose(residual.redundancy, 1.0)
    for name, estimate in without.estimates.items():
        np.testing.assert_allclose(result.estimates[name].value, estimate.value, atol=1e-12)
        np.testing.assert_allclose(result.estimates[name].cov, estimate.cov, atol=1e-15)
