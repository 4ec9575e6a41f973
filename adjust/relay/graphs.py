"""Walks through a network, all in linear time: adjacency, breadth-first forests, and which loops cover a pair.

A network is given by compressed adjacency: the neighbours of station v, and the pairs that lead there, are the ranges
``ptr[v]:ptr[v + 1]`` of ``neighbour`` and ``pair``. Two stations may be measured more than once.
"""

from dataclasses import dataclass

import numpy as np

from adjust.model.survey import IntArray


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
