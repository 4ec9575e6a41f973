"""Steps along a tree of poses that tell of each other: the ends of long corridors and strips swing.

Moved each for itself, neighbours end up apart by the product of what both move and what they move apart.
"""

from dataclasses import field

import gtsam
import numpy as np
from gtsam import Pose3
from scipy import sparse

from adjust.frames.tree import in_world
from adjust.graph.assembly import AdjustmentGraph
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.pairs import compose_poses
from adjust.observations.images.batch import Chains
from adjust.observations.images.bundles import BundleBatch
from adjust.spatial.motions import poses_at
from adjust.spatial.rigid import rigid
from adjust.spatial.rigid_motions import Motions

_SHARE = 0.5
"""Of the points that a pose has most in common with any other, as many make it a neighbour."""


def _none() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@frozen(eq=False)
class Bending:
    """Poses (N,) of the world by key, an order in which they are reached, and (N,) from which each, -1: from none.

    points, carrier: (P,) keys of points that images tell of, and the number of the pose that each swings with.
    """

    keys: list[int]
    order: IntArray
    parent: IntArray
    points: IntArray = field(default_factory=_none)
    carrier: IntArray = field(default_factory=_none)

    def bent(self, values: gtsam.Values, delta: gtsam.VectorValues, straight: gtsam.Values) -> gtsam.Values:
        """Where a step leads if every pose turns and shifts by its share, as seen from the one it is reached from.

        straight: where the same step leads if everything moves for itself, as what is no part of the tree does.
        """
        at = Motions(*poses_at(values, self.keys))
        moved = np.array([delta.at(key) for key in self.keys])
        x, below = moved.copy(), np.flatnonzero(self.parent >= 0)
        inside = at[self.parent[below]].inverse() @ at[below]
        x[below] -= (inside.inverse().adjoint() @ moved[self.parent[below], :, None])[..., 0]
        R, t = at.rotation.copy(), at.shifts.copy()
        R[below], t[below] = inside.rotation, inside.shifts
        new = Motions(R, t).retract(x)
        R, t = (np.ascontiguousarray(a) for a in (new.rotation, new.shifts))
        compose_poses(self.order, self.parent, R, t)
        out = gtsam.Values(straight)
        for key, pose in zip(self.keys, rigid(R, t), strict=True):
            out.update(key, Pose3(pose))
        self._swing_points(values, delta, (at, moved, Motions(R, t)), out)
        return out

    def _swing_points(
        self, values: gtsam.Values, delta: gtsam.VectorValues, poses: tuple[Motions, FloatArray, Motions],
        out: gtsam.Values,
    ) -> None:  # fmt: skip
        if not len(self.points):
            return
        points = self.points.tolist()
        X, d = (np.array([of(key) for key in points]) for of in (values.atPoint3, delta.at))
        before, moved, after = poses[0][self.carrier], poses[1][self.carrier], poses[2][self.carrier]
        back = np.swapaxes(before.rotation, 1, 2)
        q = (back @ (X - before.shifts)[..., None])[..., 0]
        q += (back @ d[..., None])[..., 0] - np.cross(moved[:, :3], q) - moved[:, 3:]
        for key, x in zip(points, (after.rotation @ q[..., None])[..., 0] + after.shifts, strict=True):
            out.update(key, x)


def tree(n: int, a: IntArray, b: IntArray, near: IntArray) -> tuple[IntArray, IntArray]:
    """Of n poses of which a and b (E,) tell of each other: their order, and (n,) from which each is reached.

    In few steps from those ``near`` what is held. Of those that would reach one alike the one that reaches most others:
    where the others hang on a spine, loops close over few of its pairs. What is nowhere near has a root of its own.
    """
    from scipy.sparse.csgraph import connected_components, dijkstra  # here: small surveys start without it

    a, b = np.append(a, near), np.append(b, np.full(len(near), n))
    _, part = connected_components(sparse.csr_array((np.ones(len(a)), (a, b)), (n + 1, n + 1)), directed=False)
    alone, first = np.unique(part[:n], return_index=True)
    first = first[alone != part[n]]
    a, b = np.append(a, first), np.append(b, np.full(len(first), n))
    a, b = np.append(a, b), np.append(b, a)
    away = dijkstra(sparse.csr_array((np.ones(len(a)), (a, b)), (n + 1, n + 1)), indices=n, unweighted=True)
    on = away[b] == away[a] + 1.0
    a, b = a[on], b[on]
    last = np.lexsort((np.bincount(a, minlength=n + 1)[a], b))
    parent = np.full(n, -1)
    parent[b[last]] = a[last]  # of several the last one
    return np.argsort(away[:n], kind="stable"), np.where(parent == n, -1, parent)


def bending_of(graph: AdjustmentGraph) -> Bending | None:
    """Of the poses that images and pairs tie together; None where there is but one."""
    u = graph.unknowns
    keys = [k for k, x in u.by_key.items() if x.kind == "pose" and k not in u.held and in_world(graph.survey, x.name)]
    if len(keys) < 2:
        return None
    number = {key: i for i, key in enumerate(keys)}
    of_slot = np.array([-1 if k is None else number.get(k, -1) for k in u.slot_key], dtype=np.int64)
    ends = [_ends(graph.images.chains, of_slot)]
    if graph.pairs is not None:
        ends.append(np.stack([of_slot[graph.pairs.a_slot], of_slot[graph.pairs.b_slot]]))
    a, b = np.concatenate(ends, axis=1)
    pose, key, known = _sights(graph.bundles, of_slot)
    points, point = np.unique(key, return_inverse=True)
    seen = sparse.csr_array((np.ones(len(pose)), (pose, point)), (len(keys), len(points)))
    near = np.unique(np.concatenate([np.maximum(a, b)[(a < 0) ^ (b < 0)], known]))
    both = (a >= 0) & (b >= 0)
    beside = _neighbours(seen)
    order, parent = tree(len(keys), np.append(a[both], beside[0]), np.append(b[both], beside[1]), near)
    place = np.empty(len(keys), dtype=np.int64)
    place[order] = np.arange(len(keys))
    first = np.full(len(points), len(keys))
    np.minimum.at(first, point, place[pose])
    return Bending(keys, order, parent, points, order[first])


def _ends(chains: Chains, of_slot: IntArray) -> IntArray:
    """The poses (2, B), by number, between which the chains of image blocks run; -1 for what is none."""
    node, block = of_slot[chains.slot], np.repeat(np.arange(len(chains.ptr) - 1), np.diff(chains.ptr))
    one = np.full(len(chains.ptr) - 1, -1)
    np.maximum.at(one, block, node)
    both = np.bincount(block, node + 1, minlength=len(one)).astype(np.int64)
    return np.stack([one, both - one - 2])


def _sights(bundles: tuple[BundleBatch, ...], of_slot: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Which pose, by number, sees the point of which key; the poses that see what is held."""
    poses, keys = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)]
    for bundle in bundles:
        of_point = np.array([bundle.point_key.get(i, -1) for i in range(len(bundle.point_ids))], dtype=np.int64)
        poses.append(_ends(bundle.chains, of_slot)[0][bundle.block])
        keys.append(of_point[bundle.point])
    pose, key = np.concatenate(poses), np.concatenate(keys)
    return pose[(pose >= 0) & (key >= 0)], key[(pose >= 0) & (key >= 0)], pose[(pose >= 0) & (key < 0)]


def _neighbours(seen: sparse.csr_array) -> tuple[IntArray, IntArray]:
    """Poses that have many points in common, of those that each sees (N, P)."""
    common = sparse.coo_array(sparse.triu(seen @ seen.T, 1))
    a, b = common.coords
    most = np.zeros(seen.shape[0])
    for ends in (a, b):
        np.maximum.at(most, ends, common.data)
    many = common.data >= _SHARE * np.minimum(most[a], most[b])
    return a[many].astype(np.int64), b[many].astype(np.int64)
