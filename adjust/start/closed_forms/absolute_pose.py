"""Poses of a camera from known points and the rays to them: all solutions, many views at once."""

from itertools import combinations

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, IntArray
from adjust.native.views import WIDEST, plane_poses, refine_poses, view_errors
from adjust.spatial.rigid import rigid, rotation_exp, rotation_to

_FEW = 4, 5  # points that have poses from each three of them too


def view_poses(x: FloatArray, rays: FloatArray, ptr: IntArray) -> tuple[FloatArray, IntArray, dict[int, str]]:
    """Poses (K, 4, 4) camera_from_target that may explain views, and of which view (K,) each is; why others have none.

    x: (N, 3) m in the target, rays: (N, 3) unit in the camera, view after view by ptr (B + 1,). As
    :func:`pose_solutions` finds them: unrefined, in no order and not checked for what lies in front.
    """
    both, planar = plane_poses(x, rays, ptr)
    if planar.all():
        return both.reshape(-1, 4, 4), np.repeat(np.arange(len(both)), 2), {}
    found, failed = list(both), {}
    for i in np.flatnonzero(~planar).tolist():
        part = slice(ptr[i], ptr[i + 1])
        found[i] = np.zeros((0, 4, 4))
        try:
            found[i] = _solutions(x[part], rays[part])
            if not len(found[i]):
                n = len(x[part])
                raise SurveyError(f"no camera pose explains its {n} points; check their order and coordinates")
        except SurveyError as reason:
            failed[i] = str(reason)
    return np.concatenate(found), np.repeat(np.arange(len(found)), [len(f) for f in found]), failed


def best_poses(
    x: FloatArray, rays: FloatArray, ptr: IntArray, refinements: int
) -> tuple[FloatArray, FloatArray]:
    """Of every view the refined pose (B, 4, 4) with the least error (B,), rms rad, infinite where there is none."""
    if len(ptr) < 2:
        return np.zeros((0, 4, 4)), np.zeros(0)
    poses, of, _ = view_poses(x, rays, ptr)
    return best_of(poses, of, x, rays, ptr, refinements)


def best_of(
    poses: FloatArray, of: IntArray, x: FloatArray, rays: FloatArray, ptr: IntArray, refinements: int
) -> tuple[FloatArray, FloatArray]:
    """The same from poses (K, 4, 4) to begin with, of the views ``of`` (K,)."""
    n = len(ptr) - 1
    best, least = np.tile(np.eye(4), (n, 1, 1)), np.full(n, np.inf)
    poses = refine_poses(poses, x, rays, ptr, refinements, of=of)
    error, in_front = view_errors(poses, x, rays, ptr, of)
    order = np.lexsort((error, of))
    order = order[in_front[order]]
    views, first = np.unique(of[order], return_index=True)
    best[views], least[views] = poses[order[first]], error[order[first]]
    return best, least


def pose_solutions(x: FloatArray, rays: FloatArray) -> FloatArray:
    """Poses (k, 4, 4) from points (n, 3) m in the target, not all on a line, and unit rays (n, 3) in the camera, n > 2.

    Three points: P3P (Ding et al., CVPR 2023, in OpenCV), up to four solutions. Planar: IPPE (Collins and Bartoli,
    IJCV 109, 2014), both solutions. Otherwise SQPnP (Terzakis and Lourakis, ECCV 2020); the square sum of four or five
    has several minima, of which it may find one that is not the least, so that each three of them give theirs too.
    Unrefined, in no order and not checked for what lies in front. Rays may lie in any direction: they are turned to the
    mean one first. Raises SurveyError for too few points, or points on a line.
    """
    both, planar = plane_poses(x, rays, np.array([0, len(x)]))
    return np.asarray(both[0]) if planar[0] else _solutions(x, rays)


def _solutions(x: FloatArray, rays: FloatArray) -> FloatArray:
    """:func:`pose_solutions` but for what :func:`adjust.native.views.plane_poses` does."""
    if len(x) < 3:
        raise SurveyError(f"a camera pose needs 3 known points, got {len(x)}: observe more of them")
    front_from_camera = rotation_to(rays.mean(axis=0), np.array([0.0, 0.0, 1.0]))
    turned = rays @ front_from_camera.T
    near = turned[:, 2] > WIDEST
    if near.sum() < 3:
        raise SurveyError("fewer than 3 rays within 80 degrees of their mean: split the view, or observe more points")
    if not near.all():
        both, planar = plane_poses(x[near], rays[near], np.array([0, near.sum()]))
        if planar[0]:
            return np.asarray(both[0])
    found = [rigid(front_from_camera.T, np.zeros(3)) @ _in_front(x[near], turned[near, :2] / turned[near, 2:])]
    for three in combinations(range(len(x)), 3) if _FEW[0] <= len(x) <= _FEW[1] else ():
        try:
            found.append(_solutions(x[list(three)], rays[list(three)]))
        except SurveyError:  # on a line
            continue
    return np.concatenate(found)


def _in_front(x: FloatArray, xy: FloatArray) -> FloatArray:
    """Poses (k, 4, 4) from points (n, 3) m at x/z, y/z (n, 2) of the camera, unrefined."""
    import cv2  # here: networks without images start without it

    centre = x.mean(axis=0)
    size = np.linalg.svd(x - centre, compute_uv=False)
    if size[1] <= 1e-6 * size[0]:
        raise SurveyError(f"{len(x)} points on one line do not determine a camera pose: add one off the line")
    local, identity, none = (x - centre)[:, None] / size[0], np.eye(3), np.zeros(0)
    if len(x) == 3:
        _, turns, shifts = cv2.solveP3P(local, xy[:, None], identity, none, cv2.SOLVEPNP_P3P)
    else:
        _, turns, shifts, _ = cv2.solvePnPGeneric(local, xy[:, None], identity, none, flags=cv2.SOLVEPNP_SQPNP)
    R, t = rotation_exp(np.array(turns, dtype=float).reshape(-1, 3)), np.array(shifts, dtype=float).reshape(-1, 3)
    poses = rigid(R, size[0] * t - R @ centre)
    return poses[np.isfinite(poses).all(axis=(1, 2))]
