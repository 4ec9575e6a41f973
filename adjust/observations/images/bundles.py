"""Image points of unknown world points: one factor on the unknowns that other observations touch, the rest hidden.

Points, and the poses nothing else touches, are reduced inside the batch by Schur complements; they sit in the same
Values, and :meth:`BundleBatch.complete` puts their steps into GTSAM's delta. The factor holds the square root of what
remains on the interface: the reduced camera system, condensed once more.
"""

from collections.abc import Sequence

import gtsam
import numpy as np
import scipy
from scipy import sparse

from adjust.frames.state import State
from adjust.frames.unknowns import Chain, Unknowns
from adjust.model.errors import IndeterminateError
from adjust.model.observations import ImageBlock
from adjust.model.survey import FloatArray
from adjust.native.blocks import run_split
from adjust.native.bundles import (
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
from adjust.observations.adapter import evaluated
from adjust.observations.images.bundle_layout import BundleLayout
from adjust.spatial.motions import motions_of, points_motions, poses_at, poses_motions

FLOOR = 1e-4
"""Share of a pose's own diagonal that it is scaled with at least, when the points that it sees are reduced."""
ROUNDING_PIVOT = 1e-11
"""Pivot of a scaled normal matrix below which there is nothing but rounding."""
BLIND_MOTION = 1e-10
"""Length of the image rows times a motion, in units of its parts by poses and by points, that is none."""


class BundleBatch(BundleLayout):
    """Image blocks of world points, of which some are unknown, evaluated and condensed into one factor."""

    def __init__(
        self, unknowns: Unknowns, state: State, blocks: Sequence[ImageBlock], chains: Sequence[Chain],
        points: Sequence[str], outside: set[int], by_rows: bool = False,
    ) -> None:  # fmt: skip
        """by_rows: of few image points, all on unknowns that others touch: no normal equations, which would round."""
        super().__init__(unknowns, state, blocks, chains, points, outside)
        self.by_rows = by_rows and not self.n_hidden and not self.reduced
        n = self.n_keys - self.n_hidden + 1
        self.n_rows = min(2 * len(self.point), n) if self.by_rows else n
        self.W = self.W_all * self.used[:, None]
        k, p = len(self.point), len(self.reduced)
        self.A = np.zeros((k, 2, MAX_LENS + 7))
        self.X = np.zeros((k, 3))
        self.world = np.array([self.unknowns.held_points.get(i, np.zeros(3)) for i in self.point_ids]).reshape(-1, 3)
        self.Vi, self.h = np.zeros((p, 3, 3)), np.zeros((p, 3))
        self.W3, self.WL = np.zeros((k, 3, 6)), np.zeros((len(self.pc_camera), 3, MAX_LENS))
        self.of_reduced = ReducedArrays(self.Vi, self.W3, self.WL)
        self.chi, self.depth = np.zeros(len(self.blocks)), np.zeros(len(self.blocks))
        self._free = np.array(list(self.point_key), dtype=np.int64)
        self._free_rows = np.array([self.state.point_rows[key] for key in self.point_key.values()], dtype=np.int64)
        self._blind_directions: FloatArray | None = None
        self.chi_square = 0.0
        self.hidden_decrease = 0.0  # of chi-square, by the step of what is hidden

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
        if jacobians and self.by_rows:
            self.G = self.local_from_keys()
            J = np.column_stack([(self.local_rows() @ self.G).toarray(), self.A[:, :, MAX_LENS + 6].ravel()])
            R: FloatArray = np.asarray(np.linalg.qr(J, mode="r") if len(J) > self.n_rows else J)
            self._serve_rows(R[:, :-1], R[:, -1])
        elif jacobians:
            self._condense(values, damping)

    def local_rows(self) -> sparse.csr_matrix:
        """Rows (2K, n_local) by lenses, poses and points that stay, in sorted order, as last evaluated."""
        columns, n = np.repeat(self.row_columns, 2, axis=0), MAX_LENS + 6
        values = np.concatenate([self.A[:, :, :n], self.A[:, :, n - 3 : n]], axis=2).reshape(columns.shape)
        kept, ptr = columns >= 0, np.zeros(len(columns) + 1, dtype=np.int64)
        np.cumsum(kept.sum(axis=1), out=ptr[1:])
        return sparse.csr_matrix((values[kept], columns[kept], ptr), (len(columns), self.n_local))

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
        R = np.zeros((n + 1, n))
        R[:n, perm] = U
        R -= (R @ blind) @ blind.T
        self._serve_rows(R * d, np.append(y, np.sqrt(max(0.0, rest - float(y @ y)))))

    def _serve_rows(self, R: FloatArray, r: FloatArray) -> None:
        """Rows (n_rows, n_interface) and residuals (n_rows,) of the factor."""
        ends = np.cumsum([self.unknowns.by_key[key].dim for key in self.interface])
        self.views = [np.ascontiguousarray(part) for part in np.split(R, ends[:-1], axis=1)]
        self.r = r

    def residual(self, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        """What GTSAM's custom factor returns."""
        if not self.state.served:
            self.state.load(values)
            self.prepare(values, jacobians is not None)
        if jacobians is None:
            out = np.zeros(self.n_rows)
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

    def whitened_squares(self) -> FloatArray:
        """Weighted squares v' inv(Q_ll) v (N,) of all image points where the batch was prepared, as its blocks are."""
        self.evaluate_rows(self.W_all)
        return self.unsorted((self.A[:, :, MAX_LENS + 6] ** 2).sum(axis=1))

    def add_factor(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """The one factor of this batch, for :func:`adjust.graph.solver.solve`, which moves what it hides."""
        graph.add(evaluated(gtsam.noiseModel.Unit.Create(self.n_rows), self.interface, self.residual))

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
        dX = self.points_following((self.G @ d)[:, None], self.h[:, :, None].copy())[:, :, 0]
        for j, i in enumerate(self.reduced):
            delta.insert(self.point_key[i], dX[j])

    def points_following(self, local: FloatArray, h: FloatArray) -> FloatArray:
        """Steps (P, 3, k) of the reduced points, in place of their own part h, by the local unknowns (n_local, k)."""
        back_substitute(self.arrays, self.of_reduced, h, np.ascontiguousarray(local), h)
        return h

    def residuals_px(self) -> FloatArray:
        """Unwhitened residuals (K, 2) px, sorted order, of the last :meth:`covariances`."""
        r = self.A[:, :, MAX_LENS + 6]
        v = r[:, 1] / self.W_all[:, 2]
        return np.stack([(r[:, 0] - self.W_all[:, 1] * v) / self.W_all[:, 0], v], axis=1)
