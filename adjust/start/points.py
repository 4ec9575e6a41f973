"""World points and the cameras that see them: resection from known points, intersection from known cameras.

And a second camera from image points alone: relative orientation, with a length that is not yet known.
"""

from collections.abc import Sequence

import numpy as np

from adjust.frames.unknowns import Link
from adjust.model.memory import content, once
from adjust.model.survey import BoolArray, FloatArray
from adjust.spatial.rigid import inverse, rigid
from adjust.start.chains import ChainObservation, Observations
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.network import FrameNetwork
from adjust.start.positions import PointField, Sight
from adjust.start.views import View, joined, make_views

PARALLAX = (np.deg2rad(3.0), np.deg2rad(0.3), 0.0)
"""What an intersection needs, rad; the next only where nothing goes on with the first."""
_TOGETHER = 4  # points that the cameras of a station must see together
_SHARED = 8
_TRIALS = 30  # pairs of images that are tried, those with the most common points first
_THRESHOLD_PX = 3.0


def resect(network: FrameNetwork, points: PointField) -> bool:
    """Give a pose to the blocks that see enough known points and have none yet; whether there were any."""
    have, known = set(network.observations.block_idx.tolist()), points.known
    sights = {s.block_idx: s for s in points.sights if s.block_idx not in have and network.unknown_links(s.chain)}
    seen = {i: int(known[s.rows].sum()) for i, s in sights.items()}
    # three points fit up to four poses exactly: they count only where nothing better is left
    views = _views([s for i, s in sights.items() if seen[i] >= 4], points)
    if not views and _resect_together(network, points):
        return True
    views = views or _views([s for i, s in sights.items() if seen[i] == 3], points)
    network.observe([ChainObservation(sights[v.block_idx].chain, v.poses, v.block_idx) for v in views])
    return bool(views)


def _views(sights: Sequence[Sight], points: PointField, present: FloatArray | None = None) -> list[View]:
    """Views of the known points; not those on a line, or none in front: other blocks may do."""
    known = points.known
    seen = [(s.block_idx, points.x[s.rows[k]], s.rays[k], s.focal_px) for s in sights for k in (known[s.rows],)]
    return list(make_views(joined(seen), present)[0]) if seen else []


def _resect_together(network: FrameNetwork, points: PointField) -> bool:
    """Poses of stations whose cameras see enough known points only together; whether one was found."""
    groups: dict[Link, list[tuple[Sight, int]]] = {}
    for sight in points.sights:
        missing = network.unknown_links(sight.chain)
        if len(missing) == 1 and points.known[sight.rows].any():
            groups.setdefault(sight.chain[missing[0]], []).append((sight, missing[0]))
    found = False
    for link, group in sorted(groups.items(), key=lambda item: item[0]):
        pose = _generalised_pose(network, points, group)
        if pose is not None:
            network.set_link(link, pose)
            found = True
    return found


def _generalised_pose(
    network: FrameNetwork, points: PointField, group: Sequence[tuple[Sight, int]]
) -> FloatArray | None:
    """Pose (4, 4) of the link that all these chains lack (GP3P inside RANSAC with a fixed seed, COLMAP), or None."""
    import pycolmap  # slow to load, and few surveys come here

    uv, x = [], []
    index: list[int] = []
    rigs: list[pycolmap.Rigid3d] = []
    cameras: list[pycolmap.Camera] = []
    for sight, position in group:
        rows = points.known[sight.rows] & (sight.rays[:, 2] > 0.1)
        before, after = network.product(sight.chain[:position]), network.product(sight.chain[position + 1 :])
        world = points.x[sight.rows][rows]
        uv.append(sight.rays[rows, :2] / sight.rays[rows, 2:] * sight.focal_px)
        x.append(world @ after[:3, :3].T + after[:3, 3])
        index += [len(rigs)] * int(rows.sum())
        rigs.append(pycolmap.Rigid3d(before[:3]))
        params = [sight.focal_px, sight.focal_px, 0.0, 0.0]
        cameras.append(pycolmap.Camera(model="PINHOLE", width=1, height=1, params=params))
    if len(index) < _TOGETHER:
        return None
    options = pycolmap.RANSACOptions(max_error=12.0, random_seed=1)
    answer = pycolmap.estimate_and_refine_generalized_absolute_pose(
        np.concatenate(uv), np.concatenate(x), index, rigs, cameras, options
    )
    if answer is None or answer["num_inliers"] < _TOGETHER:
        return None
    pose = np.eye(4)
    pose[:3] = answer["rig_from_world"].matrix()
    return pose


def intersect_points(network: FrameNetwork, points: PointField, parallax: float, renew: bool = False) -> int:
    """Intersect the unknown points (all but the given ones with ``renew``) from the cameras known; how many are new."""
    placed = [s for s in points.sights if not network.open_slots(s.chain)]
    if not placed:
        return 0
    row = np.concatenate([s.rows for s in placed])
    world_from_camera = np.repeat(inverse(network.products([s.chain for s in placed])), [len(s.rows) for s in placed],
                                  axis=0)  # fmt: skip
    directions = (world_from_camera[:, :3, :3] @ np.concatenate([s.rays for s in placed])[:, :, None])[..., 0]
    found = intersect(world_from_camera[:, :3, 3], directions, row, len(points.x))
    ahead = np.ones(len(points.x), dtype=bool)
    behind = np.bincount(row, weights=found.residual > np.pi / 2, minlength=len(points.x))
    ahead &= 2 * behind < np.bincount(row, minlength=len(points.x))
    wanted = np.where(points.rough, PARALLAX[0], parallax)  # a rough value is better than rays almost in line
    good = (found.parallax > wanted) & np.isfinite(found.x[:, 0]) & ahead & ~(points.given & points.known)
    new = good & ~points.known
    points.place(good if renew else new, found.x)
    return int(new.sum())


def improve(network: FrameNetwork, points: PointField, movable: BoolArray, rounds: int) -> None:
    """So many rounds; what images of the same points, at the same places, led to before is not found again."""
    seen, sights = points.seen(), [part for s in points.sights
                                    for part in (s.block_idx, s.focal_px, s.chain, s.rows, s.rays)]  # fmt: skip
    fields = points.x, points.given, points.rough
    known = content(*network.state, *(of[seen] for of in fields), points.released, movable, rounds, *sights)

    def improved() -> tuple[FloatArray, Observations, list[FloatArray | BoolArray]]:
        for _ in range(rounds):
            _improve(network, points, movable)
        return network.pose.copy(), network.observations, [of[seen] for of in fields]

    network.pose[:], network.observations, found = once((_improve, known), improved)
    points.x[seen], points.given[seen], points.rough[seen] = found


def _improve(network: FrameNetwork, points: PointField, movable: BoolArray) -> None:
    """One round: every block's pose from all points now known, the movable poses from these, and the points again."""
    known = points.known
    placed = [s for s in points.sights if not network.open_slots(s.chain) and known[s.rows].sum() >= 4]
    sights = {s.block_idx: s for s in placed}
    views = _views(placed, points, network.products([s.chain for s in placed]))
    renewed = {v.block_idx: ChainObservation(sights[v.block_idx].chain, v.poses, v.block_idx) for v in views}
    kept = [renewed.pop(o.block_idx, o) for o in network.observations]
    network.observations = Observations.of([*kept, *renewed.values()])
    touched = np.zeros(len(movable), dtype=np.bool_)
    touched[[link.slot for view in views for link in sights[view.block_idx].chain]] = True
    network.relax(movable & touched)
    intersect_points(network, points, PARALLAX[1], renew=True)


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
    network.set_link(second.chain[position], value)
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


def scale_lengths(network: FrameNetwork, points: PointField, factor: float) -> None:
    """Multiply the translations of all poses and all points that are not given."""
    network.pose[network.has & ~network.fixed, :3, 3] *= factor
    points.x[~points.given] *= factor
