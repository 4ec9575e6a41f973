"""Compiled kernels on all cores: they hold no lock and write disjoint places, so threads need no copies."""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from typing import Any, Self, TypeVar
from weakref import WeakSet

import numpy as np

from adjust.model.arrays import IntArray

_WORTHWHILE = 5_000
_here = threading.local()
_Part = TypeVar("_Part")
_Result = TypeVar("_Result")


@cache
def _pool(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="adjust", initializer=setattr, initargs=(_here, "busy", True))


@cache
def _stages(workers: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(workers, thread_name_prefix="stage", initializer=setattr, initargs=(_here, "step", True))


def _no_threads() -> None:
    """In a forked process, which has none of its parent's threads: new ones where they are wanted."""
    _pool.cache_clear()
    _stages.cache_clear()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_no_threads)


def workers() -> int:
    """Threads used: ``LABSURVEY_THREADS``, or the cores this process may use."""
    wanted = os.environ.get("LABSURVEY_THREADS", "")
    return int(wanted) if wanted.isdigit() and int(wanted) > 0 else cores()


def cores() -> int:
    """Cores that this process may use; all of the machine where the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


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


def side_by_side(function: Callable[[_Part], _Result], parts: Sequence[_Part]) -> list[_Result]:
    """The results of a function of every part, in their order; where the parts are the same, so are the results.

    What a function itself gives here is done in its own thread.
    """
    if len(parts) <= 1 or workers() == 1 or hasattr(_here, "busy"):
        return [function(part) for part in parts]
    return list(_pool(workers()).map(function, parts))


class Beside:
    """Steps that need nothing of each other, begun as they are given; each may share out its own work.

    Only one thread runs Python at a time: it pays for those that wait for kernels, for libraries or for the disk. With
    one thread, and inside a step, they are done where they are given. Leaving a ``with`` of it waits for all.
    """

    def __init__(self) -> None:
        self.alone = workers() == 1 or hasattr(_here, "step") or hasattr(_here, "busy")
        self._begun = WeakSet[Future[Any]]()  # what nobody asks for any more need not stay in memory

    def of(self, step: Callable[[], _Result]) -> Callable[[], _Result]:
        """What gives the result of a step, or raises what it raised."""
        if self.alone:
            result = step()
            return lambda: result
        begun = _stages(workers()).submit(step)
        self._begun.add(begun)
        return begun.result

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        wait(list(self._begun))


def run_split(kernel: Callable[..., object], runs: list[IntArray], *arguments: object) -> None:
    """Call ``kernel(run, *arguments)`` for every run, side by side."""
    side_by_side(lambda run: kernel(run, *arguments), runs)


def run_ranges(kernel: Callable[..., object], n: int, *arguments: object) -> None:
    """Call ``kernel(first, last, *arguments)`` for ranges that make up 0 .. n, side by side; items do not meet."""
    count = 1 if n < _WORTHWHILE else workers()
    edges = [n * i // count for i in range(count + 1)]
    side_by_side(lambda ends: kernel(*ends, *arguments), list(pairwise(edges)))
