"""Points from rays: linear intersection, then Gauss-Newton on the angles; many points at once."""


import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.averaging import medians


@frozen(eq=False)
class Intersection:
    """Intersected points.

    x: (n, 3) m, nan where fewer than two rays or no parallax. parallax: (n,) rad, the angle of two equivalent rays.
    residual: (m,) rad, angle between each ray and its point; pi where the point lies behind.
    """

    x: FloatArray
    parallax: FloatArray
    residual: FloatArray


def intersect(
    origins: FloatArray, directions: FloatArray, point_of: IntArray, n_points: int, iterations: int = 6
) -> Intersection:
    """Points from rays: origins (m, 3) m, directions (m, 3) unit, ``point_of`` (m,) which of n points each ray sees.

    Source: linear start as the point nearest to all lines, sum (I - dd') (x - o) = 0 (Hartley and Sturm, CVIU 68, 1997,
    for its relatives); then Gauss-Newton on the tangent-plane angles with Cauchy weights, so one wrong ray among four
    does no harm. A wrong ray among three cannot be told.
    """
    across = np.eye(3) - directions[:, :, None] * directions[:, None, :]
    normal = _sums(across, point_of, n_points)
    count = np.bincount(point_of, minlength=n_points)
    smallest = np.linalg.eigvalsh(normal)[:, 0] / np.maximum(count, 1)
    # two rays an angle a apart have smallest eigenvalue (1 - cos a) and so, over their number, sin^2(a / 2)
    parallax = 2.0 * np.arcsin(np.sqrt(np.clip(smallest, 0.0, 1.0)))
    good = (count >= 2) & (parallax > 1e-7)
    x = np.full((n_points, 3), np.nan)
    right = _sums((across @ origins[:, :, None])[..., 0], point_of, n_points)
    x[good] = np.linalg.solve(normal[good], right[good][..., None])[..., 0]
    for _ in range(iterations):
        x[good] += _newton_step(x, origins, across, point_of, n_points)[good]
    towards = x[point_of] - origins
    with np.errstate(invalid="ignore"):
        angle = np.arctan2(np.linalg.norm(np.cross(directions, towards), axis=1), np.sum(directions * towards, axis=1))
    return Intersection(x, np.where(count >= 2, parallax, 0.0), angle)


def _newton_step(x: FloatArray, origins: FloatArray, across: FloatArray, point_of: IntArray, n: int) -> FloatArray:
    """One reweighted step of every point (n, 3): offsets across the ray, divided by the distance."""
    towards = x[point_of] - origins
    distance = np.maximum(np.linalg.norm(towards, axis=1), 1e-12)
    offset = (across @ towards[:, :, None])[..., 0] / distance[:, None]
    size = np.linalg.norm(offset, axis=1)
    scale = np.maximum(3.0 * medians(size, point_of, n), 1e-12)
    w = 1.0 / (distance**2 * (1.0 + (size / scale[point_of]) ** 2))
    normal = _sums(w[:, None, None] * across, point_of, n)
    right = _sums((w * distance)[:, None] * offset, point_of, n)
    trace = np.trace(normal, axis1=1, axis2=2)
    bad = ~(np.isfinite(trace) & (np.linalg.eigvalsh(np.where(np.isfinite(normal), normal, 0.0))[:, 0] > 1e-15 * trace))
    normal[bad], right[bad] = np.eye(3), 0.0
    return np.asarray(-np.linalg.solve(normal, right[..., None])[..., 0])


def _sums(values: FloatArray, point_of: IntArray, n: int) -> FloatArray:
    out = np.zeros((n, *values.shape[1:]))
    np.add.at(out, point_of, values)
    return out
