"""Compiled bundle adjustment with unknown points: rows, Schur complement, back-substitution, covariances.

Local unknowns: the free lens parameters of every camera, six of ``camera_from_world`` per block (tangent on the right),
then the points that stay (tied to other observations). The other points are reduced one by one (Brown 1958; Triggs et
al. 2000, "Bundle adjustment - a modern synthesis", section 6). Observations are sorted by point, then camera.
"""

# mypy: disable-error-code="untyped-decorator"
# reason: numba ships no types, so its decorator leaves every function below untyped

import numpy as np
from numba import njit

from adjust.image_kernels import LensArrays, local_row
from adjust.lens_kernels import MAX_LENS
from adjust.model import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def rows(
    block: IntArray, camera: IntArray, lenses: LensArrays, R: FloatArray, t: FloatArray, X: FloatArray, uv: FloatArray,
    W: FloatArray, A: FloatArray, chi: FloatArray, depth: FloatArray,
) -> None:  # fmt: skip
    """Whitened rows A (K, 2, MAX_LENS + 7): lens in 0.., pose in MAX_LENS.., residual last; chi (B,), least depth (B,).

    The derivative by the point equals that by the translation of the pose.
    """
    row = np.zeros((2, MAX_LENS + 3))
    out = np.zeros((2, MAX_LENS + 7))
    chi[:] = 0.0
    depth[:] = np.inf
    for k in range(block.size):
        b = block[k]
        c = camera[b]
        nl = lenses.n_free[c]
        z = local_row(
            lenses.kind[c], lenses.values[c], lenses.constants[c], R[b], t[b], X[k, 0], X[k, 1], X[k, 2], uv[k, 0],
            uv[k, 1], W[k, 0], W[k, 1], W[k, 2], lenses.n_map[c], lenses.source[c], lenses.column[c],
            lenses.factor[c], nl, 0.0, 0.0, 0, row, out,
        )  # fmt: skip
        for s in range(2):
            for j in range(nl):
                A[k, s, j] = out[s, j]
            for j in range(7):
                A[k, s, MAX_LENS + j] = out[s, nl + j]
            chi[b] += out[s, nl + 6] ** 2
        if W[k, 0] > 0.0:
            depth[b] = min(depth[b], z)


@njit(cache=True, nogil=True, error_model="numpy")
def block_squares(block: IntArray, A: FloatArray, out: FloatArray) -> None:
    """Normal matrix (B, 6, 6) of each block's pose by its own image points alone, all points known."""
    out[:] = 0.0
    for k in range(block.size):
        for s in range(2):
            for i in range(6):
                for j in range(6):
                    out[block[k], i, j] += A[k, s, MAX_LENS + i] * A[k, s, MAX_LENS + j]


@njit(cache=True, nogil=True, error_model="numpy")
def invert3(V: FloatArray, out: FloatArray) -> bool:
    """Inverse of a symmetric positive definite V (3, 3); False where a pivot vanishes against its diagonal."""
    a, b, c = V[0, 0], V[0, 1], V[0, 2]
    d, e, f = V[1, 1], V[1, 2], V[2, 2]
    if a <= 0.0:
        return False
    d2 = d - b * b / a
    if d2 <= 1e-12 * d:
        return False
    e2 = e - b * c / a
    f2 = f - c * c / a - e2 * e2 / d2
    if f2 <= 1e-12 * f:
        return False
    det = a * d2 * f2
    out[0, 0] = (d * f - e * e) / det
    out[0, 1] = (c * e - b * f) / det
    out[0, 2] = (b * e - c * d) / det
    out[1, 1] = (a * f - c * c) / det
    out[1, 2] = (b * c - a * e) / det
    out[2, 2] = (a * d - b * b) / det
    out[1, 0], out[2, 0], out[2, 1] = out[0, 1], out[0, 2], out[1, 2]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def add_direct(
    first: int, last: int, A: FloatArray, camera_of: IntArray, n_lens: IntArray, lens_at: IntArray,
    pose_at: IntArray, point_at: IntArray, S: FloatArray, g: FloatArray,
) -> None:  # fmt: skip
    """Add observations first..last as they are: points that stay (point_at >= 0) or are held (< 0)."""
    index = np.empty(MAX_LENS + 9, np.int64)
    a = np.empty(MAX_LENS + 9)
    for k in range(first, last):
        nl = n_lens[camera_of[k]]
        n = nl + 6
        for j in range(nl):
            index[j] = lens_at[camera_of[k]] + j
        for j in range(6):
            index[nl + j] = pose_at[k] + j
        if point_at[k] >= 0:
            for j in range(3):
                index[n + j] = point_at[k] + j
            n += 3
        for s in range(2):
            for j in range(nl):
                a[j] = A[k, s, j]
            for j in range(6):
                a[nl + j] = A[k, s, MAX_LENS + j]
            if point_at[k] >= 0:
                for j in range(3):
                    a[nl + 6 + j] = A[k, s, MAX_LENS + 3 + j]
            r = A[k, s, MAX_LENS + 6]
            for i in range(n):
                g[index[i]] += a[i] * r
                for j in range(n):
                    if index[j] >= index[i]:
                        S[index[i], index[j]] += a[i] * a[j]


@njit(cache=True, nogil=True, error_model="numpy")
def reduce_points(
    ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray, pc_of: IntArray, A: FloatArray, camera_of: IntArray,
    n_lens: IntArray, lens_at: IntArray, pose_at: IntArray, damping: float, S: FloatArray, g: FloatArray,
    Vi: FloatArray, W: FloatArray, WL: FloatArray, h: FloatArray,
) -> int:  # fmt: skip
    """Schur complement over the points ptr[j]..ptr[j + 1], into the upper triangle of S and g; -1, or the bad point.

    W (K, 3, 6), WL (point-cameras, 3, MAX_LENS), Vi (P, 3, 3), h (P, 3) stay for the back-substitution.
    """
    V = np.empty((3, 3))
    vh = np.empty(3)
    Y = np.empty((3, MAX_LENS))
    for j in range(ptr.size - 1):
        V[:] = 0.0
        for a in range(3):
            h[j, a] = 0.0
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            for a in range(3):
                for q in range(MAX_LENS):
                    WL[i, a, q] = 0.0
        for k in range(ptr[j], ptr[j + 1]):
            nl, i = n_lens[camera_of[k]], pc_of[k]
            for s in range(2):
                r = A[k, s, MAX_LENS + 6]
                for a in range(3):
                    x = A[k, s, MAX_LENS + 3 + a]
                    h[j, a] += x * r
                    for q in range(a, 3):
                        V[a, q] += x * A[k, s, MAX_LENS + 3 + q]
                    for q in range(nl):
                        WL[i, a, q] += x * A[k, s, q]
            for a in range(3):
                for q in range(6):
                    W[k, a, q] = (
                        A[k, 0, MAX_LENS + 3 + a] * A[k, 0, MAX_LENS + q]
                        + A[k, 1, MAX_LENS + 3 + a] * A[k, 1, MAX_LENS + q]
                    )
        for a in range(3):
            V[a, a] *= 1.0 + damping
        if not invert3(V, Vi[j]):
            return j
        for a in range(3):
            vh[a] = Vi[j, a, 0] * h[j, 0] + Vi[j, a, 1] * h[j, 1] + Vi[j, a, 2] * h[j, 2]
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            ni, oi = n_lens[pc_camera[i]], lens_at[pc_camera[i]]
            for a in range(3):
                for q in range(ni):
                    Y[a, q] = Vi[j, a, 0] * WL[i, 0, q] + Vi[j, a, 1] * WL[i, 1, q] + Vi[j, a, 2] * WL[i, 2, q]
            for q in range(ni):
                g[oi + q] -= WL[i, 0, q] * vh[0] + WL[i, 1, q] * vh[1] + WL[i, 2, q] * vh[2]
            for m in range(pc_ptr[j], pc_ptr[j + 1]):
                om = lens_at[pc_camera[m]]
                for p in range(n_lens[pc_camera[m]]):
                    for q in range(ni):
                        if om + p <= oi + q:
                            S[om + p, oi + q] -= WL[m, 0, p] * Y[0, q] + WL[m, 1, p] * Y[1, q] + WL[m, 2, p] * Y[2, q]
        add_direct_reduced(ptr[j], ptr[j + 1], pc_ptr[j], pc_ptr[j + 1], pc_camera, A, camera_of, n_lens, lens_at,
                           pose_at, Vi[j], vh, W, WL, S, g)  # fmt: skip
    return -1


@njit(cache=True, nogil=True, error_model="numpy")
def add_direct_reduced(
    first: int, last: int, pc0: int, pc1: int, pc_camera: IntArray, A: FloatArray, camera_of: IntArray,
    n_lens: IntArray, lens_at: IntArray, pose_at: IntArray, Vi: FloatArray, vh: FloatArray, W: FloatArray,
    WL: FloatArray, S: FloatArray, g: FloatArray,
) -> None:  # fmt: skip
    """The direct part of one point's observations, and minus its share in the poses."""
    Y = np.empty((3, 6))
    for k in range(first, last):
        nl, o, ol = n_lens[camera_of[k]], pose_at[k], lens_at[camera_of[k]]
        for s in range(2):
            r = A[k, s, MAX_LENS + 6]
            for p in range(nl):
                ap = A[k, s, p]
                g[ol + p] += ap * r
                for q in range(p, nl):
                    S[ol + p, ol + q] += ap * A[k, s, q]
                for q in range(6):
                    S[ol + p, o + q] += ap * A[k, s, MAX_LENS + q]
            for p in range(6):
                ap = A[k, s, MAX_LENS + p]
                g[o + p] += ap * r
                for q in range(p, 6):
                    S[o + p, o + q] += ap * A[k, s, MAX_LENS + q]
        for a in range(3):
            for q in range(6):
                Y[a, q] = Vi[a, 0] * W[k, 0, q] + Vi[a, 1] * W[k, 1, q] + Vi[a, 2] * W[k, 2, q]
        for q in range(6):
            g[o + q] -= W[k, 0, q] * vh[0] + W[k, 1, q] * vh[1] + W[k, 2, q] * vh[2]
        for i in range(pc0, pc1):
            oi = lens_at[pc_camera[i]]
            for p in range(n_lens[pc_camera[i]]):
                for q in range(6):
                    S[oi + p, o + q] -= WL[i, 0, p] * Y[0, q] + WL[i, 1, p] * Y[1, q] + WL[i, 2, p] * Y[2, q]
        for m in range(first, last):
            om = pose_at[m]
            if om > o:
                continue
            for p in range(6):
                for q in range(6):
                    if om + p <= o + q:
                        S[om + p, o + q] -= W[m, 0, p] * Y[0, q] + W[m, 1, p] * Y[1, q] + W[m, 2, p] * Y[2, q]


@njit(cache=True, nogil=True, error_model="numpy")
def back_substitute(
    ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray, camera_of: IntArray, n_lens: IntArray, lens_at: IntArray,
    pose_at: IntArray, Vi: FloatArray, W: FloatArray, WL: FloatArray, h: FloatArray, d: FloatArray, dX: FloatArray,
) -> None:  # fmt: skip
    """Steps dX (P, 3) of the reduced points from the step d of the local unknowns."""
    s = np.empty(3)
    for j in range(ptr.size - 1):
        for a in range(3):
            s[a] = h[j, a]
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            o = lens_at[pc_camera[i]]
            for a in range(3):
                for q in range(n_lens[pc_camera[i]]):
                    s[a] += WL[i, a, q] * d[o + q]
        for k in range(ptr[j], ptr[j + 1]):
            for a in range(3):
                for q in range(6):
                    s[a] += W[k, a, q] * d[pose_at[k] + q]
        for a in range(3):
            dX[j, a] = -(Vi[j, a, 0] * s[0] + Vi[j, a, 1] * s[1] + Vi[j, a, 2] * s[2])


@njit(cache=True, nogil=True, error_model="numpy")
def point_covariances(
    ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray, pc_of: IntArray, camera_of: IntArray, n_lens: IntArray,
    lens_at: IntArray, pose_at: IntArray, A_all: FloatArray, Vi: FloatArray, W: FloatArray, WL: FloatArray,
    Q: FloatArray, CX: FloatArray, influence: FloatArray,
) -> None:  # fmt: skip
    """Covariances CX (P, 3, 3) of the reduced points and whitened A Q A' (K, 3) of their observations.

    Q: full covariance of the local unknowns. With Y = -V^-1 W: Q_XX = V^-1 + Y Q Y', Q_Xc = Y Q. A_all: rows whitened
    as if all observations were used.
    """
    for j in range(ptr.size - 1):
        m = ptr[j + 1] - ptr[j]
        n_pc = 0
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            n_pc += n_lens[pc_camera[i]]
        n = n_pc + 6 * m
        index = np.empty(n, np.int64)
        Y = np.empty((3, n))
        at = np.empty(pc_ptr[j + 1] - pc_ptr[j], np.int64)
        o = 0
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            at[i - pc_ptr[j]] = o
            for q in range(n_lens[pc_camera[i]]):
                index[o] = lens_at[pc_camera[i]] + q
                for a in range(3):
                    Y[a, o] = -(Vi[j, a, 0] * WL[i, 0, q] + Vi[j, a, 1] * WL[i, 1, q] + Vi[j, a, 2] * WL[i, 2, q])
                o += 1
        for k in range(ptr[j], ptr[j + 1]):
            for q in range(6):
                index[o] = pose_at[k] + q
                for a in range(3):
                    Y[a, o] = -(Vi[j, a, 0] * W[k, 0, q] + Vi[j, a, 1] * W[k, 1, q] + Vi[j, a, 2] * W[k, 2, q])
                o += 1
        B = np.zeros((3, n))
        for c in range(n):
            for b in range(n):
                v = Q[index[c], index[b]]
                for a in range(3):
                    B[a, b] += Y[a, c] * v
        for a in range(3):
            for b in range(3):
                v = Vi[j, a, b]
                for c in range(n):
                    v += B[a, c] * Y[b, c]
                CX[j, a, b] = v
        local = np.empty(MAX_LENS + 6, np.int64)
        r = np.empty((2, MAX_LENS + 6))
        for k in range(ptr[j], ptr[j + 1]):
            nl = n_lens[camera_of[k]]
            for q in range(nl):
                local[q] = at[pc_of[k] - pc_ptr[j]] + q
            for q in range(6):
                local[nl + q] = n_pc + 6 * (k - ptr[j]) + q
            for s in range(2):
                for q in range(nl):
                    r[s, q] = A_all[k, s, q]
                for q in range(6):
                    r[s, nl + q] = A_all[k, s, MAX_LENS + q]
            for e in range(3):
                s, u = (0, 0) if e == 0 else ((0, 1) if e == 1 else (1, 1))
                v = 0.0
                for p in range(nl + 6):
                    for q in range(nl + 6):
                        v += r[s, p] * r[u, q] * Q[index[local[p]], index[local[q]]]
                for a in range(3):
                    xs, xu = A_all[k, s, MAX_LENS + 3 + a], A_all[k, u, MAX_LENS + 3 + a]
                    for q in range(nl + 6):
                        v += B[a, local[q]] * (xs * r[u, q] + xu * r[s, q])
                    for b in range(3):
                        v += xs * CX[j, a, b] * A_all[k, u, MAX_LENS + 3 + b]
                influence[k, e] = v


@njit(cache=True, nogil=True, error_model="numpy")
def direct_influence(
    first: int, last: int, A_all: FloatArray, camera_of: IntArray, n_lens: IntArray, lens_at: IntArray,
    pose_at: IntArray, point_at: IntArray, Q: FloatArray, influence: FloatArray,
) -> None:  # fmt: skip
    """Whitened A Q A' of observations whose point stays or is held."""
    index = np.empty(MAX_LENS + 9, np.int64)
    r = np.empty((2, MAX_LENS + 9))
    for k in range(first, last):
        nl = n_lens[camera_of[k]]
        n = nl + 6
        for j in range(nl):
            index[j] = lens_at[camera_of[k]] + j
        for j in range(6):
            index[nl + j] = pose_at[k] + j
        for s in range(2):
            for j in range(nl):
                r[s, j] = A_all[k, s, j]
            for j in range(6):
                r[s, nl + j] = A_all[k, s, MAX_LENS + j]
        if point_at[k] >= 0:
            for j in range(3):
                index[n + j] = point_at[k] + j
                for s in range(2):
                    r[s, n + j] = A_all[k, s, MAX_LENS + 3 + j]
            n += 3
        for e in range(3):
            s, u = (0, 0) if e == 0 else ((0, 1) if e == 1 else (1, 1))
            v = 0.0
            for p in range(n):
                for q in range(n):
                    v += r[s, p] * Q[index[p], index[q]] * r[u, q]
            influence[k, e] = v
