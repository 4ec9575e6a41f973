"""Residuals of spots against beacons and their derivatives, compiled: the one equation of navigation.

``pixel = lens(camera_from_station * station_from_world * x_in_world)``; residuals are predicted minus observed, px.
Derivatives by poses are in GTSAM's tangent (rotation, translation, in the frame on the right).
"""

import numpy as np

from adjust.compiling import njit
from adjust.lens_kernels import MAX_LENS, N_COLUMNS, lens_row
from adjust.model import BoolArray, FloatArray, IntArray

# lens kinds, lenses, constants, camera_R, camera_t (station_from_camera), x_in_world, lens_at, n_lens, beacon_at, F
SystemArrays = tuple[
    IntArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, IntArray, IntArray, int, FloatArray
]


@njit(cache=True, nogil=True, error_model="numpy")
def spot_rows(
    system: SystemArrays, pose: FloatArray, camera: IntArray, beacon: IntArray, uv: FloatArray,
    residual: FloatArray, H: FloatArray, M: FloatArray,
) -> bool:  # fmt: skip
    """Fill residual (2n,), H (2n, 6) by ``world_from_station`` and M (2n, r) by the unit errors of the calibration.

    pose (4, 4): world_from_station. camera, beacon: (n,) positions. F (p + 3m, r): square root of the covariance of
    cameras (lens, then pose, from row ``lens_at``) and beacons (from row ``beacon_at``). Returns whether all beacons
    lie in front of their cameras (a fisheye sees behind itself).
    """
    kinds, lenses, constants, camera_R, camera_t, x_in_world, lens_at, n_lens, beacon_at, F = system
    r = F.shape[1]
    R, t = pose[:3, :3], pose[:3, 3]
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


@njit(cache=True, nogil=True, error_model="numpy")
def in_view(
    camera_R: FloatArray, camera_t: FloatArray, x_in_world: FloatArray, field: FloatArray, pose: FloatArray,
    margin: float, out: BoolArray,
) -> None:  # fmt: skip
    """Fill out (c, m): which beacons each camera has in its field, widened by a margin (tangent of an angle)."""
    q, w, p = np.empty(3), np.empty(3), np.empty(3)
    for b in range(x_in_world.shape[0]):
        for a in range(3):
            q[a] = 0.0
            for k in range(3):
                q[a] += pose[k, a] * (x_in_world[b, k] - pose[k, 3])
        for c in range(camera_R.shape[0]):
            for a in range(3):
                w[a] = q[a] - camera_t[c, a]
            for a in range(3):
                p[a] = camera_R[c, 0, a] * w[0] + camera_R[c, 1, a] * w[1] + camera_R[c, 2, a] * w[2]
            f = field[c]
            if f[4] < 1.5:
                out[c, b] = p[2] > (f[4] - margin) * np.sqrt(p[0] ** 2 + p[1] ** 2 + p[2] ** 2)
            else:
                x, y = p[0] / p[2], p[1] / p[2]
                out[c, b] = (
                    p[2] > 0.0 and f[0] - margin < x < f[1] + margin and f[2] - margin < y < f[3] + margin
                )


@njit(cache=True, nogil=True, error_model="numpy")
def gates(
    system: SystemArrays, pose: FloatArray, pose_cov: FloatArray, pose_B: FloatArray, camera: IntArray,
    uv: FloatArray, cov: FloatArray, ahead: BoolArray, distance: FloatArray, log_det: FloatArray,
) -> None:  # fmt: skip
    """Squared distance (n, m) in sigmas of spots from beacons at a pose of error ``e + B eta``; ln det(2 pi S).

    ahead (c, m): the others are infinitely far.
    """
    m, r = ahead.shape[1], pose_B.shape[1]
    beacon, zero = np.arange(m), np.zeros((m, 2))
    predicted, H, M = np.empty(2 * m), np.empty((2 * m, 6)), np.empty((2 * m, r))
    for c in range(ahead.shape[0]):
        if not np.any(camera == c):
            continue
        spot_rows(system, pose, np.full(m, c), beacon, zero, predicted, H, M)
        common = H @ pose_B + M
        by_pose = H @ pose_cov
        for b in range(m):
            base = by_pose[2 * b : 2 * b + 2] @ H[2 * b : 2 * b + 2].T
            base += common[2 * b : 2 * b + 2] @ common[2 * b : 2 * b + 2].T
            for i in range(camera.size):
                if camera[i] != c:
                    continue
                s, d, e = base[0, 0] + cov[i, 0, 0], base[1, 1] + cov[i, 1, 1], base[0, 1] + cov[i, 0, 1]
                det = s * d - e * e
                x, y = predicted[2 * b] - uv[i, 0], predicted[2 * b + 1] - uv[i, 1]
                distance[i, b] = (d * x * x - 2.0 * e * x * y + s * y * y) / det if ahead[c, b] else np.inf
                log_det[i, b] = np.log(4.0 * np.pi**2 * det)
