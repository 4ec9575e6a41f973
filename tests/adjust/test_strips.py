"""Strips of images along a wall or a row of boards: their bends are weak, and a step bends them as a whole."""

from collections.abc import Callable

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.bending import bending_of, tree
from adjust.graph.datum import gauges
from adjust.graph.solver import solve
from adjust.lenses.models import MODELS
from adjust.model.observations import ImageBlock
from adjust.model.survey import Camera, LensParameter, Point, PointParameter, Station, Survey
from adjust.precision.precision import Precision
from tests.adjust import helpers as h
from tests.adjust.test_long_traverses import augmented, strip


def wall(n: int, known: int = 6, seed: int = 0, free: tuple[str, ...] = ("fx",), rough: float = 0.0) -> AdjustmentGraph:
    """A camera moves along points of which every image sees those near it; the first ones are known. 0.1 px."""
    rng, names = np.random.default_rng(seed), MODELS["brown"].names
    lens = np.array([{"fx": 600.0, "fy": 600.0, "u0": 640.0, "v0": 512.0}.get(name, 0.0) for name in names])
    camera = Camera("C", "head", (1280, 1024), LensParameter("brown", free, lens), h.HELD)
    across = rng.normal(size=(3 * n, 2)) * (0.6, 0.3)
    X = np.c_[np.sort(rng.uniform(-1.0, 0.5 * n + 0.5, 3 * n)), across]
    views = [Pose3(Rot3.Expmap(0.03 * rng.normal(size=3)), [0.5 * i, 0.0, -2.0]) for i in range(n)]
    blocks = []
    for i, view in enumerate(views):
        q = (X - view.translation()) @ view.rotation().matrix()
        uv = 600.0 * q[:, :2] / q[:, 2:] + (640.0, 512.0)
        seen = np.flatnonzero(np.all(np.abs(uv - (640.0, 512.0)) < (640.0, 512.0), axis=1))
        uv = uv[seen] + 0.1 * rng.normal(size=(len(seen), 2))
        blocks.append(ImageBlock("C", f"e{i}", None, seen, uv, np.tile(0.01 * np.eye(2), (len(seen), 1, 1))))
    twice = np.bincount(np.concatenate([b.point_idx for b in blocks]), minlength=len(X)) > 1
    number = np.cumsum(twice) - 1
    blocks = [ImageBlock("C", b.epoch_id, None, number[b.point_idx[at]], b.uv[at], b.cov[at])
              for b in blocks if (at := twice[b.point_idx]).any()]  # fmt: skip
    X = X[twice]
    points = tuple(Point(f"P{k}", PointParameter(x, "held") if k < known else PointParameter())
                   for k, x in enumerate(X))  # fmt: skip
    poses = {("world_from_station", "head", f"e{i}"): p.retract(rough * rng.normal(size=6))
             for i, p in enumerate(views)}  # fmt: skip
    near = {f"P{k}": x + rough * rng.normal(size=3) for k, x in enumerate(X)}
    survey = Survey(cameras=(camera,), stations=(Station("head", "epoch"),), points=points, image_blocks=tuple(blocks))
    return h.build(survey, StartValues({"C": lens}, poses, near))


def test_a_survey_that_turns_as_a_whole_keeps_its_shape() -> None:
    """By a third of a radian; moved each for itself, points leave along tangents."""
    graph, delta = wall(60, known=0), gtsam.VectorValues()
    for key in graph.unknowns.by_key:
        delta.insert(key, gauges(graph, [key], graph.start) @ [0.2, -0.4, 0.1, 0.3, -0.2, 0.1, 0.0])
    bending = bending_of(graph)
    assert bending is not None
    straight = graph.start.retract(delta)
    ends = graph.start, bending.bent(graph.start, delta, straight), straight
    before, bent, aside = (graph.omega(values) for values in ends)
    assert bent == pytest.approx(before, rel=1e-9)
    assert aside > 100.0 * before


@pytest.mark.parametrize("kind", ["points", "boards"])
def test_a_step_that_bends_is_the_same_to_first_order(kind: str) -> None:
    graph, rng = wall(40) if kind == "points" else strip(40), np.random.default_rng(0)
    bending = bending_of(graph)
    assert bending is not None
    assert (len(bending.points) > 80) == (kind == "points")
    assert np.count_nonzero(bending.parent < 0) < 15
    unit = {key: rng.normal(size=u.dim) for key, u in graph.unknowns.by_key.items()}
    apart = []
    for size in (1e-3, 1e-4):
        delta = gtsam.VectorValues()
        for key, d in unit.items():
            delta.insert(key, size * d)
        straight = graph.start.retract(delta)
        apart.append(straight.localCoordinates(bending.bent(graph.start, delta, straight)).norm())
    assert apart[1] == pytest.approx(1e-2 * apart[0], rel=0.05)
    assert apart[0] > 1e-6


def test_parts_that_nothing_ties_together_have_roots_of_their_own() -> None:
    order, parent = tree(5, np.array([0, 2, 3]), np.array([1, 3, 4]), np.array([1]))
    assert parent.tolist() == [1, -1, -1, 2, 3]
    place = np.argsort(order)
    assert all(place[p] < place[i] for i, p in enumerate(parent.tolist()) if p >= 0)


LONG = [
    pytest.param(lambda: strip(100, 0.1), ("world_from_station", "head", "e98"), 7, id="100 boards"),
    pytest.param(lambda: wall(150, rough=0.01), ("world_from_station", "head", "e149"), 7, id="150 images",
                 marks=pytest.mark.slow),
    pytest.param(lambda: strip(2000, 0.1), ("world_from_station", "head", "e1998"), 8, id="2000 boards",
                 marks=pytest.mark.slow),
]  # fmt: skip


@pytest.mark.parametrize(("make", "last", "steps"), LONG)
def test_long_strips_bend_to_their_optimum_in_few_steps(
    make: Callable[[], AdjustmentGraph], last: tuple[str, ...], steps: int
) -> None:
    """By the rows of all unknowns, points too, none of them reduced."""
    graph = make()
    solved = solve(graph)
    assert solved.iterations <= steps
    expected, step = augmented(graph, solved.values, last)
    unit = np.sqrt(np.diag(expected))
    found = h.covariance_of(Precision(graph, solved), last)
    np.testing.assert_allclose(found / np.outer(unit, unit), expected / np.outer(unit, unit), atol=1e-6)
    assert np.abs(step / unit).max() < 1e-5
