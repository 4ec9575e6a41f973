import cv2
import numpy as np
import pytest

from adjust.lens import MODELS, lens_constants, lens_derivatives, lens_residuals, project
from adjust.native.lenses import FISHEYE, MAX_LENS, N_COLUMNS, N_LENS, lens_rows
from tests.adjust.lenses import IMAGE_SIZE, NAMES, PIXEL_SIZE_MM, R0_MM, lens, points_in_camera


def fourth_order(f, x, column, h):
    """Derivative of f by one component of x, central differences of fourth order."""

    def at(k):
        y = x.copy()
        y[..., column] += k * h
        return f(y)

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)


def scene(name):
    model, values, constants = lens(name)
    q = points_in_camera(60)
    if name == "fisheye":
        q = np.vstack([q, [[1.0, 0.4, 0.05], [0.7, -0.5, -0.3], [-0.099, 0.01, 1.0], [-0.101, 0.01, 1.0]]])
    # observed pixels anywhere: derivatives must hold far from zero error
    uv = np.random.default_rng(2).uniform([0, 0], IMAGE_SIZE, (len(q), 2))
    return model, values, constants, q, uv


@pytest.mark.parametrize("name", NAMES)
def test_derivatives_agree_with_differences_far_from_zero_error(name):
    model, values, constants, q, uv = scene(name)
    residuals, by_lens, by_q = lens_derivatives(model, values, constants, q, uv)
    assert np.sqrt(np.mean(residuals**2)) > 50
    for column, parameter in enumerate(model.names):
        expected = fourth_order(
            lambda v: lens_residuals(model, v, constants, q, uv), values, column, 0.02 * abs(values[column])
        )
        error = np.abs(by_lens[:, :, column] - expected).max() / np.abs(expected).max()
        assert error < 1e-7, parameter
    for column in range(3):
        expected = fourth_order(lambda x: lens_residuals(model, values, constants, x, uv), q, column, 2e-4)
        error = np.abs(by_q[:, :, column] - expected).max() / np.abs(expected).max()
        assert error < 1e-7, f"q{column}"


@pytest.mark.parametrize("name", NAMES)
def test_residual_with_and_without_derivatives_is_the_same(name):
    model, values, constants, q, uv = scene(name)
    residuals, _, _ = lens_derivatives(model, values, constants, q, uv)
    np.testing.assert_allclose(residuals, lens_residuals(model, values, constants, q, uv), atol=1e-11)


def one_row(name, q):
    model, values, constants = lens(name)
    residuals, rows = lens_rows(model.kind, values, constants, np.array([q]), np.array([[300.0, 200.0]]))
    return model, residuals[0], rows[0]


@pytest.mark.parametrize("name", NAMES)
def test_row_fills_its_columns_and_no_other(name):
    model, _, row = one_row(name, (0.1, 0.2, 1.0))
    assert row.shape == (2, N_COLUMNS)
    assert not np.any(row[:, model.n : MAX_LENS])
    assert np.all(np.any(row[:, : model.n] != 0.0, axis=0))
    assert model.n == N_LENS[model.kind] == len(lens(name)[1])


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("q", [(0.1, 0.2, -1.0), (0.1, 0.2, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)])
def test_points_beside_and_behind_the_camera_give_finite_numbers(name, q):
    _, residual, row = one_row(name, q)
    assert np.all(np.isfinite(residual))
    assert np.all(np.isfinite(row))


def test_brown_is_opencv_with_rational_terms():
    model, values, constants = lens("brown")
    values[2] = 0.0  # OpenCV has no skew
    q = points_in_camera(200)
    matrix = np.array([[values[0], 0, values[3]], [0, values[1], values[4]], [0, 0, 1]])
    expected, _ = cv2.projectPoints(q, np.zeros(3), np.zeros(3), matrix, values[5:])
    np.testing.assert_allclose(project(model, values, constants, q), expected.reshape(-1, 2), atol=1e-10)


def test_skew_moves_u_by_the_distorted_y():
    model, values, constants = lens("brown")
    q = points_in_camera(50)
    straight = values.copy()
    straight[2] = 0.0
    without = project(model, straight, constants, q)
    expected = without + np.column_stack([values[2] * (without[:, 1] - values[4]) / values[1], np.zeros(50)])
    np.testing.assert_allclose(project(model, values, constants, q), expected, atol=1e-10)


def test_fisheye_is_opencv():
    model, values, constants = lens("fisheye")
    q = np.vstack([points_in_camera(200), [[1.0, 0.2, 0.2], [-3.0, 2.0, 0.5]]])
    matrix = np.array([[values[0], 0, values[3]], [0, values[1], values[4]], [0, 0, 1]])
    expected, _ = cv2.fisheye.projectPoints(
        q.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), matrix, values[5:], alpha=values[2] / values[0]
    )
    # OpenCV switches to a pinhole within 1e-8 of the axis, its angle comes from atan
    np.testing.assert_allclose(project(model, values, constants, q), expected.reshape(-1, 2), atol=1e-9)


def test_fisheye_sees_behind_the_camera_at_the_angle():
    model, values, constants = lens("fisheye")
    theta = np.radians([100.0, 120.0, 150.0])
    uv = project(model, values, constants, np.column_stack([np.sin(theta), 0 * theta, np.cos(theta)]))
    k = values[5:]
    theta_d = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    np.testing.assert_allclose(uv[:, 0], values[0] * theta_d + values[3], rtol=1e-14)


@pytest.mark.parametrize("tangent", [0.0, 1e-12, 1e-6, 1e-3, 0.0999999, 0.1000001])
def test_fisheye_near_the_axis_keeps_its_digits(tangent):
    _, values, constants = lens("fisheye")
    row = np.zeros((2, N_COLUMNS))
    values[2:5] = 0.0
    residuals, rows = lens_rows(FISHEYE, values, constants, np.array([[tangent, 0.0, 1.0]]), np.zeros((1, 2)))
    ru, row = residuals[0, 0], rows[0]
    theta = np.arctan(tangent)
    k = values[5:]
    theta_d = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    slope = 1 + 3 * k[0] * theta**2 + 5 * k[1] * theta**4 + 7 * k[2] * theta**6 + 9 * k[3] * theta**8
    assert ru == pytest.approx(values[0] * theta_d, rel=2e-15)
    assert row[0, 14] == pytest.approx(values[0] * slope / (1 + tangent**2), rel=1e-13)
    across = values[1] * (theta_d / tangent if tangent else 1.0)
    assert row[1, 15] == pytest.approx(across, rel=1e-14)


def test_brown_backward_corrects_the_measured_point_as_australis_does():
    model, values, constants = lens("brown_backward")
    c, xp, yp, K1, K2, K3, P1, P2, B1, B2 = values
    uv = np.random.default_rng(3).uniform([0, 0], IMAGE_SIZE, (100, 2))
    x = (uv[:, 0] - 319.5) * PIXEL_SIZE_MM - xp
    y = (239.5 - uv[:, 1]) * PIXEL_SIZE_MM - yp
    r2 = x**2 + y**2
    radial = K1 * r2 + K2 * r2**2 + K3 * r2**3
    xc = x + x * radial + P1 * (r2 + 2 * x**2) + 2 * P2 * x * y + B1 * x + B2 * y
    yc = y + y * radial + P2 * (r2 + 2 * y**2) + 2 * P1 * x * y
    depth = np.linspace(1.0, 3.0, 100)
    q = np.column_stack([xc, -yc, np.full(100, c)]) * (depth / c)[:, None]
    np.testing.assert_allclose(lens_residuals(model, values, constants, q, uv), 0.0, atol=1e-10)
    # the residual is formed in the corrected plane, in pixels of the nominal size
    q[:, :2] += np.array([0.3, -0.2]) * (PIXEL_SIZE_MM / c) * depth[:, None]
    residuals = lens_residuals(model, values, constants, q, uv)
    np.testing.assert_allclose(residuals, np.tile([0.3, -0.2], (100, 1)), atol=1e-10)


def test_dbat_corrects_the_measured_point_from_the_pixel_origin():
    model, values, constants = lens("brown_backward_dbat")
    c, px, py, stretch, K1, K2, K3, P1, P2 = values
    uv = np.random.default_rng(3).uniform([0, 0], IMAGE_SIZE, (100, 2))
    flipped = uv * PIXEL_SIZE_MM * [1, -1]
    x, y = ((flipped - [px, -py]) * [1 + stretch, 1]).T
    r2 = x**2 + y**2
    radial = 1 + K1 * r2 + K2 * r2**2 + K3 * r2**3
    xc = x * radial + P1 * (r2 + 2 * x**2) + 2 * P2 * x * y
    yc = y * radial + P2 * (r2 + 2 * y**2) + 2 * P1 * x * y
    # the camera looks along -z with y up: turn its frame half way about x
    q = np.column_stack([xc, yc, np.full(100, -c)]) * [1, -1, -1] * 0.2
    np.testing.assert_allclose(lens_residuals(model, values, constants, q, uv), 0.0, atol=1e-10)


def test_aicon_distorts_the_ideal_point():
    model, values, constants = lens("aicon")
    ck, xh, yh, A1, A2, A3, B1, B2, C1, C2 = values
    q = points_in_camera(100)
    kx, ky, kz = (q * [1, -1, -1]).T  # looking along -z, y up
    xs, ys = -ck * kx / kz, -ck * ky / kz
    rho2 = xs**2 + ys**2
    D = A1 * (rho2 - R0_MM**2) + A2 * (rho2**2 - R0_MM**4) + A3 * (rho2**3 - R0_MM**6)
    x = xh + xs + xs * D + B1 * (rho2 + 2 * xs**2) + 2 * B2 * xs * ys + C1 * xs + C2 * ys
    y = yh + ys + ys * D + B2 * (rho2 + 2 * ys**2) + 2 * B1 * xs * ys
    expected = np.column_stack([x / PIXEL_SIZE_MM + 319.5, 239.5 - y / PIXEL_SIZE_MM])
    np.testing.assert_allclose(project(model, values, constants, q), expected, atol=1e-10)


def test_constants_of_pixel_models_need_no_pixel_size():
    np.testing.assert_array_equal(lens_constants(MODELS["brown"], (640, 480)), [1.0, 319.5, 239.5, 0.0])
