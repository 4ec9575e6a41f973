"""Views of planes, many at once: homographies, both poses that one allows, and how far an image is from one.

Stacks of views are those of :mod:`adjust.start.closed_forms.views`.
"""

from collections.abc import Iterator

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.start.closed_forms.views import gathered, median, stacks

PLANAR = 1e-4  # thickness against extent below which points count as a plane
WIDEST = float(np.cos(np.deg2rad(80.0)))  # rays further off the mean direction are left to the refinement
_SINGULAR = 1e-13  # smallest against largest eigenvalue


def homographies(
    xy: FloatArray, uv: FloatArray, ptr: IntArray, refinements: int = 3
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Of every view ``h`` (B, 3, 3) with uv ~ h (x, y, 1) and the rms (B,) of its residuals in the unit of uv.

    xy, uv: (N, 2), view after view by ptr (B + 1,). Also which (B,) are determined: not those of less than four points
    or of points on one line.

    Source: direct linear transformation on normalised points (Hartley and Zisserman, Multiple View Geometry, alg. 4.2),
    then Gauss-Newton steps on the distance in the image.
    """
    n = len(ptr) - 1
    h, rms, good = np.tile(np.eye(3), (n, 1, 1)), np.full(n, np.inf), np.zeros(n, dtype=np.bool_)
    for at, rows, real in _stacks_of_planes(ptr):
        h[at], rms[at], good[at] = _homographies(gathered(xy, rows), gathered(uv, rows), real, refinements)
    return h, rms, good


def plane_poses(x: FloatArray, rays: FloatArray, ptr: IntArray) -> tuple[FloatArray, BoolArray]:
    """Both poses camera_from_target (B, 2, 4, 4) of planes, from points (N, 3) m on rays (N, 3), view after view.

    Also which views (B,) have them: not those of less than four points, of points off a plane (``PLANAR``) or on a
    line, and with rays far from their mean (``WIDEST``).

    Source: Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014: the rotations from the first
    derivatives of the homography at the centroid; the translations by linear least squares.
    """
    n = len(ptr) - 1
    poses, found = np.tile(np.eye(4), (n, 2, 1, 1)), np.zeros(n, dtype=np.bool_)
    for at, rows, real in _stacks_of_planes(ptr):
        poses[at], found[at] = _poses(gathered(x, rows), gathered(rays, rows), real)
    poses[~found] = np.eye(4)
    return poses, found


def plane_misfits(x: FloatArray, uv: FloatArray, ptr: IntArray) -> FloatArray:
    """Per view the median distance (B,) from the image of the points' best plane, relative to their extent there.

    Infinite where the points lie on one line or are fewer than four.
    """
    out = np.full(len(ptr) - 1, np.inf)
    for at, rows, real in _stacks_of_planes(ptr):
        seen = gathered(uv, rows)
        _, _, _, local, good = _on_plane(gathered(x, rows), real, np.inf)
        h, _, determined = _homographies(local, seen, real, 0)
        miss = median(np.linalg.norm(_mapped(h, local) - seen, axis=1), real)
        extent = np.linalg.norm(seen.max(axis=2) - seen.min(axis=2), axis=1)
        out[at] = np.where(good & determined, miss / np.maximum(extent, 1e-9), np.inf)
    return out


def _stacks_of_planes(ptr: IntArray) -> Iterator[tuple[IntArray, IntArray, FloatArray]]:
    """:func:`adjust.start.closed_forms.views.stacks` of the views that have more than three points."""
    enough = np.flatnonzero(np.diff(ptr) > 3)
    for which, rows, real in stacks(ptr[enough], np.diff(ptr)[enough]):
        yield enough[which], rows, real


def _poses(x: FloatArray, rays: FloatArray, real: FloatArray) -> tuple[FloatArray, BoolArray]:
    """:func:`plane_poses` of one stack."""
    mean = (rays * real[:, None]).sum(axis=2)
    good = mean[:, 2] > -0.5 * np.linalg.norm(mean, axis=1)
    front = _to_front(np.where(good[:, None], mean, (0.0, 0.0, 1.0)))
    turned = front @ rays
    good &= (turned[:, 2] > WIDEST).all(axis=1)
    xy = turned[:, :2] / np.maximum(turned[:, 2:], WIDEST)
    centre, axes, scale, local, flat = _on_plane(x, real, PLANAR)
    H, _, determined = _homographies(local, xy, real, 0)
    good &= flat & determined & (H[:, 2, 2] != 0.0)
    H[~good] = np.eye(3)
    turns, possible = _infinitesimal(H / H[:, 2:, 2:])
    shifts, finite = _shifts(turns, local, xy, real)
    back = np.swapaxes(front, 1, 2)[:, None]
    poses = np.zeros((len(x), 2, 4, 4))
    poses[..., :3, :3] = R = back @ turns @ axes[:, None]
    poses[..., :3, 3:] = back @ (scale[:, None, None, None] * shifts) - R @ centre[:, None]
    poses[..., 3, 3] = 1.0
    return poses, good & possible & finite & np.isfinite(poses).all(axis=(1, 2, 3))


def _on_plane(
    x: FloatArray, real: FloatArray, thickness: float
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Centre (b, 3, 1), axes (b, 3, 3), scale (b,) and coordinates (b, 2, n) of points on the planes through them.

    axes: rows, right-handed, the normal last. The coordinates times the scale are in the unit of x. Also whether (b,)
    the points are no line and no thicker than ``thickness`` of their extent.
    """
    centre = (x * real[:, None]).sum(axis=2, keepdims=True) / real.sum(axis=1)[:, None, None]
    d = (x - centre) * real[:, None]
    squares, vectors = np.linalg.eigh(d @ np.swapaxes(d, 1, 2))
    thin, middle, long = np.sqrt(np.maximum(squares, 0.0)).T
    first, second = vectors[:, :, 2], vectors[:, :, 1]
    axes = np.stack([first, second, np.cross(first, second)], axis=1)
    scale = np.sqrt((d**2).sum(axis=1).max(axis=1))
    local = axes[:, :2] @ d / np.maximum(scale, 1e-300)[:, None, None]
    return centre, axes, scale, local, (middle > 1e-6 * long) & (thin < thickness * long)


@np.errstate(divide="ignore", invalid="ignore")
def _homographies(
    xy: FloatArray, uv: FloatArray, real: FloatArray, refinements: int
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Homographies (b, 3, 3) of points (b, 2, n) to uv (b, 2, n), rms (b,), and whether (b,) they are determined.

    Source as :func:`homographies`; the first two rows of h follow linearly from the last, the vector of length one with
    the least algebraic error (Harker and O'Leary, Computation of homographies, BMVC 2005).
    """
    x, (sx, mx) = _normalised(xy, real)
    u, (su, mu) = _normalised(uv, real)
    X = np.concatenate([x, np.ones((len(x), 1, x.shape[2]))], axis=1) * real[:, None]
    Xt = np.swapaxes(X, 1, 2)
    S, mixed = X @ Xt, np.concatenate([(X * u[:, :1]) @ Xt, (X * u[:, 1:]) @ Xt], axis=2)
    own = (X * (u**2).sum(axis=1, keepdims=True)) @ Xt
    weakest = np.linalg.eigvalsh(S)
    good = weakest[:, 0] > _SINGULAR * weakest[:, 2]
    S[~good] = np.eye(3)
    rows = np.linalg.solve(S, mixed).reshape(-1, 6, 3)
    error, vectors = np.linalg.eigh(own - np.swapaxes(mixed.reshape(-1, 6, 3), 1, 2) @ rows)
    good &= error[:, 1] > _SINGULAR * np.trace(own, axis1=1, axis2=2)
    last = vectors[:, :, :1]
    h = np.swapaxes(np.concatenate([(rows @ last).reshape(-1, 3, 2), last], axis=2), 1, 2)
    h, rms = _closer(h * np.where(np.linalg.det(h) > 0, 1.0, -1.0)[:, None, None], x, u, real, refinements)
    to_unit, from_unit = np.zeros((2, len(h), 3, 3))
    to_unit[:, 0, 0] = to_unit[:, 1, 1] = sx
    to_unit[:, :2, 2] = -sx[:, None] * mx
    from_unit[:, 0, 0] = from_unit[:, 1, 1] = 1.0 / su
    from_unit[:, :2, 2] = mu
    to_unit[:, 2, 2] = from_unit[:, 2, 2] = 1.0
    return from_unit @ h @ to_unit, rms / su, good


def _closer(
    h: FloatArray, x: FloatArray, u: FloatArray, real: FloatArray, refinements: int
) -> tuple[FloatArray, FloatArray]:
    """Gauss-Newton steps on the distances in the image, as long as these become smaller; with their rms (b,)."""
    b, n = real.shape
    rms = _rms(h, x, u, real)
    for _ in range(refinements):
        q = h[:, :, :2] @ x + h[:, :, 2:]
        y = np.concatenate([x, np.ones((b, 1, n))], axis=1) / q[:, 2:]
        v = q[:, :2] / q[:, 2:]
        J = np.zeros((b, 9, 2, n))
        J[:, :3, 0] = J[:, 3:6, 1] = y
        J[:, 6:] = -y[:, :, None] * v[:, None]
        J = J.reshape(b, 9, 2 * n) * np.tile(real, 2)[:, None]
        flat = h.reshape(b, 9, 1)
        # the scale of h has no effect: one more row holds it; points on a line leave more open
        N = J @ np.swapaxes(J, 1, 2) + flat @ np.swapaxes(flat, 1, 2) + 1e-14 * n * np.eye(9)
        trial = h - np.linalg.solve(N, J @ (v - u).reshape(b, 2 * n, 1)).reshape(b, 3, 3)
        error = _rms(trial, x, u, real)
        better = error < rms
        if not better.any():
            break
        h, rms = np.where(better[:, None, None], trial, h), np.where(better, error, rms)
    return h, rms


def _normalised(xy: FloatArray, real: FloatArray) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """Points (b, 2, n) moved to mean zero and mean distance sqrt(2), and how: scale (b,) times (xy - mean (b, 2)).

    Source: Hartley, PAMI 19(6), 1997.
    """
    size = real.sum(axis=1)
    mean = (xy * real[:, None]).sum(axis=2) / size[:, None]
    d = xy - mean[:, :, None]
    distance = (np.linalg.norm(d, axis=1) * real).sum(axis=1) / size
    scale = np.sqrt(2.0) / np.where(distance > 0, distance, np.sqrt(2.0))
    return d * scale[:, None, None], (scale, mean)


def _mapped(h: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (b, 2, n) mapped by h (b, 3, 3)."""
    p = h[:, :, :2] @ xy + h[:, :, 2:]
    return np.asarray(p[:, :2] / p[:, 2:])


def _rms(h: FloatArray, x: FloatArray, u: FloatArray, real: FloatArray) -> FloatArray:
    squares = ((_mapped(h, x) - u) ** 2).sum(axis=1)
    return np.asarray(np.sqrt((real * squares).sum(axis=1) / real.sum(axis=1)))


def _to_front(directions: FloatArray) -> FloatArray:
    """The smallest rotations (b, 3, 3) that turn directions (b, 3), not nearly backwards, to +z."""
    x, y, z = directions.T / np.linalg.norm(directions, axis=1)
    k = 1.0 / (1.0 + z)
    rows = [1.0 - x * x * k, -x * y * k, -x], [-x * y * k, 1.0 - y * y * k, -y], [x, y, z]
    return np.array(rows).transpose(2, 0, 1)


def _infinitesimal(H: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Both rotations (b, 2, 3, 3) of planes whose homographies H (b, 3, 3), H22 = 1, are known at their origins."""
    v = H[:, :2, 2]
    J = H[:, :2, :2] - v[:, :, None] * H[:, 2:, :2]
    # turns +z to the direction of the origin
    turn = np.swapaxes(_to_front(np.column_stack([v, np.ones(len(v))])), 1, 2)
    B = turn[:, :2, :2] - v[:, :, None] * turn[:, 2:, :2]
    good = np.abs(np.linalg.det(B)) >= 1e-12
    B[~good] = np.eye(2)
    A = np.linalg.solve(B, J)
    gamma = np.linalg.norm(A, ord=2, axis=(1, 2))
    good &= gamma > 1e-12
    A /= np.where(good, gamma, 1.0)[:, None, None]
    third = np.sqrt(np.maximum(1.0 - (A**2).sum(axis=1), 0.0))
    third[:, 1] *= np.where((A[:, :, 0] * A[:, :, 1]).sum(axis=1) > 0, -1.0, 1.0)
    columns = np.empty((len(H), 2, 3, 3))
    columns[..., :2, :2] = A[:, None]
    columns[..., 2, :2] = third[:, None] * np.array([[1.0], [-1.0]])
    columns[..., 2] = np.cross(columns[..., 0], columns[..., 1])
    return turn[:, None] @ columns, good


def _shifts(turns: FloatArray, local: FloatArray, xy: FloatArray, real: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Translations (b, 2, 3, 1) with which the points of the planes fall on their images, linearly; where there are."""
    q = turns[..., :2] @ local[:, None]
    right = (xy[:, None] * q[:, :, 2:] - q[:, :, :2]) * real[:, None, None]
    sides = np.concatenate([right, -(xy[:, None] * right).sum(axis=2, keepdims=True)], axis=2).sum(axis=3)
    size, sums = real.sum(axis=1), (xy * real[:, None]).sum(axis=2)
    N = np.zeros((len(local), 3, 3))
    N[:, 0, 0] = N[:, 1, 1] = size
    N[:, :2, 2] = N[:, 2, :2] = -sums
    N[:, 2, 2] = ((xy**2).sum(axis=1) * real).sum(axis=1)
    good = size * N[:, 2, 2] - (sums**2).sum(axis=1) > 0.0
    N[~good] = np.eye(3)
    return np.linalg.solve(N[:, None], sides[..., None]), good
