"""Compiled search for a shortest set of independent loops.

Horton (1987, SIAM J. Comput. 16, 358-366): the loops "shortest way from v to x, pair (x, y), shortest way back" over
all stations v and pairs (x, y) contain a minimal cycle basis; taken shortest first, those independent over GF(2) of the
ones before are one. His proof asks of v only that it lies on the loop, so v need run through a set of stations that
meets every loop (Mehlhorn and Michail 2009, ACM J. Exp. Algorithmics 14).
"""

import heapq

import numpy as np
import numpy.typing as npt

from adjust.compiling import njit
from adjust.model import IntArray

Bits = npt.NDArray[np.uint64]


@njit(cache=True, nogil=True)
def meeting_stations(ptr: IntArray, neighbour: IntArray) -> IntArray:
    """Stations that meet every loop: dead ends pruned, then always the station with most neighbours left taken out.

    Among equals the lowest number goes first. A pair measured twice is a loop as well.
    """
    n = len(ptr) - 1
    degree, gone = ptr[1:] - ptr[:-1], np.zeros(n, dtype=np.bool_)
    heap = [(-degree[v], v) for v in range(n)]
    heapq.heapify(heap)
    stack, out = np.empty(n, dtype=np.int64), np.empty(n, dtype=np.int64)
    found = top = 0
    for v in range(n):
        if degree[v] < 2:
            stack[top] = v
            top += 1
            gone[v] = True
    while True:
        while top:
            top -= 1
            v = stack[top]
            for i in range(ptr[v], ptr[v + 1]):
                w = neighbour[i]
                if not gone[w]:
                    degree[w] -= 1
                    if degree[w] < 2:
                        gone[w] = True
                        stack[top] = w
                        top += 1
                    else:
                        heapq.heappush(heap, (-degree[w], w))
        v = -1
        while len(heap):
            d, w = heapq.heappop(heap)
            if not gone[w] and -d == degree[w]:
                v = w
                break
        if v < 0:
            return out[:found]
        out[found] = v
        found += 1
        gone[v] = True
        stack[top] = v
        top += 1


@njit(cache=True, nogil=True)
def insert(bits: Bits, rows: Bits, taken: npt.NDArray[np.bool_], work: IntArray) -> bool:
    """Reduce ``bits`` by the rows so far and keep what is left; False where nothing is.

    rows: (L, words), row p leads with bit p where ``taken[p]``. work[0] counts words touched.
    """
    words = len(bits)
    for i in range(words):
        while bits[i]:
            low = 0
            word = bits[i]
            while not word & np.uint64(1):
                word >>= np.uint64(1)
                low += 1
            p = 64 * i + low
            work[0] += words - i
            if not taken[p]:
                taken[p] = True
                rows[p, i:] = bits[i:]
                return True
            for j in range(i, words):
                bits[j] ^= rows[p, j]
    return False


@njit(cache=True, nogil=True)
def way_bits(v: int, root: int, parent: IntArray, by: IntArray, chord: IntArray, bits: Bits) -> None:
    """Flip the bits of the chords on the way from ``v`` up to ``root``."""
    while v != root:
        c = chord[by[v]]
        if c >= 0:
            bits[c // 64] ^= np.uint64(1) << np.uint64(c % 64)
        v = parent[v]


@njit(cache=True, nogil=True)
def way(v: int, root: int, parent: IntArray, by: IntArray, out: IntArray, at: int) -> int:
    """Write the pairs from ``v`` up to ``root`` into ``out`` from ``at``; returns where it ends."""
    while v != root:
        out[at] = by[v]
        at += 1
        v = parent[v]
    return at


@njit(cache=True, nogil=True)
def shortest_loops(
    ptr: IntArray, neighbour: IntArray, pair: IntArray, roots: IntArray, chord: IntArray, n_loops: int, budget: int
) -> tuple[IntArray, IntArray, IntArray, Bits, npt.NDArray[np.bool_]]:
    """Independent loops, shortest first, until there are ``n_loops`` or the budget of elementary steps is used up.

    chord: (E,) number of each pair outside a spanning forest, -1 inside. Returns the loops as ranges (found + 1,) of
    their pairs, beginning at the stations ``start`` (found,), and the elimination so far (see :func:`insert`).
    """
    n = len(ptr) - 1
    words = (n_loops + 63) // 64
    rows, taken = np.zeros((n_loops, words), dtype=np.uint64), np.zeros(n_loops, dtype=np.bool_)
    bits = np.zeros(words, dtype=np.uint64)
    ends, start = np.zeros(n_loops + 1, dtype=np.int64), np.zeros(n_loops, dtype=np.int64)
    out = np.empty(max(16, 8 * n_loops), dtype=np.int64)
    parent, by = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    depth, branch = np.full(n, -1, dtype=np.int64), np.full(n, -1, dtype=np.int64)
    queue, work = np.empty(n, dtype=np.int64), np.zeros(1, dtype=np.int64)
    found, length = 0, 1
    while found < n_loops and work[0] < budget and length <= n:
        length += 1
        half = length // 2
        for root in roots:
            # breadth first down to depth ``half``; the loops of this length close at its last level
            queue[0], head, tail = root, 0, 1
            depth[root], branch[root] = 0, root
            while head < tail:
                v = queue[head]
                head += 1
                work[0] += ptr[v + 1] - ptr[v]
                for i in range(ptr[v], ptr[v + 1]):
                    w, e = neighbour[i], pair[i]
                    if depth[w] < 0:
                        if depth[v] < half:
                            depth[w], parent[w], by[w] = depth[v] + 1, v, e
                            branch[w] = w if v == root else branch[v]
                            queue[tail] = w
                            tail += 1
                        continue
                    closes = depth[v] + depth[w] + 1 == length and e != by[v] and e != by[w]
                    # each closing pair once: from its deeper end, or from the lower number among equals
                    first = depth[v] > depth[w] or (depth[v] == depth[w] and v < w)
                    if not (closes and first and branch[v] != branch[w]) or found == n_loops:
                        continue
                    bits[:] = 0
                    way_bits(v, root, parent, by, chord, bits)
                    way_bits(w, root, parent, by, chord, bits)
                    if chord[e] >= 0:
                        bits[chord[e] // 64] ^= np.uint64(1) << np.uint64(chord[e] % 64)
                    work[0] += words + length
                    if insert(bits, rows, taken, work):
                        at = ends[found]
                        if at + length > len(out):
                            longer = np.empty(2 * len(out) + length, dtype=np.int64)
                            longer[:at] = out[:at]
                            out = longer
                        # from the root down to v (reversed), across, and back up from w
                        mid = way(v, root, parent, by, out, at)
                        out[at:mid] = out[at:mid][::-1].copy()
                        out[mid] = e
                        ends[found + 1] = way(w, root, parent, by, out, mid + 1)
                        start[found] = root
                        found += 1
            for i in range(tail):
                v = queue[i]
                depth[v], parent[v], by[v], branch[v] = -1, -1, -1, -1
            if found == n_loops or work[0] >= budget:
                break
    return ends[: found + 1], out[: ends[found]], start[:found], rows, taken


@njit(cache=True, nogil=True)
def forest_loops(
    a: IntArray, b: IntArray, parent: IntArray, by: IntArray, depth: IntArray, chords: IntArray
) -> tuple[IntArray, IntArray]:
    """The loop that each chord closes with the forest, from its station a: ranges (n + 1,) and pairs, chord first."""
    ends = np.zeros(len(chords) + 1, dtype=np.int64)
    for k in range(len(chords)):
        v, w, length = b[chords[k]], a[chords[k]], 1
        while v != w:
            if depth[v] >= depth[w]:
                v = parent[v]
            else:
                w = parent[w]
            length += 1
        ends[k + 1] = ends[k] + length
    out = np.empty(ends[-1], dtype=np.int64)
    for k in range(len(chords)):
        v, w, front, back = b[chords[k]], a[chords[k]], ends[k], ends[k + 1]
        out[front] = chords[k]
        while v != w:
            if depth[v] >= depth[w]:
                front += 1
                out[front] = by[v]
                v = parent[v]
            else:
                back -= 1
                out[back] = by[w]
                w = parent[w]
    return ends, out


@njit(cache=True, nogil=True)
def independent_of(
    ends: IntArray, pairs: IntArray, chord: IntArray, rows: Bits, taken: npt.NDArray[np.bool_]
) -> npt.NDArray[np.bool_]:
    """Which of further loops are independent of those eliminated so far, taken one after the other."""
    keep = np.zeros(len(ends) - 1, dtype=np.bool_)
    bits, work = np.zeros(rows.shape[1], dtype=np.uint64), np.zeros(1, dtype=np.int64)
    for k in range(len(keep)):
        bits[:] = 0
        for i in range(ends[k], ends[k + 1]):
            c = chord[pairs[i]]
            if c >= 0:
                bits[c // 64] ^= np.uint64(1) << np.uint64(c % 64)
        keep[k] = insert(bits, rows, taken, work)
    return keep
