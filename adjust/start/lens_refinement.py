"""Lens and target poses of one camera together, by a small Levenberg-Marquardt with the poses eliminated."""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from adjust.lenses.models import LensModel, lens_derivatives, lens_residuals
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.rigid import rigid, rotation_exp


@dataclass(frozen=True, eq=False)
class LensFit:
    """values (n,), poses (B, 4, 4), residuals (N, 2) px, and the covariance (p, p) of the free lens components."""

    values: FloatArray
    poses: FloatArray
    residuals: FloatArray
    cov: FloatArray


def fit_lens(
    model: LensModel,
    constants: FloatArray,
    values: FloatArray,
    directions: FloatArray,
    poses: FloatArray,
    x: FloatArray,
    uv: FloatArray,
    ptr: IntArray,
    iterations: int = 25,
) -> LensFit:
    """Least squares over ``values + directions @ p`` and the poses camera_from_target (B, 4, 4), with Huber weights.

    directions: (n, p), what of the lens may move. x: (N, 3) m, uv: (N, 2) px, view after view by ``ptr`` (B + 1,).
    Source: Levenberg-Marquardt with the poses eliminated (Schur complement; Triggs et al., Bundle adjustment, 2000).
    """
    damping, counts, x_columns = 1e-4, np.diff(ptr), np.ascontiguousarray(x.T)
    points = _in_camera(poses, x_columns, counts)
    residuals, squares = _residuals(model, values, constants, points, uv)
    for _ in range(iterations):
        weights = _huber(squares)
        system = _normal_equations(model, values, constants, directions, points, uv, ptr, weights)
        cost = float(weights @ squares)
        gain = 0.0
        for _ in range(6):
            by_lens, by_pose = _step(*system, damping)
            new_values = values + directions @ by_lens
            new_poses = rigid(rotation_exp(by_pose[:, :3]), by_pose[:, 3:]) @ poses
            new_points = _in_camera(new_poses, x_columns, counts)
            new_residuals, new_squares = _residuals(model, new_values, constants, new_points, uv)
            new_cost = float(weights @ new_squares)
            if new_cost < cost:
                gain, damping = cost - new_cost, damping * 0.1
                values, poses, points = new_values, new_poses, new_points
                residuals, squares = new_residuals, new_squares
                break
            damping = max(damping, 1e-8) * 10.0
        if gain < 1e-6 * cost:
            break
    cov = _lens_covariance(
        *_normal_equations(model, values, constants, directions, points, uv, ptr, _huber(squares))
    )
    scale = float(np.median(squares) / np.log(4.0))  # median of a 2-D normal's square is s^2 ln 4
    return LensFit(values, poses, residuals, cov * scale)


def _in_camera(poses: FloatArray, x: FloatArray, counts: IntArray) -> FloatArray:
    """Points (N, 3) in their camera, of x (3, N) m in the target, ``counts`` of them under each pose."""
    T = np.repeat(poses[:, :3].reshape(-1, 12).T, counts, axis=1)
    out = np.empty((x.shape[1], 3))
    for i in range(3):
        out[:, i] = T[4 * i] * x[0] + T[4 * i + 1] * x[1] + T[4 * i + 2] * x[2] + T[4 * i + 3]
    return out


def _residuals(
    model: LensModel, values: FloatArray, constants: FloatArray, p: FloatArray, uv: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Residuals (N, 2) px of points in the camera, and the squares (N,) of their lengths."""
    r = lens_residuals(model, values, constants, p, uv)
    # a point behind the camera must never look like an improvement
    bad = ~(np.isfinite(r[:, 0]) & np.isfinite(r[:, 1])) | ((p[:, 2] <= 0) & (model.name != "fisheye"))
    r[bad] = 1e6
    return r, r[:, 0] ** 2 + r[:, 1] ** 2


def _huber(squares: FloatArray) -> FloatArray:
    """Weights (N,): convex, since points far out under an unfinished distortion must not be taken for gross errors."""
    size = np.sqrt(squares)
    limit = max(3.0 * float(np.median(size)), 1e-9)
    return np.asarray(limit / np.maximum(size, limit))


def _normal_equations(
    model: LensModel,
    values: FloatArray,
    constants: FloatArray,
    directions: FloatArray,
    p: FloatArray,
    uv: FloatArray,
    ptr: IntArray,
    weights: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Lens block (p, p), mixed (B, 6, p), pose blocks (B, 6, 6) and right sides (p,), (B, 6)."""
    r, by_values, by_point = lens_derivatives(model, values, constants, p, uv)
    a = (by_values.reshape(-1, len(values)) @ directions).reshape(len(p), 2, directions.shape[1])
    return lens_and_poses(ptr, p, r, a, by_point, weights)


def lens_and_poses(
    ptr: IntArray, p: FloatArray, r: FloatArray, a: FloatArray, by_point: FloatArray, weights: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Lens block (m, m), mixed blocks (B, 6, m), pose blocks (B, 6, 6) and right sides (m,), (B, 6).

    p: (N, 3) points in the camera. r: (N, 2) residuals. a: (N, 2, m) and by_point: (N, 2, 3) their derivatives.
    weights: (N,). The tangent of a pose is a turn, then a shift, in the camera's frame.
    """
    turn = np.cross(p[:, None], by_point)  # d (turn x p) = by_point . (turn x p) = turn . (p x by_point)
    rows = np.concatenate([turn, by_point, a, r[:, :, None]], axis=2)
    weighted = (weights[:, None, None] * rows).reshape(-1, rows.shape[2])
    rows = rows.reshape(weighted.shape)
    N = np.array([weighted[2 * i : 2 * j].T @ rows[2 * i : 2 * j] for i, j in pairwise(ptr.tolist())])
    lens = N[:, 6:, 6:].sum(axis=0)
    return lens[:-1, :-1], N[:, :6, 6:-1], N[:, :6, :6], lens[:-1, -1], N[:, :6, -1]


def _step(
    lens: FloatArray,
    mixed: FloatArray,
    pose: FloatArray,
    right_lens: FloatArray,
    right_pose: FloatArray,
    damping: float,
) -> tuple[FloatArray, FloatArray]:
    diagonal = np.einsum("bii->bi", pose)
    pose = pose + (damping * diagonal + 1e-14 * diagonal.max())[:, :, None] * np.eye(6)
    lens = lens + np.diag(damping * np.diag(lens) + 1e-300)
    solved = np.linalg.solve(pose, np.concatenate([mixed, right_pose[..., None]], axis=2))
    turned = np.swapaxes(mixed, 1, 2)
    reduced = lens - np.sum(turned @ solved[..., :-1], axis=0)
    right = right_lens - np.sum((turned @ solved[..., -1:])[..., 0], axis=0)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(lens), 1e-300))
    by_lens = -unit * np.linalg.lstsq(reduced * np.outer(unit, unit), unit * right, rcond=1e-13)[0]
    by_pose = -solved[..., -1] - (solved[..., :-1] @ by_lens[:, None])[..., 0]
    return by_lens, by_pose


def _lens_covariance(
    lens: FloatArray, mixed: FloatArray, pose: FloatArray, right_lens: FloatArray, right_pose: FloatArray
) -> FloatArray:
    """Inverse of the reduced normal matrix, infinite where it is singular."""
    try:
        reduced = lens - np.sum(np.swapaxes(mixed, 1, 2) @ np.linalg.solve(pose, mixed), axis=0)
        unit = 1.0 / np.sqrt(np.diag(lens))
        cov = np.linalg.inv(reduced * np.outer(unit, unit)) * np.outer(unit, unit)
    except np.linalg.LinAlgError:
        return np.diag(np.full(len(lens), np.inf))
    return np.asarray(cov) if np.all(np.diag(cov) > 0) else np.diag(np.full(len(lens), np.inf))
