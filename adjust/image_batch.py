"""All image points of known targets: one compiled pass evaluates them, one condensed factor per block serves GTSAM.

A block's rows are the upper triangular square root of its augmented normal matrix over [lens | camera_from_target |
warp | residual]: the same linear system and chi-square as its 2n rows, for any n (Lawson and Hanson 1974, chapter 27).
"""

from collections.abc import Iterator, Sequence
from itertools import accumulate

import gtsam
import numpy as np

from adjust.chain_kernels import evaluate_chains
from adjust.image_kernels import (
    SEGMENT_LENS,
    SEGMENT_POSE,
    SEGMENT_TABLE,
    SEGMENT_WARP,
    BlockArrays,
    PointArrays,
    SegmentArrays,
    errors,
    local_by_keys,
    normal_equations,
    serve,
)
from adjust.image_statistics_kernels import all_statistics
from adjust.model import BoolArray, FloatArray, IntArray, Survey
from adjust.observations import ImageBlock
from adjust.parallel import run_split, split_blocks
from adjust.state import State
from adjust.tree_covariance import TreeCovariance
from adjust.tree_kernels import TreeArrays
from adjust.unknowns import Chain, Unknowns


def square_root_information(cov: FloatArray) -> FloatArray:
    """Upper triangular W (n, 3: w00, w01, w11) with W'W = inv(cov), for covariances (n, 2, 2)."""
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    w11 = 1.0 / np.sqrt(c)
    w00 = 1.0 / np.sqrt(a - b * b / c)
    return np.stack([w00, -w00 * b / c, w11], axis=1)


def whitened_squares(v: FloatArray, W: FloatArray) -> FloatArray:
    """|W v|^2 (n,) of residuals v (n, 2) with W (n, 3) upper triangular."""
    return np.asarray((W[:, 0] * v[:, 0] + W[:, 1] * v[:, 1]) ** 2 + (W[:, 2] * v[:, 1]) ** 2)


def warp_shape(x: FloatArray) -> FloatArray:
    """The two unit sags 4u(1-u), 4v(1-v) at points (n, 3), u and v running from 0 to 1 over the target."""
    low, high = x[:, :2].min(axis=0), x[:, :2].max(axis=0)
    span = np.where(high > low, high - low, 1.0)
    u = (x[:, :2] - low) / span
    return np.asarray(4.0 * u * (1.0 - u))


class Chains:
    """Pose chains of many blocks in flat arrays, evaluated together."""

    def __init__(self, chains: Sequence[Chain]) -> None:
        links = [link for chain in chains for link in chain]
        self.ptr: IntArray = np.cumsum([0] + [len(chain) for chain in chains])
        self._slots = [link.slot for link in links]
        self.slot = np.array(self._slots, dtype=np.int64)
        self.inverse: BoolArray = np.array([link.inverse for link in links], dtype=np.bool_)
        n = len(chains)
        self.R, self.t, self.C = np.zeros((n, 3, 3)), np.zeros((n, 3)), np.zeros((len(links), 6, 6))

    def links(self, b: int) -> Iterator[tuple[int, int]]:
        """Number and slot of every link of chain ``b``."""
        first, end = self.ptr[b : b + 2].tolist()
        return zip(range(first, end), self._slots[first:end], strict=True)

    def evaluate(self, state: State) -> None:
        """Fill R (B, 3, 3), t (B, 3) and C (links, 6, 6)."""
        evaluate_chains(state.slot_R, state.slot_t, self.ptr, self.slot, self.inverse, self.R, self.t, self.C)


class Segments:
    """Which columns of a block's rows belong to which key, and how they come from the local unknowns."""

    def __init__(self) -> None:
        self.keys: list[list[int]] = []
        self.width: list[list[int]] = []
        self.ptr = [0]
        self.rows: list[tuple[int, int, int, int, int, int, int]] = []  # block, type, ref, d, start, n, key position

    def block(self, unknowns: Unknowns, state: State, chains: Chains, b: int, camera: int, target: int | None) -> None:
        """Append the segments of block ``b``."""
        found: list[tuple[int | None, int, int, int, int, int]] = []  # key, type, ref, d, start, n
        found.append((state.lens_maps[camera].key, SEGMENT_LENS, -1, -1, 0, int(state.lenses.n_free[camera])))
        for link, slot in chains.links(b):
            table = unknowns.table_slots.get(slot)
            if table is None:
                found.append((unknowns.slot_key[slot], SEGMENT_POSE, link, -1, 0, 6))
            else:
                d, k = int(state.table_index[slot]), len(table.axes)
                found.append((table.angles_key, SEGMENT_TABLE, link, d, 0, k))
                found.append((table.geometry.key, SEGMENT_TABLE, link, d, k, len(table.geometry.free)))
        warp = state.warp_maps[target] if target is not None else None
        if warp is not None:
            found.append((warp.key, SEGMENT_WARP, -1, -1, 0, len(warp.free)))
        position: dict[int, int] = {}
        width: list[int] = []
        for key, kind, ref, d, start, n in found:
            if key is None or n == 0:
                continue
            if key not in position:
                position[key] = len(width)
                width.append(n)
            self.rows.append((b, kind, ref, d, start, n, position[key]))
        self.keys.append(list(position))
        self.width.append(width)
        self.ptr.append(len(self.rows))

    def table(self) -> IntArray:
        """The segments (S, 7): block, type, reference, table slot, start, width, position of the key."""
        return np.array(self.rows, dtype=np.int64).reshape(-1, 7)


class ImageBatch:
    """Image points of known targets (and of held world points), grouped per block.

    ``prepare(values)`` evaluates everything; the factors serve what was prepared when they are asked at exactly these
    values, and evaluate their own block otherwise, so the graph is correct in any GTSAM algorithm.
    """

    def __init__(
        self,
        survey: Survey,
        unknowns: Unknowns,
        state: State,
        blocks: Sequence[ImageBlock],
        chains: Sequence[Chain],
        points: Sequence[FloatArray],
        n_warp: Sequence[int],
    ) -> None:
        self.blocks = tuple(blocks)
        self.state = state
        self.chains = Chains(chains)
        n = len(blocks)
        self.ptr: IntArray = np.cumsum([0] + [len(b.uv) for b in blocks])
        self.camera = np.array([state.cameras[b.camera_id] for b in blocks], dtype=np.int64)
        warped = {t: i for t, i in state.targets.items() if state.warp_maps[i] is not None}
        self.warp_id = np.array(
            [warped.get(b.target_id or "", -1) for b in blocks],
            dtype=np.int64,
        )
        self.n_warp = np.array(n_warp, dtype=np.int64)
        self.n_points = int(self.ptr[-1])
        X = _columns(points, 3)
        shape, uv = np.zeros((2, self.n_points)), _columns([b.uv for b in blocks], 2)
        self.W_all = square_root_information(np.concatenate([b.cov for b in blocks])) if n else np.zeros((0, 3))
        self.used: BoolArray = np.concatenate(
            [b.used if b.used is not None else np.ones(len(b.uv), dtype=np.bool_) for b in blocks]
        ) if n else np.zeros(0, dtype=np.bool_)
        self.W_all_columns = np.ascontiguousarray(self.W_all.T)
        self.W = self.W_all_columns * self.used
        for i, block in enumerate(blocks):
            if self.warp_id[i] >= 0:
                target = survey.targets[self.warp_id[i]]
                shape[:, self.ptr[i] : self.ptr[i + 1]] = warp_shape(target.x_in_target)[block.point_idx].T
        self.arrays = BlockArrays(self.ptr, self.camera, self.warp_id, self.n_warp)
        self.points = PointArrays(X, shape, uv)
        self._place_keys(unknowns)

    def _place_keys(self, unknowns: Unknowns) -> None:
        segments = Segments()
        for b, block in enumerate(self.blocks):
            target = self.state.targets[block.target_id or ""] if self.n_warp[b] else None
            segments.block(unknowns, self.state, self.chains, b, int(self.camera[b]), target)
        self.n_rows: IntArray = self.state.lenses.n_free[self.camera] + 6 + self.n_warp + 1
        self.keys = segments.keys
        starts = [list(accumulate(width, initial=0)) for width in segments.width]
        self.width = np.array([start[-1] for start in starts], dtype=np.int64)
        self.key_ptr = np.cumsum([0] + [len(keys) for keys in self.keys]).astype(np.int64)
        self._key_place = np.array([at for start in starts for at in start[:-1]], dtype=np.int64)
        ptr = np.array(segments.ptr, dtype=np.int64)
        block, kind, link, table, start, n, position = np.ascontiguousarray(segments.table().T)
        self.seg_key_number = self.key_ptr[block] + position
        place = self._key_place[self.seg_key_number]
        self.segments = SegmentArrays(ptr, kind, link, table, start, n, place)
        self._key_width = np.array([w for width in segments.width for w in width], dtype=np.int64)
        most = int(self.n_rows.max(initial=1))
        self.H = np.zeros((len(self.blocks), most, most))
        self.chi, self.depth = np.zeros(len(self.blocks)), np.zeros(len(self.blocks))
        self._flat: FloatArray | None = None
        self._served = np.zeros(len(self.blocks), dtype=np.bool_)
        self._prepared: gtsam.Values | None = None
        self._with_jacobians = False
        self._all = split_blocks(self.ptr)

    def prepare(self, values: gtsam.Values, jacobians: bool) -> None:
        """Evaluate all blocks at ``values``; ``state`` must have been loaded from the same values.

        With ``jacobians`` the normal equations of every block, from which rows are served and poses are reduced.
        """
        if values is self._prepared and self._with_jacobians >= jacobians:
            return
        self.chains.evaluate(self.state)
        self._evaluate(self._all, jacobians)
        self._prepared, self._with_jacobians = values, jacobians

    def forget(self) -> None:
        """Evaluate again when next asked, whatever the values."""
        self._prepared = None

    def _evaluate(self, runs: list[IntArray], jacobians: bool) -> None:
        s, c = self.state, self.chains
        given = (self.arrays, self.points, self.W, s.lenses, c.R, c.t, s.warp)
        if jacobians:
            run_split(normal_equations, runs, *given, self.H, self.chi, self.depth)
            self._served[:] = False
        else:
            run_split(errors, runs, *given, self.chi, self.depth)

    def serve(self, which: IntArray | None = None) -> None:
        """Condense these blocks, or all, for their factors, as last prepared with Jacobians."""
        if which is not None and len(which) == 0:
            return
        if self._flat is None:
            self._make_room()
        runs = self._all if which is None else [which]
        run_split(serve, runs, self.arrays, self.state.lenses, self.segments, self.chains.C, self.state.D, self.width,
                  self._at, self.H, self._flat, self.r)  # fmt: skip
        for run in runs:
            self._served[run] = True

    def _make_room(self) -> None:
        """Where the rows of all factors are written, and views of them for GTSAM."""
        sizes = self.n_rows * self.width
        self._at = np.cumsum(np.append(0, sizes))[:-1].astype(np.int64)
        self._flat, self.r = np.zeros(int(sizes.sum())), np.zeros((len(self.blocks), int(self.n_rows.max(initial=1))))
        self._views: list[list[FloatArray]] = []
        for b in range(len(self.blocks)):
            rows, views = int(self.n_rows[b]), []
            for i in range(self.key_ptr[b], self.key_ptr[b + 1]):
                at, k = int(self._at[b] + rows * self._key_place[i]), int(self._key_width[i])
                views.append(self._flat[at : at + rows * k].reshape(rows, k))
            self._views.append(views)

    def _evaluate_alone(self, b: int, values: gtsam.Values, jacobians: bool) -> None:
        links = slice(self.chains.ptr[b], self.chains.ptr[b + 1])
        self.state.load(values, [int(slot) for slot in self.chains.slot[links]])
        self.chains.evaluate(self.state)
        self._prepared = None
        self._evaluate([np.array([b], dtype=np.int64)], jacobians)

    def residual(self, b: int, values: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
        """What GTSAM's custom factor of block ``b`` returns: its condensed residual, and its rows by key."""
        if values is not self._prepared or (jacobians is not None and not self._with_jacobians):
            self._evaluate_alone(b, values, jacobians is not None)
        if jacobians is None:  # only the length of a residual is asked for: zeros, then the length
            length = np.zeros(int(self.n_rows[b]))
            length[-1] = np.sqrt(self.chi[b])
            return length
        if not self._served[b]:
            self.serve(np.array([b], dtype=np.int64))
        for i, view in enumerate(self._views[b]):
            jacobians[i] = view
        return np.asarray(self.r[b, : self.n_rows[b]])

    def set_weights(self, weights: FloatArray) -> None:
        """Weights (N,) on top of the covariances; a point of weight zero is left out, the others are used."""
        self.forget()
        self.used = weights > 0.0
        self.W = self.W_all_columns * np.sqrt(weights)

    def whitened_squares(self) -> FloatArray:
        """Weighted squares v' inv(Q_ll) v (N,) of all points where the chains were last evaluated."""
        return whitened_squares(self.statistics(None)[0], self.W_all)

    def add_factors(self, graph: gtsam.NonlinearFactorGraph, which: IntArray | None = None) -> None:
        """One custom factor for each of these blocks, or of all, that has an unknown."""
        noise = {int(n): gtsam.noiseModel.Unit.Create(int(n)) for n in np.unique(self.n_rows)}
        for b in range(len(self.blocks)) if which is None else which.tolist():
            keys = self.keys[b]
            if keys:
                graph.add(gtsam.CustomFactor(noise[int(self.n_rows[b])], keys, _callback(self, b)))

    def local_from_keys(self, b: int) -> FloatArray:
        """Derivative (n_lens + 6 + n_warp, sum of key dims) of the block's local unknowns by its keys."""
        nl = int(self.state.lenses.n_free[self.camera[b]])
        G = np.zeros((int(self.n_rows[b]) - 1, int(self.width[b])))
        local_by_keys(b, nl, self.segments, self.chains.C, self.state.D, G)
        return G

    def statistics(self, tree: TreeCovariance | None) -> tuple[FloatArray, FloatArray]:
        """Residuals (N, 2) px and whitened A Q A' (N, 3) of all points, where the chains were last evaluated.

        tree: covariances of the unknowns; without it, A Q A' is zero.
        """
        residual, influence = np.zeros((self.n_points, 2)), np.zeros((self.n_points, 3))
        number = tree.number if tree is not None else {}
        keys = np.array([number.get(k, -1) for mine in self.keys for k in mine], dtype=np.int64)
        s, c = self.state, self.chains
        lost = np.zeros(len(self.blocks), dtype=np.int64)
        run_split(
            all_statistics, self._all, self.arrays, self.points, self.W_all_columns, s.lenses, c.R, c.t, s.warp,
            self.segments, c.C, s.D, self.width, self.key_ptr, keys, self._key_place,
            tree.arrays() if tree is not None else TreeArrays.nothing(), residual, influence, lost,
        )  # fmt: skip
        if lost.any() and tree is not None:
            raise KeyError(f"unknowns of block {int(np.argmax(lost))} share no clique")
        return residual, influence


def _columns(rows: Sequence[FloatArray], n: int) -> FloatArray:
    """Rows (N, n), given in parts, as columns (n, N)."""
    return np.ascontiguousarray(np.concatenate([np.zeros((0, n)), *rows]).T)


def _callback(batch: ImageBatch, b: int):  # type: ignore[no-untyped-def]  # GTSAM's protocol, bound untyped
    def residual(_factor, values, jacobians):  # type: ignore[no-untyped-def]  # as above
        return batch.residual(b, values, jacobians)

    return residual
