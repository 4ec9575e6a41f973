"""Camera poses of many views at once, refined and judged by the angles between rays and points."""

import numpy as np

from adjust.model import BoolArray, FloatArray, IntArray
from adjust.native.views import ViewArrays, errors_of_views, offsets_of_views, refine_views
from adjust.parallel import run_split, split_blocks


def tangent_axes(rays: FloatArray) -> FloatArray:
    """Two unit vectors (..., 2, 3) across each unit ray (..., 3) (Duff et al., J. Comput. Graph. Techn. 6(1), 2017)."""
    x, y, z = np.moveaxis(rays, -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    first, second = (1.0 + sign * x * x * a, sign * b, -sign * x), (b, sign + y * y * a, -y)
    return np.stack([np.stack(first, axis=-1), np.stack(second, axis=-1)], axis=-2)


def view_errors(
    camera_from_target: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, of: IntArray | None = None
) -> tuple[FloatArray, BoolArray]:
    """Per pose the rms (K,) of its point offsets, rad, and whether (K,) all its points lie in front.

    x, rays: (N, 3), view after view by ptr (B + 1,); ``of`` (K,): the view of each pose, where there is not one each.
    """
    views, poses = ViewArrays.of_poses(x, rays, ptr, of), np.ascontiguousarray(camera_from_target, dtype=np.float64)
    rms, in_front = np.empty(len(poses)), np.empty(len(poses), dtype=np.bool_)
    run_split(errors_of_views, split_blocks(views.ends), views, poses, rms, in_front)
    return rms, in_front


def view_offsets(
    camera_from_target: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Tangents (N,) of the angles between rays and points, infinite for points behind, and their medians (B,)."""
    views, poses = ViewArrays.of_poses(x, rays, ptr, None), np.ascontiguousarray(camera_from_target, dtype=np.float64)
    out, medians = np.empty(len(x)), np.full(len(poses), np.nan)
    run_split(offsets_of_views, split_blocks(views.ends), views, poses, out, medians)
    return out, medians


def refine_poses(
    camera_from_target: FloatArray,
    x: FloatArray,
    rays: FloatArray,
    ptr: IntArray,
    iterations: int = 5,
    robust: bool = False,
    of: IntArray | None = None,
) -> FloatArray:
    """Least-squares poses (K, 4, 4), each of its view alone, by Levenberg-Marquardt on the offsets across its rays.

    x, rays: (N, 3), view after view; ptr: (B + 1,) row ranges, none empty; ``of`` (K,): the view of each pose, where
    there is not one each. With ``robust`` the points of a view carry Cauchy weights at three times its median offset.
    A pose stays where a step does not lower its error.
    """
    views, poses = ViewArrays.of_poses(x, rays, ptr, of), np.array(camera_from_target, dtype=np.float64, order="C")
    run_split(refine_views, split_blocks(views.ends), views, iterations, robust, poses)
    return poses
