"""Image points of known targets in the core: residuals, condensed normal equations and redundancy, block after block.

A block is what one camera saw of one target at one epoch. Its local unknowns are the free lens parameters of the
camera, the six of ``camera_from_target`` (tangent on the right) and, where the target has them, those of its warp. All
functions take the blocks that they shall do, so that threads share them. The formulas are in ``images.h``.
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.blocks import run_ranges
from adjust.native.library import Function
from adjust.native.trees import TREE, TreeArrays

SEGMENT_LENS, SEGMENT_POSE, SEGMENT_TABLE, SEGMENT_WARP = 0, 1, 2, 3
MAX_LOCAL = 28
"""Local unknowns and residual of a block, at most."""
MAX_MAP = 24
"""Parameters of a lens times free ones that they follow from, at most: 13 of the lens, 7 of its crop."""
N_SHAPE = 4
"""Parameters of a target's shape."""

BLOCKS = "ptr[B+1] camera[B] warp_id[B] n_warp[B] warming[B]"
_MAPS = " ".join(f"{name}[c,{MAX_MAP}]" for name in ("source", "column", "factor"))
LENSES = f"kind[c] values[c,14] constants[c,4] n_free[c] n_map[c] {_MAPS}"
WARPS = "warp[T,7] extent[T,4] of_warp[T,7]"
SEGMENTS = "segment_ptr[B+1] segment_kind[S] link[S] table[S] start[S] n[S] place[S] within[S] dim[S] factor[S]"
_BATCH = f"{BLOCKS} X[3,N] uv[2,N] W[3,N] {LENSES} R[B,3,3] t[B,3] {WARPS}"
CHAINED = "C[*,6,6] D[*,6,*]"
_evaluate_chains = Function(
    "evaluate_chains", "slot_R[S,3,3] slot_t[S,3] ptr[B+1] slot[L] inverse[L] R[B,3,3] t[B,3] C[L,6,6]"
)
_square_roots = Function("square_roots", "first last cov[N,2,2] W[N,3]")
_point_columns = Function(
    "point_columns", "which[*] ptr[B+1] start[B] count[B] x[P,3] shown[N] seen[N,2] weights[N,3] X[3,N] uv[2,N] W[3,N]"
)
_normal_equations = Function("normal_equations", f"which[*] {_BATCH} H[B,m,m] chi[B] depth[B]")
_errors = Function("errors", f"which[*] {_BATCH} chi[B] depth[B]")
_block_rows = Function("block_rows", f"which[g] {_BATCH} out[g,*,*]")
_condensed_rows = Function(
    "condensed_rows",
    f"which[g] {_BATCH} {SEGMENTS} {CHAINED} first[B] point[N] table[*,{N_SHAPE}] columns[g,w] lens[g,m,*] "
    f"camera[g,m,6] target[g,m,6] shape[g,m,{N_SHAPE}] e[g,m] length[g,m] entry[g,m,w] column[g,m,w]",
)
_serve = Function(
    "serve",
    f"which[*] {_BATCH} {SEGMENTS} {CHAINED} height[B] first[B] rows[B] at[B] r_at[B] H[B,m,m] flat[*] r[*]",
)
_local_by_keys = Function("local_by_keys", f"which[g] n_lens[g] {SEGMENTS} {CHAINED} G[g,*,*]")
_all_statistics = Function(
    "all_statistics",
    f"which[*] {_BATCH} {SEGMENTS} {CHAINED} columns[B] keys_ptr[B+1] key[k] key_place[k] {TREE} "
    "residual[N,2] influence[N,3] lost[B] work[*]",
)


class LensArrays(NamedTuple):
    """Lenses of all cameras: values (C, MAX_LENS), constants (C, 4), and how they follow from the free parameters.

    Parameter ``source[c, i]`` of camera c is ``factor[c, i]`` times its free one ``column[c, i]``, i < n_map[c].
    """

    kind: IntArray
    values: FloatArray
    constants: FloatArray
    n_free: IntArray
    n_map: IntArray
    source: IntArray
    column: IntArray
    factor: FloatArray


class BlockArrays(NamedTuple):
    """Blocks: rows ptr[b]..ptr[b + 1] of the points, camera, which warp applies (-1: none), free warp components.

    warming (B,): K above the temperature at which the points of the target are known.
    """

    ptr: IntArray
    camera: IntArray
    warp_id: IntArray
    n_warp: IntArray
    warming: FloatArray


class PointArrays(NamedTuple):
    """Image points by columns: X (3, N) m in the target, observed uv (2, N) px."""

    X: FloatArray
    uv: FloatArray


class WarpArrays(NamedTuple):
    """Warps of all targets: values (T, 7) in the order of ``adjust.model.boards.BOARD``, and which the free ones are.

    extent (T, 4): least x and y of the points and their spans, m. of_free (T, 7): components, as many as are free.
    """

    values: FloatArray
    extent: FloatArray
    of_free: IntArray


class SegmentArrays(NamedTuple):
    """How a block's condensed columns reach its keys: kind, link of the chain, table slot, start, width.

    place: first column among those of all the block's keys, within: among the dim ones of its own key. ptr: segments of
    every block. factor: what a local unknown of a lens or a warp moves by one of its key.
    """

    ptr: IntArray
    kind: IntArray
    link: IntArray
    table: IntArray
    start: IntArray
    n: IntArray
    place: IntArray
    within: IntArray
    dim: IntArray
    factor: FloatArray


class BlocksAt(NamedTuple):
    """Blocks where they are evaluated: their points with square root information W (3, N): w00 w01 w11, the lenses.

    R (B, 3, 3), t (B, 3) m: ``camera_from_target``.
    """

    blocks: BlockArrays
    points: PointArrays
    W: FloatArray
    lenses: LensArrays
    R: FloatArray
    t: FloatArray
    warps: WarpArrays

    @property
    def arrays(self) -> tuple[FloatArray | IntArray, ...]:
        """All of them, as the core takes them."""
        return *self.blocks, *self.points, self.W, *self.lenses, self.R, self.t, *self.warps


class ByKeys(NamedTuple):
    """How local unknowns follow from keys: links C (links, 6, 6), tables D (slots, 6, 6), width (B,) all columns."""

    segments: SegmentArrays
    C: FloatArray
    D: FloatArray
    width: IntArray


class KeyArrays(NamedTuple):
    """Block b has the keys ``key[ptr[b]:ptr[b + 1]]``, numbered as a tree does, at columns ``place``; -1 is known."""

    ptr: IntArray
    key: IntArray
    place: IntArray


def evaluate_chains(
    slot_R: FloatArray, slot_t: FloatArray, link_ptr: IntArray, link_slot: IntArray, link_inverse: BoolArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Poses R (B, 3, 3), t (B, 3) of all chains, and C (links, 6, 6), the derivative of each pose by each link.

    slot_R (S, 3, 3), slot_t (S, 3): poses by slot. Chain b has the links ``link_ptr[b]:link_ptr[b + 1]``. Tangents are
    GTSAM's (rotation then translation, perturbation on the right). For ``T = A1 ... An`` a perturbation of a forward
    link i reaches T through ``Ad((A_{i+1} ... A_n)^-1)``; of an inverted link through ``-Ad((A_i^-1 ... A_n)^-1)``
    (Sola, Deray, Atchuthan 2018, "A micro Lie theory", section II.G).
    """
    n = len(link_ptr) - 1
    R, t, C = np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((len(link_slot), 6, 6))
    _evaluate_chains(slot_R, slot_t, link_ptr, link_slot, link_inverse, R, t, C)
    return R, t, C


def square_root_information(cov: FloatArray) -> FloatArray:
    """Upper triangular W (n, 3: w00, w01, w11) with W'W = inv(cov), for covariances (n, 2, 2)."""
    W = np.empty((len(cov), 3))
    run_ranges(_square_roots, len(cov), cov, W)
    return W


def point_columns(
    which: IntArray, ptr: IntArray, targets: tuple[IntArray, IntArray, FloatArray], shown: IntArray,
    seen: FloatArray, weights: FloatArray, out: PointArrays, W: FloatArray,
) -> None:  # fmt: skip
    """The image points (N,) of the listed blocks as columns, into ``out`` and W (3, N); seen (N, 2), weights (N, 3).

    targets: where the points of each block's target begin (B,) in those of all targets, how many these are (B,), and
    all (P, 3); shown (N,) is counted from there. Raises IndexError where a block shows what its target does not have.
    """
    if _point_columns(which, ptr, *targets, shown, seen, weights, *out, W):
        raise IndexError("an image block shows points that its target does not have")


def normal_equations(which: IntArray, at: BlocksAt, H: FloatArray, chi: FloatArray, depth: FloatArray) -> None:
    """For each listed block: normal matrix H[b] (symmetric) of its local unknowns and, last, the residual.

    Its last diagonal element is chi-square, also in ``chi``; depth: the least one (m), infinite without points. A point
    of weight zero gives rows of zeros and no depth.
    """
    _normal_equations(which, *at.arrays, H, chi, depth)


def errors(which: IntArray, at: BlocksAt, chi: FloatArray, depth: FloatArray) -> None:
    """Chi-square (whitened) and least depth of each listed block."""
    _errors(which, *at.arrays, chi, depth)


def block_rows(which: IntArray, at: BlocksAt, out: FloatArray) -> None:
    """Whitened rows (g, 2 n, n_lens + 6 + n_warp + 1) of g blocks of one size over local unknowns, residual last."""
    _block_rows(which, *at.arrays, out)


class ShapeFactors(NamedTuple):
    """By what the derivatives by x, y, z and z again of points are multiplied for the shape of their target.

    Those of the point (N,) of block b: ``table[first[b] + point]`` (.., 4); first -1: of no target.
    """

    first: IntArray
    point: IntArray
    table: FloatArray


class CondensedRows(NamedTuple):
    """Rows (g, m) of g blocks with the normal equations of all their rows; m: as many as columns, or rows where fewer.

    By their lens (g, m, ..), a motion of the camera and of the target, each in its own axes (g, m, 6), and the shape
    (g, m, 4). e: (g, m). length: (g, m) how many entries each has over the keys; entry, column: of these, room for all
    (g, m, w).
    """

    lens: FloatArray
    camera: FloatArray
    target: FloatArray
    shape: FloatArray
    e: FloatArray
    length: IntArray
    entry: FloatArray
    column: IntArray


def condensed_rows(
    which: IntArray, at: BlocksAt, keys: ByKeys, shapes: ShapeFactors, columns: IntArray, out: CondensedRows
) -> int:
    """Into ``out`` the rows of g blocks of one size; how many entries they have.

    columns: (g, w) of the keys of each, -1 for what is held.
    """
    segments, C, D, _ = keys
    return _condensed_rows(which, *at.arrays, *segments, C, D, *shapes, columns, *out)


class RowPlaces(NamedTuple):
    """Where rows of blocks (B,) go: ``height`` ones from the ``first`` on among ``rows`` of the block's factor.

    Its keys come one after the other from ``at`` on, each (rows, its width), its residuals from ``r_at`` on.
    """

    height: IntArray
    first: IntArray
    rows: IntArray
    at: IntArray
    r_at: IntArray


def serve(
    which: IntArray, at: BlocksAt, keys: ByKeys, places: RowPlaces, H: FloatArray, flat: FloatArray, r: FloatArray
) -> None:  # fmt: skip
    """For each listed block: its rows, condensed where they are many, chained to its keys, into ``flat`` and ``r``."""
    segments, C, D, _ = keys
    _serve(which, *at.arrays, *segments, C, D, *places, H, flat, r)


def local_by_keys(which: IntArray, n_lens: IntArray, keys: ByKeys, G: FloatArray) -> None:
    """Derivative G (g, n_lens + 6 + n_warp, sum of key dims) of the local unknowns of g blocks of one size by keys."""
    _local_by_keys(which, n_lens, *keys.segments, keys.C, keys.D, G)


class PointStatistics(NamedTuple):
    """Residuals (N, 2), influence (N, 3) of all points, lost (B,) of all blocks."""

    residual: FloatArray
    influence: FloatArray
    lost: IntArray


def all_statistics(
    which: IntArray, at: BlocksAt, by_keys: ByKeys, keys: KeyArrays, tree: TreeArrays, out: PointStatistics
) -> None:
    """Residuals (N, 2) px of the listed blocks and the whitened covariance A Q A' (N, 3: 00, 01, 11) of their points.

    at.W: that of all points, used or not. out.lost[b] becomes 1 where two keys of a block share no clique of the tree.
    """
    widest = int(by_keys.width.max(initial=0))
    work = np.empty(widest * (widest + 2 * MAX_LOCAL))
    segments, C, D, width = by_keys
    _all_statistics(which, *at.arrays, *segments, C, D, width, *keys, *tree, *out, work)
