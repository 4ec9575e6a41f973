"""Camera poses of many views at once, refined and judged by the angles between rays and points.

Views are worked on in stacks: x and rays (b, 3, n) of b views with about equal numbers of points, ``real`` (b, n) one
for each point and zero where a view has fewer.
"""

from collections.abc import Iterator

import numpy as np

from adjust.closed_forms.rigid import rigid, rotation_exp
from adjust.model import BoolArray, FloatArray, IntArray

_STACK = 8192  # points at a time: what they need stays in the processor's cache
_ROBUST = 3.0  # times the median offset: where Cauchy's weight is a half
_ENOUGH = 1e-7  # share of the square sum: what a further step could take off is far less
_BEHIND = 1e3  # offset of a point behind the camera, more than any in front can be


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
    rms, in_front = np.empty(len(camera_from_target)), np.empty(len(camera_from_target), dtype=np.bool_)
    for which, rows, real in stacks(*_ranges(ptr, of)):
        tangent, behind = _tangents(camera_from_target[which], gathered(x, rows), gathered(rays, rows))
        rms[which] = np.sqrt((real * tangent**2).sum(axis=1) / real.sum(axis=1))
        in_front[which] = ~behind.any(axis=1)
    return rms, in_front


def view_offsets(
    camera_from_target: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Tangents (N,) of the angles between rays and points, infinite for points behind, and their medians (B,)."""
    out, medians = np.empty(len(x)), np.full(len(camera_from_target), np.nan)
    some = np.flatnonzero(np.diff(ptr))
    for which, rows, real in stacks(*_ranges(ptr, some)):
        tangent, behind = _tangents(camera_from_target[some[which]], gathered(x, rows), gathered(rays, rows))
        tangent[behind] = np.inf
        out[rows], medians[some[which]] = tangent, median(tangent, real)
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
    poses = np.array(camera_from_target, dtype=np.float64)
    for which, rows, real in stacks(*_ranges(ptr, of)):
        poses[which] = _refined(poses[which], gathered(x, rows), gathered(rays, rows), real, iterations, robust)
    return poses


def _ranges(ptr: IntArray, of: IntArray | None) -> tuple[IntArray, IntArray]:
    first, size = np.asarray(ptr[:-1]), np.diff(ptr)
    return (first, size) if of is None else (first[of], size[of])


def _tangents(poses: FloatArray, x: FloatArray, rays: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Tangents (b, n) of the angles between rays and points, and which points (b, n) lie behind."""
    p = poses[:, :3, :3] @ x + poses[:, :3, 3:]
    depth = np.einsum("bcn,bcn->bn", p, rays)
    across = np.linalg.norm(np.cross(p, rays, axis=1), axis=1)
    return across / np.maximum(np.abs(depth), 1e-12), ~(depth > 0)


def _refined(
    poses: FloatArray, x: FloatArray, rays: FloatArray, real: FloatArray, iterations: int, robust: bool
) -> FloatArray:
    """:func:`refine_poses` of one stack, with poses (b, 4, 4)."""
    out, at, damping = poses.copy(), np.arange(len(poses)), np.full(len(poses), 1e-6)
    across = np.ascontiguousarray(np.moveaxis(tangent_axes(np.moveaxis(rays, 1, 2)), (1, 3), (3, 1)))  # (b, 3, 2, n)
    p, depth, r = _offsets(poses, x, rays, across)
    for _ in range(iterations):
        w = real * _cauchy(r, real) if robust else real
        N, g, old = _normal_equations(p, depth, r, rays, across, w)
        trial = _moved(poses, _damped(N, g, damping))
        q, trial_depth, e = _offsets(trial, x, rays, across)
        new = np.einsum("bn,bkn,bkn->b", w, e, e)
        better = new < old
        damping *= np.where(better, 0.1, 30.0)
        for state, found in ((poses, trial), (p, q), (depth, trial_depth), (r, e)):
            np.copyto(state, found, where=better.reshape(-1, *[1] * (state.ndim - 1)))
        out[at] = poses
        # the last digits are reached, or a step that small lowers nothing any more
        go = np.where(better, old - new > _ENOUGH * old, damping <= 1e3)
        if not go.any():
            break
        if not go.all():
            poses, p, depth, r, x, rays, across, real = (a[go] for a in (poses, p, depth, r, x, rays, across, real))
            at, damping = at[go], damping[go]
    return out


def _offsets(
    poses: FloatArray, x: FloatArray, rays: FloatArray, across: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Points (b, 3, n) in the camera, depths (b, n) along their rays, and offsets (b, 2, n) rad across them."""
    p = poses[:, :3, :3] @ x + poses[:, :3, 3:]
    depth = np.einsum("bcn,bcn->bn", p, rays)
    r = np.einsum("bckn,bcn->bkn", across, p) / np.maximum(depth, 1e-12)[:, None]
    np.copyto(r, _BEHIND, where=~(depth > 0)[:, None])
    return p, depth, r


def _cauchy(r: FloatArray, real: FloatArray) -> FloatArray:
    """Weights (b, n) at ``_ROBUST`` times the median offset."""
    squares = np.einsum("bkn,bkn->bn", r, r)
    limit = np.maximum(_ROBUST**2 * median(squares, real), 1e-24)
    return np.asarray(1.0 / (1.0 + squares / limit[:, None]))


def _normal_equations(
    p: FloatArray, depth: FloatArray, r: FloatArray, rays: FloatArray, across: FloatArray, w: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """N (b, 6, 6) and g (b, 6) of N step = g, a turn, then a shift, in the camera's frame; the square sums (b,)."""
    b, n = depth.shape
    J = np.empty((b, 7, 2, n))
    np.multiply(r[:, None], rays[:, :, None], out=J[:, 3:6])
    np.subtract(across, J[:, 3:6], out=J[:, 3:6])
    J[:, 3:6] *= (1.0 / depth)[:, None, None]
    for i in range(3):  # the derivative by a turn is -j [p]x = p x j
        k, m = (i + 1) % 3, (i + 2) % 3
        np.multiply(p[:, k, None], J[:, 3 + m], out=J[:, i])
        J[:, i] -= p[:, m, None] * J[:, 3 + k]
    J[:, 6] = r
    rows = J.reshape(b, 7, 2 * n)
    N = (J * w[:, None, None]).reshape(b, 7, 2 * n) @ np.swapaxes(rows, 1, 2)
    return N[:, :6, :6], -N[:, :6, 6], N[:, 6, 6]


def _damped(N: FloatArray, g: FloatArray, damping: FloatArray) -> FloatArray:
    """The steps (b, 6), zero where there is none."""
    diagonal = np.einsum("bii->bi", N)
    largest = diagonal.max(axis=1)
    bad = ~(np.isfinite(largest + g.sum(axis=1)) & (largest > 0))
    N = N + (damping[:, None] * diagonal + 1e-14 * largest[:, None])[:, :, None] * np.eye(6)
    N[bad], g[bad] = np.eye(6), 0.0
    return np.asarray(np.linalg.solve(N, g[..., None])[..., 0])


def _moved(poses: FloatArray, step: FloatArray) -> FloatArray:
    """``[exp(turn) shift] * pose`` (b, 4, 4)."""
    return np.asarray(rigid(rotation_exp(step[:, :3]), step[:, 3:]) @ poses)
