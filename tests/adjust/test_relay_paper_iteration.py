from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.pose_network.loops import evaluate_loops
from adjust.published.relay import ARCSECOND, PaperOptions, loop_equations, paper_iteration
from adjust.relay.conditions import adjust_conditions
from adjust.relay.loops import loop_basis
from adjust.relay.network import MeasuredPairs
from adjust.spatial.rigid_motions import Motions
from adjust.spatial.rotation_forms import euler_cov_from_tangent, euler_from_matrix, euler_jacobian
from tests.adjust.relay_monte_carlo import MonteCarloOptions, adjust_batch, simulate_complete
from tests.adjust.relay_networks import ARCMIN, complete, simulate
from tests.adjust.relay_parametric import adjust_parametric


def rotation(angles):
    """Rz Ry Rx by SciPy."""
    return Rotation.from_euler("ZYX", np.asarray(angles)[..., ::-1]).as_matrix()


def four_cameras(seed, y=None):
    """Measured Euler angles of all pairs, 5' each; ``y`` sets the middle angle of the first pair."""
    rng = np.random.default_rng(seed)
    half = np.array([np.pi, np.pi / 2, np.pi])
    chain = rng.uniform(-half, half, (3, 3))
    if y is not None:
        chain[0, 1] = y
    world = [np.eye(3)]
    for angles in chain:
        world.append(rotation(angles) @ world[-1])
    top = complete(4)
    true = np.array([world[b] @ world[a].T for a, b in zip(top.a_idx, top.b_idx, strict=True)])
    angles = Rotation.from_matrix(true).as_euler("ZYX")[:, ::-1] + rng.normal(0, 5 * ARCMIN, (6, 3))
    return MeasuredPairs(top, Motions(rotation(angles)), np.broadcast_to(np.eye(3) * (5 * ARCMIN) ** 2, (6, 3, 3)))


def test_loop_equations_are_derivatives_of_the_products():
    network = four_cameras(0)
    angles = euler_from_matrix(network.b_from_a.rotation)
    basis = loop_basis(network.topology)

    def misclosure(changed):
        out = []
        for k in range(len(basis)):
            M = np.eye(3)
            for i in range(basis.ptr[k], basis.ptr[k + 1]):
                step = rotation(changed[basis.pair_idx[i]])
                M = (step if basis.sense[i] > 0 else step.T) @ M
            out.append(np.eye(3) - M)
        return np.concatenate([np.ravel(part) for part in out])

    C, B = loop_equations(basis, angles)
    np.testing.assert_allclose(B, misclosure(angles), atol=1e-14)
    assert C.shape == (27, 18)
    for column in range(18):
        step = np.zeros(18)
        step[column] = 1e-6
        d = (misclosure(angles + step.reshape(6, 3)) - misclosure(angles - step.reshape(6, 3))) / 2e-6
        np.testing.assert_allclose(C[:, column], -d, atol=1e-8)


def test_nine_equations_have_rank_three_a_loop():
    network = four_cameras(1)
    C, _ = loop_equations(loop_basis(network.topology), euler_from_matrix(network.b_from_a.rotation))
    s = np.linalg.svd(C, compute_uv=False)
    assert C.shape == (27, 18)
    assert np.sum(s > 1e-10 * s[0]) == 9  # so that C P^-1 C' (27 x 27) has no inverse


def reduced_form(network):
    """Angles of the paper's iteration with the three equations that a loop really has: misclosures of full rank."""
    basis, angles = loop_basis(network.topology), euler_from_matrix(network.b_from_a.rotation)
    for _ in range(20):
        w, blocks = evaluate_loops(basis, Motions(rotation(angles)))
        C = np.zeros((len(basis), 3, 6, 3))
        C[np.repeat(np.arange(len(basis)), basis.lengths), :, basis.pair_idx] = (
            blocks @ euler_jacobian(angles)[basis.pair_idx]
        )
        step = np.linalg.lstsq(C.reshape(-1, 18), -w.ravel(), rcond=1e-10)[0]
        angles = angles + step.reshape(6, 3)
        if np.abs(step).max() < ARCSECOND:
            return angles
    raise AssertionError("the corrections do not settle")


def test_reduced_form_weights_and_scale():
    network = four_cameras(2)
    printed = paper_iteration(network)
    equal = PaperOptions(euler_cov=np.broadcast_to(np.eye(3) * 4.0, (6, 3, 3)))
    np.testing.assert_allclose(reduced_form(network), printed.angles, atol=0.01 * ARCSECOND)
    np.testing.assert_allclose(paper_iteration(network, equal).angles, printed.angles, atol=1e-12)
    rng = np.random.default_rng(0)
    A = rng.normal(size=(6, 3, 3))
    cov = (A @ A.transpose(0, 2, 1) + np.eye(3)) * ARCMIN**2
    weighted = paper_iteration(network, PaperOptions(euler_cov=cov))
    other_unit = paper_iteration(network, PaperOptions(euler_cov=cov / ARCMIN**2))
    np.testing.assert_allclose(weighted.angles, other_unit.angles, atol=1e-12)
    assert np.abs(weighted.angles - printed.angles).max() > 10 * ARCSECOND
    assert weighted.misclosure < ARCSECOND


def test_first_step_of_the_paper_is_its_printed_formula():
    network = four_cameras(3)
    angles = euler_from_matrix(network.b_from_a.rotation)
    C, B = loop_equations(loop_basis(network.topology), angles)
    step = np.linalg.pinv(C, rcond=1e-10) @ B
    once = paper_iteration(network, PaperOptions(tolerance=1.0))
    np.testing.assert_allclose(once.angles - angles, step.reshape(6, 3), atol=1e-14)


def test_well_away_from_gimbal_lock_it_is_least_squares_to_second_order():
    network = four_cameras(4, y=0.3)
    angles = euler_from_matrix(network.b_from_a.rotation)
    cov = euler_cov_from_tangent(angles, network.cov)
    paper = paper_iteration(network, PaperOptions(euler_cov=cov))
    rigorous = adjust_conditions(network).pairs
    difference = np.abs((rigorous.b_from_a.inverse() @ paper.b_from_a).log()).max()
    # corrections of 5' squared are 0.4"
    assert ARCSECOND * 1e-3 < difference < 5 * ARCSECOND


def test_near_gimbal_lock_it_leaves_the_least_squares_solution():
    network = four_cameras(5, y=np.pi / 2 - 0.02 * np.pi / 180)
    angles = euler_from_matrix(network.b_from_a.rotation)
    cov = euler_cov_from_tangent(angles, network.cov)
    paper = paper_iteration(network, PaperOptions(euler_cov=cov))
    rigorous = adjust_conditions(network).pairs
    assert paper.iterations > paper_iteration(four_cameras(4, y=0.3)).iterations
    assert np.abs((rigorous.b_from_a.inverse() @ paper.b_from_a).log()).max() > 5 * ARCSECOND
    locked = network.b_from_a.rotation.copy()
    locked[2] = rotation([0.1, np.pi / 2, 0.0])
    with pytest.raises(SurveyError, match=r"rotation 2: .*gimbal lock"):
        paper_iteration(replace(network, b_from_a=Motions(locked)))


def test_refusals():
    with pytest.raises(SurveyError, match="rotations alone"):
        paper_iteration(simulate(complete(4), 6).network)
    with pytest.raises(NotConvergedError, match=r"nearest to gimbal lock \(y = "):
        paper_iteration(four_cameras(0), PaperOptions(max_iterations=1))
    with pytest.raises(SurveyError, match="three cameras"):
        simulate_complete(MonteCarloOptions(n_cameras=2))


@pytest.mark.parametrize("n", [3, 4, 9])
def test_compiled_trials_are_the_same_estimator(n):
    networks = [simulate(complete(n), 3, seed=s).network for s in range(4)]
    measured = np.array([network.b_from_a.rotation for network in networks])
    batch = adjust_batch(measured, np.array([np.linalg.inv(network.cov) for network in networks]), n)
    assert batch.settled.all()
    for trial, network in enumerate(networks):
        for pairs in (adjust_conditions(network).pairs, adjust_parametric(network).pairs):
            found = Motions(batch.b_from_a[trial])
            assert np.abs((found.inverse() @ pairs.b_from_a).log()).max() < 1e-10
            assert batch.omega[trial] == pytest.approx(pairs.omega, rel=1e-9)


@pytest.mark.slow
def test_monte_carlo_repeats_itself_and_counts_its_redundancy():
    options = MonteCarloOptions(n_cameras=5, n_trials=3000, seed=3, chunk=1000)
    first, again = simulate_complete(options), simulate_complete(options)
    np.testing.assert_array_equal(first.weighted.mean_abs, again.weighted.mean_abs)
    assert first.unsettled == 0
    # 18 equations; the mean of 3000 has a sigma of 0.11
    assert first.weighted.omega == pytest.approx(18.0, abs=0.5)
    assert first.weighted.rms < first.equal.rms < first.before.rms
    assert list(zip(first.a_idx[first.chain], first.b_idx[first.chain], strict=True)) == [
        (0, 1),
        (1, 2),
        (2, 3),
        (3, 4),
    ]
