"""Variance components against the restricted likelihood itself, dense trace formulas, and planted factors."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import sparse
from scipy.linalg import block_diag
from scipy.optimize import minimize

from adjust.model.observations import ReadingCovariance
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.statistics import variance_components
from adjust.statistics.group_sums import GroupSums, MixedBlock, moments, scaled_survey
from adjust.statistics.system import linear_system
from adjust.statistics.variance_components import (
    components_of,
    estimate_variance_components,
    linear_components,
)
from tests.adjust import statistics_networks as net
from tests.sizes import size

ALL = np.ones(3, dtype=np.bool_)


def random_blocks(seed: int, mixed: bool) -> tuple[list[tuple[FloatArray, FloatArray, FloatArray, IntArray]], int]:
    """Blocks (A, l, cov, group), not whitened; three groups, four unknowns."""
    rng, out = np.random.default_rng(seed), []
    for i in range(14):
        k = int(rng.integers(2, 5))
        root = np.eye(k) + 0.3 * rng.normal(size=(k, k))
        cov = root @ root.T
        group = np.full(k, i % 3) if not mixed or i % 2 else rng.permutation(np.arange(k) % 3)
        scale = np.sqrt(np.array([0.5, 1.0, 3.0])[group])
        out.append((rng.normal(size=(k, 4)), scale * (root @ rng.normal(size=k)), cov, group))
    return out, 4


def as_sums(blocks: list[tuple[FloatArray, FloatArray, FloatArray, IntArray]], n: int) -> GroupSums:
    N, b, c, count = [sparse.csr_matrix((n, n)) for _ in range(3)], np.zeros((3, n)), np.zeros(3), np.zeros(3)
    mixed = []
    for A, e, cov, group in blocks:
        if len(set(group.tolist())) > 1:
            mixed.append(MixedBlock(A, e, cov, group))
            continue
        P, g = np.linalg.inv(cov), int(group[0])
        N[g] = sparse.csr_matrix(N[g] + A.T @ P @ A)
        b[g] += A.T @ P @ e
        c[g] += e @ P @ e
        count[g] += len(e)
    return GroupSums(tuple(N), b, c, count, tuple(mixed), sparse.csr_matrix((0, n)))


def dense_parts(
    blocks: list[tuple[FloatArray, FloatArray, FloatArray, IntArray]], theta: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """A, l, V(theta) and the groups of all rows."""
    A, e = np.concatenate([x[0] for x in blocks]), np.concatenate([x[1] for x in blocks])
    V = block_diag(*[x[2] * np.sqrt(np.outer(theta[x[3]], theta[x[3]])) for x in blocks])
    return A, e, V, np.concatenate([x[3] for x in blocks])


@pytest.mark.parametrize("mixed", [False, True])
def test_squares_redundancies_and_information_against_dense_traces(mixed: bool) -> None:
    blocks, n = random_blocks(3, mixed)
    theta = np.array([0.7, 1.3, 2.0])
    A, e, V, group = dense_parts(blocks, theta)
    P = np.linalg.inv(V)
    M = P - P @ A @ np.linalg.solve(A.T @ P @ A, A.T @ P)
    # derivative of V_ij = sqrt(theta_i theta_j) C_ij by ln(theta_g)
    D = [V * 0.5 * ((group == g)[:, None].astype(float) + (group == g)) for g in range(3)]
    found = moments(as_sums(blocks, n), theta)
    np.testing.assert_allclose(found.q, [e @ M @ d @ M @ e for d in D], rtol=1e-8)
    np.testing.assert_allclose(found.r, [np.trace(M @ d) for d in D], rtol=1e-7)
    np.testing.assert_allclose(found.S, [[np.trace(M @ a @ M @ b) for a in D] for b in D], rtol=1e-6, atol=1e-8)
    assert found.r.sum() == pytest.approx(len(e) - n)


@pytest.mark.parametrize("mixed", [False, True])
def test_the_estimate_is_the_maximum_of_the_restricted_likelihood(mixed: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    blocks, n = random_blocks(5, mixed)

    A, e, V_of_ones, group = dense_parts(blocks, np.ones(3))

    def minus_log_likelihood(log_theta: FloatArray) -> float:
        root = np.exp(0.5 * log_theta)[group]
        V = V_of_ones * np.outer(root, root)
        P = np.linalg.inv(V)
        N = A.T @ P @ A
        v = e - A @ np.linalg.solve(N, A.T @ P @ e)
        return float(np.linalg.slogdet(V)[1] + np.linalg.slogdet(N)[1] + v @ P @ v) / 2.0

    best = minimize(minus_log_likelihood, np.zeros(3), method="Nelder-Mead", options={"xatol": 1e-7, "fatol": 1e-12})
    assert best.success
    monkeypatch.setattr(variance_components, "_LEAST", 0.1)
    monkeypatch.setattr(variance_components, "_CONVERGENCE", 1e-8)
    found = linear_components(as_sums(blocks, n), ALL)
    assert found.converged
    np.testing.assert_allclose(found.theta, np.exp(best.x), rtol=1e-5)
    np.testing.assert_allclose(found.moments.q, found.moments.r, rtol=1e-6)


@pytest.mark.slow
def test_planted_factors_over_many_trials() -> None:
    """Four groups with factors 0.25, 1, 9 and 0.5 on top of the sigmas; the noise is drawn anew in the same network."""
    survey, start = net.hall(2, n_points=36, n_stations=5, n_tapes=150)
    system = linear_system(net.adjusted(survey, start))
    true = dict(zip(("tape", "direction", "zenith", "slope_distance"), (0.5, 0.25, 1.0, 9.0), strict=True))
    root = np.sqrt([true[g] for g in system.group_names])[system.group[system.row_of]]
    rng = np.random.default_rng(0)
    factors, ratios, n = [], [], size(200, 40)
    for _ in range(n):
        e = root * rng.normal(size=len(root))
        found = components_of(replace(system, e=e), tuple(true))
        assert found.converged
        factors.append([c.factor / true[c.group] for c in found.components])
        ratios.append([(c.factor - true[c.group]) / c.sigma for c in found.components])
    mean, scatter = np.mean(factors, axis=0), np.std(factors, axis=0)
    np.testing.assert_allclose(mean, 1.0, atol=0.28 / np.sqrt(n))
    sigmas = np.array([c.sigma / c.factor for c in found.components])
    np.testing.assert_allclose(sigmas, scatter, rtol=3.0 / np.sqrt(2 * n))  # of 200 trials: 5 % (one sigma)
    assert abs(np.mean(np.abs(ratios) < 1.0) - 0.68) < 2.2 / np.sqrt(4 * n)


def test_a_whole_survey_and_its_scaled_twin() -> None:
    true = {"direction": 4.0, "slope_distance": 0.25}
    survey, start = net.hall(4, factors=true)
    found = estimate_variance_components(survey, start)
    assert found.components.converged
    for c in found.components.components:
        assert abs(c.factor - true.get(c.group, 1.0)) < 3.0 * c.sigma
        assert c.redundancy == pytest.approx(c.omega, rel=1e-3)
        assert c.lower < c.factor < c.upper
    assert found.adjustment.sigma0 == pytest.approx(1.0, abs=1e-4)
    assert next(c.factor for c in found.components.components if c.group == "direction") > 2.0
    again = scaled_survey(survey, {c.group: c.factor for c in found.components.components})
    assert again.readings[0].sigma == pytest.approx(found.adjustment.survey.readings[0].sigma, rel=1e-12)
    assert again.distances[0].sigma == pytest.approx(found.adjustment.survey.distances[0].sigma, rel=1e-12)


def joint(survey: Survey) -> Survey:
    """Direction, zenith angle and distance of every second sight with a joint covariance: blocks of three groups."""
    out = []
    for i in range(0, len(survey.readings), 6):
        ids = tuple(r.reading_id for r in survey.readings[i : i + 3])
        s = np.array([r.sigma for r in survey.readings[i : i + 3]])
        C = np.array([[1.0, 0.5, 0.3], [0.5, 1.0, -0.2], [0.3, -0.2, 1.0]])
        out.append(ReadingCovariance(ids, C * np.outer(s, s)))
    return replace(survey, reading_covariances=tuple(out))


def test_groups_that_share_correlated_blocks() -> None:
    survey, start = net.hall(5)
    survey = joint(survey)
    adjustment = net.adjusted(survey, start)
    found = components_of(linear_system(adjustment), ("direction", "zenith", "slope_distance", "tape"))
    assert sum(c.n for c in found.components) == adjustment.n_observations
    assert sum(c.redundancy for c in found.components) == pytest.approx(adjustment.redundancy)
    first = {c.group: c.factor for c in found.components}
    twice = components_of(linear_system(net.adjusted(scaled_survey(survey, first), start)), tuple(first))
    for c in twice.components:
        assert c.factor == pytest.approx(1.0, abs=1e-3)  # curvature


def test_what_cannot_be_estimated_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, start = net.hall(6)
    tapes = tuple(replace(d, group=f"tape {'ab'[i % 2]}") for i, d in enumerate(survey.distances))
    half = replace(survey, distances=tapes)
    system = linear_system(net.adjusted(half, start))
    none = components_of(system, ("direction",))
    assert {c.group: c.status for c in none.components}["zenith"] == "fixed"
    monkeypatch.setattr(variance_components, "_LEAST", 30.0)
    few = components_of(system, system.group_names)
    assert {c.status for c in few.components if c.group.startswith("tape")} == {"no redundancy"}


def test_two_groups_that_only_their_difference_checks() -> None:
    """Every coordinate is measured once by either group: only the sum of the two variances shows."""
    n = 12
    rng = np.random.default_rng(1)
    A = sparse.identity(n, format="csr")
    e = rng.normal(size=(2, n)) * [[1.0], [2.0]]
    sums = GroupSums((A, A), e.copy(), (e**2).sum(axis=1), np.full(2, float(n)), (), sparse.csr_matrix((0, n)))
    found = linear_components(sums, np.ones(2, dtype=np.bool_))
    assert found.merged.tolist() == [0, 0]
    assert found.theta[0] == found.theta[1]
    assert found.theta[0] == pytest.approx(((e[0] - e[1]) ** 2).sum() / 2.0 / n, rel=1e-6)


def test_a_group_whose_residuals_vanish() -> None:
    """Of two groups one fits exactly: its component goes to the floor and is named, the other one is estimated."""
    rng = np.random.default_rng(2)
    A, e = rng.normal(size=(60, 3)), rng.normal(size=60)
    e[:30] = 0.0
    halves = [slice(0, 30), slice(30, 60)]
    N, b = tuple(sparse.csr_matrix(A[h].T @ A[h]) for h in halves), np.array([A[h].T @ e[h] for h in halves])
    squares = np.array([e[h] @ e[h] for h in halves])
    sums = GroupSums(N, b, squares, np.full(2, 30.0), (), sparse.csr_matrix((0, 3)))
    found = linear_components(sums, np.ones(2, dtype=np.bool_))
    assert found.vanished.tolist() == [True, False]
    assert found.theta[1] == pytest.approx(e[30:] @ e[30:] / 30.0, rel=1e-3)
