import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.spatial.rigid_motions import Motions, exp, identities, right_jacobian, right_jacobian_inverse
from tests.adjust.relay_networks import as_gtsam


def tangents(angle, seed=0):
    d = np.random.default_rng(seed).normal(size=(20, 6))
    d[:, :3] *= (angle / np.linalg.norm(d[:, :3], axis=1))[:, None]
    return d


# both sides of the switch from series to closed form, and nearly half a turn
ANGLES = (0.0, 1e-9, 1e-4, 0.05, 0.299, 0.301, 1.0, 3.1)


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_log_and_jacobians_are_gtsams(angle):
    d = tangents(angle)
    motions = exp(d)
    back, J = right_jacobian_inverse(d), right_jacobian(d)
    for i in range(len(d)):
        expected, D = Pose3.Expmap(d[i]), np.zeros((6, 6), order="F")
        Pose3.Logmap(expected, D)
        np.testing.assert_allclose(motions.rotation[i], expected.rotation().matrix(), atol=2e-15)
        np.testing.assert_allclose(motions.translation[i], expected.translation(), atol=1e-14)
        np.testing.assert_allclose(back[i], D, atol=1e-11 if angle > 3 else 2e-14)
    np.testing.assert_allclose(motions.log(), d, atol=1e-12)
    np.testing.assert_allclose(J @ back, np.broadcast_to(np.eye(6), (20, 6, 6)), atol=1e-11 if angle > 3 else 1e-13)
    np.testing.assert_allclose(right_jacobian(d[:, :3]), J[:, :3, :3], atol=1e-15)
    np.testing.assert_allclose(Motions(motions.rotation).log(), d[:, :3], atol=1e-13)


def test_products_inverses_adjoints_are_gtsams():
    a, b = exp(tangents(1.0)), exp(tangents(2.0, seed=1))
    for i in range(20):
        A, B = as_gtsam(a, i), as_gtsam(b, i)
        assert (A * B).equals(as_gtsam(a @ b, i), 1e-12)
        assert A.inverse().equals(as_gtsam(a.inverse(), i), 1e-12)
        np.testing.assert_allclose(a.adjoint()[i], A.AdjointMap(), atol=1e-13)
        assert A.rotation().equals(Rot3(Motions(a.rotation).adjoint()[i]), 1e-15)
    mask = np.arange(20) % 2 == 0
    chosen = a.where(mask, b)
    np.testing.assert_array_equal(chosen.translation[::2], a.translation[::2])
    np.testing.assert_array_equal(chosen.rotation[1::2], b.rotation[1::2])
    np.testing.assert_allclose((a @ a.inverse()).log(), identities(20, 6).log(), atol=1e-14)
