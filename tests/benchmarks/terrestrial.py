"""Networks of total station readings: CPU time and memory of each stage, on simulated networks.

Run ``python -m tests.benchmarks.terrestrial 1000 1000free 3000 10000``: points, a quarter of them set up, each seeing
its nearest neighbours; "free" leaves the datum to inner constraints over all points.
"""

import resource
import sys
import time
from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph import GraphBuilder, StartValues
from adjust.model import Datum, Point, PointParameter, Setup, Survey
from adjust.observations import PositionRef, Reading
from adjust.precision import Precision
from adjust.solve import solve

NEIGHBOURS, SPACING_M, OFF_M = 14, 20.0, 0.3
KINDS = (("direction", 5e-6), ("zenith", 8e-6), ("slope_distance", 1e-3))


def network(n: int, free: bool, seed: int = 1) -> Survey:
    """A network of n points; every point is seen by three stations at least."""
    rng = np.random.default_rng(seed)
    side = SPACING_M * np.sqrt(n)
    x = np.column_stack([rng.uniform(0.0, side, (n, 2)), rng.uniform(0.0, 10.0, n)])
    stations = rng.permutation(n)[: n // 4]
    every, standing = cKDTree(x[:, :2]), cKDTree(x[stations, :2])
    seen = {int(s): {int(j) for j in every.query(x[s, :2], NEIGHBOURS + 1)[1]} - {int(s)} for s in stations}
    for j in range(n):
        for s in stations[standing.query(x[j, :2], 4)[1]]:
            if s != j:
                seen[int(s)].add(j)
    refs = [PositionRef(f"P{i}") for i in range(n)]
    readings = []
    for s, targets in seen.items():
        turn = rng.uniform(0.0, 6.0)
        for j in sorted(targets):
            d = x[j] - x[s]
            across = float(np.hypot(d[0], d[1]))
            truth = (np.arctan2(d[0], d[1]) - turn, np.arctan2(across, d[2]), np.linalg.norm(d))
            for (kind, sigma), value in zip(KINDS, truth, strict=True):
                value = float(value + sigma * rng.standard_normal())
                readings.append(Reading(f"{s}-{j}-{kind}", kind, refs[s], refs[j], value, sigma, f"S{s}"))  # type: ignore[arg-type]
    held = 0 if free else 4
    points = tuple(Point(f"P{i}", PointParameter(q, "held" if i < held else "free")) for i, q in enumerate(x))
    setups = tuple(Setup(f"S{s}") for s in seen)
    return Survey(points=points, setups=setups, readings=tuple(readings), datum=Datum("inner" if free else "given"))


def stages(survey: Survey) -> tuple[dict[str, float], int, int]:
    """CPU seconds per stage, number of unknowns and of readings."""
    clock = [time.process_time()]
    rng = np.random.default_rng(2)
    points = {p.point_id: np.asarray(p.x_in_world.value) + OFF_M * rng.standard_normal(3) for p in survey.points}
    graph = GraphBuilder(survey, {}).build(StartValues({}, {}, points))
    clock.append(time.process_time())
    solved = solve(graph)
    clock.append(time.process_time())
    precision = Precision(graph, solved)
    clock.append(time.process_time())
    result = assemble(graph, solved, AdjustOptions(), (), precision)
    clock.append(time.process_time())
    if result.n_unknowns <= 10_000:
        precision.tree.full()
    clock.append(time.process_time())
    names = ("build", "solve", "tree", "statistics", "full covariance")
    return dict(zip(names, np.diff(clock).tolist(), strict=True)), result.n_unknowns, len(survey.readings)


def main(arguments: Sequence[str]) -> None:
    """Print one line per network."""
    stages(network(50, False))  # compiles
    for argument in arguments:
        survey = network(int(argument.removesuffix("free")), argument.endswith("free"))
        found, n_unknowns, n_readings = stages(survey)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        parts = "  ".join(f"{name} {seconds:.2f}" for name, seconds in found.items())
        sys.stdout.write(f"{argument}: {n_unknowns} unknowns, {n_readings} readings: {parts}  total "
                         f"{sum(found.values()):.2f} s CPU, {memory:.0f} MB\n")  # fmt: skip


if __name__ == "__main__":
    main(sys.argv[1:] or ("1000", "1000free"))
