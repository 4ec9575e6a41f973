"""From required navigation precision back to tolerances: where the error of a pose comes from, what each may be.

A pose from the spots of an epoch by least squares with equal weights is wrong by ``-G (n + F_c c + F_b b)`` with
``G = inv(H'H) H'``: n the noise of the spots, c that of the cameras' poses on the head, b of the beacons. With equal
independent sigmas within each source its covariance is ``sum_s sigma_s^2 C_s``, exactly additive to first order. A
pose that is weighted by all covariances, as navigation does it, is never worse.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3

from adjust.lenses.compared import motion_derivatives
from adjust.lenses.models import MODELS, lens_derivatives, lens_residuals
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.navigation.fit import local
from adjust.navigation.model import Beacons, Head
from adjust.navigation.system import evaluate, in_view, make_system
from adjust.spatial.rigid import rigid, rotation_exp, transform

SOURCES = ("spots", "beacons", "camera positions", "camera attitudes")
UNITS = ("px", "m", "m", "rad")
_OPEN = 1e-9
_STEPS, _SETTLED = 20, 1e-6  # px, of all spots of a pose


@frozen(eq=False)
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


@frozen
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
    x = np.asarray(beacons.x_in_world)
    system = make_system(*_with_errors(head, x, 1.0))
    full = np.empty((len(poses), len(SOURCES), 6, 6))
    for k, pose in enumerate(poses):
        camera, beacon = in_view(system, pose.matrix())
        _, H, M = evaluate(system, pose.matrix(), camera, beacon)
        N = H.T @ H
        scale = np.sqrt(np.diag(N)) + 1e-300
        if len(H) < 6 or np.linalg.eigvalsh(N / np.outer(scale, scale))[0] < _OPEN:
            raise SurveyError(
                f"pose {k + 1} sees {len(set(beacon.tolist()))} beacons, which do not determine it; place more "
                "(labsurvey plan FOLDER --place), or leave the pose out"
            )
        G = np.linalg.solve(N, H.T)
        by = M @ system.F_inverse  # derivatives by the calibration, then by the beacons
        turns = (system.arrays.lens_at + system.arrays.n_lens)[:, None] + np.arange(3)
        parts = (np.eye(len(H)), by[:, system.arrays.beacon_at :], by[:, (turns + 3).ravel()], by[:, turns.ravel()])
        full[k] = [G @ F @ F.T @ G.T for F in parts]
    unit = np.diagonal(full, axis1=2, axis2=3).copy()
    return PoseBudget(head, tuple(poses), x, unit, full)


def _with_errors(head: Head, x: FloatArray, sigma: float) -> tuple[Head, Beacons]:
    """With this sigma (rad, m) of each component of the cameras' poses and of the beacons, and no other error."""
    variances = [np.concatenate([np.zeros(len(c.lens)), np.full(6, sigma**2)]) for c in head.cameras]
    table = np.zeros(len(head.cov) - sum(map(len, variances)))
    cov = np.diag(np.concatenate([*variances, table]))
    return replace(head, cov=cov), Beacons(tuple(f"b{i}" for i in range(len(x))), x, sigma**2 * np.eye(3 * len(x)))


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
    """Errors (q, t, 6) of poses solved anew from spots of disturbed cameras and beacons, the exact model throughout.

    Raises SurveyError where the spots of a trial lead to no pose.
    """
    out = np.empty((len(found.poses), n_trials, 6))
    system = make_system(*_with_errors(found.head, found.x_in_world, 0.0))
    for k, pose in enumerate(found.poses):
        rng, true = np.random.default_rng([seed, k]), pose.matrix()
        camera, beacon = in_view(system, true)
        spots = _disturbed_spots(found, true, camera, beacon, sigmas, n_trials, rng)
        solved = _solved(found.head, found.x_in_world[beacon], true, camera, spots)
        if solved is None:
            raise SurveyError(f"pose {k + 1}: spots with errors of these sizes lead to no pose; ask for less")
        out[k] = local(true, solved)
    return out


def _solved(
    head: Head, x: FloatArray, start: FloatArray, camera: IntArray, spots: FloatArray
) -> FloatArray | None:
    """Poses (t, 4, 4) by least squares of spots (t, n, 2) of points x (n, 3) with equal weights, all trials at once.

    By Gauss-Newton from one start (4, 4); None where the steps of any trial do not settle.
    """
    pose, t = np.tile(start, (len(spots), 1, 1)), len(spots)
    residual, H = np.empty(spots.shape), np.empty((*spots.shape, 6))
    for _ in range(_STEPS):
        q = (x - pose[:, None, :3, 3]) @ pose[:, :3, :3]
        for k, own in enumerate(head.cameras):
            rows = np.flatnonzero(camera == k)
            flat, camera_from_station = q[:, rows].reshape(-1, 3), own.station_from_camera.inverse().matrix()
            p, uv = transform(camera_from_station, flat), spots[:, rows].reshape(-1, 2)
            e, _, by_point = lens_derivatives(MODELS[own.model], own.lens, own.constants, p, uv)
            residual[:, rows] = e.reshape(t, -1, 2)
            H[:, rows] = -motion_derivatives(by_point @ camera_from_station[:3, :3], flat).reshape(t, -1, 2, 6)
        A = H.reshape(t, -1, 6)
        At = A.swapaxes(1, 2)
        step = -np.linalg.solve(At @ A, At @ residual.reshape(t, -1, 1))
        pose = pose @ rigid(rotation_exp(step[:, :3, 0]), step[:, 3:, 0])
        if np.linalg.norm(A @ step, axis=1).max() < _SETTLED:
            return pose
    return None


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
    uv = lens_residuals(MODELS[own.model], own.lens, own.constants, flat, np.zeros((len(flat), 2)))
    return np.asarray(uv.reshape(*p.shape[:-1], 2))
