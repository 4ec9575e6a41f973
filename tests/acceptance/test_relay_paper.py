"""The relay-station paper (Chao et al. 2011): its table, and the two forms of the adjustment against each other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.model.errors import IndeterminateError
from adjust.precision.precision import global_test
from adjust.published.relay import paper_iteration
from adjust.relay.conditions import MAX_HARD_LOOPS, ConditionOptions, adjust_condition_factors, adjust_conditions
from adjust.relay.counts import count
from adjust.relay.loops import loop_misclosures
from adjust.relay.network import MeasuredPairs, topology
from adjust.spatial.rigid_motions import Motions
from tests.adjust.relay_monte_carlo import MonteCarloOptions, simulate_complete
from tests.adjust.relay_networks import ARCMIN, chain_with_chords, complete, differences, grid, simulate, suspects
from tests.adjust.relay_parametric import adjust_parametric
from tests.sizes import size

# table 1: mean absolute errors (arcmin) of Ax, Ay, Az of the pairs C1-C2, C2-C3, C3-C4 over 1000 trials
BEFORE = np.array([[4.93, 3.39, 3.39], [4.87, 3.36, 3.32], [4.80, 3.40, 3.38]])
AFTER = np.array([[2.97, 2.30, 2.25], [2.82, 2.20, 2.31], [2.80, 2.23, 2.43]])


@pytest.fixture(scope="module")
def table():
    return simulate_complete(MonteCarloOptions(n_cameras=4, n_trials=size(100_000), seed=1))


@pytest.mark.parametrize(("column", "printed"), [("before", BEFORE), ("weighted", AFTER)])
def test_table_1(table, column, printed):
    errors = getattr(table, column)
    mean = errors.mean_abs[table.chain] / ARCMIN
    # of the paper's thousand trials, and of its two decimals
    deviation = errors.deviation[table.chain] / ARCMIN / np.sqrt(1000) + 0.005
    assert np.mean(deviation / mean) < 0.03
    np.testing.assert_array_less(np.abs(mean - printed), 3 * deviation)
    assert np.mean(printed / mean) == pytest.approx(1.0, abs=0.02)
    assert table.unsettled == 0


def test_table_1_with_equal_weights_is_an_eighth_worse(table):
    weighted, equal = (e.mean_abs[table.chain] for e in (table.weighted, table.equal))
    assert np.mean(equal / weighted) == pytest.approx(1.12, abs=0.02)
    # the paper's figures tell the two apart
    assert abs(np.mean(AFTER * ARCMIN / equal) - 1.0) > 0.08
    assert table.weighted.omega == pytest.approx(9.0, abs=0.1)


@pytest.mark.parametrize("n", range(3, 13))
def test_isotropic_noise_shrinks_by_the_root_of_two_over_n(n):
    trials = size(60_000 // n if n < 8 else 2000)
    found = simulate_complete(MonteCarloOptions(n_cameras=n, n_trials=trials, noise="tangent", seed=n))
    within = 1.0 / np.sqrt(trials)  # 3 to 4 sigmas of the ratio, whose pairs are correlated
    assert found.weighted.rms / found.before.rms == pytest.approx(np.sqrt(2 / n), rel=max(0.01, within))


def agree(network, *others):
    reference = adjust_parametric(network).pairs
    for other in others:
        assert np.abs((reference.b_from_a.inverse() @ other.b_from_a).log()).max() < 1e-10
        np.testing.assert_allclose(other.cov, reference.cov, rtol=0, atol=1e-8 * np.abs(reference.cov).max())
        np.testing.assert_allclose(other.redundancy, reference.redundancy, atol=1e-8)
        assert other.omega == pytest.approx(reference.omega, rel=1e-9)
    return reference


@pytest.mark.parametrize("n", [3, 4, 5, 8, 12, 20, 60])
def test_both_forms_agree_on_complete_networks(n):
    network = simulate(complete(n), seed=n).network
    conditions = adjust_conditions(network)
    forms = [conditions.pairs]
    if len(conditions.basis) <= MAX_HARD_LOOPS:
        forms.append(adjust_condition_factors(network).pairs)
        forms.append(adjust_conditions(network, ConditionOptions(loops="shortest")).pairs)
    reference = agree(network, *forms)
    assert conditions.closure < 1e-12
    assert global_test(reference.omega, reference.redundancy_total, 1e-4).passed


@pytest.mark.parametrize("dim", [3, 6])
def test_both_forms_agree_on_sparse_networks(dim):
    for top in (grid(6, 7), chain_with_chords(40, 60, seed=1)):
        network = simulate(top, dim, seed=dim).network
        agree(network, adjust_conditions(network).pairs, adjust_condition_factors(network).pairs)


def test_both_forms_agree_on_the_grid_of_4900_loops():
    network = simulate(grid(71, 71), seed=0).network
    conditions = adjust_conditions(network)
    assert (len(conditions.basis), conditions.basis.minimal) == (4900, True)
    assert conditions.closure < 1e-12
    pairs = agree(network, conditions.pairs)
    assert pairs.redundancy.sum() == pytest.approx(3 * 4900, abs=1e-6)
    assert global_test(pairs.omega, pairs.redundancy_total, 1e-4).passed


def rotation(angles):
    return Rotation.from_euler("ZYX", angles[..., ::-1]).as_matrix()


def test_the_papers_iteration_takes_at_most_four():
    rng, top, half = np.random.default_rng(0), complete(4), np.array([np.pi, np.pi / 2, np.pi])
    iterations = []
    for _ in range(size(100, 30)):
        world = [np.eye(3)]
        for angles in rng.uniform(-half, half, (3, 3)):
            world.append(rotation(angles) @ world[-1])
        true = np.array([world[b] @ world[a].T for a, b in zip(top.a_idx, top.b_idx, strict=True)])
        angles = Rotation.from_matrix(true).as_euler("ZYX")[:, ::-1] + rng.normal(0, 5 * ARCMIN, (6, 3))
        network = MeasuredPairs(top, Motions(rotation(angles)), np.broadcast_to(np.eye(3), (6, 3, 3)))
        iterations.append(paper_iteration(network).iterations)
    assert min(iterations) >= 2
    assert max(iterations) <= 4


NETWORKS = {4: (complete(4), 150), 12: (complete(12), 60), 200: (chain_with_chords(200, 400, seed=2), 12)}


@pytest.mark.parametrize("form", [adjust_parametric, adjust_conditions])
@pytest.mark.parametrize("n", NETWORKS)
def test_errors_are_as_large_as_their_covariance_says(n, form):
    top, trials = NETWORKS[n]
    trials = size(trials, 4)
    # pairs that form a spanning tree: their joint covariance is regular
    tree = [int(e) for e in (np.flatnonzero(top.a_idx == 0) if n < 200 else np.arange(n - 1))]
    total = 0.0
    for trial in range(trials):
        simulated = simulate(top, seed=1000 * n + trial)
        pairs = form(simulated.network).pairs
        d = differences(pairs.b_from_a[np.array(tree)], [simulated.true[e] for e in tree]).ravel()
        total += d @ np.linalg.solve(pairs.joint(tree), d)
    low, high = chi2.ppf([0.001, 0.999], 3 * (n - 1) * trials)
    assert low < total < high


@pytest.mark.parametrize("dim", [3, 6])
@pytest.mark.parametrize("form", [adjust_parametric, adjust_conditions])
def test_a_wrong_pair_is_found_and_named(form, dim):
    network = simulate(chain_with_chords(30, 60, seed=5), dim, seed=5).network
    assert suspects(form(network).pairs) == []
    wrong = 37
    d = np.zeros((network.topology.n_pairs, dim))
    d[wrong, :3] = np.radians([1.0, -0.5, 0.8])
    network = replace(network, b_from_a=network.b_from_a.retract(d))
    pairs = form(network).pairs
    assert suspects(pairs)[0] == wrong
    assert pairs.residual[wrong, :3] @ d[wrong, :3] < 0.0
    # and every loop that fails goes through it
    misclosures = loop_misclosures(network)
    failed = misclosures.failed()
    assert len(failed) > 0
    assert all(network.topology.pair_ids[wrong] in misclosures.basis.pairs(int(k)) for k in failed)


def test_uncontrolled_pairs_and_separate_parts_are_named():
    rows = [("12", "C1", "C2"), ("23", "C2", "C3"), ("31", "C3", "C1"), ("34", "C3", "C4")]
    network = simulate(topology(rows)).network
    assert count(network.topology).uncontrolled_pairs == ("34",)
    for form in (adjust_parametric, adjust_conditions):
        pairs = form(network).pairs
        assert list(pairs.freedom) == [3, 3, 3, 0]
        assert np.isnan(pairs.test[3])
    apart = simulate(topology([*rows, ("56", "C5", "C6")])).network
    with pytest.raises(IndeterminateError, match="no measured pair ties C5, C6 to the datum"):
        adjust_parametric(apart)
