"""Steps between poses, compiled: the same formulas as ``adjust.closed_forms.rigid``, for one pose at a time."""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray


@njit(cache=True, nogil=True, error_model="numpy")
def _turn(w0: float, w1: float, w2: float, out: FloatArray) -> None:
    """Exp(w) (3, 3) (Rodrigues)."""
    square = w0 * w0 + w1 * w1 + w2 * w2
    angle = np.sqrt(square)
    a, b = 1.0 - square / 6.0, 0.5
    if angle > 1e-6:
        a, b = np.sin(angle) / angle, (1.0 - np.cos(angle)) / square
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - b * (w1 * w1 + w2 * w2), b * w0 * w1 - a * w2, b * w0 * w2 + a * w1
    out[1, 0], out[1, 1], out[1, 2] = b * w0 * w1 + a * w2, 1.0 - b * (w0 * w0 + w2 * w2), b * w1 * w2 - a * w0
    out[2, 0], out[2, 1], out[2, 2] = b * w0 * w2 - a * w1, b * w1 * w2 + a * w0, 1.0 - b * (w0 * w0 + w1 * w1)


@njit(cache=True, nogil=True, error_model="numpy")
def retracted(pose: FloatArray, step: FloatArray) -> FloatArray:
    """``pose * (Exp(step[:3]), step[3:])`` (4, 4)."""
    turn, out = np.empty((3, 3)), np.empty((4, 4))
    _turn(step[0], step[1], step[2], turn)
    for i in range(3):
        for j in range(3):
            out[i, j] = pose[i, 0] * turn[0, j] + pose[i, 1] * turn[1, j] + pose[i, 2] * turn[2, j]
        out[i, 3] = pose[i, 3] + pose[i, 0] * step[3] + pose[i, 1] * step[4] + pose[i, 2] * step[5]
        out[3, i] = 0.0
    out[3, 3] = 1.0
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def step_between(a: FloatArray, b: FloatArray) -> FloatArray:
    """The step (6,) with ``retracted(a, step) = b``; the turn through the quaternion, exact up to half a turn."""
    r, out = np.empty((3, 3)), np.empty(6)
    d0, d1, d2 = b[0, 3] - a[0, 3], b[1, 3] - a[1, 3], b[2, 3] - a[2, 3]
    for i in range(3):
        out[3 + i] = a[0, i] * d0 + a[1, i] * d1 + a[2, i] * d2
        for j in range(3):
            r[i, j] = a[0, i] * b[0, j] + a[1, i] * b[1, j] + a[2, i] * b[2, j]
    # four multiples of the quaternion (w, x, y, z): that with the largest square is the sharpest
    w, x = 1 + r[0, 0] + r[1, 1] + r[2, 2], 1 + r[0, 0] - r[1, 1] - r[2, 2]
    y, z = 1 - r[0, 0] + r[1, 1] - r[2, 2], 1 - r[0, 0] - r[1, 1] + r[2, 2]
    d0, d1, d2 = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    s0, s1, s2 = r[1, 0] + r[0, 1], r[0, 2] + r[2, 0], r[2, 1] + r[1, 2]
    if w >= x and w >= y and w >= z:
        x, y, z = d0, d1, d2
    elif x >= y and x >= z:
        w, y, z = d0, s0, s1
    elif y >= z:
        w, x, z = d1, s0, s2
    else:
        w, x, y = d2, s1, s2
    size = np.sqrt(w * w + x * x + y * y + z * z)
    if w < 0:
        size = -size
    w, x, y, z = w / size, x / size, y / size, z / size
    sine = np.sqrt(x * x + y * y + z * z)
    factor = 2.0 if sine < 1e-12 else 2.0 * np.arctan2(sine, w) / sine
    out[0], out[1], out[2] = factor * x, factor * y, factor * z
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def step_derivative(step: FloatArray) -> FloatArray:
    """Derivative (6, 6) of ``step_between(a, retracted(b, d))`` by d at zero, where ``step = step_between(a, b)``.

    Source: inverse of the right Jacobian of SO(3) (Chirikjian 2012, eq. 10.86).
    """
    w0, w1, w2 = step[0], step[1], step[2]
    square = w0 * w0 + w1 * w1 + w2 * w2
    angle = np.sqrt(square)
    beta = 1.0 / 12.0
    if angle >= 1e-4:
        beta = 1.0 / square - (1.0 + np.cos(angle)) / (2.0 * angle * np.sin(angle))
    turn, out = np.empty((3, 3)), np.zeros((6, 6))
    _turn(w0, w1, w2, turn)
    for i in range(3):
        for j in range(3):
            # beta [w]x [w]x = beta (w w' - w^2)
            out[i, j] = beta * step[i] * step[j] + (1.0 - beta * square if i == j else 0.0)
            out[3 + i, 3 + j] = turn[i, j]
    out[0, 1] -= 0.5 * w2
    out[0, 2] += 0.5 * w1
    out[1, 0] += 0.5 * w2
    out[1, 2] -= 0.5 * w0
    out[2, 0] -= 0.5 * w1
    out[2, 1] += 0.5 * w0
    return out
