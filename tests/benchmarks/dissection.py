"""What a survey of many rooms costs, and where it is cut: ``python -m tests.benchmarks.dissection``.

Measured: buildings of growing size, each adjusted in a process of its own. Counted: the same building at any size, by
nested dissection of its rooms, from the sizes of its separators.
"""

import argparse
import json
import resource
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter, process_time

import numpy as np

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.observations import Coordinates, PositionRef
from adjust.model.survey import Datum, Survey
from tests.benchmarks import bundle
from tests.benchmarks.building import Building, Plan, build
from tests.benchmarks.tables import seconds, table

LENS = 8


def survey_of(building: Building) -> Survey:
    """The survey: a point of every room is known to a millimetre, four of them in the first."""
    free = bundle.survey(building.bundle)
    known = np.unique(building.of_point, return_index=True)[1][1:].tolist()
    room = np.flatnonzero(building.of_point == 0)
    known += room[[len(room) // 4, len(room) // 2, -1]].tolist()
    ids, x = building.bundle.names, building.truth
    given = tuple(Coordinates((PositionRef(str(ids[i])),), x[i : i + 1], np.eye(3) * 1e-6) for i in known)
    return replace(free, datum=Datum(), coordinates=given)


def graph_of(building: Building) -> AdjustmentGraph:
    """Its graph, started at the rough values of the bundle."""
    start = bundle.start(building.bundle)
    return GraphBuilder(survey_of(building), start.lenses).build(start)


@dataclass(frozen=True)
class Cost:
    """One building, measured: sizes, processor seconds of the stages, MB on top of its observations, steps."""

    image_points: int
    stations: int
    points: int
    blocks: int
    steps: int
    build: float
    solve: float
    precision: float
    mb: float
    sigma0: float

    @property
    def seconds(self) -> float:
        return self.build + self.solve + self.precision


def measure(rooms: int) -> Cost:
    """A building of rooms x rooms rooms, adjusted with the covariances and tests of everything."""
    building = build(Plan(rooms, rooms))
    before, clock = _peak_mb(), [process_time()]
    graph = graph_of(building)
    clock.append(process_time())
    solved = solve(graph)
    clock.append(process_time())
    result = assemble(graph, solved, AdjustOptions())
    clock.append(process_time())
    built, solving, precision = (float(s) for s in np.diff(clock))
    return Cost(
        len(building.bundle.uv), len(building.room), len(building.of_point), len(graph.bundles), solved.iterations,
        built, solving, precision, _peak_mb() - before, result.sigma0,
    )  # fmt: skip


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


@dataclass(frozen=True)
class Cut:
    """All cuts of one depth: regions, the mean unknowns of their doors and of what stays beside, multiplications."""

    regions: int
    rooms: float
    doors: float
    beside: float
    work: float


def nested(plan: Plan) -> list[Cut]:
    """Regions of rooms halved across their longer side, the whole building first; doors of a cut are reduced with it.

    Multiplications of reducing f unknowns beside s others: f^3/3 + f^2 s + f s^2, of a dense normal matrix.
    """
    depths: list[list[tuple[int, float, float]]] = []
    open_ = [((plan.along_x, plan.along_y), 0.0, 0)]  # size, doors cut before around it, depth
    while open_:
        (nx, ny), around, depth = open_.pop(0)
        if nx * ny == 1:
            continue
        if depth == len(depths):
            depths.append([])
        long, doors = max(nx, ny), float(min(nx, ny))
        depths[depth].append((nx * ny, 3 * plan.door * doors, 3 * plan.door * around + LENS))
        halves = (long // 2, long - long // 2)
        open_ += [((size, min(nx, ny)), around * size / long + doors, depth + 1) for size in halves]
    return [_level(level) for level in depths]


def _level(regions: Sequence[tuple[int, float, float]]) -> Cut:
    n, f, s = np.array(regions, dtype=float).T
    work = float((f**3 / 3 + f**2 * s + f * s**2).sum())
    return Cut(len(regions), float(n.mean()), float(f.mean()), float(s.mean()), work)


def multiplications_per_second() -> float:
    """Of a dense Cholesky factorisation on this machine, with as many threads as the linear algebra is given."""
    n = 1500
    A = np.eye(n) + 1e-3
    return n**3 / 3 / min(_seconds_of(lambda: np.linalg.cholesky(A)) for _ in range(5))


def _seconds_of(run: Callable[[], object]) -> float:
    t0 = perf_counter()
    run()
    return perf_counter() - t0


def in_process(rooms: int) -> Cost:
    """:func:`measure` in a process of its own."""
    command = [sys.executable, "-m", "tests.benchmarks.dissection", "--one", str(rooms)]
    out = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return Cost(**json.loads(out.splitlines()[-1]))


def measured_table(costs: Sequence[Cost]) -> str:
    """Sizes and costs, and the exponents between the ends."""
    head = ("image points", "stations", "points", "blocks", "steps", "build", "solve", "precision", "MB", "us a point")
    rows = [[f"{c.image_points}", f"{c.stations}", f"{c.points}", f"{c.blocks}", f"{c.steps}", seconds(c.build),
             seconds(c.solve), seconds(c.precision), f"{c.mb:.0f}", f"{1e6 * c.seconds / c.image_points:.0f}"]
            for c in costs]  # fmt: skip
    first, last = costs[0], costs[-1]
    grown = np.log(last.image_points / first.image_points)
    exponents = {name: np.log(getattr(last, name) / getattr(first, name)) / grown
                 for name in ("build", "solve", "precision", "seconds", "mb")}  # fmt: skip
    return table(head, rows) + "\n\nExponents: " + ", ".join(f"{n} {e:.2f}" for n, e in exponents.items())


def counted_table(plan: Plan, rate: float) -> str:
    """Every depth of cuts of a building: what is reduced there, and what passes between the regions."""
    head = ("cuts", "rooms each", "unknowns of doors", "unknowns beside", "multiplications", "s", "MB passed on, each")
    rows = [[f"{c.regions}", f"{c.rooms:.0f}", f"{c.doors:.0f}", f"{c.beside:.0f}", f"{c.work:.1e}",
             seconds(c.work / rate), f"{8e-6 * (c.beside + 1) ** 2 / 2:.2g}"] for c in nested(plan)]  # fmt: skip
    return table(head, rows)


def main() -> None:
    """Print the tables, or the one measurement that a process was asked for."""
    parser = argparse.ArgumentParser(prog="python -m tests.benchmarks.dissection", description=__doc__)
    parser.add_argument("--one", type=int, help="measure one building of so many by so many rooms, as JSON")
    parser.add_argument("--rooms", type=int, nargs="+", default=[1, 2, 4, 7, 10], help="sizes to measure")
    parser.add_argument("--building", type=int, default=32, help="size to count")
    options = parser.parse_args()
    if options.one:
        print(json.dumps(measure(options.one).__dict__))
        return
    costs = [in_process(rooms) for rooms in options.rooms]
    rate = multiplications_per_second()
    print(measured_table(costs))
    print(f"\n{rate:.2e} multiplications a second\n")
    print(counted_table(Plan(options.building, options.building), rate))


if __name__ == "__main__":
    main()
