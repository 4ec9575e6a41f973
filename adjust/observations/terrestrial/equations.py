"""Observation equations of total stations, theodolites and levels: predicted values and derivatives.

A reading from a to b is taken along ``d = x_b + h_b up_b - (x_a + h_a up_a + F_a' c)`` in the axes F_a of the
instrument (rows: zero, counter-clockwise, up), with heights h along the plumb lines and the centring error c in those
axes. Axes that turn by a small w, about the world's axes, change ``F d`` by ``F (d x w)``.
"""

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.vertical import Horizon

DIRECTION, ANGLE, ZENITH, AZIMUTH, SLOPE, HORIZONTAL, HEIGHT = range(7)
_IS_TURN = np.array([kind in (DIRECTION, ANGLE, AZIMUTH) for kind in range(7)])
AT, TO, SECOND, ORIENTATION, CENTRING, INSTRUMENT, TILT, BODY = 0, 3, 6, 9, 10, 13, 17, 19
"""First columns of the derivatives: positions (3 each), orientation, centring (3), instrument (4), tilts (2), and the
rotation (3, about its own axes) of the body that an instrument which is not levelled stands on."""
N_COLUMNS = 22


@dataclass(frozen=True, eq=False)
class Readings:
    """What (n,) readings join, as numbers of arrays, -1 for none; heights (n, 3): instrument, target, second target."""

    kind: IntArray
    at: IntArray
    to: IntArray
    second: IntArray
    orientation: IntArray
    centring: IntArray
    instrument: IntArray
    body: IntArray
    heights: FloatArray

    def of(self, rows: IntArray) -> "Readings":
        """Some of them."""
        return Readings(*(getattr(self, f.name)[rows] for f in fields(Readings)))


@dataclass(frozen=True, eq=False)
class Geometry:
    """Present values by number.

    X (P, 3): positions, and the horizon at each. body_axes (., 3, 3), orientation (.,), centring (., 3), instrument
    (., 4): distance offset and scale, refraction, vertical index.
    """

    X: FloatArray
    horizon: Horizon
    body_axes: FloatArray
    orientation: FloatArray
    centring: FloatArray
    instrument: FloatArray


def predict(r: Readings, u: Geometry, sign: float, curve: float) -> tuple[FloatArray, FloatArray]:
    """Predicted values (n,) and derivatives A (n, 22); nan where a sight has no direction.

    sign: of angles that count clockwise. curve: 1 / (2 radius), of refraction.
    """
    level, rows = np.flatnonzero(r.kind == HEIGHT), np.flatnonzero(r.kind != HEIGHT)
    distances = np.flatnonzero((r.kind == SLOPE) | (r.kind == HORIZONTAL))
    offset, scale = u.instrument[r.instrument[distances], 0], 1.0 + u.instrument[r.instrument[distances], 1]
    factor = np.where(r.kind == ANGLE, -1.0, 1.0)
    factor[distances] = scale
    value, A = _sights(r, u, rows, _End(r.to, 1, TO), factor[rows], sign, curve)
    if len(level):
        sights, by = value, A
        value, A = np.empty(len(r.kind)), np.zeros((len(r.kind), N_COLUMNS))
        value[rows], A[rows] = sights, by
        value[level] = _heights(r, u, level, A)
    rows = np.flatnonzero(r.kind == ANGLE)
    if len(rows):
        more, by = _sights(r, u, rows, _End(r.second, 2, SECOND), np.ones(len(rows)), sign, curve)
        value[rows], A[rows] = value[rows] + more, A[rows] + by
    rows = np.flatnonzero(r.kind == DIRECTION)
    value[rows] -= u.orientation[r.orientation[rows]]
    A[rows, ORIENTATION] = -1.0
    rows = np.flatnonzero(r.kind == ZENITH)
    value[rows] += u.instrument[r.instrument[rows], 3]
    A[rows, INSTRUMENT + 3] = 1.0
    A[distances, INSTRUMENT], A[distances, INSTRUMENT + 1] = 1.0, value[distances] / scale
    value[distances] += offset
    return value, A


def wrapped(kind: IntArray, predicted: FloatArray, observed: FloatArray) -> FloatArray:
    """Predicted minus observed (n,); those of horizontal angles to (-pi, pi]."""
    v = predicted - observed
    turns = np.ceil((v - np.pi) / (2.0 * np.pi))
    return np.asarray(np.where(_IS_TURN[kind], v - 2.0 * np.pi * turns, v))


def _centring(r: Readings, u: Geometry, rows: IntArray) -> FloatArray:
    of = r.centring[rows]
    return np.where(of[:, None] >= 0, u.centring[of], 0.0)


def _heights(r: Readings, u: Geometry, rows: IntArray, A: FloatArray) -> FloatArray:
    """Height differences of the ``rows``, and their derivatives into A."""
    a, b, h = r.at[rows], r.to[rows], u.horizon
    A[rows, AT : AT + 3], A[rows, TO : TO + 3] = -h.axes[a, 2], h.axes[b, 2]
    A[rows, CENTRING + 2] = -1.0
    A[rows, TILT : TILT + 2] = h.height_by_tilt[b] - h.height_by_tilt[a]
    raised = r.heights[rows, 1] - r.heights[rows, 0] - _centring(r, u, rows)[:, 2]
    return np.asarray(h.height[b] - h.height[a] + raised)


class _End(NamedTuple):
    """Where sights go: positions (n,) of all readings, the column of their heights, the first one of derivatives."""

    to: IntArray
    height: int
    column: int


def _sights(
    r: Readings, u: Geometry, rows: IntArray, end: _End, factor: FloatArray, sign: float, curve: float
) -> tuple[FloatArray, FloatArray]:
    """``factor`` times the values (m,) of the sights of ``rows`` to that end, and derivatives A (m, 22)."""
    to, target, to_column = end
    a, b, kind, horizon, body = r.at[rows], to[rows], r.kind[rows], u.horizon, r.body[rows]
    on_body, F = np.flatnonzero(body >= 0), horizon.axes[a]
    F[on_body] = u.body_axes[body[on_body]]
    back, up_b, h_b = np.swapaxes(F, 1, 2), horizon.axes[b, 2], r.heights[rows, target, None]
    offset = r.heights[rows, 0, None] * F[:, 2] + _times(back, _centring(r, u, rows))
    d = u.X[b] + h_b * up_b - u.X[a] - offset
    q = _times(F, d)
    value, g = _shape(kind, sign, q)
    A = np.zeros((len(rows), N_COLUMNS))
    zenith = np.flatnonzero(kind == ZENITH)
    h = np.hypot(q[zenith, 0], q[zenith, 1])
    bend = u.instrument[r.instrument[rows[zenith]], 2] * curve
    value[zenith] -= bend * h
    A[zenith, INSTRUMENT + 2] -= factor[zenith] * curve * h
    g[zenith, :2] -= (bend / np.where(h > 0.0, h, np.inf))[:, None] * q[zenith, :2]
    g *= factor[:, None]
    w = _times(back, g)
    A[:, AT : AT + 3], A[:, to_column : to_column + 3], A[:, CENTRING : CENTRING + 3] = -w, w, -g
    turn = _cross(w, d + offset)
    levelled = np.flatnonzero(body < 0)
    A[on_body, BODY : BODY + 3] = _times(F[on_body], turn[on_body])
    _add_turn(horizon, a[levelled], turn[levelled], levelled, AT, A)
    raised = np.flatnonzero(h_b[:, 0])
    _add_turn(horizon, b[raised], _cross((h_b * up_b)[raised], w[raised]), raised, to_column, A)
    return factor * value, A


def _add_turn(h: Horizon, at: IntArray, turn: FloatArray, rows: IntArray, column: int, A: FloatArray) -> None:
    """What the axes at positions ``at`` add to A by turning with the position and the tilts."""
    if not len(rows):
        return
    A[rows, column : column + 3] += _times(np.swapaxes(h.by_x[at], 1, 2), turn)
    A[rows, TILT : TILT + 2] += _times(np.swapaxes(h.by_tilt[at], 1, 2), turn)


def _shape(kind: IntArray, sign: float, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Geometric values (n,) of q (n, 3) in the instrument's axes, and their gradients (n, 3); nan where is none."""
    x, y, z = q.T
    h2 = x * x + y * y
    h, s2 = np.sqrt(h2), h2 + z * z
    s, zero = np.sqrt(s2), np.zeros(len(q))
    turn, zenith, slope = _IS_TURN[kind], kind == ZENITH, kind == SLOPE

    def of_kind(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
        return np.where(turn, a, np.where(zenith, b, np.where(slope, c, d)))

    with np.errstate(divide="ignore", invalid="ignore"):
        value = of_kind(sign * np.arctan2(y, x), np.arctan2(h, z), s, h)
        by_turn, by_zenith = (-sign * y / h2, sign * x / h2, zero), (x * z / (h * s2), y * z / (h * s2), -h / s2)
        by_slope, by_horizontal = (x / s, y / s, z / s), (x / h, y / h, zero)
    g = np.stack([of_kind(*parts) for parts in zip(by_turn, by_zenith, by_slope, by_horizontal, strict=True)], axis=1)
    none = np.where(slope, s, h) == 0.0
    value[none], g[none] = np.nan, 0.0
    return value, g


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Of vectors (n, 3), without what np.cross asks first."""
    (a1, a2, a3), (b1, b2, b3) = a.T, b.T
    return np.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], axis=1)


def _times(A: FloatArray, x: FloatArray) -> FloatArray:
    """A x of matrices (n, i, j) and vectors (n, j)."""
    return np.asarray(np.einsum("nij,nj->ni", A, x))
