"""Section 3 of the three-camera head's paper: figures 4 to 6, their analytic slopes, and the tolerances from them."""

import cv2
import numpy as np
import pytest

from adjust.design.error_analysis import (
    ERROR_KINDS,
    BeaconField,
    expected_slope,
    pixel_errors,
    second_order,
    tolerance,
    u_jacobian,
)
from adjust.design.error_figures import SIZES, error_figure
from adjust.model.errors import SurveyError
from adjust.spatial.rotation_forms import matrix_from_euler

MM, DEG = 1e-3, np.pi / 180.0
FAR = BeaconField(nearest_m=0.1)
CAMERA = np.array([[1600.0, 0, 640], [0, 1600, 512], [0, 0, 1]])


@pytest.mark.parametrize("kind", ERROR_KINDS)
def test_errors_are_those_of_opencvs_projection(kind):
    rng = np.random.default_rng(1)
    x, errors = FAR.sample(50, rng), 0.01 * rng.standard_normal((50, 3))
    for at, error, found in zip(x, errors, pixel_errors(kind, x, errors), strict=True):
        R, t = np.eye(3), np.zeros(3)
        if kind == "camera attitude":
            R = matrix_from_euler(error, "213")
        elif kind == "camera position":
            t = error
        moved = at + error if kind == "beacon position" else at
        uv = [cv2.projectPoints(p[None], cv2.Rodrigues(r)[0], s, CAMERA, None)[0].ravel()
              for p, r, s in ((moved, R, t), (at, np.eye(3), np.zeros(3)))]  # fmt: skip
        np.testing.assert_allclose(found, uv[0] - uv[1], atol=1e-9)


@pytest.mark.parametrize("kind", ERROR_KINDS)
def test_jacobian(kind):
    x = FAR.sample(20, np.random.default_rng(2))
    J, h = u_jacobian(kind, x), 1e-6
    for k in range(3):
        step = np.tile(h * np.eye(3)[k], (20, 1))
        numeric = (pixel_errors(kind, x, step) - pixel_errors(kind, x, -step))[:, 0] / (2 * h)
        np.testing.assert_allclose(J[:, k], numeric, rtol=1e-6, atol=1e-5)


def test_beacons_are_uniform_over_what_the_camera_sees():
    found = BeaconField().sample(200_000, np.random.default_rng(3))
    box = np.random.default_rng(4).uniform(0.0, 1.0, (500_000, 2))
    seen = box[1600.0 * box[:, 0] < 640.0 * box[:, 1]]
    for column, expected in ((0, seen[:, 0]), (2, seen[:, 1])):
        np.testing.assert_allclose(np.quantile(found[:, column], np.arange(0.1, 1, 0.1)),
                                   np.quantile(expected, np.arange(0.1, 1, 0.1)), atol=5e-3)  # fmt: skip
    uv = 1600.0 * found[:, :2] / found[:, 2:] + (640.0, 512.0)
    assert uv.min(axis=0) == pytest.approx((640.0, 0.0), abs=0.1)
    assert uv.max(axis=0) == pytest.approx((1280.0, 1024.0), abs=0.1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ERROR_KINDS)
def test_the_simulation_is_the_first_order_within_a_percent(kind):
    curve = error_figure(kind, FAR, n_trials=100_000, seed=7)
    ratio = curve.rms / (curve.slope * curve.sigmas)
    np.testing.assert_allclose(ratio, 1.0, atol=0.02)  # a single point: the heavy tail still shows
    assert np.mean(ratio) == pytest.approx(1.0, abs=0.004)
    assert np.mean(curve.rms / curve.same_draws) == pytest.approx(1.0, abs=0.004)
    assert np.median(curve.rms / curve.sigmas) == pytest.approx(expected_slope(kind, FAR), rel=0.005)


def test_integrals_by_quadrature():
    n, f, w, low, high = FAR.nearest_m, FAR.farthest_m, 0.4, -0.32, 0.32
    Z, x, y = (a + (b - a) * (np.arange(200) + 0.5) / 200 for a, b in ((n, f), (0, w), (low, high)))
    grid = np.stack(np.meshgrid(Z, x, y[::10], indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.stack([grid[:, 1] * grid[:, 0], grid[:, 2] * grid[:, 0], grid[:, 0]], axis=1)
    weight = grid[:, 0] / grid[:, 0].sum()  # an area element of the X-Z plane is Z dx dZ
    for kind in ERROR_KINDS:
        square = np.sum(u_jacobian(kind, points) ** 2, axis=1) @ weight
        assert expected_slope(kind, FAR) == pytest.approx(np.sqrt(square), rel=1e-3)


@pytest.mark.slow
def test_large_errors_need_the_second_order(monkeypatch):
    sizes = np.array([10, 15, 20]) * MM
    monkeypatch.setitem(SIZES, "beacon position", sizes)
    curve = error_figure("beacon position", FAR, n_trials=1_000_000, seed=11)
    assert np.all(curve.rms[1:] > 1.005 * curve.slope * sizes[1:])
    np.testing.assert_allclose(curve.rms, curve.analytic, rtol=0.01)
    # what the first order leaves, beacon by beacon, each with errors of either sign: only even orders remain
    rng = np.random.default_rng(12)
    beacons, errors = FAR.sample(1_000_000, rng), 5 * MM * rng.standard_normal((1_000_000, 3))
    linear = np.sum(u_jacobian("beacon position", beacons) * errors, axis=1)
    both = [pixel_errors("beacon position", beacons, sign * errors)[:, 0] ** 2 for sign in (1, -1)]
    left = np.mean(np.mean(both, axis=0) - linear**2)
    first = 5 * MM * expected_slope("beacon position", FAR)
    whole = second_order("beacon position", FAR, np.array([5 * MM]))[0]
    assert left == pytest.approx(whole**2 - first**2, rel=0.1)
    assert np.isinf(second_order("camera position", BeaconField(), sizes)).all()


@pytest.mark.slow
def test_the_papers_figures_meet_its_conclusion():
    """Several pixels (five) for 1 mm and for 0.17 deg: the scale of figures 4 to 6, which beacons anywhere would miss.

    Without a nearest depth the RMS of 10,000 trials has no expectation; its median over repeated figures is what the
    nearest beacon of so many draws, about 10 mm away, leaves.
    """
    field, slopes = BeaconField(), {}
    for kind in ERROR_KINDS:
        figures = (error_figure(kind, field, seed=s) for s in range(40))
        slopes[kind] = np.median([np.median(f.rms / f.sigmas) for f in figures])
    assert slopes["beacon position"] * MM == pytest.approx(5.3, abs=0.3)
    assert slopes["camera position"] * MM == pytest.approx(5.3, abs=0.3)
    assert slopes["camera attitude"] * DEG == pytest.approx(29.9, abs=0.1)
    assert tolerance(5.0, slopes["camera position"]) == pytest.approx(1.0 * MM, rel=0.15)
    assert tolerance(5.0, slopes["camera attitude"]) == pytest.approx(0.17 * DEG, rel=0.03)
    assert expected_slope("beacon position", BeaconField(nearest_m=0.01)) * MM == pytest.approx(5.0, abs=0.1)
    rng = np.random.default_rng(12)
    anywhere = rng.uniform(0.0, 1.0, (10_000, 3))
    u = pixel_errors("beacon position", anywhere, MM * rng.standard_normal((10_000, 3)))[:, 0]
    assert np.sqrt(np.mean(u**2)) > 1e4


def test_impossible_fields_and_budgets_are_refused():
    with pytest.raises(SurveyError, match="nearest_m < farthest_m"):
        BeaconField(nearest_m=2.0)
    with pytest.raises(SurveyError, match="outside the image"):
        BeaconField(u0_px=1300.0)
    with pytest.raises(SurveyError, match="no tolerance"):
        tolerance(0.0, 5.0)
