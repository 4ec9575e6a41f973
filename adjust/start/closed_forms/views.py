"""Camera poses of many views at once, refined and judged by the angles between rays and points.

Where NumPy does the work it is done in stacks: x and rays (b, 3, n) of b views with about equal numbers of points,
``real`` (b, n) one for each point and zero where a view has fewer.
"""

from collections.abc import Iterator

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.parallel import run_split, split_blocks
from adjust.native.views import ViewArrays, errors_of_views, offsets_of_views, refine_views

_STACK = 8192  # points at a time: what they need stays in the processor's cache


def stacks(first: IntArray, size: IntArray) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """Views with ``size`` (B,) rows from ``first`` (B,) on, those of about equal size together.

    Yields their positions (b,), the rows (b, n) of their points, the last one again where a view has fewer, and
    ``real`` (b, n). None may be empty.
    """
    order = np.argsort(size, kind="stable")
    ends = np.cumsum(size[order])
    edges = np.searchsorted(ends, np.arange(_STACK, ends[-1] if len(ends) else 0, _STACK))
    for which in np.split(order, np.unique(edges)):
        if len(which):
            step, last = np.arange(size[which[-1]]), size[which, None] - 1
            yield which, first[which, None] + np.minimum(step, last), (step <= last).astype(float)


def gathered(array: FloatArray, rows: IntArray) -> FloatArray:
    """Rows (b, n) of points (N, k) as a stack (b, k, n)."""
    return np.ascontiguousarray(np.swapaxes(array[rows], 1, 2))


def median(values: FloatArray, real: FloatArray) -> FloatArray:
    """The median (b,) of the real ones of values (b, n)."""
    ordered, size, i = np.sort(np.where(real > 0, values, np.inf)), real.sum(axis=1).astype(int), np.arange(len(real))
    return np.asarray(0.5 * (ordered[i, (size - 1) // 2] + ordered[i, size // 2]))


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
