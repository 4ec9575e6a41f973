"""Covariances of the points that a bundle has reduced, and what their observations lose to the adjustment.

With Y = -V^-1 W of a reduced point: Q_XX = V^-1 + Y Q Y', Q_Xc = Y Q, for Q of lenses and poses (Triggs et al. 2000).
"""

import numpy as np

from adjust.compiling import njit
from adjust.lens_kernels import MAX_LENS
from adjust.model import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def point_from_local(
    ptr: IntArray, pc_ptr: IntArray, Vi: FloatArray, W: FloatArray, WL: FloatArray, Y: FloatArray, YL: FloatArray
) -> None:
    """-V^-1 W by poses, Y (K, 3, 6), and by lenses, YL (point-cameras, 3, MAX_LENS)."""
    for j in range(ptr.size - 1):
        for k in range(ptr[j], ptr[j + 1]):
            for a in range(3):
                for q in range(6):
                    Y[k, a, q] = -(Vi[j, a, 0] * W[k, 0, q] + Vi[j, a, 1] * W[k, 1, q] + Vi[j, a, 2] * W[k, 2, q])
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            for a in range(3):
                for q in range(MAX_LENS):
                    YL[i, a, q] = -(Vi[j, a, 0] * WL[i, 0, q] + Vi[j, a, 1] * WL[i, 1, q] + Vi[j, a, 2] * WL[i, 2, q])


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def with_poses(
    run: IntArray, by_block: IntArray, by_ptr: IntArray, ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray,
    point_of: IntArray, block: IntArray, n_lens: IntArray, lens_at: IntArray, first_pose: int, Q: FloatArray,
    Y: FloatArray, YL: FloatArray, B: FloatArray,
) -> None:  # fmt: skip
    """Covariance B (K, 3, 6) of every observation's reduced point with its pose, for the blocks in ``run``.

    Image by image, so that the columns of Q stay in the cache.
    """
    n = Q.shape[0]
    P = np.empty((n, 6))
    for b in run:
        o = first_pose + 6 * b
        for q in range(6):
            for r in range(n):
                P[r, q] = Q[o + q, r]
        for i in range(by_ptr[b], by_ptr[b + 1]):
            k = by_block[i]
            j = point_of[k]
            for a in range(3):
                s0, s1, s2, s3, s4, s5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
                for m in range(ptr[j], ptr[j + 1]):
                    at = first_pose + 6 * block[m]
                    for q in range(6):
                        y, r = Y[m, a, q], at + q
                        s0 += y * P[r, 0]
                        s1 += y * P[r, 1]
                        s2 += y * P[r, 2]
                        s3 += y * P[r, 3]
                        s4 += y * P[r, 4]
                        s5 += y * P[r, 5]
                for c in range(pc_ptr[j], pc_ptr[j + 1]):
                    at = lens_at[pc_camera[c]]
                    for q in range(n_lens[pc_camera[c]]):
                        y, r = YL[c, a, q], at + q
                        s0 += y * P[r, 0]
                        s1 += y * P[r, 1]
                        s2 += y * P[r, 2]
                        s3 += y * P[r, 3]
                        s4 += y * P[r, 4]
                        s5 += y * P[r, 5]
                B[k, a, 0], B[k, a, 1], B[k, a, 2] = s0, s1, s2
                B[k, a, 3], B[k, a, 4], B[k, a, 5] = s3, s4, s5


@njit(cache=True, nogil=True, error_model="numpy")
def with_lenses(
    ptr: IntArray, pc_ptr: IntArray, pc_camera: IntArray, n_lens: IntArray, lens_at: IntArray, pose_at: IntArray,
    Vi: FloatArray, Q: FloatArray, Y: FloatArray, YL: FloatArray, B: FloatArray, BL: FloatArray, C: FloatArray,
) -> None:  # fmt: skip
    """Covariance BL (point-cameras, 3, MAX_LENS) of reduced points with lenses, and their own C (P, 3, 3)."""
    for j in range(ptr.size - 1):
        C[j] = Vi[j]
        for i in range(pc_ptr[j], pc_ptr[j + 1]):
            at = lens_at[pc_camera[i]]
            for p in range(n_lens[pc_camera[i]]):
                for a in range(3):
                    v = 0.0
                    for m in range(ptr[j], ptr[j + 1]):
                        for q in range(6):
                            v += Y[m, a, q] * Q[at + p, pose_at[m] + q]
                    for m in range(pc_ptr[j], pc_ptr[j + 1]):
                        for q in range(n_lens[pc_camera[m]]):
                            v += YL[m, a, q] * Q[at + p, lens_at[pc_camera[m]] + q]
                    BL[i, a, p] = v
                for a in range(3):
                    for c in range(3):
                        C[j, a, c] += BL[i, a, p] * YL[i, c, p]
        for m in range(ptr[j], ptr[j + 1]):
            for a in range(3):
                for c in range(3):
                    v = 0.0
                    for q in range(6):
                        v += B[m, a, q] * Y[m, c, q]
                    C[j, a, c] += v


@njit(cache=True, nogil=True, error_model="numpy")
def reduced_influence(
    run: IntArray, by_block: IntArray, by_ptr: IntArray, point_of: IntArray, pc_of: IntArray, camera_of: IntArray,
    n_lens: IntArray, lens_at: IntArray, first_pose: int, A: FloatArray, Q: FloatArray, B: FloatArray, BL: FloatArray,
    C: FloatArray, influence: FloatArray,
) -> None:  # fmt: skip
    """Whitened A Q A' (K, 3) of observations of reduced points; A: rows whitened as if all were used."""
    joint, t = np.empty((MAX_LENS + 9, MAX_LENS + 9)), np.empty((2, MAX_LENS + 9))
    r = np.empty((2, MAX_LENS + 9))
    for b in run:
        if by_ptr[b] == by_ptr[b + 1]:
            continue
        camera = camera_of[by_block[by_ptr[b]]]
        nl, at, o = n_lens[camera], lens_at[camera], first_pose + 6 * b
        n = nl + 6
        for p in range(n):
            row = at + p if p < nl else o + p - nl
            for q in range(nl):
                joint[p, q] = Q[row, at + q]
            for q in range(6):
                joint[p, nl + q] = Q[row, o + q]
        for i in range(by_ptr[b], by_ptr[b + 1]):
            k = by_block[i]
            j, c = point_of[k], pc_of[k]
            for a in range(3):
                for q in range(nl):
                    joint[n + a, q] = joint[q, n + a] = BL[c, a, q]
                for q in range(6):
                    joint[n + a, nl + q] = joint[nl + q, n + a] = B[k, a, q]
                for q in range(3):
                    joint[n + a, n + q] = C[j, a, q]
            for s in range(2):
                for q in range(nl):
                    r[s, q] = A[k, s, q]
                for q in range(6):
                    r[s, nl + q] = A[k, s, MAX_LENS + q]
                for q in range(3):
                    r[s, n + q] = A[k, s, MAX_LENS + 3 + q]
                for q in range(n + 3):
                    t[s, q] = 0.0
                for p in range(n + 3):
                    x = r[s, p]
                    for q in range(n + 3):
                        t[s, q] += x * joint[p, q]
            v0, v1, v2 = 0.0, 0.0, 0.0
            for q in range(n + 3):
                v0 += t[0, q] * r[0, q]
                v1 += t[0, q] * r[1, q]
                v2 += t[1, q] * r[1, q]
            influence[k, 0], influence[k, 1], influence[k, 2] = v0, v1, v2


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
