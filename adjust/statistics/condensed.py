"""A solved survey as one linear system that stays small: the image points of a block stand in a few rows.

A block's 2n whitened rows over its local unknowns are turned (orthogonally) into as many rows as there are columns: the
same normal equations, gradients and quadratic forms for any n. Beside the columns of the unknowns the rows are kept by
what a block could have besides: a motion of its camera, of its target, other lens parameters than those of the other
epochs, another shape of its target. What the residuals say of these is asked in :mod:`adjust.statistics.changes`.
"""

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from adjust.bundle_batch import BundleBatch
from adjust.graph import AdjustmentGraph
from adjust.image_batch import warp_shape
from adjust.lens_kernels import MAX_LENS
from adjust.model import FloatArray, IntArray
from adjust.precision import Precision
from adjust.statistics.row_kernels import block_rows
from adjust.statistics.system import Entries, ImageRows, KeyColumns, LinearSystem, assembled, bundle_order, bundle_rows

N_SHAPE = 4
_FLAT = 1e-9


@dataclass(frozen=True, eq=False)
class CondensedSystem:
    """The system, whose first observations are the image blocks, and its m image rows by what a block has of its own.

    block: (m,) index into ``Survey.image_blocks``. lens: (m, MAX_LENS) by the free lens parameters of its camera.
    camera, target: (m, 6) by a motion of the camera in its own axes, of the target in its own axes (rotation,
    translation). shape: (m, 4) by the shape of the target: flat ones grow along x and y, and bend (unit sags) along x
    and y; others grow along x, y and z, the last column is zero. e: (m,). key_columns: of the system.
    """

    system: LinearSystem
    block: IntArray
    lens: FloatArray
    camera: FloatArray
    target: FloatArray
    shape: FloatArray
    e: FloatArray
    key_columns: KeyColumns

    def point_rows(self, row: int) -> tuple[IntArray, FloatArray]:
        """Columns (k,) and the whitened rows (2, k) over them of an image point that is in use."""
        graph = self.system.precision.graph
        ptr = np.cumsum([0] + [len(b.uv) for b in graph.survey.image_blocks])
        i = int(np.searchsorted(ptr, row, side="right")) - 1
        point, known = row - int(ptr[i]), [k for k, free in graph.image_order if not free]
        if i not in known:  # its rows are among those of the system
            first = int(np.flatnonzero(self.block == i)[0])
            A = self.system.A[first + 2 * point : first + 2 * point + 2]
            columns = np.unique(A.indices)
            return columns, A[:, columns].toarray()
        b = known.index(i)
        local = _block_rows(graph, b)[2 * point : 2 * point + 2, :-1]
        columns = np.concatenate([self.key_columns[key] for key in graph.images.keys[b]])
        kept = columns >= 0
        return columns[kept], (local @ graph.images.local_from_keys(b))[:, kept]


def condensed_system(precision: Precision) -> CondensedSystem:
    """The system of a solved survey, of any size."""
    kept: dict[str, list[FloatArray]] = {k: [] for k in ("lens", "camera", "target", "shape")}
    blocks: list[IntArray] = []
    columns: KeyColumns = {}

    def image_rows(precision: Precision, n: int, key_columns: KeyColumns) -> ImageRows:
        graph = precision.graph
        columns.update(key_columns)
        parts = [_known(graph, n, key_columns, kept, blocks)]
        if graph.bundle is not None:
            parts.append(_unknown(precision, graph.bundle, n, key_columns, kept, blocks))
        A = sparse.vstack([p.A for p in parts]).tocsr()
        e, lengths, used = (np.concatenate([getattr(p, x) for p in parts]) for x in ("e", "lengths", "used"))
        return ImageRows(A, e, lengths, used, [g for p in parts for g in p.groups])

    system = assembled(precision, image_rows)
    block = np.concatenate([np.zeros(0, dtype=np.int64), *blocks])
    lens, camera, target, shape = (
        np.concatenate([np.zeros((0, w)), *kept[k]])
        for k, w in (("lens", MAX_LENS), ("camera", 6), ("target", 6), ("shape", N_SHAPE))
    )
    return CondensedSystem(system, block, lens, camera, target, shape, system.e[: len(block)], columns)


def _known(
    graph: AdjustmentGraph, n: int, key_columns: KeyColumns, kept: dict[str, list[FloatArray]], blocks: list[IntArray]
) -> ImageRows:
    """Blocks of known targets."""
    images, entries = graph.images, Entries()
    s, c = images.state, images.chains
    number = [i for i, free in graph.image_order if not free]
    whole = {t.target_id: t.x_in_target for t in graph.survey.targets}
    at, lengths, e = 0, np.zeros(len(images.blocks), dtype=np.int64), [np.zeros(0)]
    for b, keys in enumerate(images.keys):
        points = slice(int(images.ptr[b]), int(images.ptr[b + 1]))
        local = _block_rows(graph, b)
        nl = int(s.lenses.n_free[images.camera[b]])
        given = whole.get(images.blocks[b].target_id or "")
        shape = _shape_columns(given, images.blocks[b].point_idx, local[:, nl + 3 : nl + 6])
        rows = np.hstack([local[:, :-1], shape, local[:, -1:]]) * np.repeat(images.used[points], 2)[:, None]
        if len(rows) > rows.shape[1]:
            rows = np.asarray(np.linalg.qr(rows, mode="r"))
        k, width = len(rows), local.shape[1] - 1
        if keys:
            columns = np.concatenate([key_columns[key] for key in keys])
            entries.add(np.arange(at, at + k), columns, rows[:, :width] @ images.local_from_keys(b))
        pose = rows[:, nl : nl + 6]
        kept["lens"].append(np.pad(rows[:, :nl], ((0, 0), (0, MAX_LENS - nl))))
        kept["target"].append(pose)
        kept["camera"].append(pose @ _of_camera(c.R[b], c.t[b]))
        kept["shape"].append(rows[:, width:-1])
        blocks.append(np.full(k, number[b]))
        e.append(rows[:, -1])
        lengths[b] = k
        at += k
    A = entries.matrix((at, n))
    groups = [b.group for b in images.blocks]
    return ImageRows(A, np.concatenate(e), lengths, np.ones(len(groups), dtype=np.bool_), groups)


def _block_rows(graph: AdjustmentGraph, b: int) -> FloatArray:
    """Whitened rows (2 n, local unknowns and 1) of all points of the b-th block of known targets, residual last."""
    images = graph.images
    s, c = images.state, images.chains
    local = np.zeros((2 * int(images.ptr[b + 1] - images.ptr[b]), int(images.n_rows[b])))
    block_rows(b, images.arrays, images.points, images.W_all_columns, s.lenses, c.R, c.t, s.warp, local)
    return local


def _of_camera(R: FloatArray, t: FloatArray) -> FloatArray:
    """Motion (6, 6) in the target of a motion d of the camera: Exp(d) T = T Exp(Ad(inv T) d), T = (R, t)."""
    out = np.zeros((6, 6))
    cross = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]])
    out[:3, :3] = out[3:, 3:] = R.T
    out[3:, :3] = -R.T @ cross
    return out


def _shape_columns(whole: FloatArray | None, point_idx: IntArray, by_point: FloatArray) -> FloatArray:
    """Derivatives (2 n, 4) by the shape of a target with points ``whole`` (P, 3); by_point (2 n, 3): by coordinates."""
    out = np.zeros((len(by_point), N_SHAPE))
    if whole is None:
        return out
    out[:, :3] = by_point * np.repeat(whole[point_idx], 2, axis=0)
    if np.ptp(whole[:, 2]) < _FLAT:
        out[:, 2:] = by_point[:, 2:] * np.repeat(warp_shape(whole)[point_idx], 2, axis=0)
    return out


def _unknown(
    precision: Precision, bundle: BundleBatch, n: int, key_columns: KeyColumns, kept: dict[str, list[FloatArray]],
    blocks: list[IntArray],
) -> ImageRows:  # fmt: skip
    """Blocks of unknown points, whose rows differ in the columns of their points: as they are, two per point."""
    A, e = bundle_rows(precision.graph, n, key_columns, precision.solved.values)
    order = bundle_order(bundle)
    used = np.repeat(bundle.unsorted(bundle.used), 2).astype(float)
    local = bundle.A.reshape(-1, MAX_LENS + 7)[order] * used[:, None]
    number = np.array([i for i, free in precision.graph.image_order if free], dtype=np.int64)
    lengths = 2 * np.diff(bundle.block_ptr)
    of_row = np.repeat(np.arange(len(lengths)), lengths)
    pose = local[:, MAX_LENS : MAX_LENS + 6]
    c = bundle.chains
    by_camera = np.array([_of_camera(R, t) for R, t in zip(c.R, c.t, strict=True)])
    kept["lens"].append(local[:, :MAX_LENS])
    kept["target"].append(np.zeros_like(pose))
    kept["camera"].append(np.einsum("ni,nij->nj", pose, by_camera[of_row]))
    kept["shape"].append(np.zeros((len(local), N_SHAPE)))
    blocks.append(number[of_row])
    groups = [b.group for b in bundle.blocks]
    A = sparse.diags(used) @ A
    return ImageRows(A.tocsr(), e * used, lengths.astype(np.int64), np.ones(len(groups), dtype=np.bool_), groups)
