"""Search for a shortest set of independent loops. Sets of pairs outside a spanning forest are integers, bit by bit.

Horton (1987, SIAM J. Comput. 16, 358-366): the loops "shortest way from v to x, pair (x, y), shortest way back" over
all stations v and pairs (x, y) contain a minimal cycle basis; taken shortest first, those independent over GF(2) of the
ones before are one. His proof asks of v only that it lies on the loop, so v need run through a set of stations that
meets every loop (Mehlhorn and Michail 2009, ACM J. Exp. Algorithmics 14).
"""

import heapq
from collections.abc import Iterable, Sequence

import numpy as np

from adjust.model.survey import IntArray
from adjust.relay.graphs import Forest

_Ways = Sequence[Sequence[tuple[int, int]]]  # of every station the neighbours, and the pairs that lead there


class Independent:
    """Elimination over GF(2): which loops are independent of those before. ``work`` counts its steps."""

    def __init__(self) -> None:
        self.rows: dict[int, int] = {}
        self.work = 0

    def add(self, bits: int) -> bool:
        """Take a set in; False where it is a sum of those before."""
        while bits:
            self.work += 1
            lead = bits.bit_length()
            if lead not in self.rows:
                self.rows[lead] = bits
                return True
            bits ^= self.rows[lead]
        return False


def bits_of(pairs: Iterable[int], chord: Sequence[int]) -> int:
    """The set of chords among pairs; chord: number of each pair outside a spanning forest, -1 inside."""
    bits = 0
    for e in pairs:
        if chord[e] >= 0:
            bits ^= 1 << chord[e]
    return bits


def meeting_stations(ways: _Ways) -> list[int]:
    """Stations that meet every loop: dead ends pruned, then always the station with most neighbours left taken out.

    Among equals the lowest number goes first. A pair measured twice is a loop as well.
    """
    degree = [len(w) for w in ways]
    heap = [(-d, v) for v, d in enumerate(degree)]
    heapq.heapify(heap)
    gone = [d < 2 for d in degree]
    stack = [v for v, dead in enumerate(gone) if dead]
    out: list[int] = []
    while True:
        while stack:
            for w, _ in ways[stack.pop()]:
                if not gone[w]:
                    degree[w] -= 1
                    if degree[w] < 2:
                        gone[w] = True
                        stack.append(w)
                    else:
                        heapq.heappush(heap, (-degree[w], w))
        while heap and (gone[heap[0][1]] or -heap[0][0] != degree[heap[0][1]]):
            heapq.heappop(heap)
        if not heap:
            return out
        v = heap[0][1]
        out.append(v)
        gone[v] = True
        stack.append(v)


def shortest_loops(
    ways: _Ways, chord: Sequence[int], n_loops: int, budget: int
) -> tuple[list[list[int]], list[int], Independent]:
    """Independent loops, shortest first, until there are ``n_loops`` or the budget of elementary steps is used up.

    Returns their pairs in the order of the walk, the stations at which they begin, and the elimination so far.
    """
    found: list[list[int]] = []
    start: list[int] = []
    roots, independent, seen, work = meeting_stations(ways), Independent(), set[int](), 0
    for length in range(2, len(ways) + 1):
        for root in roots:
            if len(found) == n_loops or work + independent.work >= budget:
                return found, start, independent
            loops, visited = _loops_at(root, length, ways)
            work += visited
            for pairs in loops:
                bits = bits_of(pairs, chord)
                if bits not in seen and len(found) < n_loops:
                    seen.add(bits)
                    if independent.add(bits):
                        found.append(pairs)
                        start.append(root)
    return found, start, independent


def _loops_at(root: int, length: int, ways: _Ways) -> tuple[list[list[int]], int]:
    """Horton's loops of a length at a station, and the number of steps: they close at the last level of a search."""
    half = length // 2
    # pairs from the root, and the first station on the way, by station
    way: dict[int, list[int]] = {root: []}
    branch, order, visited, out = {root: root}, [root], 0, []
    for v in order:
        mine = way[v]
        here = len(mine)
        visited += len(ways[v])
        for w, e in ways[v]:
            other = way.get(w)
            if other is None:
                if here < half:
                    way[w], branch[w] = [*mine, e], branch[v] if mine else w
                    order.append(w)
                continue
            there = len(other)
            # each closing pair once: from its deeper end, or from the lower number among equals
            if (here + there + 1 == length and branch[v] != branch[w] and (here > there or (here == there and v < w))
                    and e != mine[-1] and (not other or e != other[-1])):  # fmt: skip
                out.append([*mine, e, *reversed(other)])
    return out, visited


def forest_loops(a: IntArray, b: IntArray, forest: Forest, chords: IntArray) -> list[list[int]]:
    """The loop that each chord closes with the forest, from its station a: its pairs, the chord first."""
    parent, by, depth = forest.parent.tolist(), forest.by.tolist(), forest.depth.tolist()
    out = []
    for c, v, w in zip(chords.tolist(), b[chords].tolist(), a[chords].tolist(), strict=True):
        down, up = [c], []
        while v != w:
            if depth[v] >= depth[w]:
                down.append(by[v])
                v = parent[v]
            else:
                up.append(by[w])
                w = parent[w]
        out.append(down + up[::-1])
    return out


def flat(loops: Sequence[Sequence[int]]) -> tuple[IntArray, IntArray]:
    """Ranges (n + 1,) of the loops' pairs, and these one after the other."""
    ptr = np.cumsum([0] + [len(pairs) for pairs in loops])
    return ptr, np.array([e for pairs in loops for e in pairs], dtype=np.int64)
