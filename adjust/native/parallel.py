"""Work on all cores. Nothing here needs NumPy: files are read while that is loaded."""

import os
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from functools import cache, partial
from typing import Any, Generic, Self, TypeVar
from weakref import ref

_here = threading.local()
_counting = threading.Lock()
_active = 1  # threads that compute: the first one, those that it has begun, without those that wait for a step
_shared: list["_Shared"] = []  # what is being shared out: for threads that have nothing else to do any more
_Part = TypeVar("_Part")
_Result = TypeVar("_Result")


@cache
def _pool(kind: str, threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix=kind)


def _first_thread() -> None:
    """In a forked process, which has none of its parent's threads: new ones where they are wanted."""
    global _counting, _active
    _pool.cache_clear()
    _counting, _active = threading.Lock(), 1


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_first_thread)


def workers() -> int:
    """Threads used: ``LABSURVEY_THREADS``, or the cores this process may use."""
    wanted = os.environ.get("LABSURVEY_THREADS", "")
    return int(wanted) if wanted.isdigit() and int(wanted) > 0 else cores()


def cores() -> int:
    """Cores that this process may use; all of the machine where the system does not tell."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def free_threads() -> int:
    """How many threads may compute besides those that do."""
    return max(0, workers() - _active)


@contextmanager
def _more_active(threads: int) -> Iterator[None]:
    """So many more compute meanwhile."""
    global _active
    with _counting:
        _active += threads
    try:
        yield
    finally:
        with _counting:
            _active -= threads


@contextmanager
def doing(what: str) -> Iterator[None]:
    """A mark on this thread while it does a ``part`` or a ``step``."""
    before = hasattr(_here, what)
    setattr(_here, what, True)
    try:
        yield
    finally:
        if not before:
            delattr(_here, what)


def side_by_side(function: Callable[[_Part], _Result], parts: Sequence[_Part]) -> list[_Result]:
    """The results of a function of every part, in their order; where the parts are the same, so are the results.

    This thread takes parts as others do, as many as have nothing else to do. What a function itself gives here is done
    in its own thread. Raises what the first part in their order raised.
    """
    if len(parts) <= 1 or workers() == 1 or hasattr(_here, "part"):
        return [function(part) for part in parts]
    return shared_out(function, parts)


def shared_out(function: Callable[[_Part], _Result], parts: Sequence[_Part]) -> list[_Result]:
    """As :func:`side_by_side`, of several parts and with several threads.

    No more than there are cores: else the one that holds Python's lock is made to wait, and all with it.
    """
    shared, free = _Shared(function, parts), min(free_threads(), len(parts) - 1)
    with _more_active(free):
        helpers = [_pool("adjust", workers() - 1).submit(shared.take) for _ in range(free)]
        _shared.append(shared)
        try:
            shared.take()
        finally:
            _shared.remove(shared)
        for helper in helpers:
            helper.cancel()
        shared.finished.wait()
    if shared.failed:
        raise shared.failed[min(shared.failed)]
    return shared.done


class _Shared:
    """Parts that threads take one after the other, and what a function gives of them."""

    def __init__(self, function: Callable[[Any], Any], parts: Sequence[Any]) -> None:
        self.done: list[Any] = [None] * len(parts)
        self.failed: dict[int, BaseException] = {}
        self.is_open, self.finished = True, threading.Event()
        self._function, self._parts = function, parts
        self._waiting, self._left = iter(range(len(parts))), len(parts)

    def take(self) -> None:
        """Do parts until there are no more, or one fails."""
        with doing("part"):
            for i in self._waiting:
                ended = 1
                try:
                    self.done[i] = self._function(self._parts[i])
                except BaseException as error:  # who waits is told
                    self.failed[i] = error
                    ended += sum(1 for _ in self._waiting)
                with _counting:
                    self._left -= ended
                    if not self._left:
                        self.finished.set()
        self.is_open = False


class _Step(Generic[_Result]):
    """A step that is done once, by whoever comes first."""

    def __init__(self, function: Callable[[], _Result]) -> None:
        self._function: Callable[[], _Result] | None = function
        self._first, self.done = threading.Lock(), Future[_Result]()

    def do(self, threads: int = 0) -> None:
        """Do it, unless it is done or being done. threads: how many more compute with the one that does it."""
        if not self._first.acquire(blocking=False):
            return
        function, self._function = self._function, None
        assert function is not None
        try:
            with _more_active(threads), doing("step"):
                result = function()
        except BaseException as error:  # who asks is told
            self.done.set_exception(error)
        else:
            self.done.set_result(result)


class Beside:
    """Steps that need nothing of those after them, begun as they are given; each may share out its own work.

    Only one thread runs Python at a time: it pays for those that wait for kernels, for libraries or for the disk. With
    one thread, and inside a step, they are done where they are given. Who waits for a step does what nobody has begun.
    Leaving a ``with`` of it waits for all.
    """

    def __init__(self) -> None:
        self.alone = workers() == 1 or hasattr(_here, "step") or hasattr(_here, "part")
        self._given: list[ref[_Step[Any]]] = []  # of what is done and asked for no more nothing stays in memory

    def of(self, function: Callable[[], _Result]) -> Callable[[], _Result]:
        """What gives the result of a step, or raises what it raised."""
        if self.alone:
            result = function()
            return lambda: result
        step = _Step(function)
        self._given.append(ref(step))
        _pool("stage", workers() - 1).submit(step.do, 1)
        return partial(self._result, step)

    def _result(self, step: _Step[_Result]) -> _Result:
        step.do()
        self._wait([step])
        return step.done.result()

    def _wait(self, wanted: Sequence[_Step[Any]]) -> None:
        """Until they are done; other steps and parts of others meanwhile.

        A step that waits leaves other steps alone: they may need it.
        """
        others = [] if hasattr(_here, "step") else self._steps()
        while any(not step.done.done() for step in wanted):
            if others:
                others.pop(0).do()
            elif shared := [x for x in _shared if x.is_open]:
                shared[0].take()
            else:
                break
        with _more_active(-1):
            wait([step.done for step in wanted])

    def _steps(self) -> list[_Step[Any]]:
        return [step for known in self._given if (step := known()) is not None]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._wait(self._steps())
