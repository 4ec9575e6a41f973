"""From required navigation precision back to tolerances: where the error of a pose comes from, what each may be.

A pose from the spots of an epoch by least squares with equal weights is wrong by ``-G (n + F_c c + F_b b)`` with
``G = inv(H'H) H'``: n the noise of the spots, c that of the cameras' poses on the head, b of the beacons. With equal
independent sigmas within each source its covariance is ``sum_s sigma_s^2 C_s``, exactly additive to first order. A
pose that is weighted by all covariances, as navigation does it, is never worse.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from gtsam import Pose3

from adjust.lenses.models import MODELS, lens_derivatives
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, IntArray
from adjust.navigation.model import Beacons, Head
from adjust.navigation.system import make_system, visible
from adjust.spatial.rigid import rotation_exp, rotation_log, skew

SOURCES = ("spots", "beacons", "camera positions", "camera attitudes")
UNITS = ("px", "m", "m", "rad")
_ITERATIONS = 8
_OPEN = 1e-9


@dataclass(frozen=True, eq=False)
class PoseBudget:
    """What each source does to the poses: ``unit`` (q, 4, 6) variances per unit variance of the source.

    Components are rotation (rad), translation (m) in the head's frame; sources in the order of ``SOURCES``.
    """

    head: Head
    poses: tuple[Pose3, ...]
    x_in_world: FloatArray
    unit: FloatArray
    full: FloatArray

    def variances(self, sigmas: FloatArray) -> FloatArray:
        """(q, 6) with these sigmas (4,) of the sources."""
        return np.asarray(np.einsum("s,qsi->qi", np.asarray(sigmas) ** 2, self.unit))

    def covariances(self, sigmas: FloatArray) -> FloatArray:
        """(q, 6, 6)."""
        return np.asarray(np.einsum("s,qsij->qij", np.asarray(sigmas) ** 2, self.full))


@dataclass(frozen=True)
class PoseTolerance:
    """Sigma a source may have, px, m or rad.

    alone: all others exact; beside: the others as planned, nan where those are too much already; shared: every source
    takes an equal share of the required variance.
    """

    source: str
    unit: str
    alone: float
    beside: float
    shared: float


def pose_budget(head: Head, beacons: Beacons, poses: Sequence[Pose3]) -> PoseBudget:
    """Propagate unit errors of every source at poses ``world_from_station``. Raises SurveyError for an open pose."""
    system = make_system(head, beacons)
    full = np.empty((len(poses), len(SOURCES), 6, 6))
    for k, pose in enumerate(poses):
        camera, beacon = (a.astype(np.int64) for a in np.nonzero(visible(system, pose.matrix())))
        H, parts = np.zeros((0, 6)), list[FloatArray]()
        if len(camera):
            H, *parts = _jacobians(head, pose.matrix(), camera, beacon, np.asarray(beacons.x_in_world))
        N = H.T @ H
        scale = np.sqrt(np.diag(N)) + 1e-300
        if len(H) < 6 or np.linalg.eigvalsh(N / np.outer(scale, scale))[0] < _OPEN:
            raise SurveyError(
                f"pose {k + 1} sees {len(set(beacon.tolist()))} beacons, which do not determine it; place more "
                "(labsurvey plan FOLDER --place), or leave the pose out"
            )
        G = np.linalg.solve(N, H.T)
        full[k] = [G @ F @ F.T @ G.T for F in (np.eye(len(H)), *parts)]
    unit = np.diagonal(full, axis1=2, axis2=3).copy()
    return PoseBudget(head, tuple(poses), np.asarray(beacons.x_in_world), unit, full)


def pose_tolerances(
    found: PoseBudget, required: FloatArray, planned: FloatArray
) -> tuple[PoseTolerance, ...]:
    """Tolerances that keep every component (6,) of every pose within ``required`` (rad, m); planned: sigmas (4,)."""
    limit = np.asarray(required)[None] ** 2
    now = np.asarray(planned)[None, :, None] ** 2 * found.unit
    out = []
    for s, (source, unit) in enumerate(zip(SOURCES, UNITS, strict=True)):
        own = found.unit[:, s]
        alone = float(np.sqrt((limit / own).min()))
        rest = float(((limit - (now.sum(axis=1) - now[:, s])) / own).min())
        beside = float(np.sqrt(rest)) if rest > 0 else float("nan")
        out.append(PoseTolerance(source, unit, alone, beside, alone / np.sqrt(len(SOURCES))))
    return tuple(out)


def simulate_poses(found: PoseBudget, sigmas: FloatArray, n_trials: int, seed: int = 0) -> FloatArray:
    """Errors (q, t, 6) of poses solved anew from spots of disturbed cameras and beacons, the exact model throughout."""
    out = np.empty((len(found.poses), n_trials, 6))
    system = make_system(found.head, _exact(found.x_in_world))
    for k, pose in enumerate(found.poses):
        rng = np.random.default_rng([seed, k])
        camera, beacon = (a.astype(np.int64) for a in np.nonzero(visible(system, pose.matrix())))
        spots = _disturbed_spots(found, pose.matrix(), camera, beacon, sigmas, n_trials, rng)
        out[k] = _solved(found, pose.matrix(), camera, beacon, spots)
    return out


def _exact(x: FloatArray) -> Beacons:
    return Beacons(tuple(f"b{i}" for i in range(len(x))), x, np.zeros((3 * len(x),) * 2))


def _jacobians(
    head: Head, pose: FloatArray, camera: IntArray, beacon: IntArray, x: FloatArray
) -> tuple[FloatArray, ...]:
    """Derivatives of the spots (2n,) by the pose (6), by beacons (3m), camera positions (3c), camera attitudes (3c)."""
    n, m, c = len(camera), len(x), len(head.cameras)
    R, t = pose[:3, :3], pose[:3, 3]
    H, by_b = np.zeros((n, 2, 6)), np.zeros((n, 2, 3 * m))
    by_p, by_a = np.zeros((n, 2, 3 * c)), np.zeros((n, 2, 3 * c))
    for k, own in enumerate(head.cameras):
        rows = np.flatnonzero(camera == k)
        if not len(rows):
            continue
        Rc, tc = own.station_from_camera.rotation().matrix(), own.station_from_camera.translation()
        q = (x[beacon[rows]] - t) @ R
        p = (q - tc) @ Rc
        by_x = lens_derivatives(MODELS[own.model], own.lens, own.constants, p, np.zeros((len(rows), 2)))[2]
        by_q = by_x @ Rc.T
        H[rows] = np.concatenate([by_q @ skew(q), -by_q], axis=2)
        for i, row in enumerate(rows):
            b = 3 * int(beacon[row])
            by_b[row, :, b : b + 3] = by_q[i] @ R.T
        by_p[rows, :, 3 * k : 3 * k + 3] = -by_q
        by_a[rows, :, 3 * k : 3 * k + 3] = by_x @ skew(p)
    return tuple(a.reshape(2 * n, -1) for a in (H, by_b, by_p, by_a))


def _disturbed_spots(
    found: PoseBudget, pose: FloatArray, camera: IntArray, beacon: IntArray, sigmas: FloatArray, t: int,
    rng: np.random.Generator,
) -> FloatArray:  # fmt: skip
    """Spots (t, n, 2) px that disturbed cameras see of disturbed beacons, with noise."""
    spot, place, position, attitude = np.asarray(sigmas).tolist()
    x = found.x_in_world + place * rng.standard_normal((t, *found.x_in_world.shape))
    q = (x[:, beacon] - pose[:3, 3]) @ pose[:3, :3]
    out = spot * rng.standard_normal((t, len(camera), 2))
    for k, own in enumerate(found.head.cameras):
        shift, turn = position * rng.standard_normal((t, 3)), attitude * rng.standard_normal((t, 3))
        rows = np.flatnonzero(camera == k)
        R = own.station_from_camera.rotation().matrix() @ rotation_exp(turn)
        centred = q[:, rows] - (own.station_from_camera.translation() + shift)[:, None]
        p = np.einsum("tnj,tjk->tnk", centred, R)
        out[:, rows] += _images(found.head, k, p)
    return np.asarray(out)


def _images(head: Head, k: int, p: FloatArray) -> FloatArray:
    own = head.cameras[k]
    flat = p.reshape(-1, 3)
    uv = lens_derivatives(MODELS[own.model], own.lens, own.constants, flat, np.zeros((len(flat), 2)))[0]
    return np.asarray(uv.reshape(*p.shape[:-1], 2))


def _solved(
    found: PoseBudget, pose: FloatArray, camera: IntArray, beacon: IntArray, spots: FloatArray
) -> FloatArray:
    """Errors (t, 6) of least-squares poses, all trials side by side, from the true pose on by Gauss-Newton."""
    n_trials = len(spots)
    R, t = np.tile(pose[:3, :3], (n_trials, 1, 1)), np.tile(pose[:3, 3], (n_trials, 1))
    for _ in range(_ITERATIONS):
        residual, H = np.zeros(spots.shape), np.zeros((*spots.shape, 6))
        for k, own in enumerate(found.head.cameras):
            rows = np.flatnonzero(camera == k)
            if not len(rows):
                continue
            Rc, tc = own.station_from_camera.rotation().matrix(), own.station_from_camera.translation()
            q = np.einsum("tnj,tjk->tnk", found.x_in_world[beacon[rows]][None] - t[:, None], R)
            p = ((q - tc) @ Rc).reshape(-1, 3)
            uv, _, by_x = lens_derivatives(
                MODELS[own.model], own.lens, own.constants, p, spots[:, rows].reshape(-1, 2).copy()
            )
            by_q = by_x @ Rc.T
            residual[:, rows] = uv.reshape(n_trials, len(rows), 2)
            both = np.concatenate([by_q @ skew(q.reshape(-1, 3)), -by_q], axis=2)
            H[:, rows] = both.reshape(n_trials, len(rows), 2, 6)
        A = H.reshape(n_trials, -1, 6)
        AT = A.transpose(0, 2, 1)
        step = -np.linalg.solve(AT @ A, AT @ residual.reshape(n_trials, -1, 1))[..., 0]
        t = t + np.einsum("tij,tj->ti", R, step[:, 3:])
        R = R @ rotation_exp(step[:, :3])
    turn = rotation_log(pose[:3, :3].T @ R)
    return np.concatenate([turn, (t - pose[:3, 3]) @ pose[:3, :3]], axis=1)
