"""The search for independent loops of a network; see :mod:`adjust.pose_network.cycles` and ``loops.h``."""

from adjust.model.survey import BoolArray, IntArray
from adjust.native.library import Function

_WALKS = "ptr[V+1] neighbour[K] pair[K] depth[V] parent[V] by[V] branch[V] order[V] sum[V]"
_horton_loops = Function(
    "horton_loops",
    f"{_WALKS} chord[E] bits[W] rows[L,W] kept[L] label[E] roots[*] budget work[1] found[m,n] start[m]",
)
_shortest_loop = Function("shortest_loop", f"{_WALKS} label[E] roots[*] budget work[1]")
_label_chords = Function("label_chords", "rows[L,W] kept[L] label[L]")


def horton_loops(
    walks: tuple[IntArray, ...], sets: tuple[IntArray, IntArray, IntArray, BoolArray],
    label: IntArray, roots: IntArray, budget: int, work: IntArray, found: IntArray, start: IntArray,
) -> int:  # fmt: skip
    """Loops of one length at the roots, those independent of all before into ``found`` (m, length); how many.

    walks: adjacency, and room (V,) for depths (-1 everywhere), parents, pairs, branches, the order of a search, sums.
    sets: chord number of each pair, and the elimination so far: room, rows, and which of these there are. label: (E,)
    bits that cancel over every loop found. work: steps so far, counted on; no root is begun above the budget. start:
    (m,) stations at which the loops begin.
    """
    return _horton_loops(*walks, *sets, label, roots, budget, work, found, start)


def shortest_loop(walks: tuple[IntArray, ...], label: IntArray, roots: IntArray, budget: int, work: IntArray) -> int:
    """Length of the shortest loop through a root whose labels (E,) do not cancel; 0 where the budget does not last."""
    return _shortest_loop(*walks, label, roots, budget, work)


def label_chords(sets: tuple[IntArray, IntArray, IntArray, BoolArray], label: IntArray) -> None:
    """Labels (L,) of the chords that lead a set, from those of the others: over each set they cancel."""
    _label_chords(*sets[2:], label)
