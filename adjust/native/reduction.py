"""Reduction of poses that only image points of known targets touch (``reduction.h``).

See :mod:`adjust.observations.images.reduction`. A pose's columns are its own six, then those of the keys its blocks
share with others, then the residual.
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.native.images import BLOCKS, CHAINED, LENSES, MAX_LOCAL, SEGMENTS, BlocksAt, ByKeys
from adjust.native.library import Function

WEAKEST_PIVOT = 2.0**-24
"""Share of a diagonal that must be left when the columns before it are eliminated: as GTSAM's Cholesky asks."""
_WIDEST = 16
"""Numbers in two of the widest vectors (``WIDEST`` in ``dense.h``)."""
_REDUCTION = "block_ptr[J+1] block[*] col_ptr[J+1] col[*] own_place[*]"
_reduce_poses = Function(
    "reduce_poses",
    f"run[*] {_REDUCTION} {BLOCKS} {LENSES} {SEGMENTS} width[B] {CHAINED} damping H[B,m,m] L[J,6,6] T[*] "
    "diagonal[runs,n] rest[runs,n+1,n+1] bad[runs] work[*] to[*]",
)
_pose_steps = Function("pose_steps", f"{_REDUCTION} L[J,6,6] T[*] d[*] out[J,6] decrease[1]")
_leaf_rows = Function("leaf_rows", f"{_REDUCTION} L[J,6,6] T[*] out[*]")


class ReductionArrays(NamedTuple):
    """Poses j: blocks ``block[block_ptr[j]:block_ptr[j + 1]]``; their columns of the interface, ascending, in col.

    T of pose j begins at ``6 (col_ptr[j] + j)``: one column more, of the residual. place (segments): first column of a
    segment among those of its pose.
    """

    block_ptr: IntArray
    block: IntArray
    col_ptr: IntArray
    col: IntArray
    place: IntArray


class ReducedPoses(NamedTuple):
    """What reduction gives: L (J, 6, 6) upper and T of the poses, for what follows, and sums over each turn's.

    rest (runs, n + 1, n + 1): upper triangle of the normal matrix of the interface and the residual, diagonal (runs, n)
    that before anything was reduced. bad (runs,): a pose without an inverse, else left alone.
    """

    L: FloatArray
    T: FloatArray
    diagonal: FloatArray
    rest: FloatArray
    bad: IntArray


def reduce_poses(
    run: IntArray, a: ReductionArrays, at: BlocksAt, keys: ByKeys, damping: float, H: FloatArray, out: ReducedPoses
) -> None:
    """Reduce the poses in run[1:]; the sums are those of turn = run[0].

    damping: share of its own diagonal that is added to a pose's.
    """
    segments, C, D, width = keys
    size = max(int(np.diff(a.col_ptr)[run[1:]].max(initial=0)) + 7, int(width.max(initial=0)) + 1)
    size = -(-size // _WIDEST) * _WIDEST
    work, to = np.empty(size * (2 * size + 3 * MAX_LOCAL)), np.empty(size, dtype=np.int64)
    _reduce_poses(run, *a, *at.blocks, *at.lenses, *segments, width, C, D, damping, H, *out, work, to)


def pose_steps(a: ReductionArrays, L: FloatArray, T: FloatArray, d: FloatArray, out: FloatArray) -> float:
    """Steps (J, 6) of the reduced poses from that of the interface (n,); by how much they alone lower chi-square."""
    decrease = np.zeros(1)
    _pose_steps(*a, L, T, d, out, decrease)
    return float(decrease[0])


def leaf_rows(a: ReductionArrays, L: FloatArray, T: FloatArray, out: FloatArray) -> None:
    """Rows [L' T] of all poses, without the residual, one after the other."""
    _leaf_rows(*a, L, T, out)
