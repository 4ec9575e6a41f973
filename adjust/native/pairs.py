"""Measured pairs of poses: residuals and derivatives; see :mod:`adjust.observations.pairs` and ``pairs.h``."""

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.native.library import Function

_PAIRS = "a[E] b[E] R[S,3,3] t[S,3] measured[E,3,3] shift[E,3]"
_pair_jacobians = Function("pair_jacobians", f"{_PAIRS} residual[E,6] by_b[E,6,6] by_a[E,6,6] turn[E,6,6]")
_pair_rows = Function("pair_rows", f"{_PAIRS} W[E,6,6] white[E,6] by_b[E,6,6] by_a[E,6,6]")
_compose_poses = Function("compose_poses", "order[N] parent[N] R[N,3,3] t[N,3]")
_right_jacobians = Function("right_jacobians", "d[n,k] back J[n,k,k]")
_pair_spread = Function(
    "pair_spread",
    "ends[E,12,12] turn[E,6,6] by_a[E,6,6] W[E,6,6] own[E,6,6] moved[E,6,6] white[E,6,6] apart[E,6]",
)
_sure_forms = Function("sure_forms", "Q[E,6,6] v[E,6] least form[E]")


def pair_jacobians(
    a: IntArray, b: IntArray, R: FloatArray, t: FloatArray, measured: FloatArray, shift: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Residuals (E, 6), derivatives (E, 6, 6) by b and by a, and Ad(b_from_a^-1) (E, 6, 6).

    a, b: (E,) positions of the ends among the poses R (S, 3, 3), t (S, 3) m. measured (E, 3, 3), shift (E, 3) m:
    ``b_from_a``.
    """
    residual, (by_b, by_a, turn) = np.empty((len(a), 6)), np.empty((3, len(a), 6, 6))
    _pair_jacobians(*map(np.ascontiguousarray, (a, b, R, t, measured, shift)), residual, by_b, by_a, turn)
    return residual, by_b, by_a, turn


def pair_rows(
    a: IntArray, b: IntArray, R: FloatArray, t: FloatArray, measured: FloatArray, shift: FloatArray,
    whitening: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """The same whitened by upper triangular matrices (E, 6, 6): residuals (E, 6), derivatives by b and by a."""
    white, (by_b, by_a) = np.empty((len(a), 6)), np.empty((2, len(a), 6, 6))
    _pair_rows(*map(np.ascontiguousarray, (a, b, R, t, measured, shift, whitening)), white, by_b, by_a)
    return white, by_b, by_a


def compose_poses(order: IntArray, parent: IntArray, R: FloatArray, t: FloatArray) -> None:
    """Poses R (N, 3, 3), t (N, 3) m, given in those of their ``parent`` (N,), in place in the world, where -1 stands.

    order: (N,) parents first.
    """
    _compose_poses(order, parent, R, t)


def right_jacobians(d: FloatArray, back: bool) -> FloatArray:
    """Right Jacobians (..., k, k) of rotations (k = 3) or motions (6) at tangents (..., k); back: their inverses."""
    tangents = np.ascontiguousarray(d, dtype=np.float64)
    out = np.empty((*d.shape, d.shape[-1]))
    _right_jacobians(tangents.reshape(-1, d.shape[-1]), back, out.reshape(-1, *out.shape[-2:]))
    return out


def pair_spread(
    ends: FloatArray, turn: FloatArray, by_a: FloatArray, whitening: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Covariances (E, 6, 6) of adjusted ``b_from_a``, of their residuals by these, and the latter whitened.

    And the variances (E, 6) of whitened residuals as if both ends were apart. ends: (E, 12, 12) covariance of both, b
    before a. turn, by_a: of :func:`pair_jacobians`. whitening: upper triangular.
    """
    (own, moved, white), apart = np.empty((3, len(ends), 6, 6)), np.empty((len(ends), 6))
    _pair_spread(*map(np.ascontiguousarray, (ends, turn, by_a, whitening)), own, moved, white, apart)
    return own, moved, white, apart


def sure_forms(Q: FloatArray, v: FloatArray, least: float) -> FloatArray:
    """The forms v' Q^-1 v (E,) of symmetric Q (E, 6, 6) without eigenvalues below ``least``; -1 where there may be."""
    form = np.empty(len(v))
    _sure_forms(*map(np.ascontiguousarray, (Q, v)), least, form)
    return form
