import cv2
import numpy as np
import pytest

from adjust.lenses.models import MODELS, lens_constants, lens_derivatives, lens_residuals, project
from adjust.native.lenses import FISHEYE, MAX_LENS, N_COLUMNS, N_LENS, lens_rows
from tests.adjust.lenses import IMAGE_SIZE, NAMES, PIXEL_SIZE_MM, R0_MM, lens, points_in_camera


def fourth_order(f, x, column, h):
    """Derivative of f (n, 2) by one component of x, and how far off it may be; h: a step, or one for each point.

    Central differences of fourth order with two steps; what they differ by, and rounding, is left open.
    """

    def difference(h):
        def at(k):
            y = x.copy()
            y[..., column] += k * h
            return f(y)

        return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * h)[..., None]

    h = np.asarray(h)
    wide, narrow = difference(h), difference(h / 2)
    return narrow, np.abs(wide - narrow) + 1e-14 * (np.abs(f(x)) + 1000.0) / h[..., None]


def agree(found, expected, open_by, what, least=0.0):
    scale = max(np.abs(expected).max(), least)
    assert np.median(open_by) < 1e-5 * scale, f"{what}: the differences say too little"
    assert np.all(np.abs(found - expected) < 1e-7 * scale + 2 * open_by), what


_AROUND = np.array([[1.0, 0.0], [0.6, 0.8], [0.0, -1.0], [-0.8, 0.6]])
_FIELD_DEG = {"brown": 20.0, "fisheye": 179.0, "brown_backward": 20.0, "brown_backward_dbat": 20.0, "aicon": 20.0}
"""Half angle to which the lenses of these tests are steep; the fisheye goes on to beside and behind the camera."""


def at_angle(degrees, depth=1.1):
    """Points (4, 3) m at an angle from the axis, all around it."""
    theta = np.radians(degrees)
    return depth * np.column_stack([np.sin(theta) * _AROUND, np.full(4, np.cos(theta))])


def places(name):
    """Groups of points (n, 3): in the field, on the axis and near it, at the edge of validity, beyond and behind."""
    steps = (60.0, 89.999, 90.0, 90.001, 100.0, 120.0, 150.0, 151.0, 170.0) if name == "fisheye" else (10.0, 15.0)
    return {
        "field": np.vstack([points_in_camera(60), *map(at_angle, steps)]),
        "axis": np.vstack([[[0.0, 0.0, 1.2]], *map(at_angle, (1e-10, 1e-6, 1e-3, 0.1, 1.0, 3.0))]),
        "edge": at_angle(_FIELD_DEG[name]),
        "beyond": np.vstack([at_angle(_FIELD_DEG[name] + more) for more in (0.5, 20.0, 60.0)])
        if name != "fisheye" else at_angle(179.5),
        "behind": np.vstack([at_angle(140.0), at_angle(175.0)]),
    }  # fmt: skip


@pytest.mark.parametrize("where", ["field", "axis", "edge", "beyond", "behind"])
@pytest.mark.parametrize("name", NAMES)
def test_derivatives_agree_with_differences_far_from_zero_error(name, where):
    model, values, constants = lens(name)
    q = places(name)[where]
    # observed pixels anywhere: derivatives must hold far from zero error
    uv = np.random.default_rng(2).uniform([0, 0], IMAGE_SIZE, (len(q), 2))
    residuals, by_lens, by_q = lens_derivatives(model, values, constants, q, uv)
    assert np.isfinite(residuals).all()
    assert np.sqrt(np.mean(residuals**2)) > 50
    for column, parameter in enumerate(model.names):
        expected, open_by = fourth_order(
            lambda v: lens_residuals(model, v, constants, q, uv), values, column, 0.01 * abs(values[column])
        )
        agree(by_lens[:, :, column], expected, open_by, parameter, 1.0 if where == "axis" else 0.0)  # px; little moves
    # what is singular: the camera's plane, for the fisheye the axis behind it
    far = np.hypot(q[:, 0], q[:, 1]) + np.maximum(q[:, 2], 0.0) if name == "fisheye" else np.abs(q[:, 2])
    for column in range(3):
        expected, open_by = fourth_order(
            lambda x: lens_residuals(model, values, constants, x, uv), q, column, np.minimum(1e-3, 5e-3 * far)
        )
        agree(by_q[:, :, column], expected, open_by, f"q{column}")


def scene(name):
    model, values, constants = lens(name)
    q = np.vstack(list(places(name).values()))
    return model, values, constants, q, np.random.default_rng(2).uniform([0, 0], IMAGE_SIZE, (len(q), 2))


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


@pytest.mark.parametrize("degrees", [1e-7, 1.0, 30.0, 60.0, 80.0, 89.9, 90.0, 100.0, 120.0, 150.0, 151.5, 170.0, 179.0])
def test_fisheye_is_its_closed_form_up_to_the_axis_behind(degrees):
    """Its value and its derivatives by the point, radial and across, from theta itself."""
    model, values, constants = lens("fisheye")
    values[2] = 0.0
    theta, k = np.radians(degrees), values[5:]
    q = at_angle(degrees, 1.3)
    theta_d = theta * (1 + k[0] * theta**2 + k[1] * theta**4 + k[2] * theta**6 + k[3] * theta**8)
    slope = 1 + 3 * k[0] * theta**2 + 5 * k[1] * theta**4 + 7 * k[2] * theta**6 + 9 * k[3] * theta**8
    uv = project(model, values, constants, q)
    np.testing.assert_allclose(uv, values[:2] * _AROUND * theta_d + values[3:5], rtol=1e-13)
    _, _, by_q = lens_derivatives(model, values, constants, q[:1], uv[:1])
    by_theta = 1.3 * np.array([np.cos(theta), 0.0, -np.sin(theta)])
    assert by_q[0, 0] @ by_theta == pytest.approx(values[0] * slope, rel=1e-11)
    assert by_q[0, 1, 1] == pytest.approx(values[1] * theta_d / (1.3 * np.sin(theta)), rel=1e-11)
    assert by_q[0] @ q[0] == pytest.approx(np.zeros(2), abs=1e-9)  # nothing changes along the ray


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
