"""Walks through a network in linear time, and the search for a shortest set of independent loops.

A network is given by compressed adjacency: the neighbours of station v, and the pairs that lead there, are the ranges
``ptr[v]:ptr[v + 1]`` of ``neighbour`` and ``pair``. Two stations may be measured more than once.

Horton (1987, SIAM J. Comput. 16, 358-366): the loops "shortest way from v to x, pair (x, y), shortest way back" over
all stations v and pairs (x, y) contain a minimal cycle basis; taken shortest first, those independent over GF(2) of the
ones before are one. His proof asks of v only that it lies on the loop, so v need run through a set of stations that
meets every loop (Mehlhorn and Michail 2009, ACM J. Exp. Algorithmics 14).

Whether a loop depends on those found is told by labels of the pairs, sums over GF(2) that vanish for all of these (de
Pina 1995; Kavitha, Mehlhorn, Michail and Paluch 2008, Algorithmica 52), 63 random ones: what does not cancel is
eliminated, and the pairs with a label tell where loops are left. One that is independent cancels once in 10^18.
"""

import heapq
from collections.abc import Iterator, Sequence
from itertools import pairwise

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, IntArray
from adjust.native.loops import horton_loops, label_chords, shortest_loop

_FEWER = 2
"""How many times fewer stations must be to search from them: near ends of a search others are found, as short."""


def adjacency(n: int, a: IntArray, b: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``ptr`` (n + 1,), ``neighbour`` (2E,), ``pair`` (2E,), by increasing pair at every station."""
    ends, others = (np.stack(x, axis=1).ravel() for x in ((a, b), (b, a)))
    order = np.argsort(ends, kind="stable")
    ptr = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=n))])
    return ptr, np.asarray(others[order]), order // 2


@frozen(eq=False)
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


def connected_parts(n: int, a: IntArray, b: IntArray) -> IntArray:
    """The connected part (n,) of every station, numbered from 0 in the order of their first stations."""
    first = np.arange(n)
    while (first[a] != first[b]).any():
        least = np.minimum(first[a], first[b])
        for ends in (a, b):
            np.minimum.at(first, first[ends], least)  # those before them that the stations are tied to
        while (first[first] != first).any():
            first = first[first]
    return np.unique(first, return_inverse=True)[1].astype(np.int64)


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


def meeting_stations(ptr: IntArray, neighbour: IntArray) -> list[int]:
    """Stations that meet every loop: dead ends pruned, then always the station with most neighbours left taken out.

    Among equals the lowest number goes first. A pair measured twice is a loop as well.
    """
    ends, others = ptr.tolist(), neighbour.tolist()
    ways = [others[i:j] for i, j in pairwise(ends)]
    degree = [len(w) for w in ways]
    heap = [(-d, v) for v, d in enumerate(degree)]
    heapq.heapify(heap)
    gone = [d < 2 for d in degree]
    stack = [v for v, dead in enumerate(gone) if dead]
    out: list[int] = []
    while True:
        while stack:
            for w in ways[stack.pop()]:
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
    walk: tuple[IntArray, IntArray, IntArray], chords: IntArray, budget: int
) -> tuple[tuple[IntArray, IntArray], IntArray, BoolArray]:
    """Independent loops, shortest first, until there is one for each chord or the budget of steps is used up.

    walk: of :func:`adjacency`; chords: (L,) pairs outside a spanning forest. Returns the loops' pairs in the order of
    the walk, as :func:`flat` does, the stations at which they begin, and which (L,) chords lead a set of the
    elimination: the loops that the other chords close with the forest are what is missing.
    """
    n, n_loops = len(walk[0]) - 1, len(chords)
    chord, led = np.full(len(walk[1]) // 2, -1, dtype=np.int64), np.zeros(n_loops, dtype=np.bool_)
    chord[chords] = np.arange(n_loops)
    words = -(-n_loops // 64)
    sets = chord, np.zeros(words, dtype=np.int64), np.empty((n_loops, words), dtype=np.int64), led
    walks = *walk, np.full(n, -1, dtype=np.int64), *(np.zeros(n, dtype=np.int64) for _ in range(5))
    every, work = np.array(meeting_stations(*walk[:2]), dtype=np.int64), np.zeros(1, dtype=np.int64)
    drawn = np.random.default_rng(0).integers(1, 2**63 - 1, size=n_loops, dtype=np.int64)
    label, length = np.zeros_like(chord), 1
    found, start, lengths = [np.zeros(0, dtype=np.int64)], [np.zeros(0, dtype=np.int64)], [0]
    while (missing := n_loops - int(led.sum())) and work[0] < budget and length <= n:
        label_chords(sets, drawn)
        label[chords] = drawn
        roots = _through(walk, label, every)
        length = length + 1 if roots is every else shortest_loop(walks, label, roots, budget, work)
        loops, begin = np.empty((missing, length), dtype=np.int64), np.empty(missing, dtype=np.int64)
        more = horton_loops(walks, sets, label, roots, budget, work, loops, begin) if length else 0
        found.append(loops[:more].ravel())
        start.append(begin[:more])
        lengths += [length] * more
    return (np.cumsum(lengths), np.concatenate(found)), np.concatenate(start), led


def _through(walk: tuple[IntArray, IntArray, IntArray], label: IntArray, every: IntArray) -> IntArray:
    """Stations that meet all loops whose labels do not cancel: those that meet every loop, or clearly fewer."""
    ptr, others, pair = walk
    rows = np.flatnonzero(label[pair])
    ends, others = np.repeat(np.arange(len(ptr) - 1), np.diff(ptr))[rows], others[rows]
    rank = len(ptr) * np.bincount(ends, minlength=len(ptr)) - np.arange(len(ptr))  # of each pair the busier end
    few = np.unique(np.where(rank[ends] > rank[others], ends, others))
    return few if _FEWER * len(few) < len(every) else every


def forest_loops(a: IntArray, b: IntArray, forest: Forest, chords: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """The loop that each chord (L,) closes with the forest, from its station a: its pairs, the chord first.

    Returns these as :func:`flat` does, and the stations (L,) where the ways back from both ends meet.
    """
    n, meet = np.ones(len(chords), dtype=np.int64), b[chords].copy()
    for loops, _, _, stations in _ways_back(a, b, forest, chords):
        n[loops] += 1
        meet[loops] = stations
    ptr = np.concatenate([[0], np.cumsum(n)])
    out, first, last = np.empty(ptr[-1], dtype=np.int64), ptr[:-1] + 1, ptr[1:] - 1
    out[ptr[:-1]] = chords
    for loops, pairs, down, _ in _ways_back(a, b, forest, chords):
        out[np.where(down, first[loops], last[loops])] = pairs
        first[loops] += down
        last[loops] -= ~down
    return ptr, out, meet


def _ways_back(a: IntArray, b: IntArray, forest: Forest, chords: IntArray) -> Iterator[tuple[IntArray, ...]]:
    """The ways back from both ends of chords until they meet, step by step, always from the deeper end.

    Of the chords still on their way: which, the pair that is walked, whether on the way from b, and where it leads.
    """
    loops, v, w = np.arange(len(chords)), b[chords], a[chords]
    while (apart := v != w).any():
        loops, v, w = loops[apart], v[apart], w[apart]
        down = forest.depth[v] >= forest.depth[w]
        here = np.where(down, v, w)
        there = forest.parent[here]
        yield loops, forest.by[here], down, there
        v, w = np.where(down, there, v), np.where(down, w, there)


def short_loops(
    n: int, a: IntArray, b: IntArray, pairs: IntArray, through: IntArray, most: int, growing: bool = False
) -> list[list[int]]:  # fmt: skip
    """For each of these pairs a short loop that it closes with those: its pairs, it first, walked from its a.

    Two searches meet that begin at its ends; where they have seen ``most`` stations without, there is none. Loops that
    are there already are not given again. growing: with the pairs before it, too, which makes the loops independent.
    """
    starts, neighbour, way = adjacency(n, a[through], b[through])
    all_ways = list(zip(neighbour.tolist(), through[way].tolist(), strict=True))
    ways = [all_ways[i:j] for i, j in pairwise(starts.tolist())]
    found: dict[frozenset[int], list[int]] = {}
    for e, v, w in zip(pairs.tolist(), a[pairs].tolist(), b[pairs].tolist(), strict=True):
        came: tuple[dict[int, tuple[int, int]], ...] = {v: (v, -1)}, {w: (w, -1)}
        fronts, meet = [[v], [w]], -1
        while meet < 0 and all(fronts) and len(came[0]) + len(came[1]) < most:
            side = int(len(fronts[1]) < len(fronts[0]))
            fronts[side], meet = _further(fronts[side], e, ways, came[side], came[1 - side])
        if meet >= 0:
            loop = [e, *_back(came[1], meet)[::-1], *_back(came[0], meet)]
            found.setdefault(frozenset(loop), loop)
        if growing:
            ways[v].append((w, e))
            ways[w].append((v, e))
    return list(found.values())


def _further(
    front: list[int], without: int, ways: list[list[tuple[int, int]]], came: dict[int, tuple[int, int]],
    others: dict[int, tuple[int, int]],
) -> tuple[list[int], int]:  # fmt: skip
    """One step of a search: the next front, and the station where it meets the other search, -1 where it does not."""
    new: list[int] = []
    for x in front:
        for y, e in ways[x]:
            if e != without and y not in came:
                came[y] = x, e
                new.append(y)
                if y in others:
                    return new, y
    return new, -1


def _back(came: dict[int, tuple[int, int]], station: int) -> list[int]:
    """The pairs from a station back to where its search began."""
    out = []
    while (step := came[station])[1] >= 0:
        station = step[0]
        out.append(step[1])
    return out


def flat(loops: Sequence[Sequence[int]]) -> tuple[IntArray, IntArray]:
    """Ranges (n + 1,) of the loops' pairs, and these one after the other."""
    ptr = np.cumsum([0] + [len(pairs) for pairs in loops])
    return ptr, np.array([e for pairs in loops for e in pairs], dtype=np.int64)
