"""Steps that keep their promise, rank judged only where the state stands still, and what is said of a failure."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.divergence import describe_divergence, misfits
from adjust.graph.solver import SolveOptions, _Loop, solve
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.observations import Distance, PositionRef
from adjust.model.survey import FloatArray, Point, PointParameter, Survey
from survey.simulate import stereo
from tests.adjust import helpers as h


class Stumbling(_Loop):
    """A loop whose undamped system has no solution in some calls."""

    stumbles: tuple[int, ...] = ()
    calls = 0

    def step(self) -> gtsam.VectorValues:
        self.calls += 1
        if self.damping == 0.0 and self.calls in self.stumbles:
            raise IndeterminateError("here")
        return super().step()


def far_start() -> AdjustmentGraph:
    survey, truth = stereo(1, n_pairs=5)
    return h.build(survey, h.shaken(h.start_at(truth), 1, 0.1))


def stumbling() -> Stumbling:
    graph = far_start()
    return Stumbling(graph, graph.start, SolveOptions(), None)


def test_a_system_without_solution_on_the_way_says_nothing() -> None:
    best = solve(far_start()).omega
    loop = stumbling()
    loop.stumbles = (2, 3)
    found = loop.run()
    assert loop.calls > 3
    assert found.omega == pytest.approx(best, rel=1e-9)


def test_a_system_without_solution_at_the_start_is_judged() -> None:
    loop = stumbling()
    loop.stumbles = (1,)
    with pytest.raises(IndeterminateError, match="here"):
        loop.run()


def test_a_system_without_solution_at_the_end_is_judged() -> None:
    """The state stands still, and the undamped system still has no solution: that is the survey's."""
    loop = stumbling()
    loop.stumbles = tuple(range(2, 200))
    with pytest.raises(IndeterminateError, match="here"):
        loop.run()


def contradicting(lengths: tuple[float, ...]) -> tuple[Survey, StartValues]:
    """A point between three others, far nearer to them than its distances say, in a plane."""
    corners = 2.0 * np.array([[1.0, 0.0, 0.0], [-0.5, 0.8, 0.0], [-0.6, -0.7, 0.0]])
    points = [Point(f"K{i}", PointParameter(x, "held")) for i, x in enumerate(corners)]
    points.append(Point("P", PointParameter(np.array([0.4, 0.3, 0.0]), held=("z",))))
    distances = tuple(
        Distance(f"d{i}", PositionRef(f"K{i}"), PositionRef("P"), d, 1e-3) for i, d in enumerate(lengths)
    )
    return Survey(points=tuple(points), distances=distances), StartValues({}, {}, {"P": np.array([0.4, 0.3, 0.0])})


def gradient(survey: Survey, x: FloatArray) -> FloatArray:
    """Of half the weighted square sum by P's place (2,)."""
    out = np.zeros(2)
    for d, p in zip(survey.distances, survey.points, strict=False):
        away = (x - np.asarray(p.x_in_world.value))[:2]
        length = np.linalg.norm(away)
        out += (length - d.value) / d.sigma**2 * away / length
    return out


@pytest.mark.parametrize("lengths", [(7.0, 7.1, 7.2), (5.0, 9.0, 7.0), (0.2, 0.3, 6.0), (12.0, 0.1, 12.5)])
def test_contradictions_end_in_a_minimum(lengths: tuple[float, ...]) -> None:
    """Residuals so large that whole Gauss-Newton steps jump over the minimum and back."""
    survey, start = contradicting(lengths)
    graph = h.build(survey, start)
    found = solve(graph)
    x = np.asarray(found.values.atPoint3(graph.unknowns.by_name["point", "P"].key))
    scale = sum(abs(d.value) / d.sigma**2 for d in survey.distances)
    assert np.linalg.norm(gradient(survey, x)) < 1e-8 * scale
    # a minimum, not a saddle: all around it is higher
    for angle in np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False):
        near = x + 1e-3 * np.array([np.cos(angle), np.sin(angle), 0.0])
        values = gtsam.Values(found.values)
        values.update(graph.unknowns.by_name["point", "P"].key, near)
        assert graph.omega(values) > found.omega


def test_what_fits_worst_is_named_first() -> None:
    """One image whose points are nonsense: the camera that took it, and the image."""
    survey, truth = stereo(1, n_pairs=5)
    start = h.start_at(truth)
    rng = np.random.default_rng(1)
    blocks = list(survey.image_blocks)
    blocks[3] = replace(blocks[3], uv=rng.uniform(0, 1000, blocks[3].uv.shape))
    graph = h.build(replace(survey, image_blocks=tuple(blocks)), start)
    with pytest.raises(NotConvergedError) as caught:
        solve(graph, SolveOptions(max_iterations=2))
    said = str(caught.value)
    wrong = f"camera {blocks[3].camera_id}"
    assert f"look first at {wrong}:" in said
    assert f"{wrong} at epoch {blocks[3].epoch_id}, target {blocks[3].target_id}" in said
    worst = max(misfits(graph, graph.start), key=lambda m: m.square)
    assert worst.text.startswith(f"{wrong} at epoch {blocks[3].epoch_id}")


def test_where_all_fit_nobody_is_named() -> None:
    survey, truth = stereo(1, n_pairs=5)
    graph = h.build(survey, h.start_at(truth))
    lines = describe_divergence(graph, graph.start, graph.start)
    assert not any("look first" in line or "group" in line or "farthest" in line for line in lines)
