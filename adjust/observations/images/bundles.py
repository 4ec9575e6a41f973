"""Image points of unknown world points: one factor on the unknowns that other observations touch, the rest hidden.

Points, and the poses nothing else touches, are reduced inside the batch by Schur complements; they sit in the same
Values, and :meth:`BundleBatch.complete` puts their steps into GTSAM's delta. The factor holds the square root of what
remains on the interface: the reduced camera system, condensed once more.
"""

from collections.abc import Sequence
from typing import TypeVar

import gtsam
import numpy as np
import scipy
from scipy import sparse

from adjust.frames.state import State
from adjust.frames.unknowns import Chain, Unknowns
from adjust.model.errors import IndeterminateError
from adjust.model.observations import ImageBlock
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.bundles import (
    BundleArrays,
    ReducedArrays,
    SightArrays,
    add_direct,
    back_substitute,
    between_poses,
    block_squares,
    fill_upper,
    pose_rows,
    reduce_points,
    rows,
    symmetric_rows,
)
from adjust.native.lenses import MAX_LENS
from adjust.native.parallel import run_split, workers
from adjust.observations.adapter import evaluated
from adjust.observations.images.batch import Chains, square_root_information
from adjust.spatial.motions import motions_of, points_motions, poses_at, poses_motions

FLOOR = 1e-4
"""Share of a pose's own diagonal that it is scaled with at least, when the points that it sees are reduced."""
ROUNDING_PIVOT = 1e-11
"""Pivot of a scaled normal matrix below which there is nothing but rounding."""
BLIND_MOTION = 1e-10
"""Length of the image rows times a motion, in units of its parts by poses and by points, that is none."""

_Rows = TypeVar("_Rows", FloatArray, BoolArray)


def may_be_hidden(unknowns: Unknowns, key: int) -> bool:
    """Whether an unknown is the pose of a station at one epoch, which image points alone may determine."""
    name = unknowns.by_key[key].name
    return name[0] == "world_from_station" and len(name) == 3


class BundleBatch:
    """Image blocks of world points, of which some are unknown.

    points: ids in the order of ``point_idx`` of the blocks. outside: keys that other factors touch. Inside, only the
    points that these blocks see are numbered.
    """

    def __init__(
        self,
        unknowns: Unknowns,
        state: State,
        blocks: Sequence[ImageBlock],
        chains: Sequence[Chain],
        points: Sequence[str],
        outside: set[int],
    ) -> None:
        self.unknowns, self.state = unknowns, state
        self.blocks = tuple(blocks)
        self.chains = Chains(chains)
        idx = np.concatenate([b.point_idx for b in blocks])
        present, self._point_of_rows = np.unique(idx, return_inverse=True)
        self.point_ids = tuple(points[i] for i in present.tolist())
        self.camera = np.array([state.lens_states.of(b.camera_id, b.epoch_id) for b in blocks], dtype=np.int64)
        self.block_ptr: IntArray = np.cumsum([0] + [len(b.uv) for b in blocks])
        self._choose_interface(outside)
        self._sort_observations()
        self._place_local_unknowns()
        self._place_derivatives()
        self._blind_directions: FloatArray | None = None
        self.chi_square = 0.0
        self.hidden_decrease = 0.0  # of chi-square, by the step of what is hidden

    # -- structure ---------------------------------------------------------------------------------------------------

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

    def _sort_observations(self) -> None:
        block = np.repeat(np.arange(len(self.blocks)), np.diff(self.block_ptr))
        point = self._point_of_rows
        group = np.full(len(self.point_ids), 0)  # reduced points first, then those that stay, then the held
        group[self.tied] = 1
        group[[i for i in range(len(self.point_ids)) if i not in self.point_key]] = 2
        self.sorted: IntArray = np.lexsort((block, self.camera[block], point, group[point]))
        self.block, self.point = block[self.sorted].astype(np.int64), point[self.sorted].astype(np.int64)
        self.camera_of = self.camera[self.block]
        self.uv = np.concatenate([b.uv for b in self.blocks])[self.sorted]
        self.W_all = square_root_information(np.concatenate([b.cov for b in self.blocks]))[self.sorted]
        self.used: BoolArray = np.concatenate(
            [b.used if b.used is not None else np.ones(len(b.uv), dtype=np.bool_) for b in self.blocks]
        )[self.sorted]
        self.W = self.W_all * self.used[:, None]
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
        k, p = len(self.point), len(self.reduced)
        self.A = np.zeros((k, 2, MAX_LENS + 7))
        self.X = np.zeros((k, 3))
        self.world = np.array([self.unknowns.held_points.get(i, np.zeros(3)) for i in self.point_ids]).reshape(-1, 3)
        self.Vi, self.h = np.zeros((p, 3, 3)), np.zeros((p, 3))
        self.W3, self.WL = np.zeros((k, 3, 6)), np.zeros((len(self.pc_camera), 3, MAX_LENS))
        self.of_reduced = ReducedArrays(self.Vi, self.W3, self.WL)
        self.arrays = BundleArrays(
            self.block, self.camera_of, self.pose_at, self.point_at, self.ptr, self.point_of, self.by_block,
            self.by_ptr, self.pc_ptr, self.pc_camera, self.pc_of, n_lens, self.lens_at, self.first_pose,
        )  # fmt: skip
        self.chi, self.depth = np.zeros(len(self.blocks)), np.zeros(len(self.blocks))
        self._free = np.array(list(self.point_key), dtype=np.int64)
        self._free_rows = np.array([self.state.point_rows[key] for key in self.point_key.values()], dtype=np.int64)

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

    # -- evaluation --------------------------------------------------------------------------------------------------

    def evaluate_rows(self, W: FloatArray) -> None:
        """Fill A with the rows of all image points at what the state has, whitened by W (K, 3); chi-square, depths."""
        self.state.outdate()
        s, c = self.state, self.chains
        self.world[self._free] = s.points[self._free_rows]
        self.X[:] = self.world[self.point]
        sights = SightArrays(self.block, self.camera, c.R, c.t, self.X, self.uv, W)
        rows(s.lenses, sights, self.A, self.chi, self.depth)

    def prepare(self, values: gtsam.Values, jacobians: bool, damping: float = 0.0) -> None:
        """Evaluate at ``values`` (already loaded into the state). Raises IndeterminateError for undetermined points."""
        self.chains.evaluate(self.state)
        self.evaluate_rows(self.W)
        self.chi_square = float(self.chi.sum())
        if jacobians:
            self._condense(values, damping)

    def _condense(self, values: gtsam.Values, damping: float) -> None:
        S, g = np.zeros((self.n_local, self.n_local)), np.zeros(self.n_local)
        bad = reduce_points(self.arrays, self.A, damping, S, g, self.of_reduced, self.h)
        if bad >= 0:
            raise self._undetermined_point(bad)
        add_direct(self.n_reduced, len(self.point), self.arrays, self.A, S, g)
        run_split(pose_rows, self.runs, self.arrays, self.A, self.of_reduced, S)
        self.G = self.local_from_keys()
        gradient = np.asarray(self.G.T @ g)
        rest = self.chi_square - float(np.einsum("ja,jab,jb->", self.h, self.Vi, self.h))
        self.blind = self._blind_motions(values) if damping == 0.0 else np.zeros((self.n_keys - self.n_hidden, 0))
        floor = FLOOR * np.abs(self._without_points()) + 1e-300  # far out, rounding takes squares below zero
        if self.alone:
            across = self._interface_rows(S)
            inner = across[:, self.n_hidden :]
            head, d = self._scaled_head(S, floor[: self.n_hidden])
        else:
            fill_upper(S)
            N = np.asarray(self.G.T @ (self.G.T @ S).T)
            d = np.sqrt(np.maximum(np.diag(N), floor)[: self.n_hidden])
            head = N[: self.n_hidden, : self.n_hidden] / d[:, None] / d
            across, inner = N[self.n_hidden :], N[self.n_hidden :, self.n_hidden :]
        last = np.sqrt(np.maximum(np.diag(inner), floor[self.n_hidden :]))
        self.scale = np.concatenate([d, last])
        across = across / self.scale / last[:, None]
        self._reduce_hidden(head, across, gradient / self.scale, rest, damping)

    def _interface_rows(self, S: FloatArray) -> FloatArray:
        """Rows (n_interface, n_keys) of the normal matrix, from the lower triangle of the local one."""
        to_interface = self.G[:, self.n_hidden :]
        mine = np.flatnonzero(np.diff(to_interface.indptr)).astype(np.int64)
        R = np.empty((len(mine), self.n_local))
        symmetric_rows(S, mine, R)
        return np.asarray((self.G.T @ (to_interface[mine].T @ R).T).T)

    def _scaled_head(self, S: FloatArray, floor: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Normal matrix of the hidden poses, lower triangle, scaled by its diagonal or ``floor``; the scales."""
        J, at = self.chains.C[self.own_links], self.own_at[:, None] + np.arange(6)
        own = S[at[:, :, None], at[:, None, :]]
        d = np.sqrt(np.maximum(np.einsum("nij,nik,nkj->nj", J, own, J, optimize=True), floor.reshape(-1, 6)))
        head = np.empty((self.n_hidden, self.n_hidden))
        between_poses(S, self.own_at, J / d[:, None, :], True, True, head)
        return head, d.ravel()

    def _blind_motions(self, values: gtsam.Values) -> FloatArray:
        """How the interface moves (n_interface, k) with those motions of the whole survey that no image point sees."""
        if self._blind_directions is None:
            self._blind_directions = self._find_blind(values)
        return self._motions(self.interface, values) @ self._blind_directions

    def _motions(self, keys: Sequence[int], values: gtsam.Values) -> FloatArray:
        by_key = self.unknowns.by_key
        poses = [k for k in keys if by_key[k].kind == "pose"]
        names = [by_key[k].name[0] for k in poses]
        in_world = np.array([name in ("world_from_station", "world_from_table") for name in names], dtype=np.bool_)
        moved = dict(zip(poses, poses_motions(*poses_at(values, poses), in_world), strict=True))
        return np.concatenate([moved[k] if k in moved else motions_of(by_key[k], values, False) for k in keys])

    def _find_blind(self, values: gtsam.Values) -> FloatArray:
        """Directions (7, k) of those motions, from the image rows before they are condensed.

        What is held does not move with the solution, so they stay the same while the same points are used.
        """
        Z = self._motions(self.order, values)
        of_point = np.zeros((len(self.point_ids), 3, 7))
        free = list(self.point_key)
        of_point[free] = points_motions(self.world[free])
        of_pose = np.asarray(self.G @ Z)[self.first_pose : self.first_pose + 6 * len(self.blocks)].reshape(-1, 6, 7)
        rows = self.A[:, :, MAX_LENS : MAX_LENS + 6]
        by_pose = (rows @ of_pose[self.block]).reshape(-1, 7)
        by_point = (rows[:, :, 3:] @ of_point[self.point]).reshape(-1, 7)
        lengths = np.sqrt((by_pose**2).sum(axis=0) + (by_point**2).sum(axis=0))
        usable = lengths > 0.0
        triangular = np.linalg.qr((by_pose + by_point)[:, usable] / lengths[usable], mode="r")
        _, s, Vt = np.linalg.svd(triangular, full_matrices=False)
        out = np.zeros((7, int(np.count_nonzero(s < BLIND_MOTION))))
        out[usable] = Vt[s < BLIND_MOTION].T / lengths[usable, None]
        return out

    def _undetermined_point(self, bad: int) -> IndeterminateError:
        name = self.point_ids[self.reduced[bad]]
        k = slice(self.ptr[bad], self.ptr[bad + 1])
        blocks = [self.blocks[b] for b in self.block[k][self.used[k]]]
        seen = sorted({f"{b.camera_id} at {b.epoch_id}" for b in blocks})
        return IndeterminateError(
            f"point {name!r} is not determined: its rays do not intersect (seen by {', '.join(seen) or 'nothing'}); "
            "observe it from a second direction, give its coordinates, or leave it out",
            (f"point {name}",),
        )

    def _reduce_hidden(
        self, head: FloatArray, across: FloatArray, z: FloatArray, rest: float, damping: float
    ) -> None:  # fmt: skip
        """head: (n_hidden, n_hidden), lower triangle; across: (n_interface, n_keys); scaled. Overwrites ``head``."""
        nh = self.n_hidden
        A, last = across[:, nh:], z[nh:]
        A = 0.5 * (A + A.T)
        if nh:
            head[np.arange(nh), np.arange(nh)] += damping
            self.C, info = scipy.linalg.lapack.dpotrf(head.T, lower=0, clean=0, overwrite_a=1)
            if info != 0:
                raise self._undetermined_pose(info - 1)
            right = np.vstack([across[:, :nh], z[:nh]]).T
            self.Y = scipy.linalg.lapack.dtrtrs(self.C, right, lower=0, trans=1, overwrite_b=1)[0]
            A = A - self.Y[:, :-1].T @ self.Y[:, :-1]
            last = last - self.Y[:, :-1].T @ self.Y[:, -1]
            rest -= float(self.Y[:, -1] @ self.Y[:, -1])
        self.hidden_decrease = self.chi_square - rest
        self._serve(A, last, self.scale[nh:], rest)

    def _without_points(self) -> FloatArray:
        """Diagonal (n_keys,) of the poses' normal matrix if all points were known: what rounding is measured by.

        A pose that moves with all points it sees (a table, where everything stands on it) has nothing but rounding left
        on its diagonal once these are reduced, and that may be of either sign.
        """
        n = len(self.blocks)
        squares = np.zeros((n, 6, 6))
        block_squares(self.block, self.A, squares)
        of_poses = self.G[self.first_pose : self.first_pose + 6 * n]
        diagonal = sparse.bsr_array((squares, np.arange(n), np.arange(n + 1)), shape=(6 * n, 6 * n))
        return np.asarray((diagonal @ of_poses).multiply(of_poses).sum(axis=0)).ravel()

    def _undetermined_pose(self, column: int) -> IndeterminateError:
        key = max((k for k in self.hidden_poses if self.key_at[k] <= column), key=lambda k: self.key_at[k])
        name = " ".join(self.unknowns.by_key[key].name)
        return IndeterminateError(
            f"{name} is not determined by its image points: too few, all in one direction, or seen from nowhere else; "
            "leave the epoch out, add points or give some their coordinates",
            (name,),
        )

    def _serve(self, A: FloatArray, z: FloatArray, d: FloatArray, rest: float) -> None:
        """Square root of the interface's normal matrix: pivoted, rounding pivots left out (seen up to 1e-12).

        The root of rounding would outweigh a weak datum, so motions that no image point sees are taken out exactly.
        """
        n = len(z)
        blind = np.linalg.qr(d[:, None] * self.blind)[0]
        A = A - blind @ (blind.T @ A)
        A = A - (A @ blind) @ blind.T
        z = z - blind @ (blind.T @ z)
        U, pivots, rank, _ = scipy.linalg.lapack.dpstrf(np.asfortranarray(A), tol=ROUNDING_PIVOT, lower=0)
        U = np.triu(U)
        U[rank:] = 0.0
        perm = pivots - 1
        y = np.zeros(n)
        if rank:  # LAPACK's solver refuses, on stderr, where there is nothing to solve
            R = np.asfortranarray(U[:rank, :rank])
            y[:rank] = scipy.linalg.lapack.dtrtrs(R, z[perm][:rank], lower=0, trans=1)[0]
        self.r = np.zeros(n + 1)
        self.r[:n] = y
        self.r[n] = np.sqrt(max(0.0, rest - float(y @ y)))
        R = np.zeros((n + 1, n))
        R[:n, perm] = U
        R -= (R @ blind) @ blind.T
        R *= d
        self.views = []
        at = 0
        for key in self.interface:
            k = self.unknowns.by_key[key].dim
            self.views.append(np.ascontiguousarray(R[:, at : at + k]))
            at += k

    def residual(self, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        """What GTSAM's custom factor returns."""
        if not self.state.served:
            self.state.load(values)
            self.prepare(values, jacobians is not None)
        if jacobians is None:
            out = np.zeros(self.n_keys - self.n_hidden + 1)
            out[-1] = np.sqrt(self.chi_square)
            return out
        for i, view in enumerate(self.views):
            jacobians[i] = view
        return self.r

    def set_weights(self, weights: FloatArray) -> None:
        """Weights (N,), blocks in their order, on top of the covariances; a point of weight zero is left out."""
        self.state.outdate()
        self._blind_directions = None
        w = weights[self.sorted]
        self.used = w > 0.0
        self.W = self.W_all * np.sqrt(w)[:, None]

    def unsorted(self, rows: _Rows) -> _Rows:
        """Rows in sorted order, back in the order of the blocks."""
        out = np.empty_like(rows)
        out[self.sorted] = rows
        return out

    def whitened_squares(self) -> FloatArray:
        """Weighted squares v' inv(Q_ll) v (N,) of all image points where the batch was prepared, as its blocks are."""
        self.evaluate_rows(self.W_all)
        return self.unsorted((self.A[:, :, MAX_LENS + 6] ** 2).sum(axis=1))

    def add_factor(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """The one factor of this batch, for :func:`adjust.graph.solver.solve`, which moves what it hides."""
        n = self.n_keys - self.n_hidden + 1
        graph.add(evaluated(gtsam.noiseModel.Unit.Create(n), self.interface, self.residual))

    def complete(self, delta: gtsam.VectorValues) -> None:
        """Insert the steps of the hidden poses and points, which follow from those of the interface."""
        d = np.zeros(self.n_keys)
        for key in self.interface:
            at = self.key_at[key]
            d[at : at + self.unknowns.by_key[key].dim] = delta.at(key)
        nh = self.n_hidden
        if nh:
            right = self.Y[:, :-1] @ (d[nh:] * self.scale[nh:]) + self.Y[:, -1]
            d[:nh] = -scipy.linalg.lapack.dtrtrs(self.C, right, lower=0)[0] / self.scale[:nh]
            for key in self.hidden_poses:
                delta.insert(key, d[self.key_at[key] : self.key_at[key] + 6])
        dX = self.points_following((self.G @ d)[:, None], self.h[:, :, None])[:, :, 0]
        for j, i in enumerate(self.reduced):
            delta.insert(self.point_key[i], dX[j])

    def points_following(self, local: FloatArray, h: FloatArray) -> FloatArray:
        """Steps (P, 3, k) of the reduced points from those of the local unknowns (n_local, k); h: their own part."""
        out = np.empty((len(self.reduced), 3, local.shape[1]))
        back_substitute(self.arrays, self.of_reduced, h, np.ascontiguousarray(local), out)
        return out

    def residuals_px(self) -> FloatArray:
        """Unwhitened residuals (K, 2) px, sorted order, of the last :meth:`covariances`."""
        r = self.A[:, :, MAX_LENS + 6]
        v = r[:, 1] / self.W_all[:, 2]
        return np.stack([(r[:, 0] - self.W_all[:, 1] * v) / self.W_all[:, 0], v], axis=1)
