"""Loops walked through a network of pairs, and what is left over when they come back to where they began.

A loop is walked from its first station; the product of its pairs, each taken along or against its direction, would be
the identity without errors. Its logarithm is the misclosure, in the frame of the first station.
"""

from collections.abc import Iterator
from dataclasses import field, replace

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.pose_network.cycles import Forest, forest_loops
from adjust.spatial.rigid_motions import Motions, identities, right_jacobian_inverse

_AT_ONCE = 200_000
"""Pairs of loops whose misclosures are found in one go."""


@frozen(eq=False)
class Tree:
    """What loops have in common that are those of a forest of shortest ways, each closed by one pair.

    chord_idx: (L,) that pair, walked first, from first (L,) to last (L,), its stations a and b. meet: (L,) where the
    ways back from both to their root meet. sense: (n,) of the pair to each station, +1 where it leads there from its
    parent.
    """

    forest: Forest
    chord_idx: IntArray
    first: IntArray
    last: IntArray
    meet: IntArray
    sense: IntArray

    def levels(self) -> Iterator[tuple[IntArray, IntArray, IntArray, BoolArray]]:
        """Stations as far from their roots as each other, nearest first: they, parents, pairs, which are along."""
        forest = self.forest
        order = np.argsort(forest.depth, kind="stable")
        for v in np.split(order, np.cumsum(np.bincount(forest.depth)))[1:-1]:
            yield v, forest.parent[v], forest.by[v], self.sense[v] > 0


@frozen(eq=False)
class Loops:
    """L loops: loop k are the pairs ``pair_idx[ptr[k]:ptr[k + 1]]`` in the order of the walk.

    sense: +1 where a pair is walked from a to b, -1 from b to a. start_idx: (L,) first station. tree: of loops of a
    spanning tree, whose pairs are as many as loops times stations, what serves to evaluate them all in one pass.
    """

    ptr: IntArray
    pair_idx: IntArray
    sense: IntArray
    start_idx: IntArray
    tree: Tree | None = field(default=None, kw_only=True)

    def __len__(self) -> int:
        return len(self.start_idx)

    @property
    def lengths(self) -> IntArray:
        """Pairs in each loop (L,)."""
        return np.diff(self.ptr)

    def and_then(self, more: "Loops") -> "Loops":
        """These and those."""
        first = "pair_idx", "sense", "start_idx"
        pairs, sense, start = (np.concatenate([getattr(self, name), getattr(more, name)]) for name in first)
        return Loops(np.concatenate([self.ptr, self.ptr[-1] + more.ptr[1:]]), pairs, sense, start)

    def portions(self, most: int) -> Iterator[tuple[slice, "Loops"]]:
        """Some loops after the other, with about so many pairs in all: which, and these."""
        first = 0
        while first < len(self):
            last = max(first + 1, int(np.searchsorted(self.ptr, self.ptr[first] + most, side="right")) - 1)
            rows, ptr = slice(self.ptr[first], self.ptr[last]), self.ptr[first : last + 1] - self.ptr[first]
            mine = slice(first, last)
            yield mine, Loops(ptr, self.pair_idx[rows], self.sense[rows], self.start_idx[mine])
            first = last


def walked(a_idx: IntArray, b_idx: IntArray, loops: tuple[IntArray, IntArray], first: IntArray) -> Loops:
    """Loops of pairs between stations a (E,) and b (E,), in the order of the walk, from their first stations (L,).

    loops: ranges (L + 1,) of their pairs, and these one after the other.
    """
    (ptr, pairs), at = loops, first.copy()
    sense = np.zeros(len(pairs), dtype=np.int64)
    for rows, some in _steps(ptr):
        a, b = a_idx[pairs[rows]], b_idx[pairs[rows]]
        along = a == at[some]
        sense[rows] = np.where(along, 1, -1)
        at[some] = np.where(along, b, a)
    return Loops(ptr, pairs, sense, first)


def tree_loops(a_idx: IntArray, b_idx: IntArray, forest: Forest, chords: IntArray) -> Loops:
    """The loops that these pairs (L,) close with a forest, each from its station a and itself first."""
    ptr, pairs, meet = forest_loops(a_idx, b_idx, forest, chords)
    sense = np.where(a_idx[forest.by] == forest.parent, 1, -1)
    tree = Tree(forest, chords, a_idx[chords], b_idx[chords], meet, sense)
    return replace(walked(a_idx, b_idx, (ptr, pairs), a_idx[chords]), tree=tree)


def _steps(ptr: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Step by step, the rows (of all loops that are this long) and the loops they belong to."""
    lengths = np.diff(ptr)
    out = []
    loops = np.arange(len(lengths))
    for step in range(int(lengths.max()) if len(lengths) else 0):
        loops = loops[lengths[loops] > step]
        out.append((ptr[loops] + step, loops))
    return out


def _walk(loops: Loops, b_from_a: Motions, before: FloatArray | None = None) -> Motions:
    """Products (L,) round the loops. before: (K, dim, dim) becomes ``Ad(Z^-1)``, Z the product up to station a."""
    product = identities(len(loops), b_from_a.dim)
    for rows, some in _steps(loops.ptr):
        step, along = b_from_a[loops.pair_idx[rows]], loops.sense[rows] > 0
        now = product[some]
        after = step.where(along, step.inverse()) @ now
        if before is not None:
            before[rows] = now.where(along, after).inverse().adjoint()
        _put(product, some, after)
    return product


def _put(motions: Motions, rows: IntArray, those: Motions) -> None:
    motions.rotation[rows] = those.rotation
    if motions.translation is not None and those.translation is not None:
        motions.translation[rows] = those.translation


def _from_roots(tree: Tree, b_from_a: Motions) -> Motions:
    """Every station (n,) from the root of its part, along the tree."""
    out = identities(len(tree.sense), b_from_a.dim)
    for v, parent, pair, along in tree.levels():
        step = b_from_a[pair]
        _put(out, v, step.where(along, step.inverse()) @ out[parent])
    return out


def _tree_vectors(tree: Tree, b_from_a: Motions, ways: Motions) -> FloatArray:
    """Misclosures (L, dim): along the chord, and back by the root."""
    return (ways[tree.first] @ ways[tree.last].inverse() @ b_from_a[tree.chord_idx]).log()


def _tree_covariances(tree: Tree, b_from_a: Motions, cov: FloatArray, ways: Motions) -> FloatArray:
    """Covariances (L, dim, dim) of the products round the loops, from those of the pairs (E, dim, dim).

    Of the pairs between a station and its root the sum, seen from there, is carried along the tree. A loop has those
    of both its ends but for what they have in common, seen from its start through the chord, and the chord.
    """
    total = np.zeros((len(tree.sense), *cov.shape[1:]))
    for v, parent, pair, along in tree.levels():
        total[v] = total[parent] + _seen(ways[parent].where(along, ways[v]).inverse(), cov[pair])
    back = total[tree.first] + total[tree.last] - 2.0 * total[tree.meet]
    return cov[tree.chord_idx] + _seen(b_from_a[tree.chord_idx].inverse() @ ways[tree.last], back)


def _seen(motion: Motions, cov: FloatArray) -> FloatArray:
    """Covariances (n, dim, dim) through motions."""
    return _carried(motion.adjoint(), cov)


def _carried(by: FloatArray, cov: FloatArray) -> FloatArray:
    return np.asarray(by @ cov @ np.swapaxes(by, -1, -2))


def loop_vectors(loops: Loops, b_from_a: Motions) -> FloatArray:
    """Misclosures (L, dim) alone."""
    if loops.tree is not None:
        return _tree_vectors(loops.tree, b_from_a, _from_roots(loops.tree, b_from_a))
    return _walk(loops, b_from_a).log()


def evaluate_loops(loops: Loops, b_from_a: Motions) -> tuple[FloatArray, FloatArray]:
    """Misclosures (L, dim) and their derivatives (K, dim, dim) by the pairs, in the order of ``loops.pair_idx``.

    With M the product round the loop and Z that up to station a of the pair: M moves by ``+-Ad(Z^-1) d`` on the right,
    and its logarithm by Jr^-1 of it; + where the pair is walked from a to b.
    """
    before = np.zeros((len(loops.pair_idx), b_from_a.dim, b_from_a.dim))
    w = _walk(loops, b_from_a, before).log()
    outer = right_jacobian_inverse(w)[np.repeat(np.arange(len(loops)), loops.lengths)]
    return w, loops.sense[:, None, None] * (outer @ before)


def misclosures(loops: Loops, b_from_a: Motions, cov: FloatArray) -> tuple[FloatArray, FloatArray]:
    """How well loops close: misclosures (L, dim) and their covariances, from those of the pairs (E, dim, dim)."""
    if loops.tree is not None:
        ways = _from_roots(loops.tree, b_from_a)
        w, C = _tree_vectors(loops.tree, b_from_a, ways), _tree_covariances(loops.tree, b_from_a, cov, ways)
        return w, _carried(right_jacobian_inverse(w), C)
    dim = b_from_a.dim
    w, C = np.zeros((len(loops), dim)), np.zeros((len(loops), dim, dim))
    for mine, some in loops.portions(_AT_ONCE):
        before = np.zeros((len(some.pair_idx), dim, dim))
        w[mine] = _walk(some, b_from_a, before).log()
        C[mine] = np.add.reduceat(_carried(before, cov[some.pair_idx]), some.ptr[:-1], axis=0)
    return w, _carried(right_jacobian_inverse(w), C)
