"""Compiled evaluation of image points: residuals, condensed normal equations and redundancy, block after block.

A block is what one camera saw of one target at one epoch. Its local unknowns are the free lens parameters of the
camera, the six of ``camera_from_target`` (tangent on the right) and, where the target has them, two of its warp.
"""

import numpy as np
from numba import njit

from adjust.lens_kernels import MAX_LENS, lens_residual, lens_row
from adjust.model import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def local_row(
    kind: int, lens: FloatArray, constants: FloatArray, R: FloatArray, t: FloatArray, x: FloatArray, uv: FloatArray,
    w: FloatArray, columns: IntArray, factors: FloatArray, n_lens: int, shape: FloatArray, n_warp: int,
    row: FloatArray, out: FloatArray,
) -> float:  # fmt: skip
    """One image point: whitened rows ``out`` (2, n_lens + 6 + n_warp + 1), residual last; returns the depth.

    w: upper triangular square root of the information (w00, w01, w11). columns, factors: where each lens parameter
    goes among the free ones (-1: held). shape: (2,) the warp functions at the point.
    """
    q0 = R[0, 0] * x[0] + R[0, 1] * x[1] + R[0, 2] * x[2] + t[0]
    q1 = R[1, 0] * x[0] + R[1, 1] * x[1] + R[1, 2] * x[2] + t[1]
    q2 = R[2, 0] * x[0] + R[2, 1] * x[1] + R[2, 2] * x[2] + t[2]
    ru, rv = lens_row(kind, lens, constants, q0, q1, q2, uv[0], uv[1], row)
    m = n_lens + 6 + n_warp
    for s in range(2):
        for j in range(n_lens):
            out[s, j] = 0.0
        for j in range(lens.size):
            if columns[j] >= 0:
                out[s, columns[j]] += factors[j] * row[s, j]
        g0, g1, g2 = row[s, MAX_LENS], row[s, MAX_LENS + 1], row[s, MAX_LENS + 2]
        h0 = g0 * R[0, 0] + g1 * R[1, 0] + g2 * R[2, 0]
        h1 = g0 * R[0, 1] + g1 * R[1, 1] + g2 * R[2, 1]
        h2 = g0 * R[0, 2] + g1 * R[1, 2] + g2 * R[2, 2]
        out[s, n_lens] = x[1] * h2 - x[2] * h1
        out[s, n_lens + 1] = x[2] * h0 - x[0] * h2
        out[s, n_lens + 2] = x[0] * h1 - x[1] * h0
        out[s, n_lens + 3] = h0
        out[s, n_lens + 4] = h1
        out[s, n_lens + 5] = h2
        for j in range(n_warp):
            out[s, n_lens + 6 + j] = h2 * shape[j]
    out[0, m] = ru
    out[1, m] = rv
    for j in range(m + 1):
        out[0, j] = w[0] * out[0, j] + w[1] * out[1, j]
        out[1, j] = w[2] * out[1, j]
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


@njit(cache=True, nogil=True, error_model="numpy")
def condense(
    blocks: IntArray, ptr: IntArray, camera: IntArray, kind: IntArray, lens: FloatArray, constants: FloatArray,
    columns: IntArray, factors: FloatArray, n_lens: IntArray, R: FloatArray, t: FloatArray, X: FloatArray,
    shape: FloatArray, warp: FloatArray, n_warp: IntArray, warp_id: IntArray, uv: FloatArray, W: FloatArray,
    seg_ptr: IntArray, seg_type: IntArray, seg_ref: IntArray, seg_d: IntArray, seg_start: IntArray, seg_n: IntArray,
    seg_out: IntArray, C: FloatArray, D: FloatArray, flat: FloatArray, r_out: FloatArray, chi: FloatArray,
    depth: FloatArray,
) -> None:  # fmt: skip
    """For each listed block: the condensed rows, chained to its keys, into ``flat``; chi-square and least depth."""
    row = np.zeros((2, MAX_LENS + 3))
    x = np.empty(3)
    for i in range(blocks.size):
        b = blocks[i]
        c = camera[b]
        nl, nw = n_lens[c], n_warp[b]
        n = nl + 6 + nw + 1
        H = np.zeros((n, n))
        out = np.empty((2, n))
        zmin = np.inf
        for p in range(ptr[b], ptr[b + 1]):
            x[0], x[1], x[2] = X[p, 0], X[p, 1], X[p, 2]
            if warp_id[b] >= 0:
                x[2] += warp[warp_id[b], 0] * shape[p, 0] + warp[warp_id[b], 1] * shape[p, 1]
            z = local_row(
                kind[c], lens[c], constants[c], R[b], t[b], x, uv[p], W[p], columns[c], factors[c], nl, shape[p], nw,
                row, out,
            )  # fmt: skip
            if W[p, 0] == 0.0:
                continue
            zmin = min(zmin, z)
            for j in range(n):
                a0, a1 = out[0, j], out[1, j]
                for k in range(j, n):
                    H[j, k] += a0 * out[0, k] + a1 * out[1, k]
        chi[b] = H[n - 1, n - 1]
        depth[b] = zmin
        half_cholesky(H, n)
        serve(b, H, n, nl, nw, seg_ptr, seg_type, seg_ref, seg_d, seg_start, seg_n, seg_out, C, D, flat)
        for j in range(n):
            r_out[b, j] = H[j, n - 1]


@njit(cache=True, nogil=True, error_model="numpy")
def serve(
    b: int, H: FloatArray, n: int, nl: int, nw: int, seg_ptr: IntArray, seg_type: IntArray, seg_ref: IntArray,
    seg_d: IntArray, seg_start: IntArray, seg_n: IntArray, seg_out: IntArray, C: FloatArray, D: FloatArray,
    flat: FloatArray,
) -> None:  # fmt: skip
    """Spread condensed rows H (n, n) over the keys of block b: lens as it is, poses by the chain, table by D."""
    for s in range(seg_ptr[b], seg_ptr[b + 1]):
        o, k = seg_out[s], seg_n[s]
        for j in range(n * k):
            flat[o + j] = 0.0
    P = np.empty(6)
    for s in range(seg_ptr[b], seg_ptr[b + 1]):
        o, k = seg_out[s], seg_n[s]
        for i in range(n):
            if seg_type[s] == 0:
                for j in range(k):
                    flat[o + i * k + j] += H[i, j]
            elif seg_type[s] == 3:
                for j in range(k):
                    flat[o + i * k + j] += H[i, nl + 6 + seg_start[s] + j]
            else:
                Cl = C[seg_ref[s]]
                for j in range(6):
                    v = 0.0
                    for a in range(6):
                        v += H[i, nl + a] * Cl[a, j]
                    P[j] = v
                if seg_type[s] == 1:
                    for j in range(6):
                        flat[o + i * k + j] += P[j]
                else:
                    Ds = D[seg_d[s]]
                    for j in range(k):
                        v = 0.0
                        for a in range(6):
                            v += P[a] * Ds[a, seg_start[s] + j]
                        flat[o + i * k + j] += v


@njit(cache=True, nogil=True, error_model="numpy")
def errors(
    blocks: IntArray, ptr: IntArray, camera: IntArray, kind: IntArray, lens: FloatArray, constants: FloatArray,
    R: FloatArray, t: FloatArray, X: FloatArray, shape: FloatArray, warp: FloatArray, warp_id: IntArray,
    uv: FloatArray, W: FloatArray, chi: FloatArray, depth: FloatArray,
) -> None:  # fmt: skip
    """Chi-square (whitened) and least depth of each listed block."""
    for i in range(blocks.size):
        b = blocks[i]
        c = camera[b]
        e, zmin = 0.0, np.inf
        for p in range(ptr[b], ptr[b + 1]):
            if W[p, 0] == 0.0:
                continue
            x0, x1, x2 = X[p, 0], X[p, 1], X[p, 2]
            if warp_id[b] >= 0:
                x2 += warp[warp_id[b], 0] * shape[p, 0] + warp[warp_id[b], 1] * shape[p, 1]
            q0 = R[b, 0, 0] * x0 + R[b, 0, 1] * x1 + R[b, 0, 2] * x2 + t[b, 0]
            q1 = R[b, 1, 0] * x0 + R[b, 1, 1] * x1 + R[b, 1, 2] * x2 + t[b, 1]
            q2 = R[b, 2, 0] * x0 + R[b, 2, 1] * x1 + R[b, 2, 2] * x2 + t[b, 2]
            zmin = min(zmin, q2)
            ru, rv = lens_residual(kind[c], lens[c], constants[c], q0, q1, q2, uv[p, 0], uv[p, 1])
            a, d = W[p, 0] * ru + W[p, 1] * rv, W[p, 2] * rv
            e += a * a + d * d
        chi[b] = e
        depth[b] = zmin


@njit(cache=True, nogil=True, error_model="numpy")
def statistics(
    b: int, ptr: IntArray, camera: IntArray, kind: IntArray, lens: FloatArray, constants: FloatArray,
    columns: IntArray, factors: FloatArray, n_lens: IntArray, R: FloatArray, t: FloatArray, X: FloatArray,
    shape: FloatArray, warp: FloatArray, n_warp: IntArray, warp_id: IntArray, uv: FloatArray, W: FloatArray,
    Q: FloatArray, residual: FloatArray, influence: FloatArray,
) -> None:  # fmt: skip
    """Residuals (px) of block b and the whitened covariance A Q A' (2 x 2: 00, 01, 11) of its adjusted image points.

    Q: joint covariance of the block's local unknowns. W here is that of all points, used or not.
    """
    c = camera[b]
    nl, nw = n_lens[c], n_warp[b]
    n = nl + 6 + nw
    row = np.zeros((2, MAX_LENS + 3))
    out = np.empty((2, n + 1))
    x = np.empty(3)
    for p in range(ptr[b], ptr[b + 1]):
        x[0], x[1], x[2] = X[p, 0], X[p, 1], X[p, 2]
        if warp_id[b] >= 0:
            x[2] += warp[warp_id[b], 0] * shape[p, 0] + warp[warp_id[b], 1] * shape[p, 1]
        local_row(
            kind[c], lens[c], constants[c], R[b], t[b], x, uv[p], W[p], columns[c], factors[c], nl, shape[p], nw, row,
            out,
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
