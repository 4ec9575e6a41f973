"""Compiled reduction of poses that only image points of known targets touch; see :mod:`adjust.image_reduction`.

A pose's columns are its own six, then those of the keys its blocks share with others, then the residual.
"""

from typing import NamedTuple

import numpy as np

from adjust.compiling import njit
from adjust.image_kernels import (
    MAX_LOCAL,
    SEGMENT_LENS,
    SEGMENT_WARP,
    BlockArrays,
    LensArrays,
    SegmentArrays,
    pose_by_key,
)
from adjust.model import FloatArray, IntArray

WEAKEST_PIVOT = 2.0**-24
"""Share of a diagonal that must be left when the columns before it are eliminated: as GTSAM's Cholesky asks."""


class ReductionArrays(NamedTuple):
    """Poses j: blocks ``block[block_ptr[j]:block_ptr[j + 1]]``; their columns of the interface, ascending, in col.

    T of pose j begins at ``6 (col_ptr[j] + j)``: one column more, of the residual. place (segments): first column of a
    segment among those of its pose.
    """

    block_ptr: IntArray
    block: IntArray
    col_ptr: IntArray
    col: IntArray
    place: IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def _by_own_columns(
    b: int, w: int, segments: SegmentArrays, place: IntArray, C: FloatArray, D: FloatArray,
    to: IntArray, G: FloatArray, E: FloatArray,
) -> None:  # fmt: skip
    """For the ``w`` columns of a block's keys: where they stand among those of its pose, and the pose's derivative G.

    ``to`` (w + 1): also of the residual, the last one. G (6, w): zero for columns that are the block's own ones.
    """
    G[:, :w] = 0.0
    for s in range(segments.ptr[b], segments.ptr[b + 1]):
        o = segments.place[s]
        for j in range(segments.n[s]):
            to[o + j] = place[s] + j
        if segments.kind[s] != SEGMENT_LENS and segments.kind[s] != SEGMENT_WARP:
            pose_by_key(s, segments, C, D, E)
            for i in range(6):
                for j in range(segments.n[s]):
                    G[i, o + j] += E[i, j]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _add_block(
    b: int, n: int, nl: int, w: int, segments: SegmentArrays, H: FloatArray, to: IntArray, G: FloatArray,
    K: FloatArray, N: FloatArray, M: FloatArray,
) -> None:  # fmt: skip
    """Add a block's normal matrix H (n, n) by its ``w`` columns, and its residual, to the upper triangle of M.

    K, N: scratch (MAX_LOCAL, w + 1) and (w + 1, w + 1): H times the derivative, and that from both sides.
    """
    for i in range(n):
        K[i, :w] = 0.0
        K[i, w] = H[i, n - 1]
        for a in range(6):
            h = H[i, nl + a]
            for j in range(w):
                K[i, j] += h * G[a, j]
    N[: w + 1, : w + 1] = 0.0
    for s in range(segments.ptr[b], segments.ptr[b + 1]):
        lens = segments.kind[s] == SEGMENT_LENS
        if lens or segments.kind[s] == SEGMENT_WARP:
            at, o = 0 if lens else nl + 6 + segments.start[s], segments.place[s]
            for j in range(segments.n[s]):
                for i in range(n):
                    K[i, o + j] += H[i, at + j]
    for s in range(segments.ptr[b], segments.ptr[b + 1]):
        lens = segments.kind[s] == SEGMENT_LENS
        if lens or segments.kind[s] == SEGMENT_WARP:
            at, o = 0 if lens else nl + 6 + segments.start[s], segments.place[s]
            for i in range(segments.n[s]):
                for j in range(w + 1):
                    N[o + i, j] += K[at + i, j]
    for i in range(w):
        for a in range(6):
            g = G[a, i]
            if g != 0.0:
                for j in range(w + 1):
                    N[i, j] += g * K[nl + a, j]
    N[w, w] = H[n - 1, n - 1]
    for i in range(w + 1):
        for j in range(i, w + 1):
            x, y = to[i], to[j]
            if x <= y:
                M[x, y] += N[i, j]
            else:
                M[y, x] += N[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def _eliminate_pose(M: FloatArray, m: int) -> bool:
    """First six rows of M (m, m) to [L' T] with L L' their own block; the rest loses T' T; upper triangles.

    False where the block has no inverse to speak of.
    """
    for i in range(6):
        given, p = M[i, i], M[i, i]
        for k in range(i):
            p -= M[k, i] * M[k, i]
        if not p > WEAKEST_PIVOT * given:
            return False
        root = np.sqrt(p)
        M[i, i] = root
        for k in range(i):
            a = M[k, i]
            for j in range(i + 1, m):
                M[i, j] -= a * M[k, j]
        for j in range(i + 1, m):
            M[i, j] /= root
    for i in range(6, m):
        for k in range(6):
            a = M[k, i]
            if a != 0.0:
                for j in range(i, m):
                    M[i, j] -= a * M[k, j]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def reduce_poses(
    run: IntArray, a: ReductionArrays, blocks: BlockArrays, lenses: LensArrays, segments: SegmentArrays,
    width: IntArray, C: FloatArray, D: FloatArray, damping: float, H: FloatArray, L: FloatArray, T: FloatArray,
    diagonal: FloatArray, rest: FloatArray, bad: IntArray,
) -> None:  # fmt: skip
    """Reduce the poses in run[1:]: L (J, 6, 6) upper and T stay for what follows; the sums are those of turn = run[0].

    rest (runs, n + 1, n + 1): upper triangle of the normal matrix of the interface and the residual, diagonal that
    before anything was reduced. damping: share of its own diagonal that is added to a pose's. bad[turn]: a pose without
    an inverse, else left alone.
    """
    most, turn = 0, run[0]
    for j in run[1:]:
        most = max(most, a.col_ptr[j + 1] - a.col_ptr[j])
    M, E, to = np.empty((most + 7, most + 7)), np.empty((6, 6)), np.empty(most + 7, dtype=np.int64)
    G, K, N = np.empty((6, most + 7)), np.empty((MAX_LOCAL, most + 7)), np.empty((most + 7, most + 7))
    end = rest.shape[1] - 1
    for j in run[1:]:
        k = a.col_ptr[j + 1] - a.col_ptr[j]
        m = k + 7
        M[:m, :m] = 0.0
        for i in range(a.block_ptr[j], a.block_ptr[j + 1]):
            b = a.block[i]
            nl = lenses.n_free[blocks.camera[b]]
            n, w = nl + 7 + blocks.n_warp[b], width[b]
            to[w] = m - 1
            _by_own_columns(b, w, segments, a.place, C, D, to, G, E)
            _add_block(b, n, nl, w, segments, H[b], to, G, K, N, M)
        for i in range(6):
            M[i, i] *= 1.0 + damping
        columns = a.col[a.col_ptr[j] : a.col_ptr[j + 1]]
        for i in range(k):
            diagonal[turn, columns[i]] += M[6 + i, 6 + i]
        if not _eliminate_pose(M, m):
            bad[turn] = j
            return
        at = 6 * (a.col_ptr[j] + j)
        for i in range(6):
            for c in range(6):
                L[j, i, c] = M[i, c] if c >= i else 0.0
            for c in range(k + 1):
                T[at + i * (k + 1) + c] = M[i, 6 + c]
        for i in range(k):
            for c in range(i, k):
                rest[turn, columns[i], columns[c]] += M[6 + i, 6 + c]
            rest[turn, columns[i], end] += M[6 + i, m - 1]
        rest[turn, end, end] += M[m - 1, m - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def pose_steps(a: ReductionArrays, L: FloatArray, T: FloatArray, d: FloatArray, out: FloatArray) -> float:
    """Steps (J, 6) of the reduced poses from that of the interface (n,); by how much they alone lower chi-square."""
    decrease = 0.0
    for j in range(out.shape[0]):
        k = a.col_ptr[j + 1] - a.col_ptr[j]
        at = 6 * (a.col_ptr[j] + j)
        for i in range(6):
            v = T[at + i * (k + 1) + k]
            decrease += v * v
            for c in range(k):
                v += T[at + i * (k + 1) + c] * d[a.col[a.col_ptr[j] + c]]
            out[j, i] = -v
        for i in range(5, -1, -1):
            for c in range(i + 1, 6):
                out[j, i] -= L[j, i, c] * out[j, c]
            out[j, i] /= L[j, i, i]
    return decrease


@njit(cache=True, nogil=True, error_model="numpy")
def leaf_rows(a: ReductionArrays, L: FloatArray, T: FloatArray, out: FloatArray) -> None:
    """Rows [L' T] of all poses, without the residual, one after the other."""
    o = 0
    for j in range(L.shape[0]):
        k = a.col_ptr[j + 1] - a.col_ptr[j]
        at = 6 * (a.col_ptr[j] + j)
        for i in range(6):
            for c in range(6):
                out[o + c] = L[j, i, c]
            for c in range(k):
                out[o + 6 + c] = T[at + i * (k + 1) + c]
            o += 6 + k
