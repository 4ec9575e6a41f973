"""Observation equations of total stations, theodolites and levels: predicted values and derivatives.

A reading from a to b is taken along ``d = x_b + h_b up_b - (x_a + h_a up_a + F_a' c)`` in the axes F_a of the
instrument (rows: zero, counter-clockwise, up), with heights h along the plumb lines and the centring error c in those
axes. Axes that turn by a small w, about the world's axes, change ``F d`` by ``F (d x w)``.
"""

from dataclasses import fields
from functools import cached_property

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.vertical import Horizon

DIRECTION, ANGLE, ZENITH, AZIMUTH, SLOPE, HORIZONTAL, HEIGHT = range(7)
_IS_TURN = np.array([kind in (DIRECTION, ANGLE, AZIMUTH) for kind in range(7)])
AT, TO, SECOND, ORIENTATION, CENTRING, INSTRUMENT, TILT, BODY = 0, 3, 6, 9, 10, 13, 17, 19
"""First columns of the derivatives: positions (3 each), orientation, centring (3), instrument (4), tilts (2), and the
rotation (3, about its own axes) of the body that an instrument which is not levelled stands on."""
N_COLUMNS = 22


@frozen(eq=False)
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

    @cached_property
    def sorted(self) -> "_Sorted":
        """What prediction asks of them that does not change with the values."""
        kind = self.kind
        level, angles, directions, zenith = (np.flatnonzero(kind == one) for one in (HEIGHT, ANGLE, DIRECTION, ZENITH))
        sights = np.flatnonzero(kind != HEIGHT)
        second = _sights_of(self, angles, self.second, 2, SECOND) if len(angles) else None
        return _Sorted(
            level, angles, directions, zenith, sights, np.flatnonzero((kind == SLOPE) | (kind == HORIZONTAL)),
            np.where(kind == ANGLE, -1.0, 1.0), _sights_of(self, sights, self.to, 1, TO), second,
        )  # fmt: skip


@frozen(eq=False)
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
    s, factor = r.sorted, r.sorted.factor
    if len(s.distances):
        offset, scale = u.instrument[r.instrument[s.distances], 0], 1.0 + u.instrument[r.instrument[s.distances], 1]
        factor = factor.copy()
        factor[s.distances] = scale
    value, A = _sights(s.first, u, factor[s.sights], sign, curve)
    if len(s.level):
        sights, by = value, A
        value, A = np.empty(len(r.kind)), np.zeros((len(r.kind), N_COLUMNS))
        value[s.sights], A[s.sights] = sights, by
        value[s.level] = _heights(r, u, s.level, A)
    if s.second is not None:
        more, by = _sights(s.second, u, np.ones(len(s.angles)), sign, curve)
        value[s.angles], A[s.angles] = value[s.angles] + more, A[s.angles] + by
    if len(s.directions):
        value[s.directions] -= u.orientation[r.orientation[s.directions]]
        A[s.directions, ORIENTATION] = -1.0
    if len(s.zenith):
        value[s.zenith] += u.instrument[r.instrument[s.zenith], 3]
        A[s.zenith, INSTRUMENT + 3] = 1.0
    if len(s.distances):
        A[s.distances, INSTRUMENT], A[s.distances, INSTRUMENT + 1] = 1.0, value[s.distances] / scale
        value[s.distances] += offset
    return value, A


def wrapped(kind: IntArray, predicted: FloatArray, observed: FloatArray) -> FloatArray:
    """Predicted minus observed (n,); those of horizontal angles to (-pi, pi]."""
    v = predicted - observed
    turns = np.ceil((v - np.pi) / (2.0 * np.pi))
    return np.asarray(np.where(_IS_TURN[kind], v - 2.0 * np.pi * turns, v))


def _centred(of: IntArray, u: Geometry) -> FloatArray:
    return np.where(of[:, None] >= 0, u.centring[of], 0.0)


def _heights(r: Readings, u: Geometry, rows: IntArray, A: FloatArray) -> FloatArray:
    """Height differences of the ``rows``, and their derivatives into A."""
    a, b, h = r.at[rows], r.to[rows], u.horizon
    A[rows, AT : AT + 3], A[rows, TO : TO + 3] = -h.axes[a, 2], h.axes[b, 2]
    A[rows, CENTRING + 2] = -1.0
    A[rows, TILT : TILT + 2] = h.height_by_tilt[b] - h.height_by_tilt[a]
    raised = r.heights[rows, 1] - r.heights[rows, 0] - _centred(r.centring[rows], u)[:, 2]
    return np.asarray(h.height[b] - h.height[a] + raised)


@frozen(eq=False)
class _Sights:
    """Sights (m,) of some readings to one of their ends, whose derivatives begin at ``column``, as they always are.

    at, to: positions. raises, raised_to (m, 1): heights of both ends. turn, slope: which are horizontal angles, slope
    distances. instrument: of the zenith angles. on_body, levelled: those in the axes of bodies, and of the horizon.
    """

    at: IntArray
    to: IntArray
    column: int
    raises: FloatArray
    raised_to: FloatArray
    raised: IntArray
    turn: BoolArray
    slope: BoolArray
    is_zenith: BoolArray
    zenith: IntArray
    instrument: IntArray
    centring: IntArray
    body: IntArray
    on_body: IntArray
    levelled: IntArray


def _sights_of(r: Readings, rows: IntArray, to: IntArray, height: int, column: int) -> _Sights:
    """height: column of the heights of that end."""
    kind, body, raised_to = r.kind[rows], r.body[rows], r.heights[rows, height, None]
    is_zenith, on_body = kind == ZENITH, np.flatnonzero(body >= 0)
    zenith = np.flatnonzero(is_zenith)
    return _Sights(
        r.at[rows], to[rows], column, r.heights[rows, 0, None], raised_to, np.flatnonzero(raised_to), _IS_TURN[kind],
        kind == SLOPE, is_zenith, zenith, r.instrument[rows[zenith]], r.centring[rows], body[on_body], on_body,
        np.flatnonzero(body < 0),
    )  # fmt: skip


@frozen(eq=False)
class _Sorted:
    """Rows of readings by kind, all but height differences as sights, and those of angles to their second targets.

    factor: (n,) by which values of first sights count, but for the scales of distances.
    """

    level: IntArray
    angles: IntArray
    directions: IntArray
    zenith: IntArray
    sights: IntArray
    distances: IntArray
    factor: FloatArray
    first: _Sights
    second: _Sights | None


def _sights(s: _Sights, u: Geometry, factor: FloatArray, sign: float, curve: float) -> tuple[FloatArray, FloatArray]:
    """``factor`` times the values (m,) of these sights, and derivatives A (m, 22)."""
    F = u.horizon.axes[s.at]
    F[s.on_body] = u.body_axes[s.body]
    back, up_b = np.swapaxes(F, 1, 2), u.horizon.axes[s.to, 2]
    offset = s.raises * F[:, 2] + _times(back, _centred(s.centring, u))
    d = u.X[s.to] + s.raised_to * up_b - u.X[s.at] - offset
    q = _times(F, d)
    value, g = _shape(s, sign, q)
    A = np.zeros((len(q), N_COLUMNS))
    if len(s.zenith):
        h = np.hypot(q[s.zenith, 0], q[s.zenith, 1])
        bend = u.instrument[s.instrument, 2] * curve
        value[s.zenith] -= bend * h
        A[s.zenith, INSTRUMENT + 2] -= factor[s.zenith] * curve * h
        g[s.zenith, :2] -= (bend / np.where(h > 0.0, h, np.inf))[:, None] * q[s.zenith, :2]
    g *= factor[:, None]
    w = _times(back, g)
    A[:, AT : AT + 3], A[:, s.column : s.column + 3], A[:, CENTRING : CENTRING + 3] = -w, w, -g
    turn = _cross(w, d + offset)
    if len(s.on_body):
        A[s.on_body, BODY : BODY + 3] = _times(F[s.on_body], turn[s.on_body])
    _add_turn(u.horizon, s.at[s.levelled], turn[s.levelled], s.levelled, AT, A)
    if len(s.raised):
        raised = _cross((s.raised_to * up_b)[s.raised], w[s.raised])
        _add_turn(u.horizon, s.to[s.raised], raised, s.raised, s.column, A)
    return factor * value, A


def _add_turn(h: Horizon, at: IntArray, turn: FloatArray, rows: IntArray, column: int, A: FloatArray) -> None:
    """What the axes at positions ``at`` add to A by turning with the position and the tilts."""
    if not len(rows):
        return
    A[rows, column : column + 3] += _times(np.swapaxes(h.by_x[at], 1, 2), turn)
    A[rows, TILT : TILT + 2] += _times(np.swapaxes(h.by_tilt[at], 1, 2), turn)


def _shape(s: _Sights, sign: float, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Geometric values (n,) of q (n, 3) in the instrument's axes, and their gradients (n, 3); nan where is none."""
    x, y, z = q.T
    h2 = x * x + y * y
    h, s2 = np.sqrt(h2), h2 + z * z
    length, zero = np.sqrt(s2), np.zeros(len(q))

    def of_kind(a: FloatArray, b: FloatArray, c: FloatArray, d: FloatArray) -> FloatArray:
        return np.where(s.turn, a, np.where(s.is_zenith, b, np.where(s.slope, c, d)))

    with np.errstate(divide="ignore", invalid="ignore"):
        value = of_kind(sign * np.arctan2(y, x), np.arctan2(h, z), length, h)
        by_turn, by_zenith = (-sign * y / h2, sign * x / h2, zero), (x * z / (h * s2), y * z / (h * s2), -h / s2)
        by_slope, by_horizontal = (x / length, y / length, z / length), (x / h, y / h, zero)
    g = np.stack([of_kind(*parts) for parts in zip(by_turn, by_zenith, by_slope, by_horizontal, strict=True)], axis=1)
    none = np.where(s.slope, length, h) == 0.0
    value[none], g[none] = np.nan, 0.0
    return value, g


def _cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Of vectors (n, 3), without what np.cross asks first."""
    (a1, a2, a3), (b1, b2, b3) = a.T, b.T
    return np.stack([a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1], axis=1)


def _times(A: FloatArray, x: FloatArray) -> FloatArray:
    """A x of matrices (n, i, j) and vectors (n, j)."""
    return np.asarray(np.einsum("nij,nj->ni", A, x))
