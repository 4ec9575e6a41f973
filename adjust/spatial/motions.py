"""The seven motions of a whole survey: three translations, three rotations about the world's origin, scale."""

from collections.abc import Sequence

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.unknowns import Unknown
from adjust.model.survey import BoolArray, FloatArray
from adjust.spatial.rigid import skew


def point_motions(x: FloatArray) -> FloatArray:
    """How a point (3,) m of the world moves, (3, 7)."""
    return np.asarray(points_motions(x[None])[0])


def points_motions(x: FloatArray) -> FloatArray:
    """How points (n, 3) m of the world move, (n, 3, 7)."""
    return np.concatenate([np.tile(np.eye(3), (len(x), 1, 1)), -skew(x), x[:, :, None]], axis=2)


def poses_motions(R: FloatArray, t: FloatArray, in_world: BoolArray) -> FloatArray:
    """How poses (R (n, 3, 3), t (n, 3) m) move, (n, 6, 7). in_world (n,): whether it is that of something there."""
    out, transposed = np.zeros((len(t), 6, 7)), R.transpose(0, 2, 1)
    out[:, 3:, 6] = np.einsum("nij,nj->ni", transposed, t)
    turned = transposed[in_world]
    out[in_world, 3:, :3] = out[in_world, :3, 3:6] = turned
    out[in_world, 3:, 3:6] = turned @ points_motions(t[in_world])[:, :, 3:6]
    return out


def values_motions(values: Sequence[Pose3 | FloatArray]) -> FloatArray:
    """How all components (n, 7) of points and poses of the world move."""
    is_pose = np.array([isinstance(v, Pose3) for v in values], dtype=np.bool_)
    poses = np.array([v.matrix() for v in values if isinstance(v, Pose3)]).reshape(-1, 4, 4)
    points = np.array([v for v in values if not isinstance(v, Pose3)]).reshape(-1, 3)
    of_pose = np.repeat(is_pose, np.where(is_pose, 6, 3))
    out = np.empty((len(of_pose), 7))
    out[~of_pose] = points_motions(points).reshape(-1, 7)
    R, t, in_world = poses[:, :3, :3], np.nan_to_num(poses[:, :3, 3]), np.ones(len(poses), dtype=np.bool_)
    out[of_pose] = poses_motions(R, t, in_world).reshape(-1, 7)
    return out


def moved_value(value: Pose3 | FloatArray, motion: FloatArray) -> Pose3 | FloatArray:
    """A point or pose moved by ``motion`` (7,) about the origin: translation, rotation vector, ln(scale)."""
    R, s = Rot3.Expmap(motion[3:6]), float(np.exp(motion[6]))
    if isinstance(value, Pose3):
        return Pose3(R * value.rotation(), s * R.matrix() @ value.translation() + motion[:3])
    return np.asarray(s * R.matrix() @ value + motion[:3])


def poses_at(values: gtsam.Values, keys: Sequence[int]) -> tuple[FloatArray, FloatArray]:
    """Rotations (n, 3, 3) and translations (n, 3) m of poses."""
    found = np.array([values.atPose3(key).matrix() for key in keys]).reshape(-1, 4, 4)
    return found[:, :3, :3], found[:, :3, 3]


def motions_of(unknown: Unknown, values: gtsam.Values, in_world: bool) -> FloatArray:
    """How an unknown moves, (dim, 7). in_world: whether a pose is that of something in the world."""
    out = np.zeros((unknown.dim, 7))
    if unknown.kind == "point":
        return point_motions(np.asarray(values.atPoint3(unknown.key)))
    if unknown.kind == "pose":
        R, t = poses_at(values, [unknown.key])
        return np.asarray(poses_motions(R, t, np.array([in_world]))[0])
    if "axis_offset" in unknown.components:
        i = unknown.components.index("axis_offset")
        out[i, 6] = values.atVector(unknown.key)[i]
    elif unknown.name[0] == "warp":
        scales = [c.startswith("scale") for c in unknown.components]
        out[:, 6] = values.atVector(unknown.key) + scales
    return out
