"""Where our time goes: wall seconds inside the parts of build, solve and precision, each without what it calls."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from time import perf_counter
from typing import Any

import gtsam

from adjust import adjustment
from adjust.adjustment import AdjustOptions, assemble
from adjust.frames.state import State
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import _Loop, solve
from adjust.observations.images.reduction import PoseReduction
from adjust.observations.pairs import PairBatch
from adjust.pose_network import solve as pose_solve
from adjust.precision import precision
from adjust.precision.precision import Precision
from adjust.precision.tree import TreeCovariance
from adjust.start import find_start
from tests.adjust.pose_networks import network_of_file, solve_network
from tests.benchmarks import tables, terrestrial
from tests.benchmarks.data import calibration, rough_start, survey
from tests.data import data_folder

Part = tuple[str, Any, str]
PARTS: list[Part] = [
    ("load values", State, "load"),
    ("prepare (kernels)", AdjustmentGraph, "prepare"),
    ("poses reduced", PoseReduction, "reduce"),
    ("poses restored", PoseReduction, "complete"),
    ("linearise (GTSAM)", gtsam.NonlinearFactorGraph, "linearize"),
    ("eliminate (GTSAM)", _Loop, "step"),
    ("weighted square sum", AdjustmentGraph, "objective"),
    ("retract", gtsam.Values, "retract"),
    ("precision: Bayes tree", Precision, "__init__"),
    ("covariances of the tree", TreeCovariance, "__init__"),
    ("redundancy of image points", precision, "residual_tests"),
    ("redundancy of readings and others", adjustment, "other_residuals"),
    ("estimates", adjustment, "estimates"),
    ("groups", adjustment, "group_summaries"),
    ("whole covariance matrix", TreeCovariance, "full"),
]
POSE_PARTS: list[Part] = [
    ("start values", pose_solve, "find_network_start"),
    ("checks", pose_solve, "check_determined"),
    ("survey", pose_solve, "survey_of"),
    ("graph", GraphBuilder, "build"),
    ("linearise", gtsam.NonlinearFactorGraph, "linearize"),
    ("eliminate (GTSAM)", _Loop, "step"),
    ("v'Pv", AdjustmentGraph, "objective"),
    ("retract", gtsam.Values, "retract"),
    ("covariances of the tree", TreeCovariance, "__init__"),
    ("Jacobians of pairs", PairBatch, "jacobians"),
    ("statistics of pairs", PairBatch, "statistics"),
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
def watched(clock: Clock, parts: Sequence[Part]) -> Iterator[None]:
    """Times the parts while the block runs; parts that the program no longer has are left out."""
    kept = [(name, owner, attribute, getattr(owner, attribute)) for name, owner, attribute in parts
            if hasattr(owner, attribute)]  # fmt: skip
    for name, owner, attribute, function in kept:
        setattr(owner, attribute, clock.timed(name, function))
    try:
        yield
    finally:
        for _, owner, attribute, function in kept:
            setattr(owner, attribute, function)


def best_of(run: Callable[[Clock], None], parts: Sequence[Part], times: int = 3) -> dict[str, float]:
    """Seconds by part in the fastest run."""
    best: Clock | None = None
    for _ in range(times):
        clock = Clock()
        with watched(clock, parts):
            run(clock)
        if best is None or sum(clock.spent.values()) < sum(best.spent.values()):
            best = clock
    return best.spent if best else {}


def milliseconds(columns: dict[str, dict[str, float]]) -> str:
    """A table, one column a run."""
    for spent in columns.values():
        spent["sum"] = sum(spent.values())
    names = list(dict.fromkeys(n for c in columns.values() for n in c if n != "sum")) + ["sum"]
    rows = [[n, *[f"{1e3 * c[n]:.1f}" if n in c else "" for c in columns.values()]] for n in names]
    return tables.table(("ms", *columns), rows)


def cameras(sizes: Sequence[tuple[int, int, tuple[int, int]]]) -> str:
    """For (cameras, epochs, shape of the board)."""
    columns = {}
    for n_cameras, epochs, shape in sizes:
        case = calibration(n_cameras, epochs, shape)
        given, start = survey(case), rough_start(case)

        def run(clock: Clock, given: Any = given, start: Any = start) -> None:
            graph = clock.timed("build", GraphBuilder(given, start.lenses).build)(start)
            solved = clock.timed("the loop's own", solve)(graph)
            clock.timed("tests and warnings", assemble)(graph, solved, AdjustOptions())

        spent = best_of(run, PARTS)
        if n_cameras * epochs <= 2000:
            find_start(survey(calibration(n_cameras, 10, shape)))  # warms up
            clock = Clock()
            clock.timed("start values, where none are given", find_start)(given)
            spent |= clock.spent
        columns[f"{n_cameras} x {epochs}"] = spent
    return milliseconds(columns)


def readings(sizes: Sequence[int]) -> str:
    """For networks of so many points."""
    columns = {}
    for n in sizes:
        given = terrestrial.network(n, False)
        start = StartValues({}, {}, terrestrial.rough(given))

        def run(clock: Clock, given: Any = given, start: Any = start) -> None:
            graph = clock.timed("build", GraphBuilder(given, {}).build)(start)
            solved = clock.timed("the loop's own", solve)(graph)
            precision = Precision(graph, solved)
            result = clock.timed("tests and warnings", assemble)(graph, solved, AdjustOptions(), (), precision)
            if result.n_unknowns <= terrestrial.FULL_UP_TO:
                precision.tree.full()

        columns[f"{n} points"] = best_of(run, PARTS, 3 if n <= 3000 else 1)
    return milliseconds(columns)


def pose_graphs(names: Sequence[str]) -> str:
    """For published graphs."""
    columns = {}
    for name in names:
        network = network_of_file(data_folder("calibration", "pose_graphs") / f"{name}.g2o")

        def run(clock: Clock, network: Any = network) -> None:
            fresh = network.with_used(network.used)
            solution = clock.timed("the rest of the solution", solve_network)(fresh)
            clock.timed("covariances of stations", lambda s: s.station_cov)(solution)
            clock.timed("the rest of the tests", lambda s: s.pairs)(solution)

        columns[name] = best_of(run, POSE_PARTS)
    return milliseconds(columns)
