"""Recursions over the cliques of a Bayes tree, flattened; see :mod:`adjust.precision.tree` and ``trees.h``.

Clique c has the keys ``keys[key_ptr[c]:key_ptr[c + 1]]``, the first ``n_front[c]`` of them frontal, parents before
children. Row-major blocks of front x width numbers begin at ``at[c]``: in ``data`` first [R S], later [R^-1, -R^-1 S];
in ``cov`` the rows of the covariance that belong to the frontal keys.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.library import Function

TREE = "home[K] key_ptr[C+1] keys[*] dims[K] front[C] width[C] at[C] cov[*]"
_tree_block = Function("tree_block", f"{TREE} a b out[*,*]")
_row_influences = Function(
    "row_influences",
    f"row_ptr[c+1] key_ptr[c+1] key[k] start[c] J[*] {TREE} found[*] lost[c] room[*]",
)
_inversion_room = Function("inversion_room", "front[C] width[C]")
_invert_cliques = Function("invert_cliques", "front[C] width[C] at[C] data[*] work[*]")
_covariance_room = Function("covariance_room", "front[C] width[C]")
_covariance_rows = Function("covariance_rows", f"{TREE} n_front[C] data[*] work[*] where[K]")
_clique_covariance = Function("clique_covariance", f"{TREE} n_front[C] clique out[n,n] where[K]")
_joint_blocks = Function("joint_blocks", f"{TREE} first[p] second[p] out[p,e,e]")
_solution_room = Function("solution_room", "width[C] m")
_solve_cliques = Function(
    "solve_cliques",
    "up[*] down[*] key_ptr[C+1] keys[*] dims[K] first[*] front[C] width[C] at[C] data[*] x[*,*] rows[*] work[*]",
)
_sets_room = Function("sets_room", "width[C] m")
_sets_among = Function(
    "sets_among",
    f"set_ptr[*] row_ptr[*] columns[e] entries[e] {TREE} parents[C] n_front[C] of_key[K] of_clique[C] way[C] heap[C] "
    "key_of[n] first[*] data[*] out[*] x[*] rows[*] work[*]",
)


class TreeArrays(NamedTuple):
    """A tree and its covariances."""

    home: IntArray
    key_ptr: IntArray
    keys: IntArray
    dims: IntArray
    front: IntArray
    width: IntArray
    at: IntArray
    cov: FloatArray

    @staticmethod
    def nothing() -> "TreeArrays":
        """A tree without unknowns."""
        none = np.zeros(0, dtype=np.int64)
        return TreeArrays(none, np.zeros(1, dtype=np.int64), none, none, none, none, none, np.zeros(0))


class KeyCovariances(Protocol):
    """Covariances of keys from a tree, as observations look them up; ``arrays`` count the keys as ``number`` says."""

    @property
    def number(self) -> Mapping[int, int]:
        """Of every key."""
        ...

    @property
    def arrays(self) -> TreeArrays:
        """The tree with its covariances."""
        ...

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of these keys, stacked."""
        ...

    def pairs(self, first: IntArray, second: IntArray, dim: int) -> FloatArray:
        """Joint covariances (p, 2 dim, 2 dim) of pairs of keys that share a factor; -1 stands for a constant."""
        ...


def row_influences(
    row_ptr: IntArray, key_ptr: IntArray, key: IntArray, start: IntArray, J: FloatArray, tree: TreeArrays
) -> tuple[FloatArray, BoolArray]:
    """Diagonal of A Q A' (N,) of the rows of all chunks, and of which (c,) chunks two keys share no clique: nonsense.

    Chunk c has rows ``row_ptr[c]`` to ``row_ptr[c + 1]`` over the keys ``key[key_ptr[c]:key_ptr[c + 1]]``; from
    ``start[c]`` on J holds their derivatives by one key after the other, each (rows, its dimension).
    """
    found, lost = np.zeros(int(row_ptr[-1])), np.zeros(len(start), dtype=np.bool_)
    _row_influences(row_ptr, key_ptr, key, start, J, *tree, found, lost, np.empty(int(tree.dims.max(initial=0)) ** 2))
    return found, lost


def invert_cliques(front: IntArray, width: IntArray, at: IntArray, data: FloatArray) -> int:
    """[R S] to [R^-1, -R^-1 S] in place; returns the first singular clique or -1."""
    return _invert_cliques(front, width, at, data, np.empty(_inversion_room(front, width)))


def fill_block(tree: TreeArrays, a: int, b: int, out: FloatArray) -> bool:
    """Covariance of two keys that share a clique into ``out``; whether they do."""
    return bool(_tree_block(*tree, a, b, out))


def covariance_rows(tree: TreeArrays, n_front: IntArray, data: FloatArray) -> None:
    """Fill ``tree.cov``: Q_fs = T Q_ss and Q_ff = R^-1 R^-T + T Q_sf, parents first."""
    room, where = np.empty(_covariance_room(tree.front, tree.width)), np.empty(len(tree.dims), dtype=np.int64)
    _covariance_rows(*tree, n_front, data, room, where)


def clique_covariance(tree: TreeArrays, n_front: IntArray, clique: int) -> FloatArray:
    """Joint covariance (n, n) of all keys of a clique, in their order."""
    out = np.empty((int(tree.width[clique]),) * 2)
    _clique_covariance(*tree, n_front, clique, out, np.empty(len(tree.dims), dtype=np.int64))
    return out


def joint_blocks(tree: TreeArrays, first: IntArray, second: IntArray, out: FloatArray) -> int:
    """Joint covariances ``out`` (p, 2 d, 2 d) of pairs of keys of dimension d that share a clique; -1: a constant.

    Returns the first pair that shares none, or -1.
    """
    return _joint_blocks(*tree, first, second, out)


def solve_cliques(
    tree: TreeArrays, up: IntArray, down: IntArray, first: IntArray, data: FloatArray, x: FloatArray
) -> None:
    """Q x in place (D, m), x not zero only in the cliques ``up`` and Q x wanted only in ``down``.

    Both parents first, with every ancestor of each of theirs. first: row of x at which a key begins. Without ``down``
    R^-T x, where ancestors are missing what is left for them.
    """
    rows = np.empty(int(tree.width.max(initial=0)), dtype=np.int64)
    work = np.empty(_solution_room(tree.width, x.shape[1]))
    _solve_cliques(up, down, tree.key_ptr, tree.keys, tree.dims, first, tree.front, tree.width, tree.at, data, x, rows,
                   work)  # fmt: skip


def sets_among(
    set_ptr: IntArray, row_ptr: IntArray, columns: IntArray, entries: FloatArray, tree: TreeArrays, parents: IntArray,
    n_front: IntArray, key_of: IntArray, first: IntArray, data: FloatArray,
) -> list[FloatArray]:  # fmt: skip
    """A Q A' (m, m) of sets of sparse rows, set i from row ``set_ptr[i]`` on; key_of (n,): of every column."""
    sizes, C = np.diff(set_ptr), len(parents)
    m = int(sizes.max(initial=0))
    marks = (np.zeros(n, dtype=np.int64) for n in (len(tree.dims), C, C, C))
    out, x = np.empty(int(sizes @ sizes)), np.empty(len(key_of) * m)
    rows, work = np.empty(int(tree.width.max(initial=0)), dtype=np.int64), np.empty(_sets_room(tree.width, m))
    _sets_among(set_ptr, row_ptr, columns, entries, *tree, parents, n_front, *marks, key_of, first, data, out, x, rows,
                work)  # fmt: skip
    ends = np.cumsum(sizes**2).tolist()
    return [out[end - n * n : end].reshape(n, n) for end, n in zip(ends, sizes.tolist(), strict=True)]
