"""The pose of an epoch from beacons in the core: rows, Gauss-Newton, minimal poses, hypotheses of names.

``pixel = lens(camera_from_station * station_from_world * x_in_world)``; residuals are predicted minus observed, px.
Derivatives by poses are in GTSAM's tangent. The formulas are in ``navigation.h``, ``minimal.h`` and ``search.h``.
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.library import Function

DONE, OPEN, UNSETTLED = 0, 1, 2
MAX_SOLUTIONS = 8
"""Poses that three rays to three points can have."""

_SYSTEM = (
    "kinds[c] lenses[c,14] constants[c,4] camera_R[c,3,3] camera_t[c,3] x_in_world[m,3] lens_at[c] n_lens[c] "
    "beacon_at F[*,r]"
)
_SPOTS = "camera[n] beacon[n] uv[n,2]"
_spot_rows = Function("spot_rows", f"{_SYSTEM} pose[4,4] {_SPOTS} residual[rows] H[rows,6] M[rows,r]")
_gauss_newton = Function(
    "gauss_newton",
    f"{_SYSTEM} start[4,4] {_SPOTS} R[k,k] prior_pose[4,4] prior_B[*,*] prior_rows[*] pose[4,4] residual[k] H[k,6] "
    "M[k,r] C[6,6] gain[6,k] numbers[4] work[*]",
)
_some_pose = Function("some_pose", f"{_SYSTEM} start[4,4] {_SPOTS} pose[4,4] work[*]")
_three_point_poses = Function("three_point_poses", "o[3,3] d[3,3] x[3,3] nearest farthest R[8,3,3] t[8,3]")
_search = Function(
    "search",
    "origin[n,3] ray[n,3] camera[n] allowed[n,m] x_in_world[m,3] camera_R[c,3,3] camera_t[c,3] field[c,5] gate "
    "named[n] missed[c] triples[*,3] nearest farthest most R[k,3,3] t[k,3] score[k] match[k,n] work[*] naming[n]",
)


class SystemArrays(NamedTuple):
    """The calibrated head and the beacons; F (p + 3m, r): square root of the covariance of both.

    The rows of F of camera c begin at ``lens_at[c]`` (lens, then pose), those of the beacons at ``beacon_at``.
    """

    kinds: IntArray
    lenses: FloatArray
    constants: FloatArray
    camera_R: FloatArray  # noqa: N815  matrices are capital letters
    camera_t: FloatArray
    x_in_world: FloatArray
    lens_at: IntArray
    n_lens: IntArray
    beacon_at: int
    F: FloatArray


class SpotArrays(NamedTuple):
    """Spots: camera (n,) and beacon (n,) by number, uv (n, 2) px."""

    camera: IntArray
    beacon: IntArray
    uv: FloatArray


class SkyArrays(NamedTuple):
    """What a naming is searched among: rays of the spots in the station, the beacons ``allowed`` (n, m) for each.

    field: (c, 5) of view. gate: rad. named (n,): score of a spot that has a beacon; missed (c,): of a beacon without.
    """

    origin: FloatArray
    ray: FloatArray
    camera: IntArray
    allowed: BoolArray
    x_in_world: FloatArray
    camera_R: FloatArray  # noqa: N815  matrices are capital letters
    camera_t: FloatArray
    field: FloatArray
    gate: float
    named: FloatArray
    missed: FloatArray


class FoundArrays(NamedTuple):
    """Room for the best k poses: R (k, 3, 3), t (k, 3) m, their score (k,) and naming (k, n), -1 for no beacon."""

    R: FloatArray
    t: FloatArray
    score: FloatArray
    match: IntArray


class PriorArrays(NamedTuple):
    """What is known of the pose (4, 4) before: components rows (k,) of its tangent, B (6, r) by the calibration."""

    pose: FloatArray
    B: FloatArray
    rows: IntArray


class PoseArrays(NamedTuple):
    """Room for a solution: pose (4, 4), residual (n,), H (n, 6), M (n, r), covariance C (6, 6), gain (6, n)."""

    pose: FloatArray
    residual: FloatArray
    H: FloatArray
    M: FloatArray
    C: FloatArray
    gain: FloatArray


def spot_rows(
    system: SystemArrays, pose: FloatArray, spots: SpotArrays, residual: FloatArray, H: FloatArray, M: FloatArray
) -> bool:
    """Fill residual (2n,), H (2n, 6) by ``world_from_station`` and M (2n, r) by the unit errors of the calibration.

    pose (4, 4): world_from_station. Returns whether all beacons lie in front of their cameras (a fisheye sees behind
    itself).
    """
    return bool(_spot_rows(*system, pose, *spots, residual, H, M))


def gauss_newton(
    system: SystemArrays, start: FloatArray, spots: SpotArrays, R: FloatArray, prior: PriorArrays, out: PoseArrays
) -> tuple[int, bool, float, float, float]:
    """Fill ``out`` at the solution.

    R (n, n): covariance of spots and prior without the errors common to all epochs. Returns DONE, OPEN (a direction is)
    or UNSETTLED, whether all beacons are in front, v' inv(Sigma) v, ln det Sigma and ln det C.
    """
    n, r = out.M.shape
    numbers, work = np.zeros(4), np.empty(n * (n + 14 + r))
    state = _gauss_newton(*system, start, *spots, R, *prior, *out, numbers, work)
    return state, bool(numbers[0]), float(numbers[1]), float(numbers[2]), float(numbers[3])


def some_pose(system: SystemArrays, start: FloatArray, spots: SpotArrays, pose: FloatArray) -> None:
    """Fill pose (4, 4) with one of the many that explain too few spots, nearest to a start in a way (damped steps)."""
    n = 2 * len(spots.camera)
    _some_pose(*system, start, *spots, pose, np.empty(n * (n + 14 + system.F.shape[1])))


def three_point_poses(
    o: FloatArray, d: FloatArray, x: FloatArray, nearest: float, farthest: float
) -> tuple[FloatArray, FloatArray]:
    """All poses ``world_from_station``, R (k, 3, 3) and t (k, 3), with points x (3, 3) m on rays o, d (3, 3).

    At depths nearest to farthest (m); none for points on one line.
    """
    R, t = np.empty((MAX_SOLUTIONS, 3, 3)), np.empty((MAX_SOLUTIONS, 3))
    n = _three_point_poses(o, d, x, nearest, farthest, R, t)
    return R[:n], t[:n]


def search(
    sky: SkyArrays, triples: IntArray, nearest: float, farthest: float, most: int, found: FoundArrays
) -> int:
    """Try the beacons allowed on triples (T, 3) of spots; keep the best poses, each naming once; how many were kept.

    Stops after ``most`` three-point problems, or when the best consensus makes it hopeless that a triple of true spots
    was not among those tried (the usual stop of RANSAC, with all beacons tried on each triple).
    """
    n, m = sky.allowed.shape
    return _search(*sky, triples, nearest, farthest, most, *found, np.empty(n + m * m), np.empty(n, dtype=np.int64))
