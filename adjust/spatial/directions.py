"""Directions that are unknown by two small turns: of the plumb line, of planes and lines."""

import numpy as np
from gtsam import Rot3

from adjust.model.survey import FloatArray, tilt_axes


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
