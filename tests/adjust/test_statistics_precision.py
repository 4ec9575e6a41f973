"""Relative precision, ellipsoids, correlations, weak directions and budgets against dense matrices and differences."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import chi2
from scipy.stats import f as fisher
from scipy.stats import t as student

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, PointParameter
from adjust.statistics.effects import uncertainty_budget
from adjust.statistics.group_sums import scaled_survey
from adjust.statistics.relative_precision import ellipsoid, relative_precision
from adjust.statistics.system import linear_system
from adjust.statistics.variance_components import estimate_variance_components
from adjust.statistics.weakness import correlations, weak_directions
from tests.adjust import helpers as h
from tests.adjust import statistics_networks as net


def hall(seed: int = 1) -> Adjustment:
    return adjust(*net.hall(seed))


def inverse(adjustment: Adjustment) -> tuple[FloatArray, FloatArray]:
    """Covariance and normal matrix of a survey with a given datum, dense."""
    system = linear_system(adjustment)
    A = system.A[system.used[system.row_of]].toarray()
    return np.linalg.inv(A.T @ A), A.T @ A


def test_an_ellipsoid_holds_its_share() -> None:
    cov = h.random_cov(np.random.default_rng(1), [1e-3, 2e-3, 5e-4])
    found = ellipsoid(cov, 0.95)
    x = np.random.default_rng(2).multivariate_normal(np.zeros(3), cov, 20000)
    inside = ((x @ found.axes / found.semi_axes) ** 2).sum(axis=1) < 1.0
    assert np.mean(inside) == pytest.approx(0.95, abs=0.006)
    assert np.all(np.diff(found.semi_axes) <= 0)
    flat = ellipsoid(np.diag([4e-6, 1e-6, 0.0]), 0.95, 2.0, 10)
    assert flat.dimension == 2
    np.testing.assert_allclose(flat.semi_axes, 2.0 * np.sqrt(2 * fisher.ppf(0.95, 2, 10)) * np.array([2e-3, 1e-3]))
    assert ellipsoid(np.diag([1e-6, 0.0, 0.0])).semi_axes[0] == pytest.approx(1e-3 * np.sqrt(chi2.ppf(0.95, 1)))


def test_relative_precision_of_points_and_stations() -> None:
    adjustment = hall()
    Q, _ = inverse(adjustment)
    at = linear_system(adjustment).columns.at
    names = [("point", "P1"), ("point", "P2"), ("point", "S3"), ("point", "S1")]
    for a, b in ((0, 1), (1, 2), (2, 3)):
        (found,) = relative_precision(adjustment, [(names[a], names[b])])
        i, j = (at.get(names[k], np.zeros(0, dtype=np.int64)) for k in (a, b))
        J = np.zeros((3, len(Q)))
        for index, sign in ((i, -1.0), (j, 1.0)):
            J[: len(index), index] += sign * np.eye(len(index))
        cov = J @ Q @ J.T
        np.testing.assert_allclose(found.cov, cov, rtol=1e-7, atol=1e-16)
        u = found.difference / found.distance
        assert found.sigma_distance == pytest.approx(np.sqrt(u @ cov @ u), rel=1e-6)
        assert found.rotation_cov is None
    held, x = next(n for n in names if n not in at), names[0]
    wide, narrow = (relative_precision(adjustment, [(held, x)], scaled=k)[0].ellipsoid.semi_axes for k in (True, False))
    expected = adjustment.sigma0 * np.sqrt(3 * fisher.ppf(0.95, 3, adjustment.redundancy) / chi2.ppf(0.95, 3))
    np.testing.assert_allclose(wide / narrow, expected)
    with pytest.raises(SurveyError, match="point X1: no such position"):
        relative_precision(adjustment, [(("point", "X1"), names[0])])


def test_relative_precision_of_cameras() -> None:
    """Two cameras of a head at different epochs, through all poses between them, by differences."""
    survey, truth = h.network(4, n_epochs=4, n_points=10)
    adjustment = adjust(survey, h.start_at(truth))
    a, b = FrameRef("camera", "C2", "e1"), FrameRef("camera", "C2", "e3")
    (found,) = relative_precision(adjustment, [(a, b)])
    names = [("world_from_station", "head", "e1"), ("world_from_station", "head", "e3"), ("station_from_camera", "C2")]
    Q = adjustment.precision.joint(names)
    one, three, camera = (adjustment.estimates[n].value for n in names)

    def places(d: FloatArray) -> tuple[Pose3, Pose3]:
        mount = camera * Pose3.Expmap(d[12:])
        return one * Pose3.Expmap(d[:6]) * mount, three * Pose3.Expmap(d[6:12]) * mount

    J, step = np.zeros((6, 18)), 1e-6
    first, second = places(np.zeros(18))
    back = first.rotation().inverse() * second.rotation()
    for i in range(18):
        d = np.zeros(18)
        d[i] = step
        p, q = places(d)
        J[:3, i] = type(back).Logmap(back.inverse() * (p.rotation().inverse() * q.rotation())) / step
        J[3:, i] = ((q.translation() - p.translation()) - (second.translation() - first.translation())) / step
    cov = J @ Q @ J.T
    assert h.relative(found.cov, cov[3:, 3:]) < 1e-4
    assert found.rotation_cov is not None
    assert h.relative(found.rotation_cov, cov[:3, :3]) < 1e-4
    assert (found.a, found.b) == (("camera", "C2", "e1"), ("camera", "C2", "e3"))
    (same,) = relative_precision(adjustment, [(FrameRef("camera", "C1", "e1"), FrameRef("camera", "C1", "e3"))])
    (by_name,) = relative_precision(adjustment, [(names[0], names[1])])
    np.testing.assert_allclose(same.cov, by_name.cov, rtol=1e-6, atol=1e-14)


def test_correlations_and_weak_directions() -> None:
    """A point seen from one station by angles alone, and a loose tape: its distance is known ten times worse."""
    survey, start = net.hall(2)
    point = survey.points[-1].point_id
    gone = tuple(r for r in survey.readings if r.to.point_id != point
                 or (r.kind != "slope_distance" and r.at.point_id == "S1"))  # fmt: skip
    weak = next(r for r in survey.readings if r.to.point_id == point and r.kind == "slope_distance")
    loose = replace(weak, sigma=1.0)
    tapes = tuple(d for d in survey.distances if point not in (d.a.point_id, d.b.point_id))
    survey = replace(survey, readings=(*gone, loose), distances=tapes)
    adjustment = adjust(survey, start)
    Q, N = inverse(adjustment)
    found = correlations(adjustment, 0.95)
    d = np.sqrt(np.diag(Q))
    C = np.triu(Q / np.outer(d, d), 1)
    assert len(found) == np.count_nonzero(np.abs(C) >= 0.95)
    assert abs(found[0].coefficient) == pytest.approx(np.abs(C).max(), rel=1e-9)
    assert {found[0].a, found[0].b} == {("point", point)}
    worst = weak_directions(adjustment)[0]
    scale = np.sqrt(np.diag(N))
    assert worst.inflation == pytest.approx(np.sqrt(np.linalg.eigvalsh(Q * np.outer(scale, scale))[-1]), rel=1e-6)
    assert {p.name for p in worst.parts} == {("point", point)}
    moved = np.array([p.amount for p in worst.parts])
    assert np.linalg.norm(moved) == pytest.approx(1.0, rel=0.05)  # along the line of sight, as loose as the tape
    assert point in worst.text()


def test_budget_is_the_sensitivity_to_the_variances() -> None:
    """d sigma^2 / d ln(variance of a source) is its share; the shares make the whole."""
    survey, start = net.hall(1)
    points = list(survey.points)
    points[7] = replace(points[7], x_in_world=PointParameter(points[7].x_in_world.value, "prior", 4e-8 * np.eye(3)))
    survey = replace(survey, points=tuple(points))
    adjustment = adjust(survey, start)
    name = ("point", "P3")
    entries = uncertainty_budget(adjustment, [name])
    variance = np.diag(adjustment.estimates[name].cov)
    for entry, total in zip(entries, variance, strict=True):
        assert entry.u**2 == pytest.approx(total, rel=1e-8)
        assert sum(line.share for line in entry.lines) == pytest.approx(1.0)
        assert {line.kind for line in entry.lines} == {"B"}
        assert entry.coverage == pytest.approx(1.95996, abs=1e-4)
        assert f"prior point {points[7].point_id}" in {line.source for line in entry.lines}
    for group in ("direction", "tape"):
        more = adjust(scaled_survey(survey, {group: 1.001}), start)
        change = (np.diag(more.estimates[name].cov) - variance) / 0.001
        mine = [next(line.u for line in e.lines if line.source == group) ** 2 for e in entries]
        np.testing.assert_allclose(change, mine, rtol=1e-2, atol=1e-3 * variance.max())


def test_budget_with_estimated_components() -> None:
    found = estimate_variance_components(*net.hall(1))
    (x, *_) = uncertainty_budget(found.adjustment, [("point", "P3")], 0.95, found.components)
    freedoms = {c.group: c.freedom for c in found.components.components}
    assert {line.kind for line in x.lines} == {"A"}
    effective = x.u**4 / sum(line.u**4 / freedoms[line.source] for line in x.lines)
    assert x.freedom == pytest.approx(effective)
    assert x.expanded == pytest.approx(x.u * student.ppf(0.975, effective))
    with pytest.raises(SurveyError, match="point S1 is no unknown"):
        uncertainty_budget(found.adjustment, [("point", "S1")])
