"""A solved survey as one linear system that stays small: the image points of a block stand in a few rows.

A block's 2n whitened rows over its local unknowns are turned into as many rows as there are columns, the triangle of
their normal equations: the same gradients and quadratic forms for any n. The solution knows a block by that triangle
too, so that nothing is lost that its covariances still have. Beside the columns of the unknowns the rows are kept by
what a block could have besides: a motion of its camera, of its target, other lens parameters than those of the other
epochs, another shape of its target. What the residuals say of these is asked in :mod:`adjust.statistics.changes`.
"""

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from adjust.frames.tables import adjoint_of_inverse
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.singles import beside_images
from adjust.model.boards import BENT, deformation
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.images import N_SHAPE, CondensedRows, ShapeFactors
from adjust.native.lenses import MAX_LENS
from adjust.native.parallel import side_by_side
from adjust.observations.images.bundles import BundleBatch
from adjust.precision.precision import Precision
from adjust.statistics.rows import (
    ImageRows,
    KeyColumns,
    bundle_order,
    bundle_rows,
    columns_of_blocks,
    stacked,
)
from adjust.statistics.system import LinearSystem, assembled

_Number = TypeVar("_Number", bound=np.generic)
_FLAT = 1e-9


class Own(NamedTuple):
    """Rows (m, ..) by what image blocks could have besides.

    lens: (m, ..) by the free lens parameters of its camera, then zeros. camera, target: (m, 6) by a motion of the
    camera in its own axes, of the target in its own axes (rotation, translation). shape: (m, 4) by the shape of the
    target: flat ones grow along x and y, and bend (unit sags) along x and y; others grow along x, y and z, the last
    column is zero.
    """

    lens: FloatArray
    camera: FloatArray
    target: FloatArray
    shape: FloatArray


@frozen(eq=False)
class CondensedSystem:
    """The system, whose first observations are the image blocks, and its m image rows by what a block has of its own.

    block: (m,) index into ``Survey.image_blocks``. own: by what a block could have besides. e: (m,). numbers: the
    image block of each of the first observations. key_columns: of the system.
    """

    system: LinearSystem
    block: IntArray
    own: Own
    e: FloatArray
    numbers: IntArray
    key_columns: KeyColumns

    def point_rows(self, points: IntArray) -> list[tuple[IntArray, FloatArray]]:
        """Of image points that are in use columns (k,), and the whitened rows (2, k) over them of each."""
        graph = self.system.precision.graph
        images, at = graph.images, graph.image_rows[points]
        known = at < images.n_points
        found = {int(i): self._row_of_system(int(points[i])) for i in np.flatnonzero(~known)}
        block = np.searchsorted(images.ptr, at, side="right") - 1
        for mine in images.alike(np.unique(block[known])):
            rows, from_keys = images.rows(mine), images.local_from_keys(mine)
            for i in np.flatnonzero(known & np.isin(block, mine)).tolist():
                b, first = int(np.searchsorted(mine, block[i])), 2 * int(at[i] - images.ptr[block[i]])
                columns = np.concatenate([self.key_columns[key] for key in images.keys[block[i]]])
                kept = columns >= 0
                found[i] = columns[kept], (rows[b, first : first + 2, :-1] @ from_keys[b])[:, kept]
        return [found[i] for i in range(len(points))]

    def _row_of_system(self, point: int) -> tuple[IntArray, FloatArray]:
        """The same of one whose rows are among those of the system."""
        A, i = self.system.A, int(np.searchsorted(self._first_points, point, side="right")) - 1
        first = int(self._first_rows[i]) + 2 * (point - int(self._first_points[i]))
        begin, middle, end = A.indptr[first : first + 3].tolist()
        columns, place = np.unique(A.indices[begin:end], return_inverse=True)
        out = np.zeros((2, len(columns)))
        out[0, place[: middle - begin]], out[1, place[middle - begin :]] = A.data[begin:middle], A.data[middle:end]
        return columns, out

    def has_own_poses(self, kind: str, name: str, blocks: IntArray) -> bool:
        """Whether a camera's or target's image blocks have poses of its own, one an epoch, which nothing else touches.

        These take over whatever the camera or target could have moved. blocks: all of it, by number.
        """
        graph, slot_of = self.system.precision.graph, self.system.precision.graph.unknowns.slot_of
        survey = graph.survey
        owner = ("carrier_from_target", name)
        if kind == "camera":
            owner = ("world_from_station", survey.cameras_by_id[name].station_id)
        epochs = {survey.image_blocks[b].epoch_id for b in blocks.tolist()}
        slots = [slot_of.get((*owner, epoch), -1) for epoch in epochs]
        return min(slots) >= 0 and int(self._own_links[slots].sum()) == len(blocks)

    @cached_property
    def _own_links(self) -> IntArray:
        """In how many chains of image blocks each slot is; none where its unknown is held, or in anything else."""
        graph = self.system.precision.graph
        unknowns, chains = graph.unknowns, [graph.images.chains, *(b.chains for b in graph.bundles)]
        elsewhere = beside_images(unknowns, graph.singles, graph.pairs, graph.terrestrial) | {None}
        elsewhere |= {k for slot in (*unknowns.table_slots, *unknowns.shifted_slots) for k in unknowns.link_keys(slot)}
        alone = np.array([key not in elsewhere for key in unknowns.slot_key], dtype=np.bool_)
        return alone * np.bincount(np.concatenate([c.slot for c in chains]), minlength=len(alone))

    @property
    def n_points(self) -> int:
        """Image points."""
        return int(self._first_points[-1])

    @cached_property
    def _first_rows(self) -> IntArray:
        """First row of every block."""
        out = np.zeros(len(self._first_points), dtype=np.int64)
        out[self.block[::-1]] = np.arange(len(self.block))[::-1]
        return out

    @cached_property
    def _first_points(self) -> IntArray:
        """First image point of every block, and the number of all."""
        blocks = self.system.precision.graph.survey.image_blocks
        return np.cumsum([0] + [len(b.uv) for b in blocks])


@frozen(eq=False)
class _Part:
    """Some blocks by their numbers: rows of the system, block (m,) of each, by what it could have besides."""

    rows: ImageRows
    numbers: IntArray
    block: IntArray
    own: Own


def condensed_system(precision: Precision) -> CondensedSystem:
    """The system of a solved survey, of any size."""
    parts, columns = list[_Part](), KeyColumns()

    def image_rows(graph: AdjustmentGraph, n: int, key_columns: KeyColumns) -> ImageRows:
        columns.update(key_columns)
        parts.append(_known(graph, n, key_columns))
        for part, bundle in enumerate(graph.bundles, 1):
            number = np.flatnonzero(graph.image_parts == part)
            parts.append(_unknown(graph, bundle, number, n, key_columns))
        rows = [p.rows for p in parts]
        e, lengths, used = (_joined([getattr(p, x) for p in rows]) for x in ("e", "lengths", "used"))
        return ImageRows(stacked([p.A for p in rows]), e, lengths, used, [g for p in rows for g in p.groups])

    system = assembled(precision, image_rows)
    numbers, block = (_joined([getattr(p, x) for p in parts]) for x in ("numbers", "block"))
    own = Own(*(_joined(x) for x in zip(*(p.own for p in parts), strict=True)))
    return CondensedSystem(system, block, own, system.e[: len(block)], numbers, columns)


def _joined(parts: Sequence[NDArray[_Number]]) -> NDArray[_Number]:
    """One behind the other; not copied where there is one."""
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def _most_lens(graph: AdjustmentGraph) -> int:
    """Free parameters of a lens, at most."""
    return int(graph.images.state.lenses.n_free.max(initial=0))


def _known(graph: AdjustmentGraph, n: int, key_columns: KeyColumns) -> _Part:
    """Blocks of known targets, those of the same size together."""
    images, number = graph.images, graph.image_numbers
    shapes, columns, sets = _shapes(graph), columns_of_blocks(graph, key_columns), images.alike()
    heights = [images.condensed_height(int(mine[0])) for mine in sets]
    ends = np.cumsum([0, *(len(mine) * k for mine, k in zip(sets, heights, strict=True))]).tolist()
    own = Own(*(np.empty((ends[-1], k)) for k in (_most_lens(graph), 6, 6, N_SHAPE)))
    e, length = np.empty(ends[-1]), np.empty(ends[-1], dtype=np.int64)

    def condensed(i: int) -> tuple[FloatArray, NDArray[np.int32]]:
        """Entries of the i-th set and their columns; the rest goes where it belongs."""
        rows, size, across = slice(ends[i], ends[i + 1]), (len(sets[i]), heights[i]), columns(sets[i])
        lens, camera, target, shape = (x[rows].reshape(*size, x.shape[1]) for x in own)
        entry, column = np.empty((*size, across.shape[1])), np.empty((*size, across.shape[1]), dtype=np.int64)
        places = e[rows].reshape(size), length[rows].reshape(size), entry, column
        out = CondensedRows(lens, camera, target, shape, *places)
        found = images.condensed_rows(sets[i], shapes, across, out)
        return entry.ravel()[:found].copy(), column.ravel()[:found].astype(np.int32)

    parts = [(np.zeros(0), np.zeros(0, dtype=np.int32)), *side_by_side(condensed, range(len(sets)))]
    entry, column = (np.concatenate(x) for x in zip(*parts, strict=True))
    A = sparse.csr_matrix((entry, column, np.append(0, np.cumsum(length)).astype(np.int32)), (len(e), n))
    order = np.concatenate([np.zeros(0, dtype=np.int64), *sets])
    groups = [images.blocks[b].group for b in order.tolist()]
    of_blocks = np.repeat(np.array(heights, dtype=np.int64), list(map(len, sets)))
    rows = ImageRows(A, e, of_blocks, np.ones(len(groups), dtype=np.bool_), groups)
    return _Part(rows, number[order], np.repeat(number[order], of_blocks), own)


def _shapes(graph: AdjustmentGraph) -> ShapeFactors:
    """Of the image points of known targets."""
    first, every, images = dict[str | None, int](), [np.zeros((0, N_SHAPE))], graph.images
    for target in graph.survey.targets:
        first[target.target_id] = sum(map(len, every))
        every.append(_shape_factors(target.x_in_target))
    begin = np.array([first.get(b.target_id, -1) for b in images.blocks], dtype=np.int64)
    return ShapeFactors(begin, images.point_idx, np.concatenate(every))


def _shape_factors(x: FloatArray) -> FloatArray:
    """By what the derivatives by x, y, z and z again of the points (P, 3) of a target are to be multiplied: (P, 4)."""
    out = np.zeros((len(x), N_SHAPE))
    out[:, :3] = x
    if np.ptp(x[:, 2]) < _FLAT:
        out[:, 2:] = deformation(x, BENT)[:, 2]
    return out


def _unknown(graph: AdjustmentGraph, bundle: BundleBatch, number: IntArray, n: int, key_columns: KeyColumns) -> _Part:
    """Blocks of unknown points, whose rows differ in the columns of their points: as they are, two per point."""
    A, e = bundle_rows(bundle, n, key_columns)
    used, lengths = np.repeat(bundle.unsorted(bundle.used), 2).astype(float), 2 * np.diff(bundle.block_ptr)
    of_row, order, k = np.repeat(np.arange(len(lengths)), lengths), bundle_order(bundle), _most_lens(graph)
    by_lens, by_pose = bundle.A[:, :, :k], bundle.A[:, :, MAX_LENS : MAX_LENS + 6]
    lens, pose = by_lens.reshape(len(order), k)[order], by_pose.reshape(len(order), 6)[order]
    if not used.all():
        A.data *= np.repeat(used, np.diff(A.indptr))
        lens, pose, e = lens * used[:, None], pose * used[:, None], e * used
    camera = np.einsum("ni,nij->nj", pose, adjoint_of_inverse(bundle.chains.R, bundle.chains.t)[of_row])
    own = Own(lens, camera, np.zeros_like(pose), np.zeros((len(pose), N_SHAPE)))
    groups = [b.group for b in bundle.blocks]
    rows = ImageRows(A, e, lengths.astype(np.int64), np.ones(len(groups), dtype=np.bool_), groups)
    return _Part(rows, number, number[of_row], own)
