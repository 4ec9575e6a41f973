"""The seven motions of a whole survey: three translations, three rotations about the world's origin, scale."""

import gtsam
import numpy as np

from adjust.model import FloatArray
from adjust.unknowns import Unknown


def skew(x: FloatArray) -> FloatArray:
    """The matrix (3, 3) that multiplies a vector from the left to give ``x`` cross it."""
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def point_motions(x: FloatArray) -> FloatArray:
    """How a point (3,) m of the world moves, (3, 7)."""
    return np.column_stack([np.eye(3), -skew(x), x])


def points_motions(x: FloatArray) -> FloatArray:
    """How points (n, 3) m of the world move, (n, 3, 7)."""
    B = np.zeros((len(x), 3, 7))
    B[:, :, :3], B[:, :, 6] = np.eye(3), x
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):  # w x x, by w
        B[:, i, 3 + j], B[:, j, 3 + i] = x[:, k], -x[:, k]
    return B


def motions_of(unknown: Unknown, values: gtsam.Values, in_world: bool) -> FloatArray:
    """How an unknown moves, (dim, 7). in_world: whether a pose is that of something in the world."""
    out = np.zeros((unknown.dim, 7))
    if unknown.kind == "point":
        return point_motions(np.asarray(values.atPoint3(unknown.key)))
    if unknown.kind == "pose":
        pose = values.atPose3(unknown.key)
        R, t = pose.rotation().matrix(), pose.translation()
        if in_world:
            out[3:, :3], out[:3, 3:6] = R.T, R.T
            out[3:, 3:6] = -R.T @ skew(t)
        out[3:, 6] = R.T @ t
    elif "axis_offset" in unknown.components:
        i = unknown.components.index("axis_offset")
        out[i, 6] = values.atVector(unknown.key)[i]
    elif unknown.name[0] == "warp":
        out[:, 6] = values.atVector(unknown.key)
    return out
