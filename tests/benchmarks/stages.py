"""Where our time goes: wall seconds inside the parts of build, solve and precision, each without what it calls."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import gtsam

from adjust import adjustment
from adjust.adjustment import AdjustOptions, assemble
from adjust.graph import AdjustmentGraph, GraphBuilder
from adjust.initial import find_start
from adjust.precision import Precision
from adjust.solve import _Loop, solve
from adjust.state import State
from tests.benchmarks import tables
from tests.benchmarks.data import calibration, rough_start, survey

PARTS: list[tuple[str, Any, str]] = [
    ("load values", State, "load"),
    ("prepare (kernels)", AdjustmentGraph, "prepare"),
    ("linearise (GTSAM)", gtsam.NonlinearFactorGraph, "linearize"),
    ("eliminate (GTSAM)", _Loop, "step"),
    ("weighted square sum", AdjustmentGraph, "objective"),
    ("retract", gtsam.Values, "retract"),
    ("Bayes tree and its covariances", Precision, "__init__"),
    ("redundancy of image points", adjustment, "image_residuals"),
    ("estimates", adjustment, "estimates"),
    ("groups", adjustment, "group_summaries"),
]


class Clock:
    """Exclusive times of nested parts."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = {}
        self.open: list[str] = []
        self.last = perf_counter()

    def switch(self, enter: str | None) -> None:
        """Charge the time since the last switch to what was open; then open or close a part."""
        now = perf_counter()
        if self.open:
            self.spent[self.open[-1]] = self.spent.get(self.open[-1], 0.0) + now - self.last
        self.last = now
        if enter is None:
            self.open.pop()
        else:
            self.open.append(enter)

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """The function, with its time charged to ``name``."""

        def wrapper(*arguments: Any, **more: Any) -> Any:
            self.switch(name)
            try:
                return function(*arguments, **more)
            finally:
                self.switch(None)

        return wrapper


@contextmanager
def watched(clock: Clock) -> Iterator[None]:
    """Times the parts while the block runs."""
    kept = [(owner, attribute, getattr(owner, attribute)) for _, owner, attribute in PARTS]
    for (name, owner, attribute), (_, _, function) in zip(PARTS, kept, strict=True):
        setattr(owner, attribute, clock.timed(name, function))
    try:
        yield
    finally:
        for owner, attribute, function in kept:
            setattr(owner, attribute, function)


def where_time_goes(sizes: Sequence[tuple[int, int, tuple[int, int]]]) -> str:
    """Table of milliseconds by part, for (cameras, epochs, shape of the board); the best of three runs each."""
    columns: dict[str, dict[str, float]] = {}
    for cameras, epochs, shape in sizes:
        case = calibration(cameras, epochs, shape)
        given, start = survey(case), rough_start(case)
        best: Clock | None = None
        for _ in range(3):
            clock = Clock()
            with watched(clock):
                graph = clock.timed("build", GraphBuilder(given, start.lenses).build)(start)
                solved = clock.timed("the loop's own", solve)(graph)
                clock.timed("tests and warnings", assemble)(graph, solved, AdjustOptions())
            if best is None or sum(clock.spent.values()) < sum(best.spent.values()):
                best = clock
        if best is not None:
            begin = perf_counter()
            if cameras * epochs <= 2000:
                find_start(given)
                best.spent["find_start, where no start is given"] = perf_counter() - begin
            columns[f"{cameras} x {epochs} ({solved.iterations} steps), ms"] = best.spent
    names = list(dict.fromkeys(n for c in columns.values() for n in c))
    rows = [[n, *[f"{1e3 * c[n]:.1f}" if n in c else "" for c in columns.values()]] for n in names]
    return tables.table(("", *columns), rows)
