"""Compiled residuals of image points, and what the adjustment takes of their noise: A Q A', block after block."""

import numpy as np

from adjust.compiling import njit
from adjust.image_kernels import (
    CHUNK,
    BlockArrays,
    LensArrays,
    PointArrays,
    SegmentArrays,
    local_by_keys,
    local_columns,
    scratch,
)
from adjust.lens_columns import add_multiple, add_product, add_products
from adjust.model import FloatArray, IntArray
from adjust.tree_kernels import TreeArrays, fill_block


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _add_four(
    a: float, b: float, c: float, d: float, x: FloatArray, y: FloatArray, z: FloatArray, w: FloatArray, o: FloatArray
) -> None:  # fmt: skip
    for p in range(o.size):
        o[p] += a * x[p] + b * y[p] + c * z[p] + d * w[p]


@njit(cache=True, nogil=True, error_model="numpy")
def quadratic_forms(A: FloatArray, n: int, m: int, Q: FloatArray, T: FloatArray, M: FloatArray) -> None:
    """M (3, m): u' Q u, u' Q v and v' Q v for the columns A of m points, u first and v after it, and a symmetric Q.

    Half of Q is enough: with T = (lower triangle, half its diagonal) a, a' Q a = 2 a' T. T (2 m,) is scratch.
    """
    M[:] = 0.0
    for i in range(n):
        T[:] = 0.0
        j = 0
        while j + 3 < i:
            _add_four(Q[i, j], Q[i, j + 1], Q[i, j + 2], Q[i, j + 3], A[j, : 2 * m], A[j + 1, : 2 * m],
                      A[j + 2, : 2 * m], A[j + 3, : 2 * m], T)  # fmt: skip
            j += 4
        while j < i:
            add_multiple(Q[i, j], A[j, : 2 * m], T)
            j += 1
        add_multiple(0.5 * Q[i, i], A[i, : 2 * m], T)
        u, v = A[i, :m], A[i, m : 2 * m]
        add_product(2.0, u, T[:m], M[0])
        add_products(1.0, u, T[m:], v, T[:m], M[1])
        add_product(2.0, v, T[m:], M[2])


@njit(cache=True, nogil=True, error_model="numpy")
def statistics(
    b: int, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray, t: FloatArray,
    warp: FloatArray, Q: FloatArray, S: FloatArray, row: FloatArray, A: FloatArray, T: FloatArray,
    residual: FloatArray, influence: FloatArray,
) -> None:  # fmt: skip
    """Residuals (N, 2) px of block b and the whitened covariance A Q A' (N, 3: 00, 01, 11) of its adjusted points.

    Q: joint covariance of the block's local unknowns. W: that of all points, used or not. The rest: scratch.
    """
    n = lenses.n_free[blocks.camera[b]] + 6 + blocks.n_warp[b]
    M = np.empty((3, CHUNK))
    for lo in range(blocks.ptr[b], blocks.ptr[b + 1], CHUNK):
        hi = min(lo + CHUNK, blocks.ptr[b + 1])
        m = hi - lo
        local_columns(b, lo, hi, blocks, points, W, lenses, R, t, warp, S, row, A)
        quadratic_forms(A, n, m, Q, T[: 2 * m], M[:, :m])
        for i in range(m):
            p = lo + i
            v = A[n, m + i] / W[2, p]
            residual[p, 1] = v
            residual[p, 0] = (A[n, i] - W[1, p] * v) / W[0, p]
            influence[p, 0], influence[p, 1], influence[p, 2] = M[0, i], M[1, i], M[2, i]


@njit(cache=True, nogil=True, error_model="numpy")
def all_statistics(
    which: IntArray, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray,
    t: FloatArray, warp: FloatArray, segments: SegmentArrays, C: FloatArray, D: FloatArray, width: IntArray,
    key_ptr: IntArray, key: IntArray, key_place: IntArray, tree: TreeArrays, residual: FloatArray,
    influence: FloatArray, lost: IntArray,
) -> None:  # fmt: skip
    """:func:`statistics` of the listed blocks from the covariances of a tree.

    Block b has the keys ``key[key_ptr[b]:key_ptr[b + 1]]``, numbered as the tree does, whose columns begin at
    ``key_place``; -1 is known exactly. lost[b] becomes 1 where two of them share no clique.
    """
    S, row, A = scratch()
    T = np.empty(2 * CHUNK)
    for i in range(which.size):
        b = which[i]
        nl = lenses.n_free[blocks.camera[b]]
        n, w = nl + 6 + blocks.n_warp[b], width[b]
        joint = np.zeros((w, w))
        for x in range(key_ptr[b], key_ptr[b + 1]):
            for y in range(key_ptr[b], x + 1):
                if key[x] < 0 or key[y] < 0:
                    continue
                out = np.empty((tree.dims[key[x]], tree.dims[key[y]]))
                if not fill_block(key[x], key[y], tree.home, tree.key_ptr, tree.keys, tree.dims, tree.front,
                                  tree.width, tree.at, tree.cov, out):  # fmt: skip
                    lost[b] = 1
                for c in range(out.shape[0]):
                    for d in range(out.shape[1]):
                        joint[key_place[x] + c, key_place[y] + d] = out[c, d]
                        joint[key_place[y] + d, key_place[x] + c] = out[c, d]
        G = np.empty((n, w))
        local_by_keys(b, nl, segments, C, D, G)
        statistics(b, blocks, points, W, lenses, R, t, warp, _congruent(G, joint), S, row, A, T, residual, influence)


@njit(cache=True, nogil=True, error_model="numpy")
def _congruent(G: FloatArray, Q: FloatArray) -> FloatArray:
    """G Q G', for a G with many zeros."""
    n, w = G.shape
    K, out = np.zeros((n, w)), np.zeros((n, n))
    for i in range(n):
        for a in range(w):
            g = G[i, a]
            if g != 0.0:
                for c in range(w):
                    K[i, c] += g * Q[a, c]
    for j in range(n):
        for a in range(w):
            g = G[j, a]
            if g != 0.0:
                for i in range(n):
                    out[i, j] += g * K[i, a]
    return out
