"""Corridors of readings, images or pairs with something else: what their normal matrix squares away is kept."""

from collections.abc import Callable
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy import sparse
from scipy.sparse.linalg import splu

from adjust.adjustment import adjust, warnings
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.datum import stacking, whitened_rows
from adjust.graph.solver import solve
from adjust.lenses.models import MODELS
from adjust.model.observations import Coordinates, FrameRef, ImageBlock, PositionRef, Reading
from adjust.model.survey import (
    Camera,
    FloatArray,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Setup,
    Station,
    Survey,
    Target,
)
from adjust.pose_network.network import survey_of
from adjust.precision.precision import Precision, precision_of
from tests.adjust import helpers as h
from tests.adjust.pose_networks import simulate
from tests.adjust.terrestrial_networks import P, measured, polar_network, start_near


def traverse(n: int) -> AdjustmentGraph:
    """Points 100 m apart, each set up and sighted from its neighbours; the first two known."""
    rng = np.random.default_rng(0)
    x = np.c_[100.0 * np.arange(n), 5.0 * rng.normal(size=n), rng.normal(size=n)]
    points = tuple(Point(f"P{i}", PointParameter(q, "held") if i < 2 else PointParameter(q))
                   for i, q in enumerate(x))  # fmt: skip
    truth = {("point", f"P{i}"): q for i, q in enumerate(x)}
    truth |= {("orientation", f"S{i}"): rng.uniform(0, 6, 1) for i in range(n)}
    readings = tuple(
        Reading(f"{kind}{s}-{t}", kind, P(f"P{s}"), P(f"P{t}"), 0.0, sigma, f"S{s}", instrument_height=1.5)
        for s in range(n) for t in (s - 1, s + 1) if 0 <= t < n
        for kind, sigma in (("direction", 1e-5), ("zenith", 2e-5), ("slope_distance", 1e-3))
    )  # fmt: skip
    setups = tuple(Setup(f"S{i}") for i in range(n))
    survey = measured(Survey(points=points, setups=setups, readings=readings), truth, 3)
    return h.build(survey, start_near(survey, truth, 1))


def pairs_and(n: int, what: str) -> AdjustmentGraph:
    """Two rows of stations joined by pairs, one of them with a held component or observed coordinates."""
    simulated = simulate(n, 2, 1)
    survey, names = survey_of(simulated.network), [f"s{i}" for i in range(2 * n)]
    poses = {("world_from_station", s): Pose3(Rot3(R), t)
             for s, R, t in zip(names, simulated.rotations, simulated.translations, strict=True)}  # fmt: skip
    if what == "held":
        given = PoseParameter(poses["world_from_station", "s5"], held=("tz",))
        stations = tuple(replace(s, world_from_station=given) if s.station_id == "s5" else s for s in survey.stations)
        survey = replace(survey, stations=stations)
    else:
        at = tuple(PositionRef(None, FrameRef("station", s)) for s in (names[n], names[n + 4]))
        seen = np.array([poses["world_from_station", p.frame.frame_id].translation() for p in at if p.frame])
        survey = replace(survey, coordinates=(Coordinates(at, seen, np.eye(6)),))
    return h.build(survey, StartValues({}, poses, {}))


def strip(n: int, sigma: float = 0.01) -> AdjustmentGraph:
    """Boards in a row of which every image sees two; the first one is known, and the focal length is not. sigma: px."""
    rng, names = np.random.default_rng(0), MODELS["brown"].names
    grid = np.array([(x, y, 0.0) for x in (0.0, 0.15, 0.3, 0.45) for y in (0.0, 0.2, 0.4)])
    lens = np.array([{"fx": 600.0, "fy": 600.0, "u0": 640.0, "v0": 512.0}.get(name, 0.0) for name in names])
    camera = Camera("C", "head", (1280, 1024), LensParameter("brown", ("fx",), lens), h.HELD)
    boards = [Pose3(Rot3.Expmap(0.05 * rng.normal(size=3)), [i - 0.2, -0.2, 0.1 * rng.normal()]) for i in range(n)]
    views = [Pose3(Rot3.Expmap(0.03 * rng.normal(size=3)), [i + 0.5, 0.0, -2.0]) for i in range(n - 1)]
    blocks = []
    for i, view in enumerate(views):
        for k in (i, i + 1):
            q = np.array([view.transformTo(boards[k].transformFrom(x)) for x in grid])
            uv = 600.0 * q[:, :2] / q[:, 2:] + (640.0, 512.0) + sigma * rng.normal(size=(len(q), 2))
            cov = np.tile(sigma**2 * np.eye(2), (len(q), 1, 1))
            blocks.append(ImageBlock("C", f"e{i}", f"B{k}", np.arange(len(grid)), uv, cov))
    targets = tuple(Target(f"B{k}", tuple(map(str, range(len(grid)))), grid,
                           carrier_from_target=PoseParameter(b, "free" if k else "held"))
                    for k, b in enumerate(boards))  # fmt: skip
    poses = {("world_from_station", "head", f"e{i}"): p for i, p in enumerate(views)}
    poses |= {("carrier_from_target", f"B{k}"): b for k, b in enumerate(boards) if k}
    survey = Survey(cameras=(camera,), stations=(Station("head", "epoch"),), targets=targets,
                    image_blocks=tuple(blocks))  # fmt: skip
    return h.build(survey, StartValues({"C": lens}, poses, {}))


def augmented(graph: AdjustmentGraph, values: gtsam.Values, name: tuple[str, ...]) -> tuple[FloatArray, FloatArray]:
    """Covariance of an unknown and what is left to go for it, by the rows A and not by A'A.

    From ``r + A x = f, A'r = g`` (Bjoerck 1967), refined with residuals in extended precision.
    """
    graph.prepare(values, jacobians=True, reduced=False)
    with graph.state.serving():
        linear = graph.graph.linearize(values)
    stack = stacking(graph, [u.key for u in graph.unknowns.by_name.values()])
    A = sparse.csc_array(whitened_rows(linear, stack))
    (m, n), place = A.shape, stack.at[graph.unknowns.by_name[name].key]
    scale, alpha, k = 1.0 / np.sqrt(A.power(2).sum(axis=0)), 1e-3, place.stop - place.start
    scaled = A @ sparse.diags_array(scale)
    factor = splu(sparse.csc_array(sparse.block_array([[alpha * sparse.eye_array(m), scaled], [scaled.T, None]])))
    exact, back = (sparse.csr_array(B.astype(np.longdouble)) for B in (A, A.T))
    f, g = np.zeros((m, k + 1), np.longdouble), np.zeros((n, k + 1), np.longdouble)
    f[:, k] = np.concatenate([linear.at(i).jacobian()[1] for i in range(linear.size())])
    g[place, :k] = -np.eye(k)
    r, x = np.zeros_like(f), np.zeros_like(g)
    for _ in range(8):
        left = np.vstack([f - r - exact @ x, (g - back @ r) * scale[:, None] / alpha])
        z = factor.solve(left.astype(float))
        r, x = r + alpha * z[:m], x + z[m:] * scale[:, None]
    return x[place, :k].astype(float), x[place, k].astype(float)


CORRIDORS: dict[str, tuple[Callable[[], AdjustmentGraph], tuple[str, ...]]] = {
    "traverse": (lambda: traverse(1200), ("point", "P1199")),
    "held component": (lambda: pairs_and(500, "held"), ("world_from_station", "s999")),
    "coordinates": (lambda: pairs_and(500, "coordinates"), ("world_from_station", "s999")),
    "image strip": (lambda: strip(300), ("world_from_station", "head", "e298")),
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", CORRIDORS)
def test_the_far_end_has_the_sigmas_and_the_place_that_the_rows_give(kind: str) -> None:
    make, last = CORRIDORS[kind]
    graph = make()
    solved = solve(graph)
    found = h.covariance_of(Precision(graph, solved), last)
    expected, step = augmented(graph, solved.values, last)
    unit = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-6)
    assert np.abs(step / unit).max() < 1e-5
    assert solved.lost < 1e-7


def test_what_rounding_took_is_said() -> None:
    survey, truth = polar_network(4)
    result = adjust(measured(survey, truth, 4), start_near(survey, truth, 2, 1e-3))
    precision = precision_of(result)
    assert precision.solved.lost < 1e-9
    assert not any("rounding" in said for said in result.warnings)
    precision.solved = replace(precision.solved, lost=2e-3)
    assert any("0.001 of its largest sigmas is rounding" in said for said in warnings(precision.graph, result))
