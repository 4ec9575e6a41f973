"""Precision of a pose: what each source of error contributes, what stays open, and what to expect beforehand."""

from collections.abc import Sequence

import numpy as np
from gtsam import Pose3

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native import navigation as native
from adjust.navigation.fit import PoseFit, Prior, fit_pose
from adjust.navigation.model import Beacons, Head, Shares
from adjust.navigation.system import Sightings, System, evaluate, in_view, make_system, sightings_of

_OPEN = 1e-8  # of the largest eigenvalue of the scaled information


@frozen(eq=False)
class Expected:
    """What a pose would have: covariance (6, 6), shares, the beacons seen, and the open directions by name.

    redundancy: observations minus unknowns. cov has infinite variances where a direction is open.
    """

    world_from_station: Pose3
    cov: FloatArray
    shares: Shares | None
    beacon_ids: tuple[str, ...]
    redundancy: int
    undetermined: tuple[str, ...]


def shares(fit: PoseFit, system: System) -> Shares:
    """The covariance of a fit by source; the parts add up to it.

    Of a prior by motion the part that beacons and calibration had in it is counted with them.
    """
    n = 2 * len(fit.used)
    spots, prior = (fit.gain[:, k] @ fit.R[k, k] @ fit.gain[:, k].T for k in (slice(n), slice(n, None)))
    # B = S F with S (6, p + 3m) unknown where F is rank deficient: split by the rows of F through its pseudo-inverse
    S, at = fit.B @ system.F_inverse, system.arrays.beacon_at
    calibration, beacons = S[:, :at] @ system.F[:at], S[:, at:] @ system.F[at:]
    cross = calibration @ beacons.T
    return Shares(spots, beacons @ beacons.T, calibration @ calibration.T, prior, cross + cross.T)


def open_directions(
    seen: Sightings, used: IntArray, beacon: IntArray, pose: FloatArray, prior: Prior | None = None
) -> tuple[FloatArray, tuple[str, ...]]:
    """Covariance (6, 6) with infinite variances where observations leave a pose (4, 4) open, and those directions."""
    _, H, M = evaluate(seen.system, pose, seen.camera[used], beacon)
    N = H.T @ np.linalg.inv(seen.noise(used) + M @ M.T) @ H
    if prior is not None:
        rows = prior.rows
        N[np.ix_(rows, rows)] += np.linalg.inv(prior.total[np.ix_(rows, rows)])
    x = seen.system.beacons.x_in_world
    lever = float(np.linalg.norm(x - pose[:3, 3], axis=1).mean())
    scale = np.array([1.0 / lever] * 3 + [1.0] * 3)  # a turn of so much moves the beacons by a metre
    values, vectors = np.linalg.eigh(N * np.outer(scale, scale))
    is_open = values <= _OPEN * max(float(values[-1]), 1e-300)
    V = vectors[:, ~is_open] * scale[:, None]
    cov = (V / values[~is_open]) @ V.T
    null = vectors[:, is_open]
    touched = np.flatnonzero(np.sum(null**2, axis=1) > 1e-6)
    cov[touched], cov[:, touched] = 0.0, 0.0
    cov[touched, touched] = np.inf
    return cov, tuple(_named(v * scale, i + 1, null.shape[1]) for i, v in enumerate(_readable(null).T))


def _readable(null: FloatArray) -> FloatArray:
    """A basis of the same space with as many zeros as elimination gives, each vector of unit length."""
    basis = null.copy()
    for k in range(basis.shape[1]):
        row = int(np.argmax(np.abs(basis[:, k])))
        basis[:, k] /= basis[row, k]
        for j in range(basis.shape[1]):
            if j != k:
                basis[:, j] -= basis[row, j] * basis[:, k]
    size = np.linalg.norm(basis, axis=0)
    return np.asarray(basis / np.where(size > 0, size, 1.0))


def _named(direction: FloatArray, number: int, of: int) -> str:
    turn, shift = float(np.linalg.norm(direction[:3])), float(np.linalg.norm(direction[3:]))

    def vector(v: FloatArray) -> str:
        return "(" + " ".join(f"{c + 0.0:.2f}" for c in v / np.linalg.norm(v)) + ")"

    if turn < 1e-3 * shift:
        what = f"shift along {vector(direction[3:])}"
    elif shift < 1e-3 * turn:
        what = f"turn about {vector(direction[:3])}"
    else:
        per_degree = 1e3 * shift / np.degrees(turn)
        what = f"turn about {vector(direction[:3])} with a shift of {per_degree:.1f} mm/deg"
        what += f" along {vector(direction[3:])}"
    return f"open direction {number} of {of} (axes of the head): {what}"


def some_pose(seen: Sightings, used: IntArray, beacon: IntArray, start: FloatArray) -> FloatArray:
    """One of the many poses (4, 4) that explain too few spots, nearest to a start in a way."""
    pose, spots = np.empty((4, 4)), native.SpotArrays(seen.camera[used], beacon, seen.uv[used])
    native.some_pose(seen.system.arrays, np.ascontiguousarray(start), spots, pose)
    return pose


def expected_precision(
    head: Head, beacons: Beacons, poses: Sequence[Pose3], sigma_px: float
) -> tuple[Expected, ...]:
    """Precision at poses ``world_from_station`` before anything is measured, with all beacons in view."""
    system = make_system(head, beacons)
    return tuple(_expected(system, pose, sigma_px) for pose in poses)


def _expected(system: System, pose: Pose3, sigma_px: float) -> Expected:
    at, ids = pose.matrix(), system.beacons.beacon_ids
    camera, beacon = in_view(system, at)
    n = len(camera)
    seen = sightings_of(system, camera, beacon, evaluate(system, at, camera, beacon)[0].reshape(n, 2), sigma_px)
    names = tuple(ids[b] for b in np.unique(beacon).tolist())
    fit = fit_pose(seen, np.arange(n), beacon, at)
    if fit is None:
        cov, undetermined = open_directions(seen, np.arange(n), beacon, at)
        return Expected(pose, cov, None, names, 2 * n - 6, undetermined)
    return Expected(pose, fit.cov, shares(fit, system), names, fit.redundancy, ())
