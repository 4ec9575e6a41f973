"""Differences of two calibrations and what a calibration leaves open, against published maps and re-drawn lenses."""

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.lenses.compared import Optics, lens_difference, pixel_grid, projection_covariance, worst_sigma
from adjust.lenses.models import lens_constants, lens_model, project
from adjust.model.errors import SurveyError

SIZE = (1280, 1024)


def optics(name="brown", **changed):
    model = lens_model(name)
    values = np.zeros(model.n)
    s = 0.005 if model.in_mm else None
    start = {"fx": 1500.0, "fy": 1502.0, "u0": 640.0, "v0": 512.0, "k1": -0.12, "k2": 0.05, "c": 7.5}
    for key, value in {**start, **changed}.items():
        if key in model.names:
            values[model.names.index(key)] = value
    return Optics(model, values, lens_constants(model, SIZE, s))


def grid():
    return pixel_grid(SIZE, 16)


def moved(camera, motion, uv, distance):
    points = np.asarray(motion.transformFrom(camera.points(uv, distance).T)).T
    return project(camera.model, camera.values, camera.constants, points)


@pytest.mark.parametrize("distance", [np.inf, 2.0])
def test_a_turned_camera_with_the_same_lens_differs_in_nothing(distance):
    """What only looks elsewhere is not a difference: found again where the same pixel rays are compared."""
    found = lens_difference(optics(), optics(), grid(), distance)
    assert np.abs(found.shift).max() < 1e-9
    assert found.second_from_first.equals(Pose3(), 1e-9)


def test_another_principal_point_is_mostly_a_turned_camera():
    uv, second = grid(), optics(u0=650.0, v0=505.0)
    found = lens_difference(optics(), second, uv)
    assert np.median(np.linalg.norm(found.shift, axis=1)) < 0.1 * np.hypot(10, 7)  # what shows without the fit
    angle = np.linalg.norm(Rot3.Logmap(found.second_from_first.rotation()))
    assert angle == pytest.approx(np.hypot(10, 7) / 1500, rel=0.15)


def test_the_fit_is_a_minimum():
    first, second, uv = optics(), optics(fx=1503.0, u0=644.0, k1=-0.121), grid()
    found = lens_difference(first, second, uv, 2.0)
    best = float((found.shift**2).sum())
    points = first.points(uv, 2.0)
    for step in 1e-4 * np.vstack([np.eye(6), -np.eye(6)]):
        there = np.asarray(found.second_from_first.compose(Pose3.Expmap(step)).transformFrom(points.T)).T
        assert float(((project(second.model, second.values, second.constants, there) - uv) ** 2).sum()) > best


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brown", "fisheye", "brown_backward"])
@pytest.mark.parametrize("distance", [np.inf, 1.5])
def test_uncertainty_is_the_scatter_of_differences(name, distance):
    """Lenses drawn from a covariance, each compared with the first: their scatter is the covariance foretold."""
    first, uv, rng = optics(name), pixel_grid(SIZE, 8), np.random.default_rng(3)
    n = len(first.values)
    by_name = {"fx": 0.2, "fy": 0.2, "u0": 0.2, "v0": 0.2, "c": 1e-3, "xp": 1e-3, "yp": 1e-3, "K2": 1e-8, "K3": 1e-10}
    sigma = np.array([by_name.get(key, 1e-6 if first.model.in_mm else 1e-5) for key in first.model.names])
    root = np.diag(sigma) @ (np.eye(n) + 0.3 * rng.normal(size=(n, n)) / np.sqrt(n))
    cov = root @ root.T
    foretold = projection_covariance(first, uv, distance, cov)
    drawn = []
    for _ in range(400):
        other = Optics(first.model, first.values + root @ rng.normal(size=n), first.constants)
        drawn.append(lens_difference(first, other, uv, distance).shift)
    found = np.einsum("mni,mnj->nij", drawn, drawn) / len(drawn)
    ratio = worst_sigma(found) / worst_sigma(foretold)
    assert np.median(ratio) == pytest.approx(1.0, abs=0.08)  # 400 draws: a sigma to 3.5 %
    assert ratio.min() > 0.8
    assert ratio.max() < 1.25


def test_on_a_body_the_mount_counts_and_nothing_is_fitted():
    first, uv, distance = optics(), pixel_grid(SIZE, 8), 2.0
    rng = np.random.default_rng(4)
    n = len(first.values)
    root = np.diag(np.r_[np.zeros(n), np.full(3, 1e-4), np.full(3, 2e-4)]) @ (
        np.eye(n + 6) + 0.2 * rng.normal(size=(n + 6, n + 6)))
    foretold = projection_covariance(first, uv, distance, root @ root.T)
    drawn = []
    for _ in range(600):
        step = root @ rng.normal(size=n + 6)
        drawn.append(moved(first, Pose3.Expmap(step[n:]).inverse(), uv, distance) - uv)
    found = np.einsum("mni,mnj->nij", drawn, drawn) / len(drawn)
    assert np.median(worst_sigma(found) / worst_sigma(foretold)) == pytest.approx(1.0, abs=0.06)


def test_too_few_pixels_are_refused():
    with pytest.raises(SurveyError, match="only 2 pixels"):
        lens_difference(optics(), optics(), grid(), fitted=np.arange(len(grid())) < 2)
