"""Pose of a camera from known points and the rays to them: all solutions, then refinement of many views at once."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from adjust.spatial.rigid import rigid, rotation_exp, rotation_to
from adjust.start.closed_forms.planes import PLANAR, WIDEST, plane_poses
from adjust.start.closed_forms.views import refine_poses, view_errors


@dataclass(frozen=True, eq=False)
class PoseCandidates:
    """All poses that explain a view, best first.

    camera_from_target: (k, 4, 4). error: (k,) rms of the angles between rays and points, rad.
    """

    camera_from_target: FloatArray
    error: FloatArray


def absolute_pose(x: FloatArray, rays: FloatArray, refinements: int = 5) -> PoseCandidates:
    """Poses from points (n, 3) m in the target and unit rays (n, 3) in the camera; needs three points not on a line.

    Three points: P3P (Ding et al., CVPR 2023, in OpenCV), up to four solutions. Planar: IPPE (Collins and Bartoli,
    IJCV 109, 2014), both solutions. Otherwise SQPnP (Terzakis and Lourakis, ECCV 2020), from six points on also EPnP.
    Each is refined on the angles. Rays may lie in any direction: they are turned to the mean one first.
    Raises SurveyError for too few points, points on a line, or where no pose has the points in front.
    """
    return _refined(pose_solutions(x, rays), x, rays, refinements)


def best_poses(x: Sequence[FloatArray], rays: Sequence[FloatArray], refinements: int) -> tuple[FloatArray, FloatArray]:
    """The best pose (B, 4, 4) of :func:`absolute_pose` in every view and its error (B,) rad, infinite where none is."""
    n, ptr = len(x), np.cumsum([0] + [len(part) for part in x])
    poses, error, planar = np.tile(np.eye(4), (n, 2, 1, 1)), np.full((n, 2), np.inf), np.zeros(n, dtype=np.bool_)
    if n:
        all_x, all_rays = np.concatenate(x), np.concatenate(rays)
        poses, planar = plane_poses(all_x, all_rays, ptr)
        of = np.repeat(np.flatnonzero(planar), 2)
        found = refine_poses(poses[planar].reshape(-1, 4, 4), all_x, all_rays, ptr, refinements, of=of)
        rms, in_front = view_errors(found, all_x, all_rays, ptr, of)
        poses[planar], error[planar] = found.reshape(-1, 2, 4, 4), np.where(in_front, rms, np.inf).reshape(-1, 2)
    for i in np.flatnonzero(~planar).tolist():
        try:
            others = absolute_pose(x[i], rays[i], refinements)
        except SurveyError:
            continue
        poses[i, 0], error[i, 0] = others.camera_from_target[0], others.error[0]
    best = np.argmin(error, axis=1)
    return poses[np.arange(n), best], error[np.arange(n), best]


def pose_solutions(x: FloatArray, rays: FloatArray) -> FloatArray:
    """The unrefined poses (k, 4, 4) of :func:`absolute_pose`, in no order and not checked for what lies in front."""
    if len(x) < 3:
        raise SurveyError(f"a camera pose needs 3 known points, got {len(x)}: observe more of them")
    both, planar = plane_poses(x, rays, np.array([0, len(x)]))
    if planar[0]:
        return np.asarray(both[0])
    mean = rays.mean(axis=0)
    front_from_camera = rotation_to(mean, np.array([0.0, 0.0, 1.0]))
    turned = rays @ front_from_camera.T
    near = turned[:, 2] > WIDEST
    if near.sum() < 3:
        raise SurveyError("fewer than 3 rays within 80 degrees of their mean: split the view, or observe more points")
    centre, axes, thin = _principal_axes(x[near])
    front_from_target = _solutions(x[near], turned[near, :2] / turned[near, 2:], centre, axes, thin)
    camera_from_front = rigid(front_from_camera.T, np.zeros(3))
    return np.array([camera_from_front @ pose for pose in front_from_target]).reshape(-1, 4, 4)


def _refined(poses: FloatArray, x: FloatArray, rays: FloatArray, refinements: int) -> PoseCandidates:
    ptr, of = np.array([0, len(x)]), np.zeros(len(poses), dtype=np.int64)
    poses = refine_poses(poses, x, rays, ptr, refinements, of=of)
    error, in_front = view_errors(poses, x, rays, ptr, of)
    poses, error = poses[in_front], error[in_front]
    if not len(poses):
        raise SurveyError(
            f"no camera pose has all {len(x)} points in front: they are mis-identified or the lens is wrong"
        )
    order = np.argsort(error, kind="stable")
    poses, error = poses[order], error[order]
    keep = [i for i in range(len(poses)) if not any(np.allclose(poses[i], poses[j], atol=1e-6) for j in range(i))]
    return PoseCandidates(poses[keep], error[keep])


def _principal_axes(x: FloatArray) -> tuple[FloatArray, FloatArray, bool]:
    """Centroid, axes (rows, right-handed, the thinnest last) and whether the points are a plane."""
    centre = x.mean(axis=0)
    squares, vectors = np.linalg.eigh((x - centre).T @ (x - centre))
    s, vt = np.sqrt(np.maximum(squares[::-1], 0.0)), vectors.T[::-1]
    if s[1] <= 1e-6 * s[0]:
        raise SurveyError(f"{len(x)} points on one line do not determine a camera pose: add one off the line")
    axes = vt * np.array([[1.0], [1.0], [np.linalg.det(vt)]])
    return centre, axes, bool(s[2] < PLANAR * s[0])


def _solutions(x: FloatArray, xy: FloatArray, centre: FloatArray, axes: FloatArray, thin: bool) -> list[FloatArray]:
    """Poses (4, 4) of the target in the turned camera, unrefined."""
    import cv2  # here: networks without images start without it

    scale = float(np.max(np.linalg.norm(x - centre, axis=1)))
    local = (x - centre) @ axes.T / scale  # unit size and the plane at z = 0: what IPPE asks for
    if thin and len(x) > 3:
        local = local * np.array([1.0, 1.0, 0.0])
    found: list[FloatArray] = []
    identity, none = np.eye(3), np.zeros(0)
    for flag in _methods(len(x), thin):
        try:
            if flag is None:
                _, turns, shifts = cv2.solveP3P(local[:, None], xy[:, None], identity, none, cv2.SOLVEPNP_P3P)
            else:
                _, turns, shifts, _ = cv2.solvePnPGeneric(local[:, None], xy[:, None], identity, none, flags=flag)
        except cv2.error:  # the linear solution refuses some configurations; the other methods remain
            continue
        for turn, shift in zip(turns, shifts, strict=True):
            pose = rigid(rotation_exp(np.ravel(turn).astype(float)), scale * np.ravel(shift).astype(float))
            if np.all(np.isfinite(pose)):
                found.append(pose @ rigid(axes, -axes @ centre))
    return found


def _methods(n: int, thin: bool) -> tuple[int | None, ...]:
    import cv2

    if n == 3:
        return (None,)
    if thin:
        return (cv2.SOLVEPNP_IPPE,)
    return (cv2.SOLVEPNP_SQPNP, cv2.SOLVEPNP_EPNP) if n >= 6 else (cv2.SOLVEPNP_SQPNP,)
