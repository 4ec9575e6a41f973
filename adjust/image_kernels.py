"""Compiled evaluation of image points: residuals, condensed normal equations and redundancy, block after block.

A block is what one camera saw of one target at one epoch. Its local unknowns are the free lens parameters of the
camera, the six of ``camera_from_target`` (tangent on the right) and, where the target has them, two of its warp.
"""

# mypy: disable-error-code="untyped-decorator"
# reason: numba ships no types, so its decorator leaves every function below untyped

from typing import NamedTuple

import numpy as np
from numba import njit

from adjust.lens_kernels import MAX_LENS, lens_residual, lens_row
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
    """Image points: X (N, 3) m in the target, warp functions shape (N, 2), observed uv (N, 2) px."""

    X: FloatArray
    shape: FloatArray
    uv: FloatArray


class SegmentArrays(NamedTuple):
    """How a block's condensed columns reach its keys: kind, link of the chain, table slot, start, width, place."""

    ptr: IntArray
    kind: IntArray
    link: IntArray
    table: IntArray
    start: IntArray
    n: IntArray
    out: IntArray


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


_CHUNK = 256  # rows gathered before they are multiplied: a block of 128 points stays in the first-level cache


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
def add_gram(A: FloatArray, n: int, m: int, H: FloatArray) -> None:
    """Add the products of A's ``n`` rows, ``m`` columns long, to H's upper triangle; vectorised over the columns."""
    for j in range(n):
        for k in range(j, n):
            v = 0.0
            for p in range(m):
                v += A[j, p] * A[k, p]
            H[j, k] += v


@njit(cache=True, nogil=True, error_model="numpy")
def condense(
    which: IntArray, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray,
    t: FloatArray, warp: FloatArray, segments: SegmentArrays, C: FloatArray, D: FloatArray, flat: FloatArray,
    r_out: FloatArray, chi: FloatArray, depth: FloatArray,
) -> None:  # fmt: skip
    """For each listed block: the condensed rows, chained to its keys, into ``flat``; chi-square and least depth."""
    row = np.zeros((2, MAX_LENS + 3))
    A = np.empty((MAX_LENS + 9, _CHUNK))
    out = np.empty((2, MAX_LENS + 9))
    H = np.empty((MAX_LENS + 9, MAX_LENS + 9))
    X, uv, shape = points.X, points.uv, points.shape
    for i in range(which.size):
        b = which[i]
        c = blocks.camera[b]
        kind, lens, constants = lenses.kind[c], lenses.values[c], lenses.constants[c]
        n_map, source, column, factor = lenses.n_map[c], lenses.source[c], lenses.column[c], lenses.factor[c]
        Rb, tb, wb = R[b], t[b], blocks.warp_id[b]
        nl, nw = lenses.n_free[c], blocks.n_warp[b]
        warp_x, warp_y = (warp[wb, 0], warp[wb, 1]) if wb >= 0 else (0.0, 0.0)
        n = nl + 6 + nw + 1
        H[:n, :n] = 0.0
        zmin = np.inf
        m = 0
        for p in range(blocks.ptr[b], blocks.ptr[b + 1]):
            if W[p, 0] == 0.0:
                continue
            s0, s1 = shape[p, 0], shape[p, 1]
            z = local_row(
                kind, lens, constants, Rb, tb, X[p, 0], X[p, 1], X[p, 2] + warp_x * s0 + warp_y * s1, uv[p, 0],
                uv[p, 1], W[p, 0], W[p, 1], W[p, 2], n_map, source, column, factor, nl, s0, s1, nw, row, out,
            )  # fmt: skip
            zmin = min(zmin, z)
            for j in range(n):
                A[j, m] = out[0, j]
                A[j, m + 1] = out[1, j]
            m += 2
            if m == _CHUNK:
                add_gram(A, n, m, H)
                m = 0
        add_gram(A, n, m, H)
        chi[b] = H[n - 1, n - 1]
        depth[b] = zmin
        half_cholesky(H, n)
        serve(b, H, n, nl, segments, C, D, flat)
        for j in range(n):
            r_out[b, j] = H[j, n - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def serve(
    b: int, H: FloatArray, n: int, nl: int, segments: SegmentArrays, C: FloatArray, D: FloatArray, flat: FloatArray
) -> None:
    """Spread condensed rows H (n, n) over the keys of block b: lens as it is, poses by the chain, table by D."""
    for s in range(segments.ptr[b], segments.ptr[b + 1]):
        o, k = segments.out[s], segments.n[s]
        for j in range(n * k):
            flat[o + j] = 0.0
    P = np.empty(6)
    for s in range(segments.ptr[b], segments.ptr[b + 1]):
        o, k, kind, start = segments.out[s], segments.n[s], segments.kind[s], segments.start[s]
        for i in range(n):
            if kind == SEGMENT_LENS:
                for j in range(k):
                    flat[o + i * k + j] += H[i, j]
                continue
            if kind == SEGMENT_WARP:
                for j in range(k):
                    flat[o + i * k + j] += H[i, nl + 6 + start + j]
                continue
            Cl = C[segments.link[s]]
            for j in range(6):
                v = 0.0
                for a in range(6):
                    v += H[i, nl + a] * Cl[a, j]
                P[j] = v
            if kind == SEGMENT_POSE:
                for j in range(6):
                    flat[o + i * k + j] += P[j]
                continue
            Ds = D[segments.table[s]]
            for j in range(k):
                v = 0.0
                for a in range(6):
                    v += P[a] * Ds[a, start + j]
                flat[o + i * k + j] += v


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
            if W[p, 0] == 0.0:
                continue
            x0, x1, x2 = X[p, 0], X[p, 1], X[p, 2] + warp_x * shape[p, 0] + warp_y * shape[p, 1]
            q0 = R[b, 0, 0] * x0 + R[b, 0, 1] * x1 + R[b, 0, 2] * x2 + t[b, 0]
            q1 = R[b, 1, 0] * x0 + R[b, 1, 1] * x1 + R[b, 1, 2] * x2 + t[b, 1]
            q2 = R[b, 2, 0] * x0 + R[b, 2, 1] * x1 + R[b, 2, 2] * x2 + t[b, 2]
            zmin = min(zmin, q2)
            ru, rv = lens_residual(kind, lens, constants, q0, q1, q2, uv[p, 0], uv[p, 1])
            a, d = W[p, 0] * ru + W[p, 1] * rv, W[p, 2] * rv
            e += a * a + d * d
        chi[b] = e
        depth[b] = zmin


@njit(cache=True, nogil=True, error_model="numpy")
def statistics(
    b: int, blocks: BlockArrays, points: PointArrays, W: FloatArray, lenses: LensArrays, R: FloatArray, t: FloatArray,
    warp: FloatArray, Q: FloatArray, residual: FloatArray, influence: FloatArray,
) -> None:  # fmt: skip
    """Residuals (px) of block b and the whitened covariance A Q A' (2 x 2: 00, 01, 11) of its adjusted image points.

    Q: joint covariance of the block's local unknowns. W: that of all points, used or not.
    """
    c, wb = blocks.camera[b], blocks.warp_id[b]
    nl, nw = lenses.n_free[c], blocks.n_warp[b]
    n = nl + 6 + nw
    warp_x, warp_y = (warp[wb, 0], warp[wb, 1]) if wb >= 0 else (0.0, 0.0)
    row = np.zeros((2, MAX_LENS + 3))
    out = np.empty((2, n + 1))
    X, uv, shape = points.X, points.uv, points.shape
    lens, constants, Rb, tb = lenses.values[c], lenses.constants[c], R[b], t[b]
    source, column, factor = lenses.source[c], lenses.column[c], lenses.factor[c]
    for p in range(blocks.ptr[b], blocks.ptr[b + 1]):
        s0, s1 = shape[p, 0], shape[p, 1]
        local_row(
            lenses.kind[c], lens, constants, Rb, tb, X[p, 0], X[p, 1], X[p, 2] + warp_x * s0 + warp_y * s1, uv[p, 0],
            uv[p, 1], W[p, 0], W[p, 1], W[p, 2], lenses.n_map[c], source, column, factor, nl, s0, s1, nw, row, out,
        )  # fmt: skip
        rv = out[1, n] / W[p, 2]
        residual[p, 1] = rv
        residual[p, 0] = (out[0, n] - W[p, 1] * rv) / W[p, 0]
        m00, m01, m11 = 0.0, 0.0, 0.0
        for i in range(n):
            v0, v1 = 0.0, 0.0
            for j in range(n):
                v0 += Q[i, j] * out[0, j]
                v1 += Q[i, j] * out[1, j]
            m00 += out[0, i] * v0
            m01 += out[0, i] * v1
            m11 += out[1, i] * v1
        influence[p, 0], influence[p, 1], influence[p, 2] = m00, m01, m11
