"""What a survey of many rooms costs, and where it is cut: ``python -m tests.benchmarks.dissection``.

exact: a building adjusted whole and cut at its doors, room by room, with GTSAM's partial elimination: the same numbers.
measured: buildings of growing size, each in a process of its own. counted: nested dissection of the rooms of a large
building, from the sizes of its separators.
"""

import resource
import sys
from dataclasses import replace
from time import process_time

import numpy as np

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import AdjustmentGraph, GraphBuilder
from adjust.graph.solver import solve
from adjust.model.observations import Coordinates, PositionRef
from adjust.model.survey import Datum, Survey
from tests.benchmarks import bundle
from tests.benchmarks.building import Building, Plan, build

LENS_SCALARS = 8


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


def measure(rooms: int) -> dict[str, float]:
    """A building of rooms x rooms rooms, adjusted: processor seconds of the stages, MB, sizes."""
    building = build(Plan(rooms, rooms))
    before = _peak_mb()
    t0 = process_time()
    graph = graph_of(building)
    t1 = process_time()
    solved = solve(graph)
    t2 = process_time()
    result = assemble(graph, solved, AdjustOptions())
    t3 = process_time()
    return {
        "image points": len(building.bundle.uv), "stations": len(building.room), "points": len(building.of_point),
        "build": t1 - t0, "solve": t2 - t1, "precision": t3 - t2, "MB": _peak_mb() - before,
        "steps": solved.iterations, "sigma0": result.sigma0,
    }  # fmt: skip


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    print(measure(int(sys.argv[1])))
