"""What a trial force tells of an elimination; inner constraints of long traverses; solutions without covariances."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.cliques import Cliques
from adjust.graph.datum import Stacking, gauges, stacking, whitened_rows
from adjust.graph.elimination import Elimination
from adjust.graph.rank import is_seen
from adjust.graph.solver import SolveOptions, solve
from adjust.graph.trial import Trial, tried
from adjust.model.survey import Datum, PointParameter
from adjust.precision.precision import Precision
from tests.adjust import helpers as h
from tests.adjust.test_long_traverses import strip, traverse
from tests.adjust.test_pair_normals import of_network


def trial(graph: AdjustmentGraph, use_qr: bool = False) -> Trial:
    linear = graph.linearized(graph.prepare(graph.start, True, reduced=False))
    order = Elimination(gtsam.Ordering.ColamdGaussianFactorGraph(linear), use_qr)
    found = order.tree(linear)
    assert found is not None
    return tried(graph, linear, Cliques.of(found[0], graph.unknowns.dims))


def test_the_longer_a_strip_the_more_its_squares_lose_and_rows_do_not() -> None:
    short, long = trial(strip(20)), trial(strip(200))
    assert short.seen
    assert long.seen
    assert short.lost < 1e-9 < 1e-8 < long.lost
    assert trial(strip(200), use_qr=True).lost < 1e-10


def test_what_can_be_named_has_to_be_far_from_nothing_and_what_cannot_less_far() -> None:
    graph = strip(3)
    small, large = Stacking({}, 6000), Stacking({}, 6001)
    assert is_seen(graph, small, 1.1e-7)
    assert not is_seen(graph, small, 0.9e-7)
    assert is_seen(graph, large, 1.1e-11)
    assert not is_seen(graph, large, 0.9e-11)


def test_without_covariances_the_solution_is_the_same() -> None:
    graph = of_network(8, 3)
    both = [solve(graph, SolveOptions(covariances=wanted)) for wanted in (True, False)]
    assert both[0].values.localCoordinates(both[1].values).norm() < 1e-9
    assert both[0].lost > 0.0
    assert both[1].lost == 0.0


def free(n: int) -> AdjustmentGraph:
    """The traverse with inner constraints over all its points, which are its start."""
    graph = traverse(n)
    places = {p.point_id: np.asarray(p.x_in_world.value) for p in graph.survey.points}
    turns = {u.name: graph.start.atVector(u.key) for u in graph.unknowns.by_name.values() if u.kind == "vector"}
    points = tuple(replace(p, x_in_world=PointParameter(p.x_in_world.value)) for p in graph.survey.points)
    survey = replace(graph.survey, points=points, datum=Datum("inner"))
    return h.build(survey, StartValues({}, {}, places, turns))


def centre_stays(graph: AdjustmentGraph, values: gtsam.Values) -> bool:
    keys = [u.key for u in graph.unknowns.by_name.values() if u.kind == "point"]
    moved = np.array([values.atPoint3(k) - graph.start.atPoint3(k) for k in keys])
    return bool(np.abs(moved.mean(axis=0)).max() < 1e-9 < np.abs(moved).max())


def test_a_free_traverse_has_the_covariances_of_inner_constraints() -> None:
    """By ``(N + B B')^-1 - G (B'G)^-1 (B'G)^-T G'`` of the four motions G that it cannot see, B those of points."""
    graph = free(60)
    solved = solve(graph)
    linear = graph.graph.linearize(solved.values)
    stack = stacking(graph, [u.key for u in graph.unknowns.by_name.values()])
    A = whitened_rows(linear, stack).toarray()
    G = gauges(graph, list(stack.at), solved.values)[:, [0, 1, 2, 5]]
    assert np.abs(A @ G).max() < 1e-6 * np.abs(A).max()
    is_point = np.concatenate([np.full(at.stop - at.start, graph.unknowns.by_key[k].kind == "point")
                               for k, at in stack.at.items()])  # fmt: skip
    B = G * is_point[:, None]
    back = np.linalg.inv(B.T @ G)
    Q = np.linalg.inv(A.T @ A + B @ B.T) - G @ back @ back.T @ G.T
    for name in (("point", "P0"), ("point", "P59")):
        at = stack.at[graph.unknowns.by_name[name].key]
        unit = np.sqrt(np.diag(Q[at, at]))
        found = h.covariance_of(Precision(graph, solved), name)
        np.testing.assert_allclose(found / np.outer(unit, unit), Q[at, at] / np.outer(unit, unit), atol=1e-6)
    assert centre_stays(graph, solved.values)


@pytest.mark.slow
def test_three_thousand_set_ups_with_inner_constraints() -> None:
    """Both ends are as far from the datum, which lies in the middle, and are known alike."""
    graph = free(3000)
    solved = solve(graph)
    assert solved.iterations < 7
    assert solved.use_qr
    assert solved.lost < 1e-9
    assert solved.datum is not None
    assert solved.datum.defect == 4
    first, last = (np.sqrt(np.diag(h.covariance_of(Precision(graph, solved), ("point", p)))) for p in ("P0", "P2999"))
    np.testing.assert_allclose(first, last, rtol=0.05)
    assert centre_stays(graph, solved.values)
