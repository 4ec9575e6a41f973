"""Robust means of rotations and of rigid motions."""

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.spatial.rigid import nearest_rotation, rigid

_MEDOID_LIMIT = 150  # more candidates than this are thinned out for the quadratic search of the medoid
_SETTLED = 1e-4  # of the scale: a further step tells nothing that the motions do


def pose_distance(a: FloatArray, b: FloatArray, lever: float) -> FloatArray:
    """Distance in m between rigid motions (..., 4, 4): shift, and turn times ``lever`` m, added in squares."""
    squares = (a[..., :3, :] - b[..., :3, :]) ** 2
    # half of the turn has the sine |A - B| / sqrt(8) (Hartley et al., IJCV 103, 2013, sec. 4)
    turn = 2.0 * np.arcsin(np.minimum(np.sqrt(squares[..., :3].sum(axis=(-2, -1)) / 8.0), 1.0))
    return np.asarray(np.hypot(np.sqrt(squares[..., 3].sum(axis=-1)), lever * turn))


def mean_pose(
    poses: FloatArray, lever: float, members: IntArray | None = None, iterations: int = 20
) -> tuple[FloatArray, FloatArray]:
    """Robust mean (4, 4) of rigid motions (n, 4, 4), and the distance (n,) m of each from it.

    The start is the medoid; then reweighted chordal means (Hartley et al., IJCV 103, 2013) with Geman-McClure weights
    1 / (1 + (d / s)^2)^2, s three times the median distance. Nearly half of the motions may be wrong.
    members: (n,) numbers; motions of equal number are alternatives of one observation, of which the nearest counts.
    """
    index = np.arange(len(poses)) if members is None else np.unique(members, return_inverse=True)[1]
    mean = _medoid(poses, lever, index)
    for _ in range(iterations):
        distance = pose_distance(poses, mean, lever)
        chosen = _nearest(distance, index)
        scale = max(3.0 * float(np.median(distance[chosen])), 1e-12)
        weights = np.zeros(len(poses))
        weights[chosen] = 1.0 / (1.0 + (distance[chosen] / scale) ** 2) ** 2
        r = nearest_rotation(poses[:, :3, :3], weights)
        step = rigid(r, weights @ poses[:, :3, 3] / weights.sum())
        moved, mean = float(pose_distance(step, mean, lever)), step
        if moved < _SETTLED * scale:
            break
    return mean, pose_distance(poses, mean, lever)


def _nearest(distance: FloatArray, index: IntArray) -> IntArray:
    """Position of the nearest alternative of each observation."""
    order = np.lexsort((distance, index))
    first = np.concatenate([[True], np.diff(index[order]) > 0])
    return np.asarray(order[first])


def _medoid(poses: FloatArray, lever: float, index: IntArray) -> FloatArray:
    """The motion with the least sum of distances to the nearest alternatives of all observations."""
    step = max(1, -(-len(poses) // _MEDOID_LIMIT))
    trial = poses[::step]
    keep = np.isin(index, index[::step])
    others, groups = poses[keep], np.unique(index[keep], return_inverse=True)[1]
    d = pose_distance(trial[:, None], others[None], lever)
    best = np.full((len(trial), int(groups.max()) + 1), np.inf)
    for column, group in enumerate(groups):
        best[:, group] = np.minimum(best[:, group], d[:, column])
    return np.asarray(trial[int(np.argmin(best.sum(axis=1)))])
