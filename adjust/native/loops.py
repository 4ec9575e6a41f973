"""The search for independent loops of a network; see :mod:`adjust.pose_network.cycles` and ``loops.h``."""

from adjust.model.survey import BoolArray, IntArray
from adjust.native.library import Function

_horton_loops = Function(
    "horton_loops",
    "ptr[V+1] neighbour[K] pair[K] depth[V] parent[V] by[V] branch[V] order[V] chord[E] bits[W] rows[L,W] kept[L] "
    "roots[*] budget work[1] found[m,n] start[m]",
)  # fmt: skip


def horton_loops(
    walks: tuple[IntArray, ...], sets: tuple[IntArray, IntArray, IntArray, BoolArray], roots: IntArray, budget: int,
    work: IntArray, found: IntArray, start: IntArray,
) -> int:  # fmt: skip
    """Loops of one length at the roots, those independent of all before into ``found`` (m, length); how many.

    walks: adjacency, and room (V,) for depths (-1 everywhere), parents, pairs, branches and the order of a search.
    sets: chord number of each pair, and the elimination so far: room, rows, and which of these there are. work: steps
    so far, counted on; no root is begun above the budget. start: (m,) stations at which the loops begin.
    """
    return _horton_loops(*walks, *sets, roots, budget, work, found, start)
