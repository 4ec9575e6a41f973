"""Steps between poses, compiled: the same formulas as ``adjust.closed_forms.rigid``, for one pose at a time."""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def retracted(pose: FloatArray, step: FloatArray) -> FloatArray:
    """``pose * (Exp(step[:3]), step[3:])`` (4, 4)."""
    w0, w1, w2 = step[0], step[1], step[2]
    angle = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    a, b = 1.0 - angle**2 / 6.0, 0.5
    if angle > 1e-6:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle**2
    k = np.array([[0.0, -w2, w1], [w2, 0.0, -w0], [-w1, w0, 0.0]])
    turn = np.eye(3) + a * k + b * (k @ k)
    out = np.eye(4)
    R = np.ascontiguousarray(pose[:3, :3])
    out[:3, :3] = R @ turn
    for i in range(3):
        out[i, 3] = pose[i, 3] + R[i, 0] * step[3] + R[i, 1] * step[4] + R[i, 2] * step[5]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def step_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """The step (6,) with ``retracted(a, step) = b``; the turn through the quaternion, exact up to half a turn."""
    A = np.ascontiguousarray(a[:3, :3].T)
    r = A @ np.ascontiguousarray(b[:3, :3])
    out = np.empty(6)
    out[3:] = A @ (b[:3, 3] - a[:3, 3])
    squares = np.array([
        1 + r[0, 0] + r[1, 1] + r[2, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2],
        1 - r[0, 0] + r[1, 1] - r[2, 2], 1 - r[0, 0] - r[1, 1] + r[2, 2],
    ])  # fmt: skip
    largest = np.argmax(squares)
    q = np.empty(4)
    d0, d1, d2 = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    s0, s1, s2 = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
    if largest == 0:
        q[:] = np.array([squares[0], d0, d1, d2])
    elif largest == 1:
        q[:] = np.array([d0, squares[1], s0, s1])
    elif largest == 2:
        q[:] = np.array([d1, s0, squares[2], s2])
    else:
        q[:] = np.array([d2, s1, s2, squares[3]])
    q /= np.sqrt(np.sum(q * q))
    if q[0] < 0:
        q = -q
    sine = np.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    factor = 2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, q[0]) / sine
    out[:3] = factor * q[1:]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def step_derivative(step: FloatArray) -> FloatArray:
    """Derivative (6, 6) of ``step_between(a, retracted(b, d))`` by d at zero, where ``step = step_between(a, b)``.

    Source: inverse of the right Jacobian of SO(3) (Chirikjian 2012, eq. 10.86).
    """
    w0, w1, w2 = step[0], step[1], step[2]
    angle = np.sqrt(w0 * w0 + w1 * w1 + w2 * w2)
    beta = 1.0 / 12.0
    if angle >= 1e-4:
        beta = 1.0 / angle**2 - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    k = np.array([[0.0, -w2, w1], [w2, 0.0, -w0], [-w1, w0, 0.0]])
    out = np.zeros((6, 6))
    out[:3, :3] = np.eye(3) + 0.5 * k + beta * (k @ k)
    only_turn = np.zeros(6)
    only_turn[:3] = step[:3]
    out[3:, 3:] = retracted(np.eye(4), only_turn)[:3, :3]
    return out
