"""The batches behind GTSAM's factors: right at any values, in any algorithm."""

import gtsam
import numpy as np
import pytest

from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.solver import solve
from survey.simulate import head_on_table
from tests.adjust import helpers as h


def rows_of(graph: AdjustmentGraph, values: gtsam.Values) -> list[tuple[np.ndarray, np.ndarray]]:  # type: ignore[type-arg]  # plain floats
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
