"""Walks through a network in linear time, and the search for a shortest set of independent loops.

A network is given by compressed adjacency: the neighbours of station v, and the pairs that lead there, are the ranges
``ptr[v]:ptr[v + 1]`` of ``neighbour`` and ``pair``. Two stations may be measured more than once. Sets of pairs outside
a spanning forest are integers, bit by bit.

Horton (1987, SIAM J. Comput. 16, 358-366): the loops "shortest way from v to x, pair (x, y), shortest way back" over
all stations v and pairs (x, y) contain a minimal cycle basis; taken shortest first, those independent over GF(2) of the
ones before are one. His proof asks of v only that it lies on the loop, so v need run through a set of stations that
meets every loop (Mehlhorn and Michail 2009, ACM J. Exp. Algorithmics 14).
"""

import heapq
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from adjust.model.survey import IntArray

_Ways = Sequence[Sequence[tuple[int, int]]]  # of every station the neighbours, and the pairs that lead there


def adjacency(n: int, a: IntArray, b: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``ptr`` (n + 1,), ``neighbour`` (2E,), ``pair`` (2E,), by increasing pair at every station."""
    ends, others = (np.stack(x, axis=1).ravel() for x in ((a, b), (b, a)))
    order = np.argsort(ends, kind="stable")
    ptr = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=n))])
    return ptr, np.asarray(others[order]), order // 2


@dataclass(frozen=True, eq=False)
class Forest:
    """A forest of shortest ways: of each station (n,) the parent, the pair to it (-1 at roots), depth and part.

    order: (n,) stations as they were reached.
    """

    order: IntArray
    parent: IntArray
    by: IntArray
    depth: IntArray
    part: IntArray


def breadth_first(ptr: IntArray, neighbour: IntArray, pair: IntArray, roots: IntArray) -> Forest:
    """The forest of a network; roots: all stations in the order in which they are tried, each part takes the first."""
    n = len(ptr) - 1
    starts, ways = ptr.tolist(), list(zip(neighbour.tolist(), pair.tolist(), strict=True))
    parent, by, depth, part = [-1] * n, [-1] * n, [0] * n, [-1] * n
    order: list[int] = []
    parts = 0
    for root in roots.tolist():
        if part[root] >= 0:
            continue
        part[root] = parts
        head = len(order)
        order.append(root)
        while head < len(order):
            v = order[head]
            head += 1
            for w, e in ways[starts[v] : starts[v + 1]]:
                if part[w] < 0:
                    part[w], parent[w], by[w], depth[w] = parts, v, e, depth[v] + 1
                    order.append(w)
        parts += 1
    return Forest(*(np.array(x, dtype=np.int64) for x in (order, parent, by, depth, part)))


def loop_labels(n: int, a: IntArray, b: IntArray) -> IntArray:
    """Of every pair (E,) a number that pairs with the same loops share, 0 where it closes none.

    Each pair outside a spanning forest closes one loop with it and has a random label of 63 bits; a pair's number is
    the exclusive or of the labels of its loops. For a pair of the forest these are the pairs outside that have one end
    in the subtree below it. Numbers of two pairs agree by chance once in 10^18 comparisons.
    """
    forest = breadth_first(*adjacency(n, a, b), np.arange(n))
    out = np.random.default_rng(0).integers(1, 2**63 - 1, size=len(a), dtype=np.int64)
    out[forest.by[forest.by >= 0]] = 0
    mark = np.zeros(n, dtype=np.int64)
    for ends in (a, b):
        np.bitwise_xor.at(mark, ends, out)
    below, parent = mark.tolist(), forest.parent.tolist()
    for v in forest.order[::-1].tolist():
        if parent[v] >= 0:
            below[parent[v]] ^= below[v]
    inner = np.flatnonzero(forest.by >= 0)
    out[forest.by[inner]] = np.array(below, dtype=np.int64)[inner]
    return out


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
