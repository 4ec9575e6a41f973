"""Compiled walks through a network, all in linear time: adjacency, depth-first and breadth-first forests, covers.

A network is given by compressed adjacency: the neighbours of station v, and the pairs that lead there, are the ranges
``ptr[v]:ptr[v + 1]`` of ``neighbour`` and ``pair``. Two stations may be measured more than once.
"""

import numpy as np

from adjust.compiling import njit
from adjust.model import IntArray


@njit(cache=True, nogil=True)
def adjacency(n: int, a: IntArray, b: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """``ptr`` (n + 1,), ``neighbour`` (2E,), ``pair`` (2E,)."""
    ptr = np.zeros(n + 1, dtype=np.int64)
    for e in range(len(a)):
        ptr[a[e] + 1] += 1
        ptr[b[e] + 1] += 1
    for i in range(n):
        ptr[i + 1] += ptr[i]
    at = ptr[:-1].copy()
    neighbour, pair = np.empty(2 * len(a), dtype=np.int64), np.empty(2 * len(a), dtype=np.int64)
    for e in range(len(a)):
        neighbour[at[a[e]]], pair[at[a[e]]] = b[e], e
        at[a[e]] += 1
        neighbour[at[b[e]]], pair[at[b[e]]] = a[e], e
        at[b[e]] += 1
    return ptr, neighbour, pair


@njit(cache=True, nogil=True)
def breadth_first(
    ptr: IntArray, neighbour: IntArray, pair: IntArray, roots: IntArray
) -> tuple[IntArray, IntArray, IntArray, IntArray, IntArray]:
    """Forest of shortest ways: order (n,), parent, pair to the parent (-1 at roots), depth and part of each station.

    roots: all stations in the order in which they are tried as roots; each part takes the first it meets.
    """
    n = len(ptr) - 1
    order = np.empty(n, dtype=np.int64)
    parent, by = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    depth, part = np.zeros(n, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    head = tail = 0
    parts = 0
    for root in roots:
        if part[root] >= 0:
            continue
        part[root] = parts
        order[tail] = root
        tail += 1
        while head < tail:
            v = order[head]
            head += 1
            for i in range(ptr[v], ptr[v + 1]):
                w = neighbour[i]
                if part[w] < 0:
                    part[w], parent[w], by[w], depth[w] = parts, v, pair[i], depth[v] + 1
                    order[tail] = w
                    tail += 1
        parts += 1
    return order, parent, by, depth, part


@njit(cache=True, nogil=True)
def depth_first(ptr: IntArray, neighbour: IntArray, pair: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Depth-first forest: order (n,) of discovery, parent, pair to the parent (-1 at roots)."""
    n = len(ptr) - 1
    order, at = np.empty(n, dtype=np.int64), ptr[:-1].copy()
    parent, by = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    seen, stack = np.zeros(n, dtype=np.bool_), np.empty(n, dtype=np.int64)
    found = 0
    for root in range(n):
        if seen[root]:
            continue
        seen[root] = True
        stack[0], top = root, 1
        order[found] = root
        found += 1
        while top:
            v = stack[top - 1]
            if at[v] == ptr[v + 1]:
                top -= 1
                continue
            i = at[v]
            at[v] += 1
            w = neighbour[i]
            if not seen[w]:
                seen[w] = True
                parent[w], by[w] = v, pair[i]
                order[found] = w
                found += 1
                stack[top] = w
                top += 1
    return order, parent, by


@njit(cache=True, nogil=True)
def covers(
    order: IntArray, parent: IntArray, by: IntArray, a: IntArray, b: IntArray, label: IntArray
) -> tuple[IntArray, IntArray]:
    """Of every pair: the number of loops through it, and the exclusive or of their labels.

    The loops are those that each pair outside the depth-first forest closes with it; every such pair joins a station
    with one of its forebears, so that what it adds at its lower end and takes off at its upper end sums, over the
    subtree below a pair of the forest, to the loops through that pair.
    """
    n, m = len(order), len(a)
    rank = np.empty(n, dtype=np.int64)
    for i in range(n):
        rank[order[i]] = i
    in_forest = np.zeros(m, dtype=np.bool_)
    for v in range(n):
        if by[v] >= 0:
            in_forest[by[v]] = True
    number, mark = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
    count, xor = np.zeros(m, dtype=np.int64), np.zeros(m, dtype=np.int64)
    for e in range(m):
        if not in_forest[e]:
            lower, upper = (a[e], b[e]) if rank[a[e]] > rank[b[e]] else (b[e], a[e])
            number[lower] += 1
            number[upper] -= 1
            mark[lower] ^= label[e]
            mark[upper] ^= label[e]
            count[e], xor[e] = 1, label[e]
    for i in range(n - 1, -1, -1):
        v = order[i]
        if by[v] >= 0:
            count[by[v]], xor[by[v]] = number[v], mark[v]
            number[parent[v]] += number[v]
            mark[parent[v]] ^= mark[v]
    return count, xor
