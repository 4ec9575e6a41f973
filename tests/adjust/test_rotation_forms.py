import numpy as np
import pytest
from gtsam import Rot3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.spatial.rotation_forms import (
    euler_cov_from_tangent,
    euler_from_matrix,
    euler_jacobian,
    matrix_from_euler,
    tangent_cov_from_euler,
)

ORDERS = ("zyx", "213")
MIDDLE = {"zyx": 1, "213": 0}


def angles_in_range(order, n=200, seed=0):
    rng = np.random.default_rng(seed)
    half = np.full(3, np.pi)
    half[MIDDLE[order]] = 0.49 * np.pi
    return rng.uniform(-half, half, (n, 3))


def test_zyx_is_the_product_of_turns_about_z_y_x():
    angles = angles_in_range("zyx")
    expected = Rotation.from_euler("ZYX", angles[:, ::-1]).as_matrix()
    np.testing.assert_allclose(matrix_from_euler(angles), expected, atol=1e-15)
    np.testing.assert_allclose(Rot3.RzRyRx(*angles[0]).matrix(), expected[0], atol=1e-15)


def test_213_is_the_printed_matrix():
    phi, theta, psi = angles_in_range("213").T
    sp, cp, st, ct, ss, cs = np.sin(phi), np.cos(phi), np.sin(theta), np.cos(theta), np.sin(psi), np.cos(psi)
    expected = np.array([
        [cs * ct + ss * st * sp, ss * cp, -cs * st + ss * ct * sp],
        [-ss * ct + cs * st * sp, cs * cp, ss * st + cs * ct * sp],
        [cp * st, -sp, ct * cp],
    ]).transpose(2, 0, 1)  # fmt: skip
    found = matrix_from_euler(np.stack([phi, theta, psi], axis=1), "213")
    np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize("order", ORDERS)
def test_there_and_back(order):
    angles = angles_in_range(order)
    np.testing.assert_allclose(euler_from_matrix(matrix_from_euler(angles, order), order), angles, atol=1e-13)
    stacked = angles.reshape(4, 50, 3)
    assert matrix_from_euler(stacked, order).shape == (4, 50, 3, 3)
    np.testing.assert_array_equal(matrix_from_euler(stacked, order).reshape(-1, 3, 3), matrix_from_euler(angles, order))


@pytest.mark.parametrize("order", ORDERS)
def test_jacobian_is_the_derivative_in_gtsams_tangent(order):
    for angles in angles_in_range(order, 20, seed=1):
        R, h = Rot3(matrix_from_euler(angles, order)), 1e-6
        columns = []
        for k in range(3):
            step = h * np.eye(3)[k]
            plus, minus = (Rot3(matrix_from_euler(angles + s, order)) for s in (step, -step))
            columns.append((Rot3.Logmap(R.between(plus)) - Rot3.Logmap(R.between(minus))) / (2 * h))
        J = euler_jacobian(angles, order)
        np.testing.assert_allclose(J, np.array(columns).T, atol=1e-9)
        assert abs(np.linalg.det(J)) == pytest.approx(np.cos(angles[MIDDLE[order]]), abs=1e-12)


@pytest.mark.parametrize("order", ORDERS)
def test_covariance_there_and_back_and_against_scatter(order):
    rng, angles = np.random.default_rng(2), angles_in_range(order, 1, seed=3)[0] * 0.8
    A = rng.normal(size=(3, 3)) * 1e-4
    cov = A @ A.T
    tangent = tangent_cov_from_euler(angles, cov, order)
    np.testing.assert_allclose(euler_cov_from_tangent(angles, tangent, order), cov, rtol=1e-9, atol=1e-9 * cov.max())
    noisy = matrix_from_euler(angles + rng.multivariate_normal(np.zeros(3), cov, 40_000), order)
    scatter = Rotation.from_matrix(matrix_from_euler(angles, order).T @ noisy).as_rotvec()
    scale = np.sqrt(np.diag(tangent))
    # 40,000 samples: correlations to 0.5 %
    np.testing.assert_allclose(np.cov(scatter.T) / np.outer(scale, scale), tangent / np.outer(scale, scale), atol=0.03)


@pytest.mark.parametrize("order", ORDERS)
def test_gimbal_lock_is_refused_by_position(order):
    angles = np.zeros((3, 3))
    angles[1, MIDDLE[order]] = np.pi / 2
    with pytest.raises(SurveyError, match=rf"rotation 1: the angle about {'xyz'[MIDDLE[order]]} .*gimbal lock"):
        euler_from_matrix(matrix_from_euler(angles, order), order)
    with pytest.raises(SurveyError, match=r"rotation 1: .*gimbal lock"):
        euler_cov_from_tangent(angles, np.broadcast_to(np.eye(3), (3, 3, 3)), order)
