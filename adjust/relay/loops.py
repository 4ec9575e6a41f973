"""Independent loops of a network, and their misclosures one by one (:mod:`adjust.pose_network.loops`)."""

from collections.abc import Sequence
from functools import cached_property
from itertools import pairwise
from typing import Literal

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.pose_network.cycles import adjacency, breadth_first, flat, short_loops, shortest_loops
from adjust.pose_network.loops import Loops, misclosures, tree_loops, walked
from adjust.pose_network.network import Topology
from adjust.relay.network import MeasuredPairs
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

LoopKind = Literal["shortest", "tree"]

# larger networks get short loops, each closed by a pair with a spanning tree and the pairs nearer to its root
MAX_SHORTEST_LOOPS = 20_000
# stations among which these are looked for
_SEEN = 200
# elementary steps, some seconds
SEARCH_BUDGET = 20_000_000


@frozen(eq=False)
class LoopBasis(Loops):
    """E - n + c independent loops.

    minimal: whether the total length is the least possible. note: how the loops were found, for people.
    """

    topology: Topology
    minimal: bool
    note: str

    def pairs(self, loop: int) -> tuple[str, ...]:
        """Ids of the pairs of a loop, in the order of the walk."""
        return self.all_pairs[loop]

    def stations(self, loop: int) -> tuple[str, ...]:
        """Ids of the stations of a loop, in the order of the walk."""
        return self.all_stations[loop]

    @cached_property
    def all_pairs(self) -> list[tuple[str, ...]]:
        """:meth:`pairs` of every loop."""
        return self._told(self.topology.pair_ids, self.pair_idx)

    @cached_property
    def all_stations(self) -> list[tuple[str, ...]]:
        """:meth:`stations` of every loop."""
        a, b = self.topology.a_idx[self.pair_idx], self.topology.b_idx[self.pair_idx]
        return self._told(self.topology.station_ids, np.where(self.sense > 0, a, b))

    def _told(self, ids: Sequence[str], rows: IntArray) -> list[tuple[str, ...]]:
        every, ptr = tuple([ids[i] for i in rows.tolist()]), self.ptr.tolist()
        return [every[first:last] for first, last in pairwise(ptr)]


def loop_basis(topology: Topology, kind: LoopKind = "shortest", budget: int = SEARCH_BUDGET) -> LoopBasis:
    """Independent loops: ``shortest`` (a minimal cycle basis) or ``tree`` (of a spanning tree from the busiest).

    Above ``MAX_SHORTEST_LOOPS`` loops short ones are taken; where the search exceeds its budget the spanning tree's
    complete what was found. ``minimal`` and ``note`` say so.
    """
    n = topology.n_stations
    walk = adjacency(n, topology.a_idx, topology.b_idx)
    busiest = np.argsort(-np.diff(walk[0]), kind="stable")
    forest = breadth_first(*walk, busiest)
    in_tree = np.zeros(topology.n_pairs, dtype=np.bool_)
    in_tree[forest.by[forest.by >= 0]] = True
    chords = np.flatnonzero(~in_tree)
    many, a, b = len(chords) > MAX_SHORTEST_LOOPS, topology.a_idx, topology.b_idx
    if kind == "tree" or not len(chords):
        found = tree_loops(a, b, forest, chords)
        return _basis(topology, found, False, "loops of a spanning tree")
    if many:
        reached = np.argsort(forest.order)
        chords = chords[np.argsort(np.maximum(reached[a[chords]], reached[b[chords]]), kind="stable")]
        short = short_loops(n, a, b, chords, np.flatnonzero(in_tree), _SEEN, growing=True)
        first = np.array([loop[0] for loop in short], dtype=np.int64)
        pairs, start, led = flat(short), a[first], np.isin(chords, first)
    else:
        pairs, start, led = shortest_loops(walk, chords, budget)
    found = walked(a, b, pairs, start)
    if len(found) == len(chords) and not many:
        return _basis(topology, found, True, "shortest independent loops")
    rest = tree_loops(a, b, forest, chords[~led])  # as long as the network is wide, maybe
    more = f", and {len(rest)} of a spanning tree" if len(rest) else ""
    note = f"the {len(found)} shortest loops{more}: the search used up its budget"
    if many:
        note = f"{len(found)} short loops{more}: more than {MAX_SHORTEST_LOOPS} are too many for the shortest ones"
    return _basis(topology, found.and_then(rest), False, note)


def _basis(topology: Topology, found: Loops, minimal: bool, note: str) -> LoopBasis:
    return LoopBasis(found.ptr, found.pair_idx, found.sense, found.start_idx, topology, minimal, note, tree=found.tree)


@frozen(eq=False)
class LoopMisclosures:
    """Misclosures of the measured pairs: vector (L, dim), cov (L, dim, dim), test = w' cov^-1 w (L,), p_value (L,).

    Under the a priori covariances each test is chi-square with dim degrees of freedom.
    """

    basis: LoopBasis
    vector: FloatArray
    cov: FloatArray
    test: FloatArray
    p_value: FloatArray

    def failed(self, alpha: float = 0.001) -> IntArray:
        """Loops that do not close, worst first; ``alpha`` is for the whole network (Sidak)."""
        single = sidak(alpha, len(self.test))
        order = np.argsort(self.p_value, kind="stable")
        return np.asarray(order[self.p_value[order] < single], dtype=np.int64)

    def text(self, loop: int) -> str:
        """One loop for people."""
        turn = np.degrees(np.linalg.norm(self.vector[loop, :3])) * 3600.0
        shift = f", {1e3 * np.linalg.norm(self.vector[loop, 3:]):.3f} mm" if self.vector.shape[1] == 6 else ""
        way = " -> ".join((*self.basis.stations(loop), self.basis.stations(loop)[0]))
        return (
            f"{way}: misclosure {turn:.2f} arcsec{shift}, test {self.test[loop]:.1f} (p {self.p_value[loop]:.2g}), "
            f"pairs {', '.join(self.basis.pairs(loop))}"
        )


def loop_misclosures(network: MeasuredPairs) -> LoopMisclosures:
    """How well each loop closes, from the measured pairs alone."""
    basis = loop_basis(network.topology)
    w, cov = misclosures(basis, network.b_from_a, network.cov)
    test = np.einsum("li,li->l", w, np.linalg.solve(cov, w[..., None])[..., 0])
    return LoopMisclosures(basis, w, cov, test, np.asarray(chi2.sf(test, network.dim)))
