"""Compiled kernels on all cores: they hold no lock and write disjoint places, so threads need no copies."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from adjust.model.arrays import IntArray
from adjust.native.parallel import side_by_side, workers

_WORTHWHILE = 5_000


def split_blocks(ptr: IntArray, parts: int = 0) -> list[IntArray]:
    """Block numbers in runs of about equal numbers of points: one run for small batches, else one per worker.

    parts: so many instead, whatever the number of workers, where what the runs give is added up.
    """
    n, total = len(ptr) - 1, int(ptr[-1])
    count = 1 if total < _WORTHWHILE else min(n, parts or workers())
    if count <= 1:
        return [np.arange(n)] if n else []
    edges = np.searchsorted(ptr, np.linspace(0, total, count + 1)[1:-1])
    return [run.astype(np.int64) for run in np.split(np.arange(n), edges) if len(run)]


def run_split(kernel: Callable[..., object], runs: list[IntArray], *arguments: object) -> None:
    """Call ``kernel(run, *arguments)`` for every run, side by side."""
    side_by_side(lambda run: kernel(run, *arguments), runs)


def run_ranges(kernel: Callable[..., object], n: int, *arguments: object) -> None:
    """Call ``kernel(first, last, *arguments)`` for ranges that make up 0 .. n, side by side; items do not meet."""
    count = 1 if n < _WORTHWHILE else workers()
    edges = [n * i // count for i in range(count + 1)]
    side_by_side(lambda ends: kernel(*ends, *arguments), list(pairwise(edges)))
