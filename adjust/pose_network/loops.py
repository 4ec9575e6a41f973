"""Loops walked through a network of pairs, and what is left over when they come back to where they began.

A loop is walked from its first station; the product of its pairs, each taken along or against its direction, would be
the identity without errors. Its logarithm is the misclosure, in the frame of the first station.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.pose_network.cycles import flat
from adjust.spatial.rigid_motions import Motions, identities, right_jacobian_inverse

_AT_ONCE = 200_000
"""Pairs of loops whose misclosures are found in one go: of a spanning tree of 10^5 pairs there are 10^7."""


@dataclass(frozen=True, eq=False)
class Loops:
    """L loops: loop k are the pairs ``pair_idx[ptr[k]:ptr[k + 1]]`` in the order of the walk.

    sense: +1 where a pair is walked from a to b, -1 from b to a. start_idx: (L,) first station.
    """

    ptr: IntArray
    pair_idx: IntArray
    sense: IntArray
    start_idx: IntArray

    def __len__(self) -> int:
        return len(self.start_idx)

    @property
    def lengths(self) -> IntArray:
        """Pairs in each loop (L,)."""
        return np.diff(self.ptr)

    def portions(self, most: int) -> Iterator[tuple[slice, "Loops"]]:
        """Some loops after the other, with about so many pairs in all: which, and these."""
        first = 0
        while first < len(self):
            last = max(first + 1, int(np.searchsorted(self.ptr, self.ptr[first] + most, side="right")) - 1)
            rows, ptr = slice(self.ptr[first], self.ptr[last]), self.ptr[first : last + 1] - self.ptr[first]
            mine = slice(first, last)
            yield mine, Loops(ptr, self.pair_idx[rows], self.sense[rows], self.start_idx[mine])
            first = last


def walked(a_idx: IntArray, b_idx: IntArray, loops: Sequence[Sequence[int]], first: Sequence[int] | IntArray) -> Loops:
    """Loops of pairs between stations a (E,) and b (E,), in the order of the walk, from their first stations (L,)."""
    (ptr, pairs), start = flat(loops), np.array(first, dtype=np.int64)
    sense, at = np.zeros(len(pairs), dtype=np.int64), start.copy()
    for rows, some in _steps(ptr):
        a, b = a_idx[pairs[rows]], b_idx[pairs[rows]]
        along = a == at[some]
        sense[rows] = np.where(along, 1, -1)
        at[some] = np.where(along, b, a)
    return Loops(ptr, pairs, sense, start)


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
        product.rotation[some] = after.rotation
        if product.translation is not None and after.translation is not None:
            product.translation[some] = after.translation
    return product


def loop_vectors(loops: Loops, b_from_a: Motions) -> FloatArray:
    """Misclosures (L, dim) alone."""
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
    dim = b_from_a.dim
    w, C = np.zeros((len(loops), dim)), np.zeros((len(loops), dim, dim))
    for mine, some in loops.portions(_AT_ONCE):
        before = np.zeros((len(some.pair_idx), dim, dim))
        w[mine] = _walk(some, b_from_a, before).log()
        each = before @ cov[some.pair_idx] @ np.swapaxes(before, -1, -2)
        C[mine] = np.add.reduceat(each, some.ptr[:-1], axis=0)
    outer = right_jacobian_inverse(w)
    return w, outer @ C @ np.swapaxes(outer, -1, -2)
