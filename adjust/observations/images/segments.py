"""Which columns of a block's rows belong to which key, for all blocks of an image batch at once.

A block meets its *sources* one after the other: the lens of its camera, the slots of its chain, the warp of its target.
Each has the same segments in every block, so they are listed once and then copied to where the sources are met.
"""


import numpy as np

from adjust.frames.state import State
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.images import SEGMENT_LENS, SEGMENT_POSE, SEGMENT_TABLE, SEGMENT_WARP, SegmentArrays


def ranges(first: IntArray, count: IntArray) -> IntArray:
    """The integers first[i], first[i] + 1, ..., ``count[i]`` of them, for one i after the other."""
    end = np.cumsum(count)
    return np.asarray(np.repeat(first - end + count, count) + np.arange(int(end[-1]) if len(end) else 0))


def first_seen(values: IntArray) -> tuple[IntArray, IntArray]:
    """Where each different value comes first, in this order, and the number in this order of every value."""
    _, first, which = np.unique(values, return_index=True, return_inverse=True)
    order = np.argsort(first)
    number = np.empty_like(order)
    number[order] = np.arange(len(order))
    return first[order], number[which]


@frozen(eq=False)
class BlockKeys:
    """The keys of all blocks, block after block, each key once a block.

    ptr: (B + 1,) where a block's begin. key: (K,). block: (K,). width: (K,) its columns, which begin at ``place`` among
    those of its block. columns: (B,) all of a block. of_segment: (S,) position of every segment's key.
    """

    ptr: IntArray
    key: IntArray
    block: IntArray
    width: IntArray
    place: IntArray
    columns: IntArray
    segments: SegmentArrays
    of_segment: IntArray


def _sources(state: State) -> tuple[IntArray, IntArray, FloatArray]:
    """Segments (n, 6) of all lenses, slots and warps: key, kind, table slot, start, width, first column of the key.

    Then where each's begin, and the factors (n,).
    """
    unknowns = state.unknowns
    rows: list[tuple[int | None, int, int, int, int, int]] = []
    ptr, factors = [0], {}

    def close(*found: tuple[int | None, int, int, int, int]) -> None:
        rows.extend((*row, 0) for row in found if row[0] is not None and row[-1] > 0)
        ptr.append(len(rows))

    for i in range(len(state.lens_states.states)):
        for p in state.lens_states.parts(i):
            factors[len(rows)] = p.factor
            rows.append((p.key, SEGMENT_LENS, -1, p.first, p.n, p.within))
        ptr.append(len(rows))
    for slot, key in enumerate(unknowns.slot_key):
        derived, d = unknowns.derived(slot), int(state.derived_index[slot])
        if derived is None:
            close((key, SEGMENT_POSE, -1, 0, 6))
        else:
            close(*((part, SEGMENT_TABLE, d, start, n) for part, start, n in derived.parts))
    for warp in state.warp_maps:
        close((warp.key if warp is not None else None, SEGMENT_WARP, -1, 0, len(warp.free) if warp is not None else 0))
    every = np.array([factors.get(i, 1.0) for i in range(len(rows))])
    return np.array(rows, dtype=np.int64).reshape(-1, 6), np.array(ptr, dtype=np.int64), every


def block_keys(state: State, camera: IntArray, link_ptr: IntArray, slot: IntArray, warp: IntArray) -> BlockKeys:
    """Keys and segments of blocks with these cameras, chains (slots of all links by ``link_ptr``) and warps (or -1)."""
    table, table_ptr, factors = _sources(state)
    n_cameras, n_links = len(state.lens_states.states), np.diff(link_ptr)
    count = n_links + 1 + (warp >= 0)
    end = np.cumsum(count)
    source, link = np.empty(int(count.sum()), dtype=np.int64), np.full(int(count.sum()), -1, dtype=np.int64)
    chained = ranges(end - count + 1, n_links)
    source[end - count] = camera
    source[chained], link[chained] = n_cameras + slot, np.arange(len(slot))
    bent = np.flatnonzero(warp >= 0)
    source[end[bent] - 1] = n_cameras + len(state.unknowns.slot_key) + warp[bent]
    each = np.diff(table_ptr)[source]
    rows = ranges(table_ptr[source], each)
    block = np.repeat(np.repeat(np.arange(len(camera)), count), each)
    dims = np.array([state.unknowns.by_key[key].dim for key in table[:, 0].tolist()], dtype=np.int64)
    return _numbered(table[rows], dims[rows], factors[rows], block, np.repeat(link, each), len(camera))


def _numbered(
    rows: IntArray, dims: IntArray, factors: FloatArray, block: IntArray, link: IntArray, n_blocks: int
) -> BlockKeys:
    """Keys in the order in which each block meets them; the segments' links stand for poses and tables alone."""
    key, kind, table, start, n, within = np.ascontiguousarray(rows.T)
    number = np.unique(key, return_inverse=True)[1]
    first, of_segment = first_seen(block * (len(rows) + 1) + number)
    numbers, of_key, width = np.arange(n_blocks + 1), block[first], dims[first]
    ptr = np.searchsorted(of_key, numbers).astype(np.int64)
    total = np.concatenate([[0], np.cumsum(width)])
    place = total[:-1] - total[ptr[of_key]]
    segments = SegmentArrays(
        np.searchsorted(block, numbers).astype(np.int64), kind, link, table, start, n,
        place[of_segment] + within, within, dims, factors,
    )
    return BlockKeys(ptr, key[first], of_key, width, place, np.diff(total[ptr]), segments, of_segment)
