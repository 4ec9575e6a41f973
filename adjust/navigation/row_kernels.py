"""Residuals of spots against beacons and their derivatives, compiled: the one equation of navigation.

``pixel = lens(camera_from_station * station_from_world * x_in_world)``; residuals are predicted minus observed, px.
Derivatives by poses are in GTSAM's tangent (rotation, translation, in the frame on the right).
"""

# mypy: disable-error-code="untyped-decorator"
# reason: numba ships no types, so its decorator leaves every function below untyped

import numpy as np
from numba import njit

from adjust.lens_kernels import MAX_LENS, N_COLUMNS, lens_row
from adjust.model import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def spot_rows(
    R: FloatArray, t: FloatArray, camera: IntArray, beacon: IntArray, uv: FloatArray, kinds: IntArray,
    lenses: FloatArray, constants: FloatArray, camera_R: FloatArray, camera_t: FloatArray, x_in_world: FloatArray,
    lens_at: IntArray, n_lens: IntArray, beacon_at: int, F: FloatArray,
    residual: FloatArray, H: FloatArray, M: FloatArray,
) -> bool:  # fmt: skip
    """Fill residual (2n,), H (2n, 6) by ``world_from_station`` and M (2n, r) by the unit errors of the calibration.

    R, t: world_from_station. camera, beacon: (n,) positions. F (p + 3m, r): square root of the covariance of cameras
    (lens, then pose, from row ``lens_at``) and beacons (from row ``beacon_at``). Returns whether all beacons lie in
    front of their cameras (a fisheye sees behind itself).
    """
    r = F.shape[1]
    row = np.zeros((2, N_COLUMNS))
    q, p = np.empty(3), np.empty(3)
    by_station, by_camera, by_beacon = np.empty((3, 6)), np.empty((3, 6)), np.empty((3, 3))
    in_front = True
    M[:] = 0.0
    for i in range(camera.size):
        c, b = camera[i], beacon[i]
        for a in range(3):
            q[a] = 0.0
            for k in range(3):
                q[a] += R[k, a] * (x_in_world[b, k] - t[k])
        for a in range(3):
            p[a] = 0.0
            for k in range(3):
                p[a] += camera_R[c, k, a] * (q[k] - camera_t[c, k])
        if kinds[c] != 1 and p[2] <= 0.0:
            in_front = False
        row[:] = 0.0
        residual[2 * i], residual[2 * i + 1] = lens_row(
            kinds[c], lenses[c], constants[c], p[0], p[1], p[2], uv[i, 0], uv[i, 1], row
        )
        _by_pose(p, by_camera)
        for a in range(3):
            for j in range(3):
                turn, shift, world = 0.0, 0.0, 0.0
                for k in range(3):
                    # d q = skew(q) w - v, then into the camera
                    turn += camera_R[c, k, a] * _skew(q, k, j)
                    world += camera_R[c, k, a] * R[j, k]
                shift = -camera_R[c, j, a]
                by_station[a, j], by_station[a, 3 + j], by_beacon[a, j] = turn, shift, world
        first, at_beacon = lens_at[c], beacon_at + 3 * b
        for e in range(2):
            d = row[e, MAX_LENS:]
            for j in range(6):
                H[2 * i + e, j] = d[0] * by_station[0, j] + d[1] * by_station[1, j] + d[2] * by_station[2, j]
            for j in range(n_lens[c]):
                if row[e, j] != 0.0:
                    for k in range(r):
                        M[2 * i + e, k] += row[e, j] * F[first + j, k]
            for j in range(6):
                value = d[0] * by_camera[0, j] + d[1] * by_camera[1, j] + d[2] * by_camera[2, j]
                for k in range(r):
                    M[2 * i + e, k] += value * F[first + n_lens[c] + j, k]
            for j in range(3):
                value = d[0] * by_beacon[0, j] + d[1] * by_beacon[1, j] + d[2] * by_beacon[2, j]
                for k in range(r):
                    M[2 * i + e, k] += value * F[at_beacon + j, k]
    return in_front


@njit(cache=True, nogil=True, error_model="numpy")
def _skew(q: FloatArray, i: int, j: int) -> float:
    """Element of the cross-product matrix of q."""
    if i == j:
        return 0.0
    k = 3 - i - j
    return float(-q[k] if (j - i) % 3 == 1 else q[k])


@njit(cache=True, nogil=True, error_model="numpy")
def _by_pose(p: FloatArray, out: FloatArray) -> None:
    """Derivative (3, 6) of ``inverse(pose) * x`` by the pose, p being the result."""
    for i in range(3):
        for j in range(3):
            out[i, j] = _skew(p, i, j)
            out[i, 3 + j] = -1.0 if i == j else 0.0
