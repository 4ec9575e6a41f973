"""The plumb line at any position, the horizontal axes there, and how both turn with the position and with the tilt.

With planes as level surfaces the plumb lines are parallel; with a radius they meet at ``-radius * up``. The first
horizontal axis is the axis ``zero`` of the world, turned by the tilt and laid into the horizon; the second stands 90
degrees counter-clockwise of it, seen from above. Directions that are unknown (of the plumb line, of planes and lines)
are so by two small turns.
"""

from functools import cached_property
from typing import Literal

import gtsam
import numpy as np
from gtsam import Rot3

from adjust.frames.unknowns import Unknowns, VectorMap, vector_map
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, Survey, Vertical, tilt_axes
from adjust.spatial.rigid import skew

VERTICAL = ("vertical",)


@frozen(eq=False)
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


@frozen(eq=False)
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
        (v, curved, turned), dz = self.upwards(x), self.turns.T @ skew(self.zero)
        dot = (v @ self.zero)[:, None]
        across = self.zero - dot * v
        n = np.linalg.norm(across, axis=1)[:, None]
        crossing = skew(v)
        h1 = (crossing @ (across / n)[:, :, None])[:, :, 0]
        by_x = (crossing - v[:, :, None] * (dot / n * h1)[:, None]) * curved[:, :, None]
        twist = (h1 @ dz.T - dot * (h1[:, None] @ turned)[:, 0]) / n
        by_tilt = crossing @ turned + v[:, :, None] * twist[:, None]
        height = x @ self.up
        if self.radius > 0.0:
            height = (x * (x + 2.0 * self.radius * self.up)).sum(axis=1) / (1.0 / curved[:, 0] + self.radius)
        height_by_tilt = self._share(curved) * (x @ self.turned_up)
        return Horizon(np.stack([across / n, h1, v], axis=1), by_x, by_tilt, height, height_by_tilt)

    def upwards(self, x: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """At positions x (n, 3): up (n, 3), the curvature (n, 1) of their level, the derivative of up by the tilts."""
        if self.radius > 0.0:
            p = x + self.radius * self.up
            curved = 1.0 / np.linalg.norm(p, axis=1)[:, None]
            v = p * curved
        else:
            v, curved = np.tile(self.up, (len(x), 1)), np.zeros((len(x), 1))
        turned = self.turned_up - v[:, :, None] * (v @ self.turned_up)[:, None]
        return v, curved, self._share(curved)[:, :, None] * turned

    @cached_property
    def turned_up(self) -> FloatArray:
        """How ``up`` moves with the tilts (3, 2)."""
        return np.asarray(-skew(self.up) @ self.turns)

    def _share(self, curved: FloatArray) -> FloatArray:
        return self.radius * curved if self.radius > 0.0 else np.ones_like(curved)


def plumb(vertical: Vertical, zero: Literal["x", "y"], tilt: FloatArray) -> Plumb:
    """The plumb line at ``tilt`` (2,) rad, with horizontal axes counted from the world's axis ``zero``."""
    return _tilted_plumb(_upright(vertical, zero), tilt)


def _upright(vertical: Vertical, zero: Literal["x", "y"]) -> Plumb:
    """The plumb line without tilt, and the axes that it is tilted about."""
    up = np.asarray(vertical.up_in_world, dtype=float)
    length = float(np.linalg.norm(up))
    if not 0.999 < length < 1.001:
        raise SurveyError(f"vertical: up_in_world has length {length:.4g}; give a unit vector")
    up = up / length
    axis = np.eye(3)["xyz".index(zero)]
    first = axis - up * (up @ axis)
    if np.linalg.norm(first) < 0.1:
        raise SurveyError(f"bearings count from the world's axis {zero}, which is nearly vertical; choose the other")
    return Plumb(up, first / np.linalg.norm(first), tilt_axes(up).T, vertical.radius or 0.0)


def _tilted_plumb(upright: Plumb, tilt: FloatArray) -> Plumb:
    right = np.zeros((3, 3), order="F")
    R = Rot3.Expmap(upright.turns @ tilt, right).matrix()  # R exp(right d) ; in the world: R right d
    turns = np.ascontiguousarray(R @ right @ upright.turns)
    return Plumb(R @ upright.up, R @ upright.zero, turns, upright.radius)


@frozen(eq=False)
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
        """The plumb line at these values; always the same one where its tilt is held."""
        return self._held if self.tilt is None else _tilted_plumb(self._upright, self.tilt.full(values))

    @cached_property
    def _held(self) -> Plumb:
        return _tilted_plumb(self._upright, np.asarray(self.vertical.tilt.values, dtype=float))

    @cached_property
    def _upright(self) -> Plumb:
        return _upright(self.vertical, self.zero)


def collect_vertical(survey: Survey, unknowns: Unknowns) -> VerticalMap:
    """Register the tilt where any component of it is free."""
    tilt = survey.vertical.tilt
    if tilt.free and VERTICAL not in unknowns.vectors:
        unknowns.vectors[VERTICAL] = vector_map(tilt, ("rad", "rad"), unknowns, VERTICAL)
    return VerticalMap(survey.vertical, survey.bearings.zero, unknowns.vectors.get(VERTICAL))


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
