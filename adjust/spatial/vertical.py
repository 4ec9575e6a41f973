"""The plumb line at any position, the horizontal axes there, and how both turn with the position and with the tilt.

With planes as level surfaces the plumb lines are parallel; with a radius they meet at ``-radius * up``. The first
horizontal axis is the axis ``zero`` of the world, turned by the tilt and laid into the horizon; the second stands 90
degrees counter-clockwise of it, seen from above. Directions that are unknown (of the plumb line, of planes and lines)
are so by two small turns.
"""

from dataclasses import dataclass
from typing import Literal

import gtsam
import numpy as np
from gtsam import Rot3

from adjust.frames.unknowns import Unknowns, VectorMap, vector_map
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, Survey, Vertical, tilt_axes
from adjust.spatial.rigid import skew

VERTICAL = ("vertical",)


@dataclass(frozen=True, eq=False)
class Horizon:
    """The horizons at n positions.

    axes: (n, 3, 3), rows zero, 90 degrees counter-clockwise, up. by_x (n, 3, 3), by_tilt (n, 3, 2): the rotation
    vector, about the world's axes, that they turn by with the position and with the tilts. height (n,): above the level
    of the world's origin; height_by_tilt (n, 2).
    """

    axes: FloatArray
    by_x: FloatArray
    by_tilt: FloatArray
    height: FloatArray
    height_by_tilt: FloatArray


@dataclass(frozen=True, eq=False)
class Plumb:
    """The plumb line at given tilts: ``up`` and ``zero`` (3,) at the world's origin and how they turn with the tilts.

    turns: (3, 2) rotation vector, about the world's axes, by the two tilts. radius: 0 for parallel plumb lines.
    """

    up: FloatArray
    zero: FloatArray
    turns: FloatArray
    radius: float

    def horizon(self, x: FloatArray) -> Horizon:
        """The horizons at positions x (n, 3).

        A change dv of the plumb line and dz of the zero axis turn the axes by v x dv + v (h1.dz - (zero.v) h1.dv) / n.
        """
        up, radius, dv, dz = self.up, self.radius, np.cross(self.turns.T, self.up), np.cross(self.turns.T, self.zero)
        if radius > 0.0:
            p = x + radius * up
            length = np.linalg.norm(p, axis=1)[:, None]
            v, share = p / length, radius / length
            height = (x * (x + 2.0 * radius * up)).sum(axis=1) / (length[:, 0] + radius)
        else:
            v, share, height = np.tile(up, (len(x), 1)), np.ones((len(x), 1)), x @ up
        dot = (v @ self.zero)[:, None]
        across = self.zero - dot * v
        n = np.linalg.norm(across, axis=1)[:, None]
        h1 = np.cross(v, across / n)
        by_x = np.zeros((len(x), 3, 3))
        if radius > 0.0:
            by_x += (skew(v) - v[:, :, None] * (dot / n * h1)[:, None]) / length[:, :, None]
        turned = share[:, :, None] * (dv - (v @ dv.T)[:, :, None] * v[:, None])
        twist = (h1 @ dz.T - dot * (turned @ h1[:, :, None])[:, :, 0]) / n
        by_tilt = np.swapaxes(np.cross(v[:, None], turned) + twist[:, :, None] * v[:, None], 1, 2)
        return Horizon(np.stack([across / n, h1, v], axis=1), by_x, by_tilt, height, share * (x @ dv.T))


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
    horizon = plumb_line.horizon(np.asarray(x, dtype=float)[None])
    up = horizon.axes[0, 2]
    cross = -skew(up)  # w -> w x up
    return up, cross @ horizon.by_x[0], cross @ horizon.by_tilt[0]


def tilted_frame(direction: FloatArray, tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The axes of a unit ``direction`` (3,) turned by ``tilt`` (2,) rad about the first two of them.

    Returns their directions as columns (3, 3), the tilted direction last, and the turn (3, 2) by the tilts, as a small
    rotation about these axes (perturbation on the right; Sola, Deray, Atchuthan 2018, equation 67).
    """
    axes = np.vstack([tilt_axes(direction), direction]).T
    right = np.zeros((3, 3), order="F")
    rotation = Rot3.Expmap(axes[:, :2] @ tilt, right)
    return np.asarray(rotation.matrix() @ axes), np.asarray(axes.T @ right @ axes[:, :2])


def tilted(direction: FloatArray, tilt: FloatArray) -> tuple[FloatArray, FloatArray]:
    """A unit ``direction`` (3,) turned by ``tilt`` (2,) rad about ``tilt_axes(direction)``, with derivative (3, 2)."""
    axes, turn = tilted_frame(direction, tilt)
    return axes[:, 2], axes @ np.cross(turn, np.array([0.0, 0.0, 1.0]), axisa=0).T
