"""Networks of total station readings: ours, and a dense NumPy adjustment of the same readings.

Simulated: points over a square, a quarter of them set up, each seeing its nearest neighbours. The datum is four held
points, or inner constraints over all points.
"""

from collections.abc import Callable
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import StartValues
from adjust.graph.building import GraphBuilder
from adjust.graph.solver import solve
from adjust.model.observations import PositionRef, Reading
from adjust.model.survey import BoolArray, Datum, FloatArray, IntArray, Point, PointParameter, Setup, Survey
from adjust.precision.precision import Precision
from tests.acceptance.dense_network import _Model
from tests.benchmarks.cases import Arrays
from tests.benchmarks.outcome import Competitor, Outcome

NEIGHBOURS, SPACING_M, OFF_M = 14, 20.0, 0.03
KINDS = (("direction", 5e-6), ("zenith", 8e-6), ("slope_distance", 1e-3))
FULL_UP_TO = 10_000  # unknowns; the whole covariance matrix of more would fill the memory


@dataclass(frozen=True, eq=False)
class Terrestrial(Arrays):
    """How to make the network: number of points, inner constraints or held points, seed."""

    n: IntArray
    free: BoolArray
    seed: IntArray


def case(n: int, free: bool = False, seed: int = 1) -> Terrestrial:
    """A network of ``n`` points."""
    return Terrestrial(np.array(n), np.array(free), np.array(seed))


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
                readings.append(Reading(f"{s}-{j}-{kind}", kind, refs[s], refs[j], value, sigma, f"S{s}"))
    held = 0 if free else 4
    points = tuple(Point(f"P{i}", PointParameter(q, "held" if i < held else "free")) for i, q in enumerate(x))
    setups = tuple(Setup(f"S{s}") for s in seen)
    return Survey(points=points, setups=setups, readings=tuple(readings), datum=Datum("inner" if free else "given"))


def rough(survey: Survey) -> dict[str, FloatArray]:
    """Start of all points, some centimetres off; held points at their places."""
    rng = np.random.default_rng(2)
    return {
        p.point_id: np.asarray(p.x_in_world.value)
        + (p.x_in_world.treatment != "held") * OFF_M * rng.standard_normal(3)
        for p in survey.points
    }


def ours(given: Terrestrial) -> Competitor:
    """Graph, least squares, variances and statistics of everything, and the whole matrix where it is not too large."""
    survey = network(int(given.n), bool(given.free), int(given.seed))
    points = rough(survey)

    def run() -> Outcome:
        clock = [perf_counter()]
        graph = GraphBuilder(survey, {}).build(StartValues({}, {}, points))
        clock.append(perf_counter())
        solved = solve(graph)
        clock.append(perf_counter())
        precision = Precision(graph, solved)
        clock.append(perf_counter())
        result = assemble(graph, solved, AdjustOptions(), (), precision)
        clock.append(perf_counter())
        names = ["build", "solve", "tree", "statistics"]
        if result.n_unknowns <= FULL_UP_TO:
            precision.tree.full()
            clock.append(perf_counter())
            names.append("full covariance")
        stages = dict(zip(names, np.diff(clock).tolist(), strict=True))
        x, sigmas = _points(survey, result)
        numbers = {"omega": result.omega, "redundancy": float(result.redundancy), "unknowns": float(result.n_unknowns),
                   "readings": float(len(survey.readings))}  # fmt: skip
        return Outcome(stages, {"x": x, "sigmas": sigmas}, f"{solved.iterations} steps", numbers)

    return run


def _points(survey: Survey, result) -> tuple[FloatArray, FloatArray]:
    x, sigmas = np.zeros((2, len(survey.points), 3))
    for i, p in enumerate(survey.points):
        estimate = result.estimates.get(("point", p.point_id))
        x[i] = p.x_in_world.value if estimate is None else np.asarray(estimate.value)
        sigmas[i] = 0.0 if estimate is None else np.sqrt(np.diag(estimate.cov))
    return x, sigmas


def dense(given: Terrestrial) -> Competitor:
    """Normal equations as one dense matrix: LAPACK's Cholesky, its inverse, residuals' variances. Plain Python rows."""
    survey = network(int(given.n), bool(given.free), int(given.seed))
    points = rough(survey)

    def run() -> Outcome:
        t0 = perf_counter()
        model = _Model(survey, points)
        build, steps = 0.0, 0
        while True:
            t1 = perf_counter()
            model.orient()
            A, w, _, cov = model.system()
            build += perf_counter() - t1
            P = 1.0 / cov.diagonal()
            N = (A.T @ (A * P[:, None])).toarray()
            D, H = _datum(model, bool(given.free))
            factor = cho_factor(N + D @ D.T, overwrite_a=True)
            dx = cho_solve(factor, A.T @ (P * w))
            model.move(dx)
            steps += 1
            if np.abs(dx[: model.n_points]).max() < 1e-7:
                break
        t2 = perf_counter()
        Q = cho_solve(factor, np.eye(len(N)), overwrite_b=True)
        if H.shape[1]:  # inner constraints D: Q = (N + D D')^-1 - H (H' D D' H)^-1 H', N H = 0
            HD = H.T @ D
            Q -= H @ np.linalg.solve(HD @ HD.T, H.T)
        v = A @ dx - w
        redundancy = 1.0 - np.einsum("ij,ij->i", A @ Q, A.toarray()) * P
        t3 = perf_counter()
        sigma = np.sqrt(np.diagonal(Q))
        sigmas = np.array([[sigma[model.columns[p, i]] if (p, i) in model.columns else 0.0 for i in range(3)]
                           for p in model.x])  # fmt: skip
        numbers = {"omega": float(v @ (P * v)), "redundancy": float(redundancy.sum())}
        stages = {"rows in Python": build, "solve": t2 - t0 - build, "precision": t3 - t2}
        return Outcome(stages, {"x": np.array(list(model.x.values())), "sigmas": sigmas}, f"{steps} steps", numbers)

    return run


def _datum(model: _Model, free: bool) -> tuple[FloatArray, FloatArray]:
    """Conditions D (n, 4) over the points, orthonormal, and the motions H (n, 4) that the readings do not see."""
    if not free:
        return np.zeros((model.n, 0)), np.zeros((model.n, 0))
    H = np.zeros((model.n, 4))
    for (point, i), column in model.columns.items():
        H[column, i] = 1.0
        H[column, 3] = (-model.x[point][1], model.x[point][0], 0.0)[i]
    D = np.linalg.qr(H)[0]
    sign = -1.0 if model.survey.bearings.clockwise else 1.0
    H[list(model.setup_column.values()), 3] = sign
    return D * 1e3, H  # of the size of the normal matrix's entries


OURS, DENSE = "ours", "dense NumPy"
TERRESTRIAL: dict[str, Callable[[Terrestrial], Competitor]] = {OURS: ours, DENSE: dense}
