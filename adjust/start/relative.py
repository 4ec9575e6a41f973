"""A second camera from image points alone: relative orientation, with a length that is not yet known."""

from collections.abc import Sequence

import numpy as np

from adjust.model.survey import FloatArray
from adjust.spatial.rigid import inverse, rigid
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.network import FrameNetwork
from adjust.start.points import PointField, Sight

_SHARED = 8
_TRIALS = 30  # pairs of images that are tried, those with the most common points first
_THRESHOLD_PX = 3.0


def orient_second(network: FrameNetwork, points: PointField) -> str | None:
    """Give a pose to one more image of unknown points, relative to one that has a pose; a note, or None.

    The distance of the two cameras is set to one metre. Source: Nister, PAMI 26(6), 2004 (five points, in OpenCV, with
    RANSAC of a fixed seed); of the most connected pairs the one with the best product of inliers and parallax is taken.
    """
    ready = [s for s in points.sights if not network.unknown_links(s.chain)]
    waiting = [s for s in points.sights if len(network.unknown_links(s.chain)) == 1]
    pairs = [(len(np.intersect1d(a.rows, b.rows)), i, j) for i, a in enumerate(ready) for j, b in enumerate(waiting)]
    best: tuple[float, Sight, Sight, FloatArray] | None = None
    for shared, i, j in sorted(pairs, key=lambda p: (-p[0], p[1], p[2]))[:_TRIALS]:
        if shared < _SHARED:
            break
        found = _relative_pose(ready[i], waiting[j])
        if found is not None and (best is None or found[0] > best[0]):
            best = (found[0], ready[i], waiting[j], found[1])
    if best is None:
        return None
    _, first, second, second_from_first = best
    camera_from_world = second_from_first @ network.product(first.chain)
    position = network.unknown_links(second.chain)[0]
    before = network.product(second.chain[:position])
    after = network.product(second.chain[position + 1 :])
    value = inverse(before) @ camera_from_world @ inverse(after)
    link = second.chain[position]
    network.known[link.slot] = inverse(value) if link.inverse else value
    return f"{second.text}: oriented relative to {first.text}, one metre apart until a length says otherwise"


def _relative_pose(first: Sight, second: Sight) -> tuple[float, FloatArray] | None:
    """Score and pose (4, 4) second_from_first with unit distance, or None."""
    import cv2  # here: networks without images start without it

    _, i, j = np.intersect1d(first.rows, second.rows, return_indices=True)
    ahead = (first.rays[i, 2] > 0.1) & (second.rays[j, 2] > 0.1)
    a, b = first.rays[i][ahead], second.rays[j][ahead]
    if len(a) < _SHARED:
        return None
    xy = [r[:, :2] / r[:, 2:] for r in (a, b)]
    threshold = _THRESHOLD_PX / min(first.focal_px, second.focal_px)
    essential, inliers = cv2.findEssentialMat(
        xy[0], xy[1], cameraMatrix=np.eye(3), method=cv2.RANSAC, prob=0.9999, threshold=threshold
    )
    if essential is None or essential.shape != (3, 3):
        return None
    count, turn, shift, mask = cv2.recoverPose(essential, xy[0], xy[1], cameraMatrix=np.eye(3), mask=inliers)
    if count < _SHARED:
        return None
    pose = rigid(np.asarray(turn, dtype=float), np.asarray(shift, dtype=float)[:, 0])
    good = mask.ravel() > 0
    return count * float(np.clip(_parallax(pose, a[good], b[good]), 0.0, np.deg2rad(15.0))), pose


def _parallax(second_from_first: FloatArray, a: FloatArray, b: FloatArray) -> float:
    """Median angle of corresponding rays, rad."""
    first_from_second = inverse(second_from_first)
    n = len(a)
    origins = np.concatenate([np.zeros((n, 3)), np.tile(first_from_second[:3, 3], (n, 1))])
    directions = np.concatenate([a, b @ first_from_second[:3, :3].T])
    return float(np.median(intersect(origins, directions, np.tile(np.arange(n), 2), n, iterations=0).parallax))


def scale_lengths(network: FrameNetwork, points: PointField, factor: float, slots: Sequence[int]) -> None:
    """Multiply the translations of these poses and all points that are not given."""
    for slot in slots:
        network.known[slot] = rigid(network.known[slot][:3, :3], factor * network.known[slot][:3, 3])
    points.x[~points.given] *= factor
