"""The plumb line at any position, the horizontal axes there, and how both turn with the position and with the tilt.

With planes as level surfaces the plumb lines are parallel; with a radius they meet at ``-radius * up``. The first
horizontal axis is the axis ``zero`` of the world, turned by the tilt and laid into the horizon; the second stands 90
degrees counter-clockwise of it, seen from above.
"""

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from gtsam import Rot3

from adjust.compiling import njit
from adjust.errors import SurveyError
from adjust.model import FloatArray, Survey, Vertical, tilt_axes
from adjust.unknowns import Unknowns, VectorMap, vector_map

VERTICAL = ("vertical",)


@njit(cache=True, nogil=True)
def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """The vector a x b."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@njit(cache=True, nogil=True)
def horizon_at(
    x: FloatArray, up: FloatArray, zero: FloatArray, turns: FloatArray, radius: float, axes: FloatArray,
    by_x: FloatArray, by_tilt: FloatArray,
) -> float:  # fmt: skip
    """Axes (3, 3) at ``x``: rows zero, 90 degrees counter-clockwise, up; returns the height above the level of 0.

    up, zero: unit vectors at the world's origin (zero horizontal there). turns (3, 2): by how much these turn, about
    the world's axes, with the two tilts. radius: 0 for planes. by_x (3, 3), by_tilt (3, 2): the rotation vector, about
    the world's axes, that the axes turn by with the position and with the tilts.
    """
    by_x[:] = 0.0
    height = 0.0
    if radius == 0.0:
        v = up.copy()
        length = 1.0
        for i in range(3):
            height += x[i] * up[i]
    else:
        p = x + radius * up
        length = np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])
        v = p / length
        for i in range(3):
            height += x[i] * (x[i] + 2.0 * radius * up[i])
        height /= length + radius
    dot = zero[0] * v[0] + zero[1] * v[1] + zero[2] * v[2]
    h0 = zero - dot * v
    n = np.sqrt(h0[0] * h0[0] + h0[1] * h0[1] + h0[2] * h0[2])
    h0 /= n
    h1 = cross(v, h0)
    axes[0], axes[1], axes[2] = h0, h1, v
    # a change dv of the plumb line and dz of the zero axis turn the axes by v x dv + v (h1.dz - (zero.v) h1.dv) / n
    if radius > 0.0:
        for j in range(3):
            dv = -v[j] * v / length
            dv[j] += 1.0 / length
            twist = -dot * (h1[0] * dv[0] + h1[1] * dv[1] + h1[2] * dv[2]) / n
            by_x[:, j] = cross(v, dv) + twist * v
    for j in range(2):
        w = turns[:, j]
        dz, dv = cross(w, zero), cross(w, up)
        if radius > 0.0:
            dv *= radius / length
            dv -= (v[0] * dv[0] + v[1] * dv[1] + v[2] * dv[2]) * v
        twist = (
            h1[0] * dz[0] + h1[1] * dz[1] + h1[2] * dz[2] - dot * (h1[0] * dv[0] + h1[1] * dv[1] + h1[2] * dv[2])
        ) / n
        by_tilt[:, j] = cross(v, dv) + twist * v
    return height


@dataclass(frozen=True, eq=False)
class Plumb:
    """The plumb line at given tilts: ``up`` and ``zero`` (3,) at the world's origin and how they turn with the tilts.

    turns: (3, 2) rotation vector, about the world's axes, by the two tilts. radius: 0 for parallel plumb lines.
    """

    up: FloatArray
    zero: FloatArray
    turns: FloatArray
    radius: float

    def horizon(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
        """Axes (3, 3) (rows zero, counter-clockwise, up), their turns by x (3, 3) and tilt (3, 2), and the height."""
        axes, by_x, by_tilt = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 2))
        x = np.ascontiguousarray(x, dtype=float)
        height = horizon_at(x, self.up, self.zero, self.turns, self.radius, axes, by_x, by_tilt)
        return axes, by_x, by_tilt, height


def plumb(vertical: Vertical, zero: Literal["x", "y"], tilt: FloatArray) -> Plumb:
    """The plumb line at ``tilt`` (2,) rad, with horizontal axes counted from the world's axis ``zero``."""
    up = np.asarray(vertical.up_in_world, dtype=float)
    length = float(np.linalg.norm(up))
    if not 0.999 < length < 1.001:
        raise SurveyError(f"vertical: up_in_world has length {length:.4g}; give a unit vector")
    up = up / length
    axis = np.eye(3)["xyz".index(zero)]
    first = axis - up * (up @ axis)
    if np.linalg.norm(first) < 0.1:
        raise SurveyError(f"bearings count from the world's axis {zero}, which is nearly vertical; choose the other")
    first /= np.linalg.norm(first)
    turn_axes = tilt_axes(up)
    vector = tilt @ turn_axes
    R = Rot3.Expmap(vector).matrix()
    turns = Rot3.ExpmapDerivative(vector)  # right: R exp(J d) ; in the world: R J d
    return Plumb(R @ up, R @ first, np.ascontiguousarray(R @ np.asarray(turns) @ turn_axes.T), vertical.radius or 0.0)


@dataclass(frozen=True, eq=False)
class VerticalMap:
    """The plumb line of a survey from its values; ``key`` of the tilt, None where it is held."""

    vertical: Vertical
    zero: Literal["x", "y"]
    tilt: VectorMap | None

    @property
    def key(self) -> int | None:
        """The unknown tilt."""
        return self.tilt.key if self.tilt is not None else None

    @property
    def matrix(self) -> FloatArray:
        """Derivative (2, k) of the two tilts by those that are free."""
        return self.tilt.matrix if self.tilt is not None else np.zeros((2, 0))

    def at(self, values: gtsam.Values) -> Plumb:
        """The plumb line at these values."""
        tilt = np.asarray(self.vertical.tilt.values, dtype=float) if self.tilt is None else self.tilt.full(values)
        return plumb(self.vertical, self.zero, tilt)


def collect_vertical(survey: Survey, unknowns: Unknowns) -> VerticalMap:
    """Register the tilt where any component of it is free."""
    tilt = survey.vertical.tilt
    if tilt.free and VERTICAL not in unknowns.vectors:
        unknowns.vectors[VERTICAL] = vector_map(tilt, ("rad", "rad"), unknowns, VERTICAL)
    return VerticalMap(survey.vertical, survey.bearings.zero, unknowns.vectors.get(VERTICAL))


def up_at(plumb_line: Plumb, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The unit vector upwards at a position x (3,) m, with its derivatives by x (3, 3) and by the tilts (3, 2)."""
    axes, by_x, by_tilt, _ = plumb_line.horizon(x)
    up = axes[2]
    cross = np.array([[0, up[2], -up[1]], [-up[2], 0, up[0]], [up[1], -up[0], 0]])  # w -> w x up
    return up, cross @ by_x, cross @ by_tilt
