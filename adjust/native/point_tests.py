"""Tests and reliability of all image points in the core, in threads: every point by itself (``point_tests.h``).

And of what may have changed from one epoch on (``changes.h``), and what errs alike (``parallels.h``).
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.blocks import run_ranges, run_split, split_blocks
from adjust.native.library import Function

_ADJUSTED = "v[N,2] M[N,3] W[N,3] used[N]"
_POINTS = f"first last {_ADJUSTED}"
_residual_tests = Function("residual_tests", f"{_POINTS} redundancy[N,2] standardized[N,2] test[N]")
_sums_of_blocks = Function("sums_of_blocks", f"which[*] ptr[B+1] {_ADJUSTED} sums[B,3]")
_farthest_points = Function("farthest_points", "which[*] ptr[B+1] uv[N,2] centre[B,2] farthest[B]")
_controlled_directions = Function("controlled_directions", f"{_POINTS} freedom[N]")
_external_reliability = Function("external_reliability", f"{_POINTS} lambda0[2] external[N]")
_point_tests = Function(
    "point_tests",
    f"{_POINTS} lambda0[2] redundancy[N] least[N] statistic[N] detectable[N] external[N] w[N,2] error[N,2] "
    "detectable_component[N,2] bias[N,2]",
)
_change_squares = Function(
    "change_squares",
    "first[J+1] rows[k] at[k] table[*] A_ptr[m+1] A_column[a] A_entry[a] e[m] own_ptr[n+1] own_column[o] own_entry[o] "
    "U[n,c] x[n,w] s[n,w] mark[n] touched[n] left[q,w] shared[c,w] columns[2,w] squares[J,q] M[J,q,q] g[J,q]",
)
_parallel_pairs = Function("parallel_pairs", "first last end u[N,d] head[h,N+31] rest[N+31] least found[m,3]")
_HEAD, _BEHIND = 16, 31
"""Components by which vectors are compared first; numbers behind the last of them, for whole vectors."""


class AdjustedPoints(NamedTuple):
    """Image points (N): residuals v (N, 2) px, predicted minus observed, and what their tests take besides.

    M: whitened A Q A' (N, 3: 00, 01, 11). W: upper triangular square root information (N, 3), 1 / px. used: (N,).
    """

    v: FloatArray
    M: FloatArray
    W: FloatArray
    used: BoolArray

    def at(self, rows: IntArray) -> "AdjustedPoints":
        """Some of them."""
        return AdjustedPoints(self.v[rows], self.M[rows], self.W[rows], self.used[rows])


def residual_tests(points: AdjustedPoints) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Redundancy numbers (N, 2), standardized residuals (N, 2) and v' inv(Q_vv) v (N,), as ``ImageResiduals`` has them.

    Baarda (1968), Foerstner (1979); nan where nothing controls the point.
    """
    n = len(points.v)
    out = np.empty((n, 2)), np.empty((n, 2)), np.empty(n)
    run_ranges(_residual_tests, n, *points, *out)
    return out


def sums_of_blocks(ptr: IntArray, points: AdjustedPoints) -> FloatArray:
    """Of blocks of points, by ptr (B + 1,): components in use, their redundancy, their weighted square sum (B, 3)."""
    out = np.empty((len(ptr) - 1, 3))
    run_split(_sums_of_blocks, split_blocks(ptr), ptr, *points, out)
    return out


def farthest_points(ptr: IntArray, uv: FloatArray, centre: FloatArray) -> FloatArray:
    """Of blocks of points, by ptr (B + 1,): largest distance (B,) of its uv (N, 2) from its centre (B, 2)."""
    out = np.empty(len(ptr) - 1)
    run_split(_farthest_points, split_blocks(ptr), ptr, uv, centre, out)
    return out


def controlled_directions(points: AdjustedPoints, freedom: IntArray) -> None:
    """Into ``freedom`` (N,) in how many directions an error of each point shows in its residuals."""
    run_ranges(_controlled_directions, len(points.v), *points, freedom)


def external_reliability(points: AdjustedPoints, lambda0: FloatArray, external: FloatArray) -> None:
    """Into ``external`` (N,) how far the least detectable bias of each point moves the unknowns, as ``point_tests``."""
    run_ranges(_external_reliability, len(points.v), *points, lambda0, external)


def point_tests(points: AdjustedPoints, lambda0: FloatArray, out: tuple[FloatArray, ...]) -> None:
    """Into ``out`` redundancy, least, statistic, detectable, external (N,), then w, error, detectable_component, bias.

    The latter (N, 2); all as ``TestColumns`` has them. lambda0: (2,) of tests with one and two components.
    """
    run_ranges(_point_tests, len(points.v), *points, lambda0, *out)


class SparseRows(NamedTuple):
    """A sparse matrix: the columns and entries of row i are those from ``ptr[i]`` to ``ptr[i + 1]``."""

    ptr: IntArray
    column: IntArray
    entry: FloatArray


class ColumnsOfRows(NamedTuple):
    """Columns (k, q) of some rows (k,) of a system: those of the i-th are ``table[at[i] : at[i] + q]``."""

    rows: IntArray
    at: IntArray
    table: FloatArray


def change_squares(
    first: IntArray, B: ColumnsOfRows, q: int, A: SparseRows, e: FloatArray, own: SparseRows, U: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of q columns B of rows of a system, run j from ``first[j]`` on: the sums over all runs from j on.

    The diagonal (J, q) of B'B, ``B' (I - A Q A') B`` (J, q, q) and B'e (J, q), with Q = own + U U', U (n, c).
    """
    (n, c), J, w = U.shape, len(first) - 1, -(-q // 8) * 8
    later = np.zeros((n, w)), np.zeros((n, w)), np.full(n, -1), np.empty(n, dtype=np.int64)
    sums = np.zeros((q, w)), np.zeros((c, w)), np.zeros((2, w))
    out = np.empty((J, q)), np.empty((J, q, q)), np.empty((J, q))
    _change_squares(first, *B, *A, e, *own, U, *later, *sums, *out)
    return out


class UnitVectors:
    """Unit vectors (n, d) of single numbers, in axes along which most of them are long."""

    def __init__(self, u: FloatArray) -> None:
        self.u = u.astype(np.float32)
        axes = np.linalg.eigh(u.T @ u)[1][:, : -_HEAD - 1 : -1]
        head = u @ axes
        rest = np.sqrt(np.maximum(1.0 - np.einsum("nh,nh->n", head, head), 0.0))
        self._head, self._rest = (np.concatenate([x, np.zeros((_BEHIND, *x.shape[1:]))]).T.astype(np.float32, order="C")
                                  for x in (head, rest))  # fmt: skip

    def parallel(self, first: int, last: int, end: int, least: float) -> FloatArray:
        """Rows (k, 3): i < end, j < i from first to last, and the size of their product, where that is not less."""
        found = np.empty((4 * (last - first), 3))
        while True:
            n = _parallel_pairs(first, last, end, self.u, self._head, self._rest, least, found)
            if n <= len(found):
                return found[:n]
            found = np.empty((n, 3))
