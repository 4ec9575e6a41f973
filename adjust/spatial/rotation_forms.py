"""Euler angles and rotation matrices, and how covariances pass between them.

Angles are (..., 3) rad about the axes x, y, z, whatever the order of the turns; matrices (..., 3, 3). A tangent is
GTSAM's, on the right: ``R(a + da) = R(a) Exp(J da)``.

- ``zyx``: ``R = Rz(z) Ry(y) Rx(x)``, each turning a vector about its axis (Chao et al. 2011, relay stations).
- ``213``: ``R = C3(psi) C1(phi) C2(theta)`` with the angles (phi, theta, psi), each turning the frame:
  ``Ck(a) = Rk(-a)`` (the rotation matrix of the multi field-of-view navigation system, order 2-1-3).

Both are products of three different axes, so one set of formulas serves them: with ``R = Ri(a) Rj(b) Rk(c)`` and e the
sign of the permutation (i, j, k), ``R_ik = e sin b``, ``R_ij = -e cos b sin c``, ``R_ii = cos b cos c``,
``R_jk = -e cos b sin a``, ``R_kk = cos b cos a``. At ``cos b = 0`` (gimbal lock) a and c cannot be told apart.
"""

from typing import Any, Literal

import numpy as np
from gtsam import Rot3

from adjust.frames.tables import turns
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray

EulerOrder = Literal["zyx", "213"]

# cos of the middle angle below which the other two have no digits left
GIMBAL_COSINE = 1e-7


@frozen
class _Order:
    """Axes of the three turns from the left, and the sense in which all turn."""

    axes: tuple[int, int, int]
    sense: float

    @property
    def parity(self) -> float:
        i, j, k = self.axes
        return float((i - j) * (j - k) * (k - i)) / 2.0


_ORDERS = {"zyx": _Order((2, 1, 0), 1.0), "213": _Order((2, 0, 1), -1.0)}


def matrix_from_euler(angles: FloatArray, order: EulerOrder = "zyx") -> FloatArray:
    """Rotation matrices (..., 3, 3) of Euler angles (..., 3) rad."""
    found = _ORDERS[order]
    i, j, k = found.axes
    turned = found.sense * np.asarray(angles, dtype=float)
    return np.asarray(turns(i, turned[..., i]) @ turns(j, turned[..., j]) @ turns(k, turned[..., k]))


def euler_from_matrix(matrix: FloatArray, order: EulerOrder = "zyx") -> FloatArray:
    """Euler angles (..., 3) rad, the middle one within a quarter turn. Raises SurveyError at gimbal lock."""
    found = _ORDERS[order]
    i, j, k = found.axes
    e, m = found.parity, np.asarray(matrix, dtype=float)
    cosine = np.hypot(m[..., i, i], m[..., i, j])
    _refuse_gimbal_lock(cosine, order)
    angles = np.empty((*m.shape[:-2], 3))
    angles[..., i] = np.arctan2(-e * m[..., j, k], m[..., k, k])
    angles[..., j] = np.arctan2(e * m[..., i, k], cosine)
    angles[..., k] = np.arctan2(-e * m[..., i, j], m[..., i, i])
    return found.sense * angles


def quaternion_wxyz(rotation: Rot3) -> tuple[float, float, float, float]:
    """The unit quaternion of a rotation."""
    q: Any = rotation.toQuaternion()  # GTSAM's stubs do not know Eigen's quaternion
    return q.w(), q.x(), q.y(), q.z()


def euler_jacobian(angles: FloatArray, order: EulerOrder = "zyx") -> FloatArray:
    """Jacobian (..., 3, 3) from Euler angles to the tangent on the right; its determinant is +-cos of the middle angle.

    The last turn adds along its own axis; the earlier ones are seen through the turns after them.
    """
    found = _ORDERS[order]
    i, j, k = found.axes
    turned = found.sense * np.asarray(angles, dtype=float)
    after = turns(k, turned[..., k])
    out = np.zeros((*turned.shape[:-1], 3, 3))
    out[..., k, k] = 1.0
    out[..., :, j] = after[..., j, :]
    out[..., :, i] = (turns(j, turned[..., j]) @ after)[..., i, :]
    return found.sense * out


def tangent_cov_from_euler(angles: FloatArray, cov: FloatArray, order: EulerOrder = "zyx") -> FloatArray:
    """Covariance (..., 3, 3) rad^2 in the tangent on the right, from that of the Euler angles."""
    J = euler_jacobian(angles, order)
    return np.asarray(J @ cov @ np.swapaxes(J, -1, -2))


def euler_cov_from_tangent(angles: FloatArray, cov: FloatArray, order: EulerOrder = "zyx") -> FloatArray:
    """Covariance (..., 3, 3) rad^2 of Euler angles from that in the tangent. Raises SurveyError at gimbal lock."""
    J = euler_jacobian(angles, order)
    middle = _ORDERS[order].axes[1]
    _refuse_gimbal_lock(np.abs(np.cos(np.asarray(angles, dtype=float)[..., middle])), order)
    inverse = np.linalg.inv(J)
    return np.asarray(inverse @ cov @ np.swapaxes(inverse, -1, -2))


def _refuse_gimbal_lock(cosine: FloatArray, order: str) -> None:
    locked = np.flatnonzero(np.atleast_1d(cosine) < GIMBAL_COSINE)
    if len(locked):
        middle = "xyz"[_ORDERS[order].axes[1]]
        more = f" and {len(locked) - 1} more" if len(locked) > 1 else ""
        raise SurveyError(
            f"rotation {int(locked[0])}{more}: the angle about {middle} is a quarter turn (gimbal lock), where Euler "
            f"angles in order {order} and their sigmas are not defined; give the rotation as a quaternion, and its "
            "covariance as small rotations about the axes"
        )
