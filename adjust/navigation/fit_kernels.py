"""The pose of an epoch by Gauss-Newton, compiled; what it computes is said in ``adjust.navigation.fit``."""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray, IntArray
from adjust.navigation.pose_kernels import retracted, step_between, step_derivative
from adjust.navigation.row_kernels import SystemArrays, spot_rows

MAX_ITERATIONS = 30
_SETTLED = 1e-4
_WEAK = 1e-9
DONE, OPEN, UNSETTLED = 0, 1, 2


@njit(cache=True, nogil=True, error_model="numpy")
def _cholesky(A: FloatArray) -> bool:
    """Lower Cholesky factor in place; False where there is none."""
    n = A.shape[0]
    for j in range(n):
        s = A[j, j]
        for k in range(j):
            s -= A[j, k] * A[j, k]
        if not s > 0.0:
            return False
        pivot = np.sqrt(s)
        A[j, j] = pivot
        for i in range(j + 1, n):
            s = A[i, j]
            for k in range(j):
                s -= A[i, k] * A[j, k]
            A[i, j] = s / pivot
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _whitened(L: FloatArray, X: FloatArray) -> FloatArray:
    """``inv(L) X`` (n, m)."""
    out = X.copy()
    for i in range(out.shape[0]):
        for k in range(i):
            f = L[i, k]
            for j in range(out.shape[1]):
                out[i, j] -= f * out[k, j]
        for j in range(out.shape[1]):
            out[i, j] /= L[i, i]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _back(L: FloatArray, X: FloatArray) -> FloatArray:
    """``inv(L') X`` (n, m)."""
    out = X.copy()
    n = out.shape[0]
    for i in range(n - 1, -1, -1):
        for k in range(i + 1, n):
            f = L[k, i]
            for j in range(out.shape[1]):
                out[i, j] -= f * out[k, j]
        for j in range(out.shape[1]):
            out[i, j] /= L[i, i]
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def _rows(
    system: SystemArrays, pose: FloatArray, camera: IntArray, beacon: IntArray, uv: FloatArray,
    prior_pose: FloatArray, prior_B: FloatArray, prior_rows: IntArray,
    residual: FloatArray, H: FloatArray, M: FloatArray,
) -> bool:  # fmt: skip
    """Fill residual (n,), H (n, 6), M (n, r) of spots, then of the prior; whether all beacons are in front."""
    n, k = 2 * camera.size, prior_rows.size
    in_front = spot_rows(system, pose, camera, beacon, uv, residual[:n], H[:n], M[:n])
    if k:
        step = step_between(prior_pose, pose)
        J = step_derivative(step)
        for i in range(k):
            residual[n + i] = step[prior_rows[i]]
            H[n + i] = J[prior_rows[i]]
            M[n + i] = -prior_B[prior_rows[i]]
    return bool(in_front)


@njit(cache=True, nogil=True, error_model="numpy")
def _solved(
    R: FloatArray, residual: FloatArray, H: FloatArray, M: FloatArray, L: FloatArray, C: FloatArray, step: FloatArray
) -> bool:
    """Fill the factor L (n, n) of ``R + M M'``, covariance C (6, 6), step (6,); False where a direction is open."""
    L[:] = R + M @ M.T
    if not _cholesky(L):
        return False
    W = _whitened(L, H)
    normal = W.T @ W
    scale = np.empty(6)
    for i in range(6):
        scale[i] = 1.0 / np.sqrt(normal[i, i])
        if not (np.isfinite(scale[i]) and scale[i] > 0.0):
            return False
    scaled = np.empty((6, 6))
    for i in range(6):
        for j in range(6):
            scaled[i, j] = normal[i, j] * scale[i] * scale[j]
            if not np.isfinite(scaled[i, j]):
                return False
    values, vectors = np.linalg.eigh(scaled)
    if values[0] < _WEAK:
        return False
    for i in range(6):
        for j in range(6):
            s = 0.0
            for k in range(6):
                s += vectors[i, k] * vectors[j, k] / values[k]
            C[i, j] = s * scale[i] * scale[j]
    w = _whitened(L, residual.reshape(-1, 1))
    step[:] = -(C @ (W.T @ w))[:, 0]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _squares(L: FloatArray, residual: FloatArray) -> float:
    w = _whitened(L, residual.reshape(-1, 1))
    return float(np.sum(w * w))


@njit(cache=True, nogil=True, error_model="numpy")
def gauss_newton(
    system: SystemArrays, start: FloatArray, camera: IntArray, beacon: IntArray, uv: FloatArray, R: FloatArray,
    prior_pose: FloatArray, prior_B: FloatArray, prior_rows: IntArray, pose: FloatArray, residual: FloatArray,
    H: FloatArray, M: FloatArray, C: FloatArray, gain: FloatArray,
) -> tuple[int, bool, float, float, float]:  # fmt: skip
    """Fill pose (4, 4), residual (n,), H (n, 6), M (n, r), covariance C (6, 6) and gain (6, n) at the solution.

    R (n, n): covariance of spots and prior without the errors common to all epochs. Returns DONE, OPEN (a direction is)
    or UNSETTLED, whether all beacons are in front, v' inv(Sigma) v, ln det Sigma and ln det C.
    """
    n, r = M.shape
    L, step = np.empty((n, n)), np.empty(6)
    pose[:] = start
    in_front = _rows(system, pose, camera, beacon, uv, prior_pose, prior_B, prior_rows, residual, H, M)
    new, new_H, new_M = np.empty(n), np.empty((n, 6)), np.empty((n, r))
    converged = False
    for _ in range(MAX_ITERATIONS):
        if not _solved(R, residual, H, M, L, C, step):
            return OPEN, in_front, 0.0, 0.0, 0.0
        size = np.sqrt(_squares(L, H @ step))
        step *= min(1.0, 0.5 / max(np.sqrt(step[0] ** 2 + step[1] ** 2 + step[2] ** 2), 0.5))
        before, moved = _squares(L, residual), False
        for _ in range(6):
            trial = retracted(pose, step)
            front = _rows(system, trial, camera, beacon, uv, prior_pose, prior_B, prior_rows, new, new_H, new_M)
            if _squares(L, new) <= before * (1.0 + 1e-9) + 1e-9 and (front or not in_front):
                pose[:] = trial
                residual[:], H[:], M[:] = new, new_H, new_M
                in_front, moved = front, True
                break
            step *= 0.5
        if size < _SETTLED or not moved:
            converged = size < 1e-2
            break
    if not converged:
        return UNSETTLED, in_front, 0.0, 0.0, 0.0
    if not _solved(R, residual, H, M, L, C, step):
        return OPEN, in_front, 0.0, 0.0, 0.0
    gain[:] = -C @ _back(L, _whitened(L, H)).T
    log_det, log_det_C, root = 0.0, 0.0, C.copy()
    for i in range(n):
        log_det += 2.0 * np.log(L[i, i])
    if not _cholesky(root):
        return OPEN, in_front, 0.0, 0.0, 0.0
    for i in range(6):
        log_det_C += 2.0 * np.log(root[i, i])
    return DONE, in_front, _squares(L, residual), log_det, log_det_C


@njit(cache=True, nogil=True, error_model="numpy")
def some_pose(
    system: SystemArrays, start: FloatArray, camera: IntArray, beacon: IntArray, uv: FloatArray, pose: FloatArray
) -> None:
    """Fill pose (4, 4) with one of the many that explain too few spots, nearest to a start in a way (damped steps)."""
    n, r = 2 * camera.size, system[-1].shape[1]
    residual, H, M = np.empty(n), np.empty((n, 6)), np.empty((n, r))
    new, new_H = np.empty(n), np.empty((n, 6))
    damping = 1e-3
    pose[:] = start
    spot_rows(system, pose, camera, beacon, uv, residual, H, M)
    for _ in range(60):
        A = H @ H.T
        add = damping * np.trace(A) / n
        for i in range(n):
            A[i, i] += add
        if not _cholesky(A):
            return
        step = -(H.T @ _back(A, _whitened(A, residual.reshape(-1, 1))))[:, 0]
        step *= min(1.0, 0.3 / max(np.sqrt(np.sum(step * step)), 1e-12))
        trial = retracted(pose, step)
        in_front = spot_rows(system, trial, camera, beacon, uv, new, new_H, M)
        if in_front and np.sum(new * new) < np.sum(residual * residual):
            pose[:] = trial
            residual[:], H[:] = new, new_H
            damping *= 0.3
            if np.max(np.abs(residual)) < 1e-9:
                return
        else:
            damping *= 10.0
