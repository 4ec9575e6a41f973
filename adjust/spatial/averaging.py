"""Robust means of angles, of rotations and of rigid motions."""

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.spatial.rigid import nearest_rotation, rigid

_MEDOID_LIMIT = 40  # more candidates than this are thinned out for the quadratic search of the medoid
_AT_ONCE = 1000  # means whose medoids are found together
_STEPS = 20
_SETTLED = 1e-4  # of the scale: a further step tells nothing that the motions do


def wrapped(angles: FloatArray) -> FloatArray:
    """Angles (...) rad as the nearest turns, from minus half a turn to half a turn."""
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)


def circular_median(angles: FloatArray) -> float:
    """The angle nearest to all others (least sum of absolute differences), of those given; zero of none."""
    if len(angles) < 2:
        return float(angles[0]) if len(angles) else 0.0
    return float(circular_medians(angles[None])[0])


def circular_medians(angles: FloatArray) -> FloatArray:
    """The same (m,) of each row of angles (m, n), n > 0."""
    some = angles[:, :: max(1, angles.shape[1] // 64)]
    turns = wrapped(angles[:, None, :] - some[:, :, None])
    rows, best = np.arange(len(angles)), np.abs(turns).sum(axis=2).argmin(axis=1)
    ordered, n = np.sort(turns[rows, best], axis=1), angles.shape[1]  # of few, np.median takes ten times as long
    return np.asarray(some[rows, best] + 0.5 * (ordered[:, (n - 1) // 2] + ordered[:, n // 2]))


def pose_distance(a: FloatArray, b: FloatArray, lever: float) -> FloatArray:
    """Distance in m between rigid motions (..., 4, 4): shift, and turn times ``lever`` m, added in squares."""
    squares = (a[..., :3, :] - b[..., :3, :]) ** 2
    # half of the turn has the sine |A - B| / sqrt(8) (Hartley et al., IJCV 103, 2013, sec. 4)
    turn = 2.0 * np.arcsin(np.minimum(np.sqrt(squares[..., :3].sum(axis=(-2, -1)) / 8.0), 1.0))
    return np.asarray(np.hypot(np.sqrt(squares[..., 3].sum(axis=-1)), lever * turn))


def typical_distance(poses: FloatArray) -> float:
    """The median length, m, of the shifts of rigid motions (n, 4, 4): at which turns weigh as much as shifts."""
    return float(np.median(np.linalg.norm(poses[:, :3, 3], axis=1)))


def mean_pose(poses: FloatArray, lever: float, members: IntArray | None = None) -> tuple[FloatArray, FloatArray]:
    """One mean (4, 4) as :func:`mean_poses` has it, and the distance (n,) m of each motion from it."""
    order = np.arange(len(poses)) if members is None else np.argsort(members, kind="stable")
    sorted_members = None if members is None else members[order]
    mean = mean_poses(poses[order], lever, np.array([0, len(poses)]), sorted_members)[0]
    return mean, pose_distance(poses, mean, lever)


def mean_poses(poses: FloatArray, lever: float, ptr: IntArray, members: IntArray | None = None) -> FloatArray:
    """Robust means (k, 4, 4) of rigid motions (n, 4, 4), those of each mean one after the other by ptr (k + 1,).

    The start is the medoid; then reweighted chordal means (Hartley et al., IJCV 103, 2013) with Geman-McClure weights
    1 / (1 + (d / s)^2)^2, s three times the median distance. Nearly half of the motions may be wrong.
    members: (n,) numbers in order; neighbours of equal number are alternatives of one observation, the nearest counts.
    """
    owner = np.repeat(np.arange(len(ptr) - 1), np.diff(ptr))
    new = np.ones(len(poses), dtype=np.bool_) if members is None else _begins(members) | _begins(owner)
    member = np.cumsum(new) - 1
    mean = np.concatenate([
        poses[_medoids(poses, lever, part, member)]
        for part in np.split(np.column_stack([ptr[:-1], ptr[1:]]), range(_AT_ONCE, len(ptr) - 1, _AT_ONCE))
    ])  # fmt: skip
    live, of, of_member, here = np.arange(len(mean)), owner, owner[new], poses
    for _ in range(_STEPS):
        distance = pose_distance(here, mean[live[of]], lever)
        chosen = least(distance, member)
        near, first = distance[chosen], np.searchsorted(of_member, np.arange(len(live)))
        scale = np.maximum(3.0 * medians(near, of_member, len(live)), 1e-12)
        weights = 1.0 / (1.0 + (near / scale[of_member]) ** 2) ** 2
        total = np.add.reduceat(weights[:, None, None] * here[chosen, :3], first)
        step = rigid(nearest_rotation(total[..., :3]), total[..., 3] / np.add.reduceat(weights, first)[:, None])
        going = pose_distance(step, mean[live], lever) >= _SETTLED * scale
        mean[live] = step
        live = live[going]
        if not len(live):
            break
        if not going.all():
            rows, number = going[of], np.cumsum(going) - 1
            of, here, member = number[of[rows]], here[rows], member[rows]
            of_member = number[of_member[going[of_member]]]
    return mean


def _begins(numbers: IntArray) -> BoolArray:
    """(n,) whether a number is another one than that before it."""
    out = np.ones(len(numbers), dtype=np.bool_)
    np.not_equal(numbers[1:], numbers[:-1], out=out[1:])
    return out


def least(values: FloatArray, owner: IntArray) -> IntArray:
    """Position of the least of the values (n,) of each owner (n,), whose numbers are in order; the first of equals."""
    new = _begins(owner)
    if new.all():
        return np.arange(len(owner))
    hits = np.flatnonzero(values == np.minimum.reduceat(values, np.flatnonzero(new))[np.cumsum(new) - 1])
    return np.asarray(hits[_begins(owner[hits])])


def medians(values: FloatArray, owner: IntArray, k: int) -> FloatArray:
    """Of the values (n,) of each of k owners (n,); of one without any the number means nothing."""
    ordered, size = np.append(values[np.lexsort((values, owner))], 0.0), np.bincount(owner, minlength=k)
    first = np.cumsum(size) - size
    return np.asarray(0.5 * (ordered[first + (size - 1) // 2] + ordered[first + size // 2]))


def _medoids(poses: FloatArray, lever: float, spans: IntArray, member: IntArray) -> IntArray:
    """Of each span (k, 2) of motions that with the least sum of distances to the nearest ones of all members."""
    low, size = spans[0, 0], spans[:, 1] - spans[:, 0]
    owner, step = np.repeat(np.arange(len(spans)), size), np.maximum(1, -(-size // _MEDOID_LIMIT))
    place = np.arange(len(owner)) - (spans[:, 0] - low)[owner]
    trial = np.flatnonzero(place % step[owner] == 0)
    own = member[low : spans[-1, 1]]
    tried = np.zeros(len(member), dtype=np.bool_)
    tried[own[trial]] = True
    kept = np.flatnonzero(tried[own])
    counts = np.bincount(owner[kept], minlength=len(spans))
    begin = np.cumsum(counts) - counts
    n = counts[owner[trial]]
    first = np.cumsum(n) - n
    other = kept[np.repeat(begin[owner[trial]] - first, n) + np.arange(n.sum())]
    d = pose_distance(poses[low + np.repeat(trial, n)], poses[low + other], lever)
    changes = _begins(own[other])
    changes[first] = True
    runs = np.flatnonzero(changes)
    sums = np.add.reduceat(np.minimum.reduceat(d, runs), np.searchsorted(runs, first))
    return np.asarray(low + trial[least(sums, owner[trial])])
