"""Compiled evaluation of image points: residuals, condensed normal equations and redundancy, block after block.

A block is what one camera saw of one target at one epoch. Its local unknowns are the free lens parameters of the
camera, the six of ``camera_from_target`` (tangent on the right) and, where the target has them, two of its warp.
"""

from typing import NamedTuple

import numpy as np

from adjust.compiling import njit
from adjust.lens_columns import (
    BY_POINT_U,
    BY_POINT_V,
    N_SCRATCH,
    RESIDUAL_U,
    RESIDUAL_V,
    brown,
    brown_parameter,
    combine,
    cross,
    product,
    products,
)
from adjust.lens_kernels import BROWN, MAX_LENS, lens_residual, lens_row
from adjust.model import FloatArray, IntArray

SEGMENT_LENS, SEGMENT_POSE, SEGMENT_TABLE, SEGMENT_WARP = 0, 1, 2, 3


class LensArrays(NamedTuple):
    """Lenses of all cameras: values (C, MAX_LENS), constants (C, 4), and how they follow from the free parameters.

    Parameter ``source[c, i]`` of camera c is ``factor[c, i]`` times its free one ``column[c, i]``, i < n_map[c].
    """

    kind: IntArray
    values: FloatArray
    constants: FloatArray
    n_free: IntArray
    n_map: IntArray
    source: IntArray
    column: IntArray
    factor: FloatArray


class BlockArrays(NamedTuple):
    """Blocks: rows ptr[b]..ptr[b + 1] of the points, camera, which warp applies (-1: none), free warp components."""

    ptr: IntArray
    camera: IntArray
    warp_id: IntArray
    n_warp: IntArray


class PointArrays(NamedTuple):
    """Image points by columns: X (3, N) m in the target, warp functions shape (2, N), observed uv (2, N) px."""

    X: FloatArray
    shape: FloatArray
    uv: FloatArray


class SegmentArrays(NamedTuple):
    """How a block's condensed columns reach its keys: kind, link of the chain, table slot, start, width.

    place: first column among those of all the block's keys. ptr: segments of every block.
    """

    ptr: IntArray
    kind: IntArray
    link: IntArray
    table: IntArray
    start: IntArray
    n: IntArray
    place: IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def local_row(
    kind: int, lens: FloatArray, constants: FloatArray, R: FloatArray, t: FloatArray,
    x0: float, x1: float, x2: float, u: float, v: float, w00: float, w01: float, w11: float,
    n_map: int, source: IntArray, column: IntArray, factor: FloatArray, n_lens: int, s0: float, s1: float, n_warp: int,
    row: FloatArray, out: FloatArray,
) -> float:  # fmt: skip
    """One image point: whitened rows ``out`` (2, n_lens + 6 + n_warp + 1), residual last; returns the depth.

    w: upper triangular square root of the information. source, column, factor: the ``n_map`` lens parameters that
    depend on the free ones, and how. s0, s1: the warp functions at the point.
    """
    q0 = R[0, 0] * x0 + R[0, 1] * x1 + R[0, 2] * x2 + t[0]
    q1 = R[1, 0] * x0 + R[1, 1] * x1 + R[1, 2] * x2 + t[1]
    q2 = R[2, 0] * x0 + R[2, 1] * x1 + R[2, 2] * x2 + t[2]
    ru, rv = lens_row(kind, lens, constants, q0, q1, q2, u, v, row)
    m = n_lens + 6 + n_warp
    for j in range(n_lens):
        out[0, j] = 0.0
        out[1, j] = 0.0
    for i in range(n_map):
        j, k, f = column[i], source[i], factor[i]
        out[0, j] += f * (w00 * row[0, k] + w01 * row[1, k])
        out[1, j] += f * w11 * row[1, k]
    for s in range(2):
        if s == 0:
            g0 = w00 * row[0, MAX_LENS] + w01 * row[1, MAX_LENS]
            g1 = w00 * row[0, MAX_LENS + 1] + w01 * row[1, MAX_LENS + 1]
            g2 = w00 * row[0, MAX_LENS + 2] + w01 * row[1, MAX_LENS + 2]
        else:
            g0, g1, g2 = w11 * row[1, MAX_LENS], w11 * row[1, MAX_LENS + 1], w11 * row[1, MAX_LENS + 2]
        h0 = g0 * R[0, 0] + g1 * R[1, 0] + g2 * R[2, 0]
        h1 = g0 * R[0, 1] + g1 * R[1, 1] + g2 * R[2, 1]
        h2 = g0 * R[0, 2] + g1 * R[1, 2] + g2 * R[2, 2]
        out[s, n_lens] = x1 * h2 - x2 * h1
        out[s, n_lens + 1] = x2 * h0 - x0 * h2
        out[s, n_lens + 2] = x0 * h1 - x1 * h0
        out[s, n_lens + 3] = h0
        out[s, n_lens + 4] = h1
        out[s, n_lens + 5] = h2
        if n_warp > 0:
            out[s, n_lens + 6] = h2 * s0
            out[s, n_lens + 7] = h2 * s1
    out[0, m] = w00 * ru + w01 * rv
    out[1, m] = w11 * rv
    depth: float = q2
    return depth


CHUNK = 128
"""Image points evaluated together: their rows stay in the first two caches."""
MAX_LOCAL = 24
"""Local unknowns and residual of a block, at most, rounded up to what :func:`add_gram` takes at a time."""


@njit(cache=True, nogil=True, error_model="numpy")
def scratch() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Working arrays of :func:`local_columns`: intermediate columns, a point's own row, the rows by columns."""
    return np.empty((N_SCRATCH + 9, CHUNK)), np.zeros((2, MAX_LENS + 3)), np.zeros((MAX_LOCAL, 2 * CHUNK))


@njit(cache=True, nogil=True, error_model="numpy")
def _other_lens(
    kind: int, lens: FloatArray, constants: FloatArray, q0: FloatArray, q1: FloatArray, q2: FloatArray, u: FloatArray,
    v: FloatArray, w00: FloatArray, w01: FloatArray, w11: FloatArray, n_map: int, source: IntArray, column: IntArray,
    factor: FloatArray, row: FloatArray, S: FloatArray, A: FloatArray,
) -> None:  # fmt: skip
    """What :func:`brown` and :func:`brown_parameter` give, for any lens, point by point."""
    n = q0.size
    for p in range(n):
        S[RESIDUAL_U, p], S[RESIDUAL_V, p] = lens_row(kind, lens, constants, q0[p], q1[p], q2[p], u[p], v[p], row)
        for i in range(3):
            S[BY_POINT_U + i, p], S[BY_POINT_V + i, p] = row[0, MAX_LENS + i], row[1, MAX_LENS + i]
        for i in range(n_map):
            j, k, f = column[i], source[i], factor[i]
            A[j, p] += f * (w00[p] * row[0, k] + w01[p] * row[1, k])
            A[j, n + p] += f * w11[p] * row[1, k]


@njit(cache=True, nogil=True, error_model="numpy")
def local_columns(
    b: int, lo: int, hi: int, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays,
    R: FloatArray, t: FloatArray, warp: FloatArray, S: FloatArray, row: FloatArray, A: FloatArray,
) -> float:  # fmt: skip
    """Whitened rows of the points lo..hi of block b, as columns A[j]: first all of u, then all of v; the least depth.

    Columns as in :func:`local_row`: n_lens + 6 + n_warp unknowns, then the residual. W: square root information (3, N);
    a point of weight zero gives rows of zeros and no depth. S, row, A: of :func:`scratch`; at most CHUNK points.
    """
    c, wb, n = blocks.camera[b], blocks.warp_id[b], hi - lo
    kind, lens, n_lens, n_warp = lenses.kind[c], lenses.values[c], lenses.n_free[c], blocks.n_warp[b]
    x0, x1, x2 = points.X[0, lo:hi], points.X[1, lo:hi], points.X[2, lo:hi]
    w00, w01, w11 = W[0, lo:hi], W[1, lo:hi], W[2, lo:hi]
    q0, q1, q2 = S[N_SCRATCH, :n], S[N_SCRATCH + 1, :n], S[N_SCRATCH + 2, :n]
    if wb >= 0:
        bent = S[N_SCRATCH + 3, :n]
        combine(1.0, warp[wb, 0], warp[wb, 1], 0.0, x2, points.shape[0, lo:hi], points.shape[1, lo:hi], bent)
        x2 = bent
    combine(R[b, 0, 0], R[b, 0, 1], R[b, 0, 2], t[b, 0], x0, x1, x2, q0)
    combine(R[b, 1, 0], R[b, 1, 1], R[b, 1, 2], t[b, 1], x0, x1, x2, q1)
    combine(R[b, 2, 0], R[b, 2, 1], R[b, 2, 2], t[b, 2], x0, x1, x2, q2)
    A[:n_lens, : 2 * n] = 0.0
    u, v = points.uv[0, lo:hi], points.uv[1, lo:hi]
    n_map, source, column, factor = lenses.n_map[c], lenses.source[c], lenses.column[c], lenses.factor[c]
    if kind == BROWN:
        brown(lens, q0, q1, q2, u, v, S)
        for i in range(n_map):
            j = column[i]
            brown_parameter(source[i], factor[i], lens, w00, w01, w11, S, A[j, :n], A[j, n : 2 * n])
    else:
        _other_lens(kind, lens, lenses.constants[c], q0, q1, q2, u, v, w00, w01, w11, n_map, source, column, factor,
                    row, S, A)  # fmt: skip
    _pose_columns(n, n_lens, n_warp, R[b], x0, x1, x2, points.shape[:, lo:hi], w00, w01, w11, S, A)
    depth = np.inf
    for p in range(n):
        if w00[p] != 0.0:
            depth = min(depth, q2[p])
    return depth


@njit(cache=True, nogil=True, error_model="numpy")
def _pose_columns(
    n: int, at: int, n_warp: int, R: FloatArray, x0: FloatArray, x1: FloatArray, x2: FloatArray, shape: FloatArray,
    w00: FloatArray, w01: FloatArray, w11: FloatArray, S: FloatArray, A: FloatArray,
) -> None:  # fmt: skip
    """Columns of the pose (from ``at``), of the warp and of the residual; derivatives by the point stand in S."""
    last = at + 6 + n_warp
    products(w00, S[RESIDUAL_U, :n], w01, S[RESIDUAL_V, :n], A[last, :n])
    product(w11, S[RESIDUAL_V, :n], A[last, n : 2 * n])
    g0, g1, g2 = S[N_SCRATCH + 6, :n], S[N_SCRATCH + 7, :n], S[N_SCRATCH + 8, :n]
    for s in range(2):
        lo, hi = s * n, s * n + n
        for i, g in enumerate((g0, g1, g2)):
            if s == 0:
                products(w00, S[BY_POINT_U + i, :n], w01, S[BY_POINT_V + i, :n], g)
            else:
                product(w11, S[BY_POINT_V + i, :n], g)
        h0, h1, h2 = A[at + 3, lo:hi], A[at + 4, lo:hi], A[at + 5, lo:hi]
        combine(R[0, 0], R[1, 0], R[2, 0], 0.0, g0, g1, g2, h0)
        combine(R[0, 1], R[1, 1], R[2, 1], 0.0, g0, g1, g2, h1)
        combine(R[0, 2], R[1, 2], R[2, 2], 0.0, g0, g1, g2, h2)
        cross(x1, h2, x2, h1, A[at, lo:hi])
        cross(x2, h0, x0, h2, A[at + 1, lo:hi])
        cross(x0, h1, x1, h0, A[at + 2, lo:hi])
        if n_warp > 0:
            product(h2, shape[0], A[at + 6, lo:hi])
            product(h2, shape[1], A[at + 7, lo:hi])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def _nine_products(
    a0: FloatArray, a1: FloatArray, a2: FloatArray, b0: FloatArray, b1: FloatArray, b2: FloatArray, H: FloatArray
) -> None:  # fmt: skip
    c00, c01, c02, c10, c11, c12, c20, c21, c22 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for p in range(a0.size):
        x0, x1, x2, y0, y1, y2 = a0[p], a1[p], a2[p], b0[p], b1[p], b2[p]
        c00 += x0 * y0
        c01 += x0 * y1
        c02 += x0 * y2
        c10 += x1 * y0
        c11 += x1 * y1
        c12 += x1 * y2
        c20 += x2 * y0
        c21 += x2 * y1
        c22 += x2 * y2
    H[0, 0] += c00
    H[0, 1] += c01
    H[0, 2] += c02
    H[1, 0] += c10
    H[1, 1] += c11
    H[1, 2] += c12
    H[2, 0] += c20
    H[2, 1] += c21
    H[2, 2] += c22


@njit(cache=True, nogil=True, error_model="numpy")
def add_gram(A: FloatArray, n: int, m: int, H: FloatArray) -> None:
    """Add the products of A's first ``n`` rows, ``m`` columns long, to H's upper triangle (and a little below it).

    Three rows by three at a time, so that every number read is used three times; A has room for a multiple of three.
    """
    top = (n + 2) // 3 * 3
    A[n:top, :m] = 0.0
    for j in range(0, n, 3):
        for k in range(j, n, 3):
            _nine_products(
                A[j, :m], A[j + 1, :m], A[j + 2, :m], A[k, :m], A[k + 1, :m], A[k + 2, :m], H[j : j + 3, k : k + 3]
            )


@njit(cache=True, nogil=True, error_model="numpy")
def normal_equations(
    which: IntArray, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray,
    t: FloatArray, warp: FloatArray, H: FloatArray, chi: FloatArray, depth: FloatArray,
) -> None:  # fmt: skip
    """For each listed block: normal matrix H[b] (symmetric) of its local unknowns and, last, the residual.

    Its last diagonal element is chi-square, also in ``chi``; depth: the least one.
    """
    S, row, A = scratch()
    N = np.empty((MAX_LOCAL, MAX_LOCAL))
    for i in range(which.size):
        b = which[i]
        n = lenses.n_free[blocks.camera[b]] + 6 + blocks.n_warp[b] + 1
        N[:] = 0.0
        z = np.inf
        for lo in range(blocks.ptr[b], blocks.ptr[b + 1], CHUNK):
            hi = min(lo + CHUNK, blocks.ptr[b + 1])
            z = min(z, local_columns(b, lo, hi, blocks, points, W, lenses, R, t, warp, S, row, A))
            add_gram(A, n, 2 * (hi - lo), N)
        for j in range(n):
            for k in range(j, n):
                H[b, j, k] = N[j, k]
                H[b, k, j] = N[j, k]
        chi[b] = N[n - 1, n - 1]
        depth[b] = z


@njit(cache=True, nogil=True, error_model="numpy")
def half_cholesky(H: FloatArray, n: int) -> None:
    """Upper triangular R with R'R = H, positive semidefinite (n, n), in place; a vanishing pivot leaves a zero row.

    H is scaled to a unit diagonal first, so a pivot below 1e-14 is rounding.
    """
    d = np.empty(n)
    for i in range(n):
        d[i] = np.sqrt(H[i, i]) if H[i, i] > 0.0 else 0.0
    for i in range(n):
        for j in range(i, n):
            H[i, j] = H[i, j] / (d[i] * d[j]) if d[i] > 0.0 and d[j] > 0.0 else 0.0
    for i in range(n):
        p = H[i, i]
        if p <= 1e-14:
            for j in range(i, n):
                H[i, j] = 0.0
            continue
        f = 1.0 / np.sqrt(p)
        for j in range(i, n):
            H[i, j] *= f
        for k in range(i + 1, n):
            a = H[i, k]
            if a != 0.0:
                for j in range(k, n):
                    H[k, j] -= a * H[i, j]
    for i in range(n):
        for j in range(i):
            H[i, j] = 0.0
        for j in range(i, n):
            H[i, j] *= d[j]


@njit(cache=True, nogil=True, error_model="numpy")
def serve(
    which: IntArray, blocks: BlockArrays, lenses: LensArrays, segments: SegmentArrays, C: FloatArray, D: FloatArray,
    width: IntArray, at: IntArray, H: FloatArray, flat: FloatArray, r_out: FloatArray,
) -> None:  # fmt: skip
    """For each listed block: its condensed rows, chained to its keys, into ``flat`` from ``at[b]``, and r_out (B, n).

    Keys one after the other, each (n, its width); ``segments.place`` counts columns, width (B,) all of a block.
    """
    T = np.empty((MAX_LOCAL, MAX_LOCAL))
    E = np.empty((6, 6))
    for i in range(which.size):
        b = which[i]
        nl = lenses.n_free[blocks.camera[b]]
        n = nl + 6 + blocks.n_warp[b] + 1
        for j in range(n):
            for c in range(n):
                T[j, c] = H[b, j, c]
        half_cholesky(T, n)
        for j in range(n):
            r_out[b, j] = T[j, n - 1]
        for j in range(at[b], at[b] + n * width[b]):
            flat[j] = 0.0
        for s in range(segments.ptr[b], segments.ptr[b + 1]):
            k, kind, start = segments.n[s], segments.kind[s], segments.start[s]
            o = at[b] + n * segments.place[s]
            if kind in (SEGMENT_LENS, SEGMENT_WARP):
                first = 0 if kind == SEGMENT_LENS else nl + 6 + start
                for j in range(n):
                    for c in range(k):
                        flat[o + j * k + c] += T[j, first + c]
                continue
            pose_by_key(s, segments, C, D, E)
            for j in range(n):
                for c in range(k):
                    v = 0.0
                    for a in range(6):
                        v += T[j, nl + a] * E[a, c]
                    flat[o + j * k + c] += v


@njit(cache=True, nogil=True, error_model="numpy")
def pose_by_key(s: int, segments: SegmentArrays, C: FloatArray, D: FloatArray, E: FloatArray) -> None:
    """Derivative E (6, n of segment s) of a block's pose by its unknown: a pose, or a part of a table."""
    Cs = C[segments.link[s]]
    if segments.kind[s] == SEGMENT_POSE:
        for i in range(6):
            for j in range(6):
                E[i, j] = Cs[i, j]
        return
    Ds, start = D[segments.table[s]], segments.start[s]
    for i in range(6):
        for j in range(segments.n[s]):
            v = 0.0
            for a in range(6):
                v += Cs[i, a] * Ds[a, start + j]
            E[i, j] = v


@njit(cache=True, nogil=True, error_model="numpy")
def local_by_keys(
    b: int, nl: int, segments: SegmentArrays, C: FloatArray, D: FloatArray, G: FloatArray
) -> None:  # fmt: skip
    """Derivative G (n_lens + 6 + n_warp, sum of key dims) of a block's local unknowns by its keys."""
    G[:] = 0.0
    E = np.empty((6, 6))
    for s in range(segments.ptr[b], segments.ptr[b + 1]):
        k, kind, o = segments.n[s], segments.kind[s], segments.place[s]
        if kind in (SEGMENT_LENS, SEGMENT_WARP):
            first = 0 if kind == SEGMENT_LENS else nl + 6 + segments.start[s]
            for j in range(k):
                G[first + j, o + j] += 1.0
            continue
        pose_by_key(s, segments, C, D, E)
        for i in range(6):
            for j in range(k):
                G[nl + i, o + j] += E[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def errors(
    which: IntArray, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray,
    t: FloatArray, warp: FloatArray, chi: FloatArray, depth: FloatArray,
) -> None:  # fmt: skip
    """Chi-square (whitened) and least depth of each listed block."""
    X, uv, shape = points.X, points.uv, points.shape
    for i in range(which.size):
        b = which[i]
        c, wb = blocks.camera[b], blocks.warp_id[b]
        kind, lens, constants = lenses.kind[c], lenses.values[c], lenses.constants[c]
        warp_x, warp_y = (warp[wb, 0], warp[wb, 1]) if wb >= 0 else (0.0, 0.0)
        e, zmin = 0.0, np.inf
        for p in range(blocks.ptr[b], blocks.ptr[b + 1]):
            if W[0, p] == 0.0:
                continue
            x0, x1, x2 = X[0, p], X[1, p], X[2, p] + warp_x * shape[0, p] + warp_y * shape[1, p]
            q0 = R[b, 0, 0] * x0 + R[b, 0, 1] * x1 + R[b, 0, 2] * x2 + t[b, 0]
            q1 = R[b, 1, 0] * x0 + R[b, 1, 1] * x1 + R[b, 1, 2] * x2 + t[b, 1]
            q2 = R[b, 2, 0] * x0 + R[b, 2, 1] * x1 + R[b, 2, 2] * x2 + t[b, 2]
            zmin = min(zmin, q2)
            ru, rv = lens_residual(kind, lens, constants, q0, q1, q2, uv[0, p], uv[1, p])
            a, d = W[0, p] * ru + W[1, p] * rv, W[2, p] * rv
            e += a * a + d * d
        chi[b] = e
        depth[b] = zmin
