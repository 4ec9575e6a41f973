"""The whitened row of every observation of a graph over every unknown, sparse."""

from collections.abc import Callable, Sequence

import gtsam
import numpy as np
import numpy.typing as npt
from scipy import sparse

from adjust.graph.assembly import AdjustmentGraph
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.lenses import MAX_LENS
from adjust.observations.factors import ObservationFactor
from adjust.observations.images.bundles import BundleBatch
from adjust.observations.terrestrial.layout import Chunk


@frozen(eq=False)
class Columns:
    """The free components of all unknowns, n in all, in the order of the graph's unknowns.

    names, components, units: (n,). at: columns of an unknown's free components. free: which components these are.
    """

    names: tuple[ParameterName, ...]
    components: tuple[str, ...]
    units: tuple[str, ...]
    at: dict[ParameterName, IntArray]
    free: dict[ParameterName, IntArray]

    def __len__(self) -> int:
        return len(self.names)

    def of(self, names: Sequence[ParameterName]) -> IntArray:
        """Columns of these unknowns, one after the other."""
        return np.concatenate([self.at[n] for n in names] or [np.zeros(0, dtype=np.int64)])


@frozen(eq=False)
class ImageRows:
    """Whitened rows of the image points, as some observations: A (m, n), e (m,), how many rows each has, used, groups.

    An observation is one image point here, or a whole block of them (see :mod:`adjust.statistics.condensed`).
    """

    A: sparse.csr_matrix
    e: FloatArray
    lengths: IntArray
    used: BoolArray
    groups: list[str]


KeyColumns = dict[int, IntArray]
"""By key: column of every component, -1 for held ones."""


MakeImageRows = Callable[[AdjustmentGraph, int, KeyColumns], ImageRows]
ItemRows = tuple[Sequence[int], FloatArray, FloatArray]
"""Keys of an observation, its whitened rows over them, and its whitened residuals."""


@frozen(eq=False)
class SurveyRows:
    """All observations at some values: ``A``, ``e``, ``ptr``, ``used`` as in ``LinearSystem``; groups (M,).

    n_image: the first of them, which are image points; n_before: rows before those of the readings.
    """

    columns: Columns
    key_columns: KeyColumns
    A: sparse.csr_matrix
    e: FloatArray
    ptr: IntArray
    used: BoolArray
    groups: list[str]
    n_image: int
    n_before: int


def survey_rows(
    graph: AdjustmentGraph, values: gtsam.Values, image_rows: MakeImageRows,
    of_item: Callable[[ObservationFactor], ItemRows],
) -> SurveyRows:  # fmt: skip
    """Rows of a graph that was prepared at these values."""
    columns = _columns(graph)
    key_columns = {graph.unknowns.by_name[name].key: _all_columns(graph, columns, name) for name in columns.at}
    n = len(columns)
    images = image_rows(graph, n, key_columns)
    others = _other_rows(graph, values, of_item, n, key_columns)
    readings = _reading_rows(graph, values, n, key_columns)
    lengths = np.concatenate([images.lengths, others[2], np.ones(len(readings[1]))])
    return SurveyRows(
        columns, key_columns, stacked([images.A, others[0], readings[0]]),
        np.concatenate([images.e, others[1], readings[1]]), np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        np.concatenate([images.used, _used_others(graph)]), images.groups + groups_of_others(graph),
        len(images.lengths), images.A.shape[0] + others[0].shape[0],
    )  # fmt: skip


def stacked(parts: Sequence[sparse.csr_matrix]) -> sparse.csr_matrix:
    """One below the other; not copied where all others are empty."""
    some = [A for A in parts if A.shape[0]] or parts[:1]
    return some[0] if len(some) == 1 else sparse.vstack(some).tocsr()


def points_apart(graph: AdjustmentGraph, n: int, key_columns: KeyColumns) -> ImageRows:
    """Every image point an observation of its own."""
    A, e = _image_rows(graph, n, key_columns)
    groups = [b.group for b in graph.survey.image_blocks for _ in range(len(b.uv))]
    return ImageRows(A, e, np.full(len(groups), 2), graph.used(), groups)


def groups_of_others(graph: AdjustmentGraph) -> list[str]:
    """Of all observations that are no image points, the readings last."""
    return graph.of_others(lambda o: o.group, lambda p: p.group) + [r.group for r in graph.survey.readings]


def _used_others(graph: AdjustmentGraph) -> BoolArray:
    readings = graph.terrestrial.used if graph.terrestrial is not None else np.zeros(0, dtype=np.bool_)
    return np.concatenate([np.array(graph.of_others(lambda o: o.used, lambda p: p.used), dtype=np.bool_), readings])


def _columns(graph: AdjustmentGraph) -> Columns:
    names: list[ParameterName] = []
    components: list[str] = []
    units: list[str] = []
    at, free, whole = {}, {}, {n: np.arange(n) for n in {u.dim for u in graph.unknowns.by_name.values()}}
    for name, unknown in graph.unknowns.by_name.items():
        held = graph.unknowns.held.get(unknown.key, ())
        free[name] = kept = np.delete(whole[unknown.dim], held) if held else whole[unknown.dim]
        at[name] = np.arange(len(names), len(names) + len(kept))
        names += [name] * len(kept)
        components += [unknown.components[i] for i in kept.tolist()] if held else unknown.components
        units += [unknown.units[i] for i in kept.tolist()] if held else unknown.units
    return Columns(tuple(names), tuple(components), tuple(units), at, free)


def _all_columns(graph: AdjustmentGraph, columns: Columns, name: ParameterName) -> IntArray:
    """Column (dim,) of every component of an unknown, -1 for held ones."""
    free, dim = columns.free[name], graph.unknowns.by_name[name].dim
    if len(free) == dim:
        return columns.at[name]
    out = np.full(dim, -1, dtype=np.int64)
    out[free] = columns.at[name]
    return out


class Entries:
    """Dense blocks gathered into one sparse matrix; columns of -1 are left out."""

    def __init__(self) -> None:
        self.parts: list[tuple[IntArray, npt.NDArray[np.int32], FloatArray]] = []

    def add(self, rows: IntArray, columns: IntArray, values: FloatArray) -> None:
        """Values (r, c) at these rows and columns."""
        self.add_blocks(rows[None], columns[None], values[None])

    def add_blocks(self, rows: IntArray, columns: IntArray, values: FloatArray) -> None:
        """Values (b, r, c) at rows (b, r) and columns (b, c)."""
        across = np.repeat(columns.astype(np.int32), rows.shape[1], axis=0)
        self.parts.append((rows.ravel(), across, values.ravel()))

    def matrix(self, shape: tuple[int, int]) -> sparse.csr_matrix:
        """All together."""
        if not self.parts:
            return sparse.csr_matrix(shape)
        rows = np.concatenate([r for r, _, _ in self.parts])
        lengths = np.repeat([c.shape[1] for _, c, _ in self.parts], [len(r) for r, _, _ in self.parts])
        c, v = np.concatenate([c.ravel() for _, c, _ in self.parts]), np.concatenate([v for _, _, v in self.parts])
        if (kept := c >= 0).all() and (rows[1:] >= rows[:-1]).all():  # row by row already
            ptr = np.concatenate([[0], np.cumsum(np.bincount(rows, lengths, shape[0]))]).astype(np.int32)
            out = sparse.csr_matrix((v, c, ptr), shape=shape)
            out.sum_duplicates()
            return out
        return sparse.csr_matrix((v[kept], (np.repeat(rows, lengths)[kept], c[kept])), shape=shape)


Rows = tuple[sparse.csr_matrix, FloatArray]


def _image_rows(graph: AdjustmentGraph, n: int, key_columns: KeyColumns) -> Rows:
    """Rows of all image points in the order of ``Survey.image_blocks``."""
    parts = [_known_rows(graph, n, key_columns)] + [bundle_rows(b, n, key_columns) for b in graph.bundles]
    if len(parts) == 1:
        return parts[0]
    A, e = sparse.vstack([p[0] for p in parts]).tocsr(), np.concatenate([p[1] for p in parts])
    order = (2 * graph.image_rows[:, None] + np.arange(2)).ravel()
    return A[order], e[order]


def columns_of_blocks(graph: AdjustmentGraph, key_columns: KeyColumns) -> Callable[[IntArray], IntArray]:
    """Columns (g, w) of g image blocks of known targets with equally many: those of their keys, one after the other."""
    k = graph.images.of_blocks
    every = np.concatenate([np.zeros(0, dtype=np.int64), *(key_columns[key] for key in k.key.tolist())])
    first = np.cumsum(k.columns) - k.columns
    return lambda mine: every[first[mine][:, None] + np.arange(int(k.columns[mine[0]]))]


def _known_rows(graph: AdjustmentGraph, n: int, key_columns: KeyColumns) -> Rows:
    images, entries = graph.images, Entries()
    e = np.zeros(2 * images.n_points)
    columns = columns_of_blocks(graph, key_columns)
    for mine in images.alike():
        local = images.rows(mine)
        rows = 2 * images.ptr[mine][:, None] + np.arange(local.shape[1])
        e[rows] = local[:, :, -1]
        entries.add_blocks(rows, columns(mine), local[:, :, :-1] @ images.local_from_keys(mine))
    return entries.matrix((len(e), n)), e


def bundle_rows(bundle: BundleBatch, n: int, key_columns: KeyColumns) -> Rows:
    """Whitened rows of the image points of unknown points, used or not, in the order of the bundle's blocks."""
    bundle.whitened_squares()  # leaves the rows of all points, used or not, with their own weights
    k, points = len(bundle.point), Entries()
    of_point = np.full((len(bundle.point_ids), 3), -1, dtype=np.int64)
    for i in bundle.reduced:
        of_point[i] = key_columns[bundle.point_key[i]]
    by_point, reduced = bundle.A[:, :, MAX_LENS + 3 : MAX_LENS + 6], bundle.point_at[:, None] < 0
    points.add_blocks(np.arange(2 * k).reshape(k, 2), np.where(reduced, of_point[bundle.point], -1), by_point)
    columns = np.concatenate([key_columns[key] for key in bundle.order])
    kept = columns >= 0
    select = sparse.csr_matrix((np.ones(int(kept.sum())), (np.flatnonzero(kept), columns[kept])), (len(columns), n))
    A_keys = bundle.local_rows() @ (bundle.local_from_keys() @ select) + points.matrix((2 * k, n))
    order = bundle_order(bundle)
    return A_keys.tocsr()[order], bundle.A[:, :, MAX_LENS + 6].ravel()[order]


def bundle_order(bundle: BundleBatch) -> IntArray:
    """Rows (2 K,) of a bundle's image points as its blocks have them."""
    back = np.empty(len(bundle.sorted), dtype=np.int64)
    back[bundle.sorted] = np.arange(len(back))
    return np.asarray((2 * back[:, None] + np.arange(2)).ravel())


def _other_rows(
    graph: AdjustmentGraph, values: gtsam.Values, of_item: Callable[[ObservationFactor], ItemRows], n: int,
    key_columns: KeyColumns,
) -> tuple[sparse.csr_matrix, FloatArray, IntArray]:  # fmt: skip
    """Rows, residuals and lengths of what is neither an image point nor a reading, in the order of the survey."""
    alone, batch, entries = [of_item(item) for item in graph.singles], graph.pairs, Entries()
    rows = iter([len(e) for _, _, e in alone])
    lengths = np.array(graph.of_others(lambda _: next(rows), lambda p: len(p.cov)), dtype=np.int64)
    ptr = np.concatenate([[0], np.cumsum(lengths)])
    residuals = np.empty(int(ptr[-1]))
    for (keys, A, e), at in zip(alone, ptr[graph.single].tolist(), strict=True):
        columns = np.concatenate([np.zeros(0, dtype=np.int64), *(key_columns[k] for k in keys)])
        residuals[at : at + len(e)] = e
        entries.add(np.arange(at, at + len(e)), columns, A)
    if batch is not None:
        first = ptr[graph.first_pair + batch.rows]
        r, *by = batch.whitened_rows(values)
        places = {k: np.flatnonzero(np.equal(batch.arrays.is_pose, k == 6)) for k in (6, 3)}
        none = np.full(6, -1)
        ends = [np.array([key_columns.get(k, none) for k in keys.tolist()]) for keys in (batch.b_key, batch.a_key)]
        for k, mine in places.items():
            at = first[mine, None] + np.arange(k)
            residuals[at] = r[mine, :k]
            across = np.concatenate([c[mine] for c in ends], axis=1)
            entries.add_blocks(at, across, np.concatenate([J[mine, :k] for J in by], axis=2))
    return entries.matrix((int(ptr[-1]), n)), residuals, lengths


def _reading_rows(graph: AdjustmentGraph, values: gtsam.Values, n: int, key_columns: KeyColumns) -> Rows:
    batch = graph.terrestrial
    if batch is None:
        return sparse.csr_matrix((0, n)), np.zeros(0)
    e, entries = batch.unweighted(values).copy(), Entries()
    alike: dict[tuple[int, ...], list[Chunk]] = {}
    for chunk in batch.layout.chunks:
        if chunk.keys:  # those between held positions have none
            alike.setdefault((len(chunk.rows), *chunk.dims), []).append(chunk)
    for (k, *dims), chunks in alike.items():
        rows, at = np.array([c.rows for c in chunks]), np.array([c.start for c in chunks])
        for i, dim in enumerate(dims):
            blocks = batch.J[at[:, None] + np.arange(k * dim)].reshape(len(at), k, dim)
            entries.add_blocks(rows, np.array([key_columns[c.keys[i]] for c in chunks]), blocks)
            at += k * dim
    return entries.matrix((len(e), n)), e
