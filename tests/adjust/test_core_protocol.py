"""The batches behind GTSAM's factors: right at any values, in any algorithm."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.solver import settled, solve
from survey.simulate import head_on_table
from tests.adjust import helpers as h
from tests.adjust.terrestrial_networks import measured, polar_network, start_near


def rows_of(graph: AdjustmentGraph, values: gtsam.Values) -> list[tuple[np.ndarray, np.ndarray]]:
    return [graph.graph.at(i).linearize(values).jacobian() for i in range(graph.graph.size())]


def check_served(graph: AdjustmentGraph, compare: float) -> None:
    """Asked at values that were not prepared, a factor evaluates itself; with the prepared values it serves."""
    other = h.disturbed(graph.start, graph, 3, 0.3)
    graph.prepare(other, jacobians=True)
    expected = rows_of(graph, other)
    errors = [graph.graph.at(i).error(other) for i in range(graph.graph.size())]
    graph.prepare(graph.start, jacobians=True)
    copied = gtsam.Values(other)
    for i, (A, b) in enumerate(expected):
        found_A, found_b = graph.graph.at(i).linearize(copied).jacobian()
        np.testing.assert_allclose(found_A.T @ found_A, A.T @ A, rtol=compare, atol=compare * np.abs(A.T @ A).max())
        np.testing.assert_allclose(found_b @ found_b, b @ b, rtol=1e-9)
        assert graph.graph.at(i).error(copied) == pytest.approx(errors[i], rel=1e-12)
    # and back: what was prepared before must not be taken for what was evaluated in between
    again = rows_of(graph, graph.start)
    graph.prepare(graph.start, jacobians=True)
    for (A, _), (expected_A, _) in zip(again, rows_of(graph, graph.start), strict=True):
        np.testing.assert_allclose(A.T @ A, expected_A.T @ expected_A, rtol=1e-9,
                                   atol=compare * np.abs(A.T @ A).max())  # fmt: skip


def test_image_factors_evaluate_themselves_elsewhere() -> None:
    check_served(h.build(*h.everything(1)), 1e-12)


def test_bundle_factor_evaluates_itself_elsewhere() -> None:
    survey, truth = h.network(1)
    check_served(h.build(survey, h.start_at(truth)), 1e-9)


def test_errors_without_jacobians_then_with() -> None:
    """An evaluation for the error alone is not served as if it had derivatives."""
    graph = h.build(*h.everything(1))
    graph.prepare(graph.start, jacobians=True)
    expected = rows_of(graph, graph.start)
    moved = h.disturbed(graph.start, graph, 3, 0.3)
    graph.prepare(moved, jacobians=True)
    graph.prepare(graph.start, jacobians=False)
    for (A, b), (expected_A, expected_b) in zip(rows_of(graph, graph.start), expected, strict=True):
        np.testing.assert_array_equal(A, expected_A)
        np.testing.assert_array_equal(b, expected_b)


@pytest.mark.parametrize("which", ["everything", "network"])
def test_values_that_change_in_place_are_evaluated_anew(which: str) -> None:
    """What was prepared is known by its evaluation, not by the object that held the values."""
    survey, truth = h.network(1)
    graph = h.build(*h.everything(1)) if which == "everything" else h.build(survey, h.start_at(truth))
    values = gtsam.Values(graph.start)
    moved = h.disturbed(graph.start, graph, 3, 0.3)
    expected = graph.omega(moved)
    at = graph.prepare(values, jacobians=True)
    values.update(moved)
    for factors in (graph.graph, graph.view(graph.reduction)):
        assert 2.0 * factors.error(values) == pytest.approx(expected, rel=1e-9)
    assert graph.objective(graph.prepare(values, jacobians=True)) == pytest.approx(expected, rel=1e-9)
    assert graph.prepare(values, jacobians=True).number != at.number


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["reduced", "readings"])
def test_the_solver_changes_nothing_that_it_was_given(kind: str) -> None:
    """Start, reduction, weights and sigmas stay, though sigmas with centring follow the distances of the solution."""
    if kind == "reduced":
        survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=12, n_free_epochs=9)
        graph = h.build(survey, h.shaken(h.start_at(truth), 2, 0.005))
        assert graph.reduction is not None
    else:
        survey, truth = polar_network(2, plane=True)
        survey = measured(survey, truth, 1)
        survey = replace(survey, readings=tuple(replace(r, target_centring_sigma=0.001) for r in survey.readings))
        begin = start_near(survey, truth, 1, points=0.3)
        graph = h.build(survey, replace(begin, points={k: x * (1.0, 1.0, 0.0) for k, x in begin.points.items()}))
    before, start, reduction = gtsam.Values(graph.start), graph.start, graph.reduction
    sigma = None if graph.terrestrial is None else graph.terrestrial.sigma.copy()
    following, done = settled(graph)
    assert graph.start is start
    assert graph.start.equals(before, 0.0)
    assert graph.reduction is reduction
    assert not done.values.equals(before, 1e-6)
    if graph.terrestrial is not None and following.terrestrial is not None and sigma is not None:
        np.testing.assert_array_equal(graph.terrestrial.sigma, sigma)
        assert np.abs(following.terrestrial.sigma / sigma - 1.0).max() > 1e-4
    again = settled(graph)[1]
    assert again.omega == pytest.approx(done.omega, rel=1e-12)


def test_gtsams_own_optimiser_reaches_the_same_optimum() -> None:
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    start = h.shaken(h.start_at(truth), 2, 0.005)
    graph = h.build(survey, start)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-12)
    theirs = gtsam.LevenbergMarquardtOptimizer(graph.graph, graph.start, parameters).optimize()
    ours = solve(h.build(survey, start))
    assert 2.0 * graph.graph.error(theirs) == pytest.approx(ours.omega, rel=1e-10)
    precision = h.Precision(graph, ours)
    for name, unknown in graph.unknowns.by_name.items():
        step = theirs.localCoordinates(ours.values).at(unknown.key)
        assert np.all(np.abs(step) < 1e-4 * np.sqrt(np.diag(h.covariance_of(precision, name)))), name
