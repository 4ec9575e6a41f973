"""Compiled observation equations of total stations, theodolites and levels: predicted values and derivatives.

A reading from a to b is taken along ``d = x_b + h_b up_b - (x_a + h_a up_a + F_a' c)`` in the axes F_a of the
instrument (rows: zero, counter-clockwise, up), with heights h along the plumb lines and the centring error c in those
axes. Axes that turn by a small w, about the world's axes, change ``F d`` by ``F (d x w)``.
"""

import numpy as np

from adjust.compiling import njit
from adjust.model import BoolArray, FloatArray, IntArray
from adjust.vertical import horizon_at

DIRECTION, ANGLE, ZENITH, AZIMUTH, SLOPE, HORIZONTAL, HEIGHT = range(7)
AT, TO, SECOND, ORIENTATION, CENTRING, INSTRUMENT, TILT, BODY = 0, 3, 6, 9, 10, 13, 17, 19
"""First columns of the derivatives: positions (3 each), orientation, centring (3), instrument (4), tilts (2), and the
rotation (3, about its own axes) of the body that an instrument which is not levelled stands on."""
N_COLUMNS = 22


@njit(cache=True, nogil=True)
def cross(a: FloatArray, b: FloatArray, out: FloatArray) -> None:
    """Put a x b into ``out``."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


@njit(cache=True, nogil=True)
def add_transposed(J: FloatArray, w: FloatArray, out: FloatArray) -> None:
    """Add J' w to ``out``."""
    for j in range(J.shape[1]):
        out[j] += J[0, j] * w[0] + J[1, j] * w[1] + J[2, j] * w[2]


@njit(cache=True, nogil=True)
def shape(kind: int, sign: float, q: FloatArray, g: FloatArray) -> float:
    """The geometric value of ``q`` (3,) in the instrument's axes, and its gradient g (3,); nan where there is none."""
    h2 = q[0] * q[0] + q[1] * q[1]
    h = np.sqrt(h2)
    g[:] = 0.0
    if kind in (DIRECTION, ANGLE, AZIMUTH):
        if h2 == 0.0:
            return np.nan
        g[0], g[1] = -sign * q[1] / h2, sign * q[0] / h2
        return float(sign * np.arctan2(q[1], q[0]))
    s2 = h2 + q[2] * q[2]
    if kind == ZENITH:
        if h2 == 0.0:
            return np.nan
        g[0], g[1], g[2] = q[0] * q[2] / (h * s2), q[1] * q[2] / (h * s2), -h / s2
        return float(np.arctan2(h, q[2]))
    if kind == SLOPE:
        s = np.sqrt(s2)
        if s == 0.0:
            return np.nan
        g[:] = q / s
        return float(s)
    if h2 == 0.0:
        return np.nan
    g[0], g[1] = q[0] / h, q[1] / h
    return float(h)


@njit(cache=True, nogil=True)
def sight(
    kind: int, sign: float, factor: float, curve: float, to_column: int, F: FloatArray, by_x_a: FloatArray,
    by_tilt_a: FloatArray, up_a: FloatArray, x_a: FloatArray, h_a: float, c: FloatArray, x_b: FloatArray, h_b: float,
    up_b: FloatArray, by_x_b: FloatArray, by_tilt_b: FloatArray, body: bool, refraction: float, A: FloatArray,
) -> float:  # fmt: skip
    """One sight: adds ``factor`` times its derivatives to A (22,), returns ``factor`` times its value.

    curve: 1 / (2 radius), of refraction. body: whether F are the axes of a body instead of the plumb line's.
    """
    offset, d, q, g, w = np.empty(3), np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    # no products of NumPy's: they load SciPy's linear algebra
    for i in range(3):
        offset[i] = h_a * up_a[i] + F[0, i] * c[0] + F[1, i] * c[1] + F[2, i] * c[2]
        d[i] = x_b[i] + h_b * up_b[i] - x_a[i] - offset[i]
    for i in range(3):
        q[i] = F[i, 0] * d[0] + F[i, 1] * d[1] + F[i, 2] * d[2]
    value = shape(kind, sign, q, g)
    if kind == ZENITH:
        h = np.sqrt(q[0] * q[0] + q[1] * q[1])
        value -= refraction * curve * h
        A[INSTRUMENT + 2] -= factor * curve * h
        if h > 0.0:
            g[0] -= refraction * curve * q[0] / h
            g[1] -= refraction * curve * q[1] / h
    for i in range(3):
        g[i] *= factor
    for i in range(3):
        w[i] = F[0, i] * g[0] + F[1, i] * g[1] + F[2, i] * g[2]
    for i in range(3):
        A[AT + i] -= w[i]
        A[to_column + i] += w[i]
        A[CENTRING + i] -= g[i]
    turn = np.empty(3)
    cross(w, d + offset, turn)
    if body:
        for i in range(3):
            A[BODY + i] += F[i, 0] * turn[0] + F[i, 1] * turn[1] + F[i, 2] * turn[2]
    else:
        add_transposed(by_x_a, turn, A[AT : AT + 3])
        add_transposed(by_tilt_a, turn, A[TILT : TILT + 2])
    if h_b != 0.0:
        cross(h_b * up_b, w, turn)
        add_transposed(by_x_b, turn, A[to_column : to_column + 3])
        add_transposed(by_tilt_b, turn, A[TILT : TILT + 2])
    return factor * value


@njit(cache=True, nogil=True)
def predict(
    rows: IntArray, kind: IntArray, at: IntArray, to: IntArray, second: IntArray, orientation_of: IntArray,
    centring_of: IntArray, instrument_of: IntArray, body_of: IntArray, heights: FloatArray, sign: float, curve: float,
    X: FloatArray, axes: FloatArray, by_x: FloatArray, by_tilt: FloatArray, level: FloatArray, up_by_tilt: FloatArray,
    body_axes: FloatArray, orientation: FloatArray, centring: FloatArray, instrument: FloatArray, value: FloatArray,
    A: FloatArray,
) -> None:  # fmt: skip
    """Predicted values (N,) and derivatives A (N, 22) of the readings ``rows``; nan where a sight has no direction.

    at, to, second (N,): positions, second -1 where there is none. orientation_of, centring_of, instrument_of, body_of
    (N,): into the arrays of the same name, -1 for none. heights (N, 3): of instrument, target and second target. axes
    (P, 3, 3), by_x (P, 3, 3), by_tilt (P, 3, 2), level (P,): as :func:`adjust.vertical.horizon_at` gives them.
    up_by_tilt (P, 2): derivative of level by the tilts.
    """
    none = np.zeros(3)
    for index in range(len(rows)):
        r = rows[index]
        a, b = at[r], to[r]
        row = A[r]
        row[:] = 0.0
        c = centring[centring_of[r]] if centring_of[r] >= 0 else none
        p = instrument[instrument_of[r]]
        body = body_of[r] >= 0
        if kind[r] == HEIGHT:
            up_a, up_b = axes[a, 2], axes[b, 2]
            value[r] = level[b] - level[a] + heights[r, 1] - heights[r, 0] - c[2]
            row[CENTRING + 2] = -1.0
            for i in range(3):
                row[AT + i], row[TO + i] = -up_a[i], up_b[i]
            for i in range(2):
                row[TILT + i] = up_by_tilt[b, i] - up_by_tilt[a, i]
            continue
        F = body_axes[body_of[r]] if body else axes[a]
        factor = -1.0 if kind[r] == ANGLE else 1.0
        v = sight(
            kind[r], sign, factor, curve, TO, F, by_x[a], by_tilt[a], F[2], X[a], heights[r, 0], c, X[b], heights[r, 1],
            axes[b, 2], by_x[b], by_tilt[b], body, p[2], row,
        )  # fmt: skip
        if kind[r] == ANGLE:
            s = second[r]
            v += sight(
                kind[r], sign, 1.0, curve, SECOND, F, by_x[a], by_tilt[a], F[2], X[a], heights[r, 0], c, X[s],
                heights[r, 2], axes[s, 2], by_x[s], by_tilt[s], body, p[2], row,
            )  # fmt: skip
        elif kind[r] == DIRECTION:
            v -= orientation[orientation_of[r]]
            row[ORIENTATION] = -1.0
        elif kind[r] == ZENITH:
            v += p[3]
            row[INSTRUMENT + 3] = 1.0
        elif kind[r] == SLOPE or kind[r] == HORIZONTAL:
            row *= 1.0 + p[1]
            row[INSTRUMENT], row[INSTRUMENT + 1] = 1.0, v
            v = p[0] + (1.0 + p[1]) * v
        value[r] = v


@njit(cache=True, nogil=True)
def horizons(
    rows: IntArray, X: FloatArray, up: FloatArray, zero: FloatArray, turns: FloatArray, radius: float,
    axes: FloatArray, by_x: FloatArray, by_tilt: FloatArray, level: FloatArray, level_by_tilt: FloatArray,
) -> None:  # fmt: skip
    """:func:`adjust.vertical.horizon_at` of the positions ``rows`` of X (P, 3), and the level by the tilts (P, 2)."""
    dup = np.empty(3)
    for index in range(len(rows)):
        i = rows[index]
        level[i] = horizon_at(X[i], up, zero, turns, radius, axes[i], by_x[i], by_tilt[i])
        share = 1.0
        if radius > 0.0:
            p = X[i] + radius * up
            share = radius / np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        for j in range(2):
            cross(turns[:, j], up, dup)
            level_by_tilt[i, j] = share * (X[i, 0] * dup[0] + X[i, 1] * dup[1] + X[i, 2] * dup[2])


@njit(cache=True, nogil=True)
def wrapped(kind: IntArray, predicted: FloatArray, observed: FloatArray, out: FloatArray) -> None:
    """Predicted minus observed; those of horizontal angles to (-pi, pi]."""
    for r in range(len(kind)):
        v = predicted[r] - observed[r]
        if kind[r] in (DIRECTION, ANGLE, AZIMUTH):
            v -= 2.0 * np.pi * np.ceil((v - np.pi) / (2.0 * np.pi))
        out[r] = v


@njit(cache=True, nogil=True)
def scatter(
    goal: IntArray, row: IntArray, column: IntArray, factor: FloatArray, root: FloatArray, A: FloatArray,
    out: FloatArray,
) -> None:  # fmt: skip
    """Add to out[goal]: root[row] A[row, column] factor, entry by entry."""
    for e in range(len(goal)):
        out[goal[e]] += root[row[e]] * A[row[e], column[e]] * factor[e]


@njit(cache=True, nogil=True)
def chi_square(e: FloatArray, used: BoolArray) -> float:
    """Sum of the squares of what is used."""
    total = 0.0
    for i in range(len(e)):
        if used[i]:
            total += e[i] * e[i]
    return total
