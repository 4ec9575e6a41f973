"""All image points of known targets: one compiled pass evaluates them, one condensed factor per image serves GTSAM.

A block's rows are the upper triangular square root of its augmented normal matrix over [lens | camera_from_target |
warp | residual]: the same linear system and chi-square as its 2n rows, for any n (Lawson and Hanson 1974, chapter 27).
Where 2n are fewer, as of the parts of an image whose rows have times of their own, they are these. The parts of an
image are on the same keys, and one factor.
"""

from collections.abc import Sequence
from functools import cached_property, partial
from itertools import pairwise

import gtsam
import numpy as np

from adjust.frames.state import State
from adjust.frames.unknowns import Chain
from adjust.model.boards import warming_of
from adjust.model.observations import ImageBlock, ImagePoints
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.native.blocks import run_split, split_blocks
from adjust.native.images import (
    N_SHAPE,
    BlockArrays,
    BlocksAt,
    ByKeys,
    CondensedRows,
    KeyArrays,
    PointArrays,
    PointStatistics,
    RowPlaces,
    ShapeFactors,
    all_statistics,
    block_rows,
    condensed_rows,
    errors,
    evaluate_chains,
    local_by_keys,
    normal_equations,
    point_columns,
    serve,
    square_root_information,
)
from adjust.native.trees import KeyCovariances, TreeArrays
from adjust.observations.adapter import evaluated
from adjust.observations.images.segments import block_keys


class Chains:
    """Pose chains of many blocks in flat arrays, evaluated together."""

    def __init__(self, chains: Sequence[Chain]) -> None:
        links = [link for chain in chains for link in chain]
        self.ptr: IntArray = np.cumsum([0] + [len(chain) for chain in chains])
        self.slot = np.array([link.slot for link in links], dtype=np.int64)
        self.inverse: BoolArray = np.array([link.inverse for link in links], dtype=np.bool_)
        n = len(chains)
        self.R, self.t, self.C = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((len(links), 6, 6))

    def evaluate(self, state: State) -> None:
        """Fill R (B, 3, 3), t (B, 3) and C (links, 6, 6)."""
        self.R, self.t, self.C = evaluate_chains(state.slot_R, state.slot_t, self.ptr, self.slot, self.inverse)

    def one(self, state: State, b: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """R (1, 3, 3), t (1, 3) and C (links, 6, 6) of chain ``b`` alone; fills nothing."""
        links = slice(self.ptr[b], self.ptr[b + 1])
        ptr: IntArray = np.array([0, self.ptr[b + 1] - self.ptr[b]])
        return evaluate_chains(state.slot_R, state.slot_t, ptr, self.slot[links], self.inverse[links])

    def slots(self, b: int) -> list[int]:
        """The slots of chain ``b``."""
        return [int(slot) for slot in self.slot[self.ptr[b] : self.ptr[b + 1]]]


_AT_ONCE = 20_000
"""Image points of which rows are made at once."""


class ImageBatch:
    """Image points of known targets (and of held world points), grouped per block.

    ``prepare`` evaluates everything; the factors serve that inside ``State.serving``, and evaluate their own block
    otherwise, so the graph is correct in any GTSAM algorithm.
    """

    def __init__(
        self, survey: Survey, state: State, blocks: Sequence[ImageBlock], chains: Sequence[Chain],
        x_in_world: FloatArray,
    ) -> None:  # fmt: skip
        """x_in_world: points (P, 3) m of the world, for blocks without a target."""
        self.state, self.blocks, points = state, blocks, ImagePoints.of(blocks)
        self.chains = Chains(chains)
        self.ptr, self.point_idx, self.used, self.n_points = points.ptr, points.point_idx, points.used, len(points.uv)
        self._all = split_blocks(self.ptr)
        self.W_all = square_root_information(points.cov)
        self.W_all_columns = np.empty((3, self.n_points))
        self.points = PointArrays(np.empty((3, self.n_points)), np.empty((2, self.n_points)))
        every = [*(t.x_in_target for t in survey.targets), x_in_world]
        number: dict[str | None, int] = {None: len(state.targets)}
        number.update(state.targets)
        target = np.array([number[b.target_id] for b in blocks], dtype=np.int64)
        ends = np.cumsum([0, *(len(x) for x in every)])
        shown = ends[target], np.diff(ends)[target], np.concatenate(every)
        run_split(point_columns, self._all, self.ptr, shown, points.point_idx, points.uv, self.W_all,
                  self.points, self.W_all_columns)  # fmt: skip
        self._weighed: tuple[BoolArray, FloatArray] | None = None
        self.W = self._used_weights
        self.camera = np.array([state.lens_states.of(b.camera_id, b.epoch_id) for b in blocks], dtype=np.int64)
        warped = np.array([m is not None for m in state.warp_maps] + [False])[target]
        self.warp_id = np.where(warped, target, -1)
        self.n_warp = np.array([0 if m is None else len(m.free) for m in [*state.warp_maps, None]])[target]
        warming = np.zeros(len(blocks))
        for i in np.flatnonzero(warped).tolist():
            warming[i] = warming_of(survey, survey.targets[target[i]], blocks[i].epoch_id)
        self.arrays = BlockArrays(self.ptr, self.camera, self.warp_id, self.n_warp, warming)
        self._place_keys()

    def _place_keys(self) -> None:
        warp = np.where(self.n_warp > 0, self.warp_id, -1)
        self.of_blocks = block_keys(self.state, self.camera, self.chains.ptr, self.chains.slot, warp)
        self.n_rows: IntArray = self.state.lenses.n_free[self.camera] + 6 + self.n_warp + 1
        most = int(self.n_rows.max(initial=1))
        self.H = np.zeros((len(self.blocks), most, most))
        self.chi, self.depth = np.zeros(len(self.blocks)), np.zeros(len(self.blocks))
        self._flat: FloatArray | None = None
        self._place_rows()

    def _place_rows(self) -> None:
        """Which blocks are together a factor, numbered from ``factor_ptr``, and where their rows go."""
        k = self.of_blocks
        seen, count = [(b.camera_id, b.epoch_id, b.target_id) for b in self.blocks], np.diff(k.ptr)
        alike: BoolArray = np.array([False, *(a == b for a, b in pairwise(seen))][: len(seen)], dtype=np.bool_)
        alike[1:] &= count[1:] == count[:-1]
        same = k.key == k.key[np.maximum(np.arange(len(k.key)) - count[k.block], 0)]
        alike[k.block[~same]] = False
        begins = np.flatnonzero(~alike)
        self.factor_of: IntArray = np.cumsum(~alike) - 1
        self.factor_ptr: IntArray = np.append(begins, len(seen))
        height = np.minimum(self.n_rows, np.maximum(2 * np.diff(self.ptr), 1))
        end = np.concatenate([[0], np.cumsum(height)])
        self.height: IntArray = np.diff(end[self.factor_ptr])
        size = np.cumsum(np.append(0, self.height * k.columns[begins]))
        first = end[begins][self.factor_of]
        self._places = RowPlaces(height, end[:-1] - first, self.height[self.factor_of], size[self.factor_of], first)

    @cached_property
    def keys(self) -> list[list[int]]:
        """The keys of every block."""
        ptr, key = self.of_blocks.ptr.tolist(), self.of_blocks.key.tolist()
        return [key[a:b] for a, b in pairwise(ptr)]

    def at(self, W: FloatArray) -> BlocksAt:
        """All blocks where the chains were last evaluated, weighted by W (3, N)."""
        s, c = self.state, self.chains
        return BlocksAt(self.arrays, self.points, W, s.lenses, c.R, c.t, s.warps)

    @property
    def by_keys(self) -> ByKeys:
        """How the local unknowns of all blocks follow from their keys there."""
        return ByKeys(self.of_blocks.segments, self.chains.C, self.state.D, self.of_blocks.columns)

    def prepare(self, jacobians: bool) -> None:
        """Evaluate all blocks at the values that ``state`` was loaded from.

        With ``jacobians`` the normal equations of every block, from which rows are served and poses are reduced.
        """
        if self.blocks:
            self.chains.evaluate(self.state)
            self._evaluate(self._all, jacobians)

    def _evaluate(self, runs: list[IntArray], jacobians: bool) -> None:
        if jacobians:
            run_split(normal_equations, runs, self.at(self.W), self.H, self.chi, self.depth)
        else:
            run_split(errors, runs, self.at(self.W), self.chi, self.depth)

    def serve(self, which: IntArray | None = None) -> None:
        """Condense these blocks, or all, for their factors, as last prepared with Jacobians."""
        if not self.blocks or (which is not None and len(which) == 0):
            return
        if self._flat is None:
            self._make_room()
        runs = self._all if which is None else [which]
        run_split(serve, runs, self.at(self.W), self.by_keys, self._places, self.H, self._flat, self.r)

    def _make_room(self) -> None:
        """Where the rows of all factors are written, and views of them for GTSAM."""
        k, begins = self.of_blocks, self.factor_ptr[:-1]
        at, ends = self._places.at[begins], np.cumsum(self.height)
        self._flat, self.r = np.zeros(int((self.height * k.columns[begins]).sum())), np.zeros(int(self.height.sum()))
        self._residuals = np.split(self.r, ends[:-1])
        self._views: list[list[FloatArray]] = []
        for begin, rows, b in zip(at.tolist(), self.height.tolist(), begins.tolist(), strict=True):
            mine = range(int(k.ptr[b]), int(k.ptr[b + 1]))
            parts = [(begin + rows * int(k.place[i]), int(k.width[i])) for i in mine]
            self._views.append([self._flat[a : a + rows * n].reshape(rows, n) for a, n in parts])

    def _evaluate_alone(self, blocks: IntArray, values: gtsam.Values, jacobians: bool) -> None:
        self.state.load(values, [slot for b in blocks.tolist() for slot in self.chains.slots(b)])
        c = self.chains
        for b in blocks.tolist():
            links = slice(c.ptr[b], c.ptr[b + 1])
            c.R[b : b + 1], c.t[b : b + 1], c.C[links] = c.one(self.state, b)
        self._evaluate([blocks], jacobians)
        if jacobians:
            self.serve(blocks)

    def residual(self, factor: int, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        """What GTSAM's custom factor of this number returns: its residuals, and its rows by key."""
        begin, end = int(self.factor_ptr[factor]), int(self.factor_ptr[factor + 1])
        if not self.state.served:
            self._evaluate_alone(np.arange(begin, end), values, jacobians is not None)
        if jacobians is None:  # only the length of a residual is asked for: zeros, then the length
            length = np.zeros(int(self.height[factor]))
            length[-1] = np.sqrt(self.chi[begin:end].sum())
            return length
        for i, view in enumerate(self._views[factor]):
            jacobians[i] = view
        return np.asarray(self._residuals[factor])

    def set_weights(self, weights: FloatArray) -> None:
        """Weights (N,) on top of the covariances; a point of weight zero is left out, the others are used."""
        self.state.outdate()
        self.used = weights > 0.0
        self.W = self.W_all_columns * np.sqrt(weights)

    def whitened_squares(self) -> FloatArray:
        """Weighted squares v' inv(Q_ll) v (N,) of all points where the chains were last evaluated."""
        (u, v), (w00, w01, w11) = self.statistics(None)[0].T, self.W_all_columns
        return np.asarray((w00 * u + w01 * v) ** 2 + (w11 * v) ** 2)

    def add_factors(self, graph: gtsam.NonlinearFactorGraph, which: IntArray | None = None) -> None:
        """A custom factor for the parts of each image among these blocks, or all, that have an unknown."""
        noise = {n: gtsam.noiseModel.Unit.Create(n) for n in np.unique(self.height).tolist()}
        for i in np.unique(self.factor_of if which is None else self.factor_of[which]).tolist():
            keys = self.keys[int(self.factor_ptr[i])]
            if keys:
                graph.add(evaluated(noise[int(self.height[i])], keys, partial(self.residual, i)))

    def alike(self, which: IntArray | None = None) -> list[IntArray]:
        """These blocks, or all, in sets with the same numbers of points, rows and columns, of about ``_AT_ONCE``."""
        among = np.arange(len(self.blocks)) if which is None else which
        sizes = np.stack([np.diff(self.ptr)[among], self.n_rows[among], self.of_blocks.columns[among]], axis=1)
        kinds, kind = np.unique(sizes, axis=0, return_inverse=True)
        sets: list[IntArray] = []
        for j, n in enumerate(kinds[:, 0].tolist()):
            mine, most = among[kind.ravel() == j], max(_AT_ONCE // max(n, 1), 1)
            sets += [mine[i : i + most] for i in range(0, len(mine), most)]
        return sets

    def rows(self, which: IntArray) -> FloatArray:
        """Whitened rows (g, 2 n, local unknowns and 1) of all points of g blocks that are alike, the residual last.

        Used or not.
        """
        b = int(which[0])
        out = np.zeros((len(which), 2 * int(self.ptr[b + 1] - self.ptr[b]), int(self.n_rows[b])))
        block_rows(which, self.at(self.W_all_columns), out)
        return out

    def condensed_rows(self, which: IntArray, shapes: ShapeFactors, columns: IntArray, out: CondensedRows) -> int:
        """Into ``out`` rows of the used points of g alike blocks, with the same normal equations as all of them.

        As :func:`adjust.native.images.condensed_rows`, weights left aside.
        """
        return condensed_rows(which, self.at(self._used_weights), self.by_keys, shapes, columns, out)

    def condensed_height(self, b: int) -> int:
        """How many rows these are for a block like ``b``."""
        return min(2 * int(self.ptr[b + 1] - self.ptr[b]), int(self.n_rows[b]) + N_SHAPE)

    @property
    def _used_weights(self) -> FloatArray:
        """Square root information (3, N) of the points that are used, their weights left aside; else zero."""
        if self._weighed is None or self._weighed[0] is not self.used:
            W = self.W_all_columns if self.used.all() else self.W_all_columns * self.used
            self._weighed = self.used, W
        return self._weighed[1]

    def local_from_keys(self, which: IntArray) -> FloatArray:
        """Derivative (g, n_lens + 6 + n_warp, sum of key dims) of the local unknowns of g alike blocks by keys."""
        nl, b = self.state.lenses.n_free[self.camera[which]], int(which[0])
        G = np.zeros((len(which), int(self.n_rows[b]) - 1, int(self.of_blocks.columns[b])))
        local_by_keys(which, nl, self.by_keys, G)
        return G

    def statistics(self, tree: KeyCovariances | None) -> tuple[FloatArray, FloatArray]:
        """Residuals (N, 2) px and whitened A Q A' (N, 3) of all points, where the chains were last evaluated.

        tree: covariances of the unknowns; without it, A Q A' is zero.
        """
        n = self.n_points
        out = PointStatistics(np.zeros((n, 2)), np.zeros((n, 3)), np.zeros(len(self.blocks), dtype=np.int64))
        number = tree.number if tree is not None else {}
        k = self.of_blocks
        keys = np.array([number.get(key, -1) for key in k.key.tolist()], dtype=np.int64)
        run_split(
            all_statistics, self._all, self.at(self.W_all_columns), self.by_keys, KeyArrays(k.ptr, keys, k.place),
            tree.arrays if tree is not None else TreeArrays.nothing(), out,
        )  # fmt: skip
        if out.lost.any() and tree is not None:
            raise KeyError(f"unknowns of block {int(np.argmax(out.lost))} share no clique")
        return out.residual, out.influence
