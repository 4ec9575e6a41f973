"""World points and the cameras that see them: resection from known points and intersection from known cameras."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from adjust.frames.unknowns import Chain
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.spatial.rigid import inverse
from adjust.start import views as single
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.network import ChainObservation, PoseNetwork
from adjust.start.views import View, block_text, make_views, used_rows

PARALLAX = (np.deg2rad(3.0), np.deg2rad(0.3), 0.0)
"""What an intersection needs, rad; the next only where nothing goes on with the first."""
_TOGETHER = 4  # points that the cameras of a station must see together


@dataclass(frozen=True, eq=False)
class Sight:
    """A block of world points: positions (n,) in the survey's points, rays (n, 3) in the camera, camera_from_world."""

    block_idx: int
    camera_id: str
    text: str
    rows: IntArray
    rays: FloatArray
    focal_px: float
    chain: Chain


@dataclass(eq=False)
class PointField:
    """The world's points, (n, 3) m: nan until known. ``given`` (n,): coordinates that came with the survey.

    rough (n,): given ones that nothing but a start value tells. They stay unknown, and may be intersected, while there
    is firmer ground to go on from (targets), until they are ``released``.
    """

    x: FloatArray
    given: BoolArray
    rough: BoolArray
    sights: list[Sight] = field(default_factory=list)
    released: bool = False

    @property
    def known(self) -> BoolArray:
        """Which points (n,) have coordinates by now that may be used."""
        known = np.isfinite(self.x[:, 0])
        return np.asarray(known if self.released else known & ~self.rough)

    def release(self) -> bool:
        """Use the rough ones from now on; whether that is news."""
        news = not self.released and bool(self.rough.any())
        self.released = True
        return news

    def place(self, rows: BoolArray, x: FloatArray) -> None:
        """Set coordinates that were found; they are no given ones any more."""
        self.x[rows] = x[rows]
        self.given[rows] = self.rough[rows] = False

    def add(self, survey: Survey, block_idx: int, rays: FloatArray, focal_px: float, chain: Chain) -> None:
        """Take in a block of world points."""
        block = survey.image_blocks[block_idx]
        used = used_rows(block)
        rows = np.asarray(block.point_idx, dtype=np.int64)[used]
        self.sights.append(Sight(block_idx, block.camera_id, block_text(block), rows, rays[used], focal_px, chain))

    def seen(self) -> BoolArray:
        """Which points (n,) any block sees."""
        out = np.zeros(len(self.x), dtype=bool)
        for sight in self.sights:
            out[sight.rows] = True
        return out


def point_field(survey: Survey) -> PointField:
    """The points of a survey, given or observed; those with a start value are rough where targets are seen."""
    x = np.full((len(survey.points), 3), np.nan)
    index = {p.point_id: i for i, p in enumerate(survey.points)}
    for observed in survey.coordinates:
        finite = np.all(np.isfinite(np.diag(observed.cov)).reshape(-1, 3), axis=1).tolist()
        for ref, value, whole in zip(observed.positions, observed.values, finite, strict=True):
            if ref.frame is None and ref.point_id in index and observed.used and whole:
                x[index[ref.point_id]] = value
    firm = np.isfinite(x[:, 0])
    for i, point in enumerate(survey.points):
        known = point.x_in_world.treatment != "free" or bool(point.x_in_world.held)
        if point.x_in_world.value is not None and (known or not firm[i]):  # what was observed tells more than a start
            x[i] = point.x_in_world.value
            firm[i] |= known
    given = np.asarray(np.isfinite(x[:, 0]))
    boards = any(b.target_id is not None for b in survey.image_blocks)
    return PointField(x, given, given & ~firm, released=not boards)


def resect(network: PoseNetwork, points: PointField) -> bool:
    """Give a pose to the blocks that see enough known points and have none yet; whether there were any."""
    have, known = {o.block_idx for o in network.observations}, points.known
    sights = {s.block_idx: s for s in points.sights if s.block_idx not in have and network.unknown_links(s.chain)}
    seen = {i: int(known[s.rows].sum()) for i, s in sights.items()}
    # three points fit up to four poses exactly: they count only where nothing better is left
    views = _views([s for i, s in sights.items() if seen[i] >= 4], points)
    if not views and _resect_together(network, points):
        return True
    views = views or _views([s for i, s in sights.items() if seen[i] == 3], points)
    for view in views:
        sight = sights[view.block_idx]
        network.observations.append(ChainObservation(sight.chain, view.poses, sight.text, view.block_idx))
    return bool(views)


def _views(sights: Sequence[Sight], points: PointField, present: Sequence[FloatArray] | None = None) -> list[View]:
    """Views of the known points; not those on a line, or none in front: other blocks may do."""
    seen = []
    for s in sights:
        rows = points.known[s.rows]
        seen.append(single.Sight(s.block_idx, points.x[s.rows][rows], s.rays[rows], s.focal_px))
    return make_views(seen, present)[0]


def _resect_together(network: PoseNetwork, points: PointField) -> bool:
    """Poses of stations whose cameras see enough known points only together; whether one was found."""
    groups: dict[tuple[int, bool], list[tuple[Sight, int]]] = {}
    for sight in points.sights:
        missing = network.unknown_links(sight.chain)
        if len(missing) == 1 and points.known[sight.rows].any():
            link = sight.chain[missing[0]]
            groups.setdefault((link.slot, link.inverse), []).append((sight, missing[0]))
    found = False
    for (slot, inverted), group in sorted(groups.items(), key=lambda item: item[0]):
        pose = _generalised_pose(network, points, group)
        if pose is not None:
            network.known[slot] = inverse(pose) if inverted else pose
            found = True
    return found


def _generalised_pose(
    network: PoseNetwork, points: PointField, group: Sequence[tuple[Sight, int]]
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


def intersect_points(network: PoseNetwork, points: PointField, parallax: float, renew: bool = False) -> int:
    """Intersect the unknown points (all but the given ones with ``renew``) from the cameras known; how many are new."""
    origins, directions, rows = [], [], []
    for sight in points.sights:
        if network.unknown_links(sight.chain):
            continue
        world_from_camera = inverse(network.product(sight.chain))
        directions.append(sight.rays @ world_from_camera[:3, :3].T)
        origins.append(np.broadcast_to(world_from_camera[:3, 3], sight.rays.shape))
        rows.append(sight.rows)
    if not rows:
        return 0
    row = np.concatenate(rows)
    found = intersect(np.concatenate(origins), np.concatenate(directions), row, len(points.x))
    ahead = np.ones(len(points.x), dtype=bool)
    behind = np.bincount(row, weights=found.residual > np.pi / 2, minlength=len(points.x))
    ahead &= 2 * behind < np.bincount(row, minlength=len(points.x))
    wanted = np.where(points.rough, PARALLAX[0], parallax)  # a rough value is better than rays almost in line
    good = (found.parallax > wanted) & np.isfinite(found.x[:, 0]) & ahead & ~(points.given & points.known)
    new = good & ~points.known
    points.place(good if renew else new, found.x)
    return int(new.sum())


def improve(network: PoseNetwork, points: PointField, movable: set[int]) -> None:
    """One round: every block's pose from all points now known, the movable poses from these, and the points again."""
    known = points.known
    placed = [s for s in points.sights if not network.unknown_links(s.chain) and known[s.rows].sum() >= 4]
    sights = {s.block_idx: s for s in placed}
    views = _views(placed, points, list(network.products([s.chain for s in placed])))
    renewed = {
        v.block_idx: ChainObservation(sights[v.block_idx].chain, v.poses, sights[v.block_idx].text, v.block_idx)
        for v in views
    }
    network.observations = [renewed.pop(o.block_idx, o) for o in network.observations] + list(renewed.values())
    touched = {link.slot for view in views for link in sights[view.block_idx].chain}
    network.relax(movable & touched)
    intersect_points(network, points, PARALLAX[1], renew=True)
