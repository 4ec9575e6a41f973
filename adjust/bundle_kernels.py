"""Compiled bundle adjustment with unknown points: rows, Schur complement, back-substitution, covariances.

Local unknowns: the free lens parameters of every camera, six of ``camera_from_world`` per block (tangent on the right),
then the points that stay (tied to other observations). The other points are reduced one by one (Brown 1958; Triggs et
al. 2000, "Bundle adjustment - a modern synthesis", section 6). Observations are sorted by point, then camera.
"""

import numpy as np

from adjust.compiling import njit
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
    """Add observations first..last as they are: points that stay (point_at >= 0) or are held (< 0).

    To the lower triangle of S, and all of a pose's own block.
    """
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
                    if index[j] <= index[i] or nl <= i < j < nl + 6:
                        S[index[i], index[j]] += a[i] * a[j]


@njit(cache=True, nogil=True, error_model="numpy")
def reduce_points(
    ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray, pc_of: IntArray, A: FloatArray, camera_of: IntArray,
    n_lens: IntArray, lens_at: IntArray, pose_at: IntArray, damping: float, S: FloatArray, g: FloatArray,
    Vi: FloatArray, W: FloatArray, WL: FloatArray, h: FloatArray,
) -> int:  # fmt: skip
    """Reduce the points ptr[j]..ptr[j + 1]: their share in g and among lenses in S (lower); -1, or the bad point.

    W (K, 3, 6), WL (point-cameras, 3, MAX_LENS), Vi (P, 3, 3), h (P, 3) stay: for :func:`pose_rows`, which does the
    rest of S, and for the back-substitution.
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
            nl, i, ol = n_lens[camera_of[k]], pc_of[k], lens_at[camera_of[k]]
            for s in range(2):
                r = A[k, s, MAX_LENS + 6]
                for a in range(3):
                    x = A[k, s, MAX_LENS + 3 + a]
                    h[j, a] += x * r
                    for q in range(a, 3):
                        V[a, q] += x * A[k, s, MAX_LENS + 3 + q]
                    for q in range(nl):
                        WL[i, a, q] += x * A[k, s, q]
                for p in range(nl):
                    g[ol + p] += A[k, s, p] * r
                    for q in range(p + 1):
                        S[ol + p, ol + q] += A[k, s, p] * A[k, s, q]
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
        for k in range(ptr[j], ptr[j + 1]):
            o = pose_at[k]
            for q in range(6):
                own = A[k, 0, MAX_LENS + q] * A[k, 0, MAX_LENS + 6] + A[k, 1, MAX_LENS + q] * A[k, 1, MAX_LENS + 6]
                g[o + q] += own - (W[k, 0, q] * vh[0] + W[k, 1, q] * vh[1] + W[k, 2, q] * vh[2])
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            ni, oi = n_lens[pc_camera[i]], lens_at[pc_camera[i]]
            for a in range(3):
                for q in range(ni):
                    Y[a, q] = Vi[j, a, 0] * WL[i, 0, q] + Vi[j, a, 1] * WL[i, 1, q] + Vi[j, a, 2] * WL[i, 2, q]
            for q in range(ni):
                g[oi + q] -= WL[i, 0, q] * vh[0] + WL[i, 1, q] * vh[1] + WL[i, 2, q] * vh[2]
            for m in range(pc_ptr[j], pc_ptr[j + 1]):
                om = lens_at[pc_camera[m]]
                for q in range(ni):
                    for p in range(n_lens[pc_camera[m]]):
                        if om + p <= oi + q:
                            S[oi + q, om + p] -= WL[m, 0, p] * Y[0, q] + WL[m, 1, p] * Y[1, q] + WL[m, 2, p] * Y[2, q]
    return -1


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def pose_rows(
    run: IntArray, by_block: IntArray, by_ptr: IntArray, ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray,
    point_of: IntArray, block: IntArray, camera_of: IntArray, n_lens: IntArray, lens_at: IntArray, first_pose: int,
    A: FloatArray, Vi: FloatArray, W: FloatArray, WL: FloatArray, S: FloatArray,
) -> None:  # fmt: skip
    """Rows of S, up to the diagonal block, of the poses of the blocks in ``run``: from the reduced points alone.

    Image by image, so that what is written stays in the fastest cache; 6 x 6 by hand, so that it is vectorised.
    """
    T = np.empty((S.shape[0], 6))
    for b in run:
        o = first_pose + 6 * b
        T[: o + 6] = 0.0
        for i in range(by_ptr[b], by_ptr[b + 1]):
            k = by_block[i]
            j = point_of[k]
            v00, v01, v02 = Vi[j, 0, 0], Vi[j, 0, 1], Vi[j, 0, 2]
            v11, v12, v22 = Vi[j, 1, 1], Vi[j, 1, 2], Vi[j, 2, 2]
            y00, y01, y02, y03, y04, y05 = _combine(v00, v01, v02, W, k)
            y10, y11, y12, y13, y14, y15 = _combine(v01, v11, v12, W, k)
            y20, y21, y22, y23, y24, y25 = _combine(v02, v12, v22, W, k)
            for m in range(ptr[j], ptr[j + 1]):
                if block[m] > b:
                    continue
                at = first_pose + 6 * block[m]
                for q in range(6):
                    w0, w1, w2, r = W[m, 0, q], W[m, 1, q], W[m, 2, q], at + q
                    T[r, 0] -= w0 * y00 + w1 * y10 + w2 * y20
                    T[r, 1] -= w0 * y01 + w1 * y11 + w2 * y21
                    T[r, 2] -= w0 * y02 + w1 * y12 + w2 * y22
                    T[r, 3] -= w0 * y03 + w1 * y13 + w2 * y23
                    T[r, 4] -= w0 * y04 + w1 * y14 + w2 * y24
                    T[r, 5] -= w0 * y05 + w1 * y15 + w2 * y25
            for n in range(pc_ptr[j], pc_ptr[j + 1]):
                at = lens_at[pc_camera[n]]
                for q in range(n_lens[pc_camera[n]]):
                    w0, w1, w2, r = WL[n, 0, q], WL[n, 1, q], WL[n, 2, q], at + q
                    T[r, 0] -= w0 * y00 + w1 * y10 + w2 * y20
                    T[r, 1] -= w0 * y01 + w1 * y11 + w2 * y21
                    T[r, 2] -= w0 * y02 + w1 * y12 + w2 * y22
                    T[r, 3] -= w0 * y03 + w1 * y13 + w2 * y23
                    T[r, 4] -= w0 * y04 + w1 * y14 + w2 * y24
                    T[r, 5] -= w0 * y05 + w1 * y15 + w2 * y25
            at = lens_at[camera_of[k]]
            for s in range(2):
                for q in range(n_lens[camera_of[k]]):
                    for p in range(6):
                        T[at + q, p] += A[k, s, q] * A[k, s, MAX_LENS + p]
                for q in range(6):
                    for p in range(6):
                        T[o + q, p] += A[k, s, MAX_LENS + q] * A[k, s, MAX_LENS + p]
        for p in range(6):
            for c in range(o + 6):
                S[o + p, c] += T[c, p]


@njit(cache=True, nogil=True, error_model="numpy", inline="always")
def _combine(
    a: float, b: float, c: float, W: FloatArray, k: int
) -> tuple[float, float, float, float, float, float]:  # fmt: skip
    return (
        a * W[k, 0, 0] + b * W[k, 1, 0] + c * W[k, 2, 0],
        a * W[k, 0, 1] + b * W[k, 1, 1] + c * W[k, 2, 1],
        a * W[k, 0, 2] + b * W[k, 1, 2] + c * W[k, 2, 2],
        a * W[k, 0, 3] + b * W[k, 1, 3] + c * W[k, 2, 3],
        a * W[k, 0, 4] + b * W[k, 1, 4] + c * W[k, 2, 4],
        a * W[k, 0, 5] + b * W[k, 1, 5] + c * W[k, 2, 5],
    )


@njit(cache=True, nogil=True, error_model="numpy")
def fill_upper(S: FloatArray) -> None:
    """Copy the lower triangle of S (n, n) to the upper one, in squares that stay in the cache."""
    n, side = S.shape[0], 32
    for i0 in range(0, n, side):
        for j0 in range(0, i0 + 1, side):
            for i in range(i0, min(n, i0 + side)):
                for j in range(j0, min(i, j0 + side)):
                    S[j, i] = S[i, j]


@njit(cache=True, nogil=True, error_model="numpy")
def symmetric_rows(S: FloatArray, rows_of: IntArray, out: FloatArray) -> None:
    """Rows of a symmetric S of which only the lower triangle is there, out (r, n)."""
    for i in range(rows_of.size):
        a = rows_of[i]
        for c in range(S.shape[0]):
            out[i, c] = S[a, c] if c <= a else S[c, a]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def between_poses(S: FloatArray, at: IntArray, J: FloatArray, transpose: bool, lower: bool, out: FloatArray) -> None:
    """Blocks out[6a.., 6b..] of J_a' S J_b (``transpose``), S at rows at[a], at[b]: its lower triangle, a >= b.

    Else the other way: out at at[a], at[b] of J_a S J_b', S at 6a, 6b. lower: only that of out, not mirrored.
    """
    M, K, C = np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    for a in range(at.size):
        for b in range(a + 1):
            r, c = (at[a], at[b]) if transpose else (6 * a, 6 * b)
            r_out, c_out = (6 * a, 6 * b) if transpose else (at[a], at[b])
            for p in range(6):
                for q in range(6):
                    if transpose and c > r:
                        M[p, q] = S[c + q, r + p]
                    else:
                        M[p, q] = S[r + p, c + q]
            if transpose:
                for p in range(6):
                    for q in range(6):
                        K[p, q] = J[a, 0, p] * M[0, q]
                    for i in range(1, 6):
                        for q in range(6):
                            K[p, q] += J[a, i, p] * M[i, q]
                for p in range(6):
                    for q in range(6):
                        C[p, q] = K[p, 0] * J[b, 0, q]
                    for i in range(1, 6):
                        for q in range(6):
                            C[p, q] += K[p, i] * J[b, i, q]
            else:
                for p in range(6):
                    for q in range(6):
                        K[p, q] = J[a, p, 0] * M[0, q]
                    for i in range(1, 6):
                        for q in range(6):
                            K[p, q] += J[a, p, i] * M[i, q]
                for p in range(6):
                    for q in range(6):
                        C[p, q] = K[p, 0] * J[b, q, 0]
                    for i in range(1, 6):
                        for q in range(6):
                            C[p, q] += K[p, i] * J[b, q, i]
            for p in range(6):
                for q in range(6):
                    out[r_out + p, c_out + q] = C[p, q]
            if not lower and a != b:
                for q in range(6):
                    for p in range(6):
                        out[c_out + q, r_out + p] = C[p, q]


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
def of_points(
    ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray, camera_of: IntArray, n_lens: IntArray, lens_at: IntArray,
    pose_at: IntArray, W: FloatArray, WL: FloatArray, v: FloatArray, out: FloatArray,
) -> None:  # fmt: skip
    """Subtract W' v from ``out`` (n_local, k), for v (P, 3, k): what reduced points carry over to the others."""
    for j in range(ptr.size - 1):
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            o = lens_at[pc_camera[i]]
            for q in range(n_lens[pc_camera[i]]):
                for c in range(out.shape[1]):
                    out[o + q, c] -= WL[i, 0, q] * v[j, 0, c] + WL[i, 1, q] * v[j, 1, c] + WL[i, 2, q] * v[j, 2, c]
        for k in range(ptr[j], ptr[j + 1]):
            o = pose_at[k]
            for q in range(6):
                for c in range(out.shape[1]):
                    out[o + q, c] -= W[k, 0, q] * v[j, 0, c] + W[k, 1, q] * v[j, 1, c] + W[k, 2, q] * v[j, 2, c]
