"""A command in this process: its processor time by step, its memory, and what two threads can save, as a line of JSON.

With ``LABSURVEY_THREADS`` above 1 what is shared out is done in turn and timed by the thread's own clock. Two threads
would take as long as the longer of two lists, filled one after the other; the rest of the sum is what they save.
"""

import json
import re
import resource
import sys
import time
from collections.abc import Callable, Iterable
from concurrent.futures import Future
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from survey.commands.common import begin_adjusting

begin_adjusting()  # as the command does, before NumPy is loaded

from adjust.native import parallel  # noqa: E402

WORKERS = 2


def saved(seconds: Iterable[float]) -> float:
    """What two lists, filled one after the other, save of the sum."""
    lists = [0.0] * WORKERS
    for s in seconds:
        lists[lists.index(min(lists))] += s
    return sum(lists) - max(lists)


class InTurn:
    """A pool that does everything at once, in this thread, and adds up what two would save."""

    def __init__(self) -> None:
        self.parts = self.steps = 0.0
        self.open: dict[object, tuple[float, list[float]]] = {}

    def now(self) -> float:
        """Time of this thread, less what is saved of it."""
        return time.thread_time() - self.parts - self.steps

    def beside(self, steps: object) -> object:
        """From here on what this thread does itself is a step beside those that it begins."""
        self.open[steps] = self.now(), []
        return steps

    def shared_out(self, function: Callable[[Any], Any], parts: Iterable[Any]) -> list[Any]:
        """As that of ``parallel``."""
        out, seconds = [], []
        with parallel.doing("part"):
            for part in parts:
                begin = time.thread_time()
                out.append(function(part))
                seconds.append(time.thread_time() - begin)
        self.parts += saved(seconds)
        return out

    def given(self, steps: object, step: Callable[[], Any]) -> Callable[[], Any]:
        """As of ``Beside``: a step beside others; its own parts do not count twice."""
        begin = self.now()
        done: Future[Any] = Future()
        with parallel.doing("step"):
            try:
                done.set_result(step())
            except Exception as error:  # the one who waits is told
                done.set_exception(error)
        self.open[steps][1].append(self.now() - begin)
        return done.result

    def finished(self, steps: object) -> None:
        """No more steps beside these."""
        begin, begun = self.open.pop(steps)
        self.steps += saved([*begun, self.now() - begin - sum(begun)]) if begun else 0.0


def main() -> None:
    """Runs the command of the arguments."""
    pool = InTurn()
    parallel.shared_out = pool.shared_out
    parallel.Beside.__enter__ = lambda self: pool.beside(self)
    parallel.Beside.__exit__ = lambda self, *_: pool.finished(self)
    plain = parallel.Beside.of
    parallel.Beside.of = lambda self, step: plain(self, step) if self.alone else pool.given(self, step)
    from survey.solution.earlier import runs

    runs.time = SimpleNamespace(perf_counter=time.process_time)
    from survey.cli import program

    sys.argv = ["labsurvey", *sys.argv[1:]]
    said, code = StringIO(), 0
    with redirect_stdout(said):
        try:
            program()
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else 1
    if code not in (0, 3):
        raise SystemExit(code)
    stages = re.findall(r"(\w[\w ]*) ([\d.]+) s(?:,|$)", next(iter(reversed(_steps(said.getvalue()))), ""))
    every = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    print(json.dumps({
        "cpu_s": sum(u.ru_utime + u.ru_stime for u in every), "mb": _largest_kb() / 1024,
        "stages": {name.strip(): float(s) for name, s in stages}, "parts": pool.parts, "steps": pool.steps,
    }))  # fmt: skip


def _largest_kb() -> int:
    """Of this process, and not of the one that it came from, as ``getrusage`` would tell; or of its own children."""
    found = re.search(r"VmHWM:\s*(\d+)", Path("/proc/self/status").read_text())
    return max(int(found[1]) if found else 0, resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss)


def _steps(said: str) -> list[str]:
    return [line for line in said.splitlines() if re.match(r"\s*(detect|read) [\d.]+ s", line)]


if __name__ == "__main__":
    main()
