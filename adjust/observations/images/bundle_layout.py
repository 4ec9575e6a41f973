"""What a bundle of image points is a factor on, what it hides, and where everything stands in it."""

from collections.abc import Sequence
from functools import cached_property
from typing import TypeVar

import numpy as np
from scipy import sparse

from adjust.frames.state import State
from adjust.frames.unknowns import Chain, Unknowns
from adjust.model.observations import ImageBlock, ImagePoints
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.bundles import BundleArrays
from adjust.native.images import square_root_information
from adjust.native.lenses import MAX_LENS
from adjust.native.parallel import workers
from adjust.observations.images.batch import Chains

_Rows = TypeVar("_Rows", FloatArray, BoolArray)


def may_be_hidden(unknowns: Unknowns, key: int) -> bool:
    """Whether an unknown is the pose of a station at one epoch, which image points alone may determine."""
    name = unknowns.by_key[key].name
    return name[0] == "world_from_station" and len(name) == 3


class BundleLayout:
    """Image blocks of world points, of which some are unknown.

    points: ids in the order of ``point_idx`` of the blocks. outside: keys that other factors touch. Inside, only the
    points that these blocks see are numbered. Image points are sorted: those of a reduced point side by side, then
    those of points that stay, then of the held ones.
    """

    def __init__(
        self, unknowns: Unknowns, state: State, blocks: Sequence[ImageBlock], chains: Sequence[Chain],
        points: Sequence[str], outside: set[int],
    ) -> None:  # fmt: skip
        self.unknowns, self.state = unknowns, state
        self.blocks = tuple(blocks)
        self.chains = Chains(chains)
        all_seen = ImagePoints.of(blocks)
        present, self._point_of_rows = np.unique(all_seen.point_idx, return_inverse=True)
        self.point_ids = tuple(points[i] for i in present.tolist())
        self.camera = np.array([state.lens_states.of(b.camera_id, b.epoch_id) for b in blocks], dtype=np.int64)
        self.block_ptr = all_seen.ptr
        self._choose_interface(outside)
        self._sort_observations(all_seen)
        self._place_local_unknowns()
        self._place_derivatives()

    def _choose_interface(self, outside: set[int]) -> None:
        """Hide the free points and per-epoch poses that nothing else touches.

        Two poses stay, so that what is hidden is determined even where the datum is not, which the solver then names;
        and one unknown at least, for GTSAM knows no factor without any.
        """
        key_of = {i: self.unknowns.by_name[("point", p)].key for i, p in enumerate(self.point_ids)
                  if ("point", p) in self.unknowns.by_name}  # fmt: skip
        self.point_key = key_of
        self.tied = sorted(i for i, key in key_of.items() if key in outside)
        tied = set(self.tied)
        self.reduced = sorted(i for i in key_of if i not in tied)
        pose_keys: list[int] = []
        for slot in self.chains.slot:
            pose_keys += [k for k in self.unknowns.link_keys(int(slot)) if k not in pose_keys]
        may_hide = [k for k in pose_keys if k not in outside and may_be_hidden(self.unknowns, k)]
        self.hidden_poses = may_hide[1:-1]
        hidden = set(self.hidden_poses)
        lenses = sorted(set(self.camera.tolist()))
        lens_keys = list(dict.fromkeys(p.key for i in lenses for p in self.state.lens_states.parts(i)))
        if not lens_keys and not pose_keys and not self.tied:
            self.tied = sorted(key_of)[:1]
            self.reduced = [i for i in self.reduced if i not in self.tied]
        self.interface = lens_keys + [k for k in pose_keys if k not in hidden] + [key_of[i] for i in self.tied]
        self.order = self.hidden_poses + self.interface
        dims = [self.unknowns.by_key[k].dim for k in self.order]
        starts = np.cumsum([0] + dims)
        self.key_at = {k: int(starts[i]) for i, k in enumerate(self.order)}
        self.n_keys = int(starts[-1])
        self.n_hidden = int(sum(dims[: len(self.hidden_poses)]))

    def _sort_observations(self, all_seen: ImagePoints) -> None:
        block = np.repeat(np.arange(len(self.blocks)), np.diff(self.block_ptr))
        point = self._point_of_rows
        group = np.full(len(self.point_ids), 0)  # reduced points first, then those that stay, then the held
        group[self.tied] = 1
        group[[i for i in range(len(self.point_ids)) if i not in self.point_key]] = 2
        self.sorted: IntArray = np.lexsort((block, self.camera[block], point, group[point]))
        self.block, self.point = block[self.sorted].astype(np.int64), point[self.sorted].astype(np.int64)
        self.camera_of = self.camera[self.block]
        self.uv, self.used = all_seen.uv[self.sorted], all_seen.used[self.sorted]
        self.W_all = square_root_information(all_seen.cov[self.sorted])
        self.n_reduced = int(np.count_nonzero(group[self.point] == 0))
        seen = self.point[: self.n_reduced]
        self.reduced = [int(i) for i in dict.fromkeys(seen)]
        self.ptr = np.searchsorted(seen, [*self.reduced, np.iinfo(np.int64).max]).astype(np.int64)
        pair = np.stack([seen, self.camera_of[: self.n_reduced]], axis=1)
        new = np.ones(len(pair), dtype=np.bool_)
        new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
        self.pc_of = (np.cumsum(new) - 1).astype(np.int64)
        self.pc_camera = pair[new, 1].astype(np.int64)
        self.pc_ptr = np.searchsorted(pair[new, 0], [*self.reduced, np.iinfo(np.int64).max]).astype(np.int64)
        mine = self.block[: self.n_reduced]
        self.point_of = np.repeat(np.arange(len(self.reduced)), np.diff(self.ptr))
        self.by_block = np.argsort(mine, kind="stable").astype(np.int64)
        self.by_ptr = np.searchsorted(mine[self.by_block], np.arange(len(self.blocks) + 1)).astype(np.int64)
        # later images have more pairs with earlier ones: every worker takes some of all
        count = workers() if self.n_reduced > 2000 else 1
        self.runs = [np.arange(i, len(self.blocks), count) for i in range(min(count, len(self.blocks)))]

    def _place_local_unknowns(self) -> None:
        n_lens = self.state.lenses.n_free
        used_cameras = set(self.camera.tolist())
        self.lens_at = np.zeros(len(n_lens), dtype=np.int64)
        offset = 0
        for i in sorted(used_cameras):
            self.lens_at[i] = offset
            offset += int(n_lens[i])
        self.pose_at = (offset + 6 * self.block).astype(np.int64)
        self.first_pose = offset
        offset += 6 * len(self.blocks)
        self.tied_at = {i: offset + 3 * q for q, i in enumerate(self.tied)}
        of_point = np.full(len(self.point_ids), -1, dtype=np.int64)
        of_point[list(self.tied_at)] = list(self.tied_at.values())
        self.point_at = of_point[self.point]
        self.n_local = offset + 3 * len(self.tied)
        self.arrays = BundleArrays(
            self.block, self.camera_of, self.pose_at, self.point_at, self.ptr, self.point_of, self.by_block,
            self.by_ptr, self.pc_ptr, self.pc_camera, self.pc_of, n_lens, self.lens_at, self.first_pose,
        )  # fmt: skip

    def _place_derivatives(self) -> None:
        """Where the derivatives of the local unknowns by the keys stand; which hidden poses own one block alone."""
        rows, columns, links, self._derived_links = [], [], [], []
        own: dict[int, list[tuple[int, int]]] = {key: [] for key in self.hidden_poses}
        for b in range(len(self.blocks)):
            for link in range(self.chains.ptr[b], self.chains.ptr[b + 1]):
                slot = int(self.chains.slot[link])
                if self.unknowns.derived(slot) is not None:
                    self._derived_links.append((self.first_pose + 6 * b, slot, link))
                    continue
                for key in self.unknowns.link_keys(slot):
                    rows.append(self.first_pose + 6 * b)
                    columns.append(self.key_at[key])
                    links.append(link)
                    if key in own:
                        own[key].append((b, link))
        lenses, states = sorted(set(self.camera.tolist())), self.state.lens_states
        fixed = [(int(self.lens_at[i]) + p.first, self.key_at[p.key] + p.within, p.n, p.factor)
                 for i in lenses for p in states.parts(i)]  # fmt: skip
        fixed += [(at, self.key_at[self.point_key[i]], 3, 1.0) for i, at in self.tied_at.items()]
        at = np.array(rows, dtype=np.int64)[:, None, None] + np.arange(6)[:, None]
        to = np.array(columns, dtype=np.int64)[:, None, None] + np.arange(6)
        every = np.zeros((len(links), 6, 6), dtype=np.int64)
        self._G_links = np.array(links, dtype=np.int64)
        self._G_rows = np.concatenate([(at + every).ravel(), *(r + np.arange(n) for r, _, n, _ in fixed)])
        self._G_columns = np.concatenate([(to + every).ravel(), *(c + np.arange(n) for _, c, n, _ in fixed)])
        self._G_direct = np.repeat([f for *_, f in fixed], [n for _, _, n, _ in fixed])
        owners = [block for key in self.hidden_poses for block in own[key]]
        blocks_of = [b for b, _ in owners]
        per_block = np.bincount(np.array(rows, dtype=np.int64), minlength=self.n_local + 1)
        # every hidden pose is that of one block, and the only unknown behind that block's pose
        self.alone = (
            bool(owners) and not self._derived_links and all(len(own[key]) == 1 for key in self.hidden_poses)
            and bool(np.all(per_block[self.first_pose + 6 * np.array(blocks_of)] == 1))
        )  # fmt: skip
        self.own_links = np.array([link for _, link in owners], dtype=np.int64)
        self.own_at = (self.first_pose + 6 * np.array(blocks_of, dtype=np.int64)).astype(np.int64)

    def local_from_keys(self) -> sparse.csr_matrix:
        """Derivative (n_local, n_keys) of the local unknowns by the keys: lens and points direct, poses by chains."""
        r, c = [self._G_rows], [self._G_columns]
        v = [self.chains.C[self._G_links].ravel(), self._G_direct]
        for row, slot, link in self._derived_links:
            for key, J in self.state.by_keys(slot, self.chains.C[link]):
                r.append(np.repeat(row + np.arange(6), J.shape[1]))
                c.append(np.tile(self.key_at[key] + np.arange(J.shape[1]), 6))
                v.append(J.ravel())
        entries = (np.concatenate(v), (np.concatenate(r), np.concatenate(c)))
        return sparse.csr_matrix(entries, shape=(self.n_local, self.n_keys))

    @cached_property
    def row_columns(self) -> IntArray:
        """Local unknowns (K, MAX_LENS + 9) of every image point: lens, pose, point that stays; -1 for none."""
        lens = np.arange(MAX_LENS)
        free = lens < self.state.lenses.n_free[self.camera_of][:, None]
        of_lens = np.where(free, self.lens_at[self.camera_of][:, None] + lens, -1)
        of_point = np.where(self.point_at[:, None] >= 0, self.point_at[:, None] + np.arange(3), -1)
        return np.hstack([of_lens, self.pose_at[:, None] + np.arange(6), of_point])

    def unsorted(self, rows: _Rows) -> _Rows:
        """Rows in sorted order, back in the order of the blocks."""
        out = np.empty_like(rows)
        out[self.sorted] = rows
        return out
