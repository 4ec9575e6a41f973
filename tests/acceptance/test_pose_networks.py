"""Pose networks: real ones with certified optima, large simulated ones, wrong pairs.

The full sizes (10,000 stations one by one, 100,000 in one batch) run by ``python -m tests.benchmarks.networks``, or
here with LABSURVEY_LONG set.
"""

import os

import numpy as np
import pytest
from scipy.stats import chi2

from adjust.pose_network.network import survey_of
from adjust.pose_network.solve import minimize
from adjust.precision.precision import global_test
from adjust.statistics.screened_adjustment import adjust_cleaned
from tests.adjust.chordal import chordal_cost, minimize_chordal
from tests.adjust.pose_networks import exp6, network_of_file, omega_of, simulate, solve_network
from tests.benchmarks.networks import batch, gradient, grow
from tests.data import data_folder

LONG = bool(os.environ.get("LABSURVEY_LONG"))

# certified optima of the chordal cost to 4 digits: Rosen, Carlone, Bandeira and Leonard, SE-Sync, IJRR 2019, table 1
CERTIFIED = {"sphere2500": 1.687e3, "torus3D": 2.423e4, "parking-garage": 1.263}


@pytest.mark.parametrize("name", CERTIFIED)
def test_published_optimum_is_met_from_nothing(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    network = network_of_file(data_folder("calibration", "pose_graphs") / f"{name}.g2o")
    free = np.delete(network.station_translations, network.held, axis=0)
    assert np.isnan(free).all()  # neither odometry nor the file's vertices are used
    chordal = minimize_chordal(network)
    assert float(f"{chordal.cost:.3e}") == CERTIFIED[name]
    ours = solve_network(network)
    assert gradient(ours) < 1e-6
    # the optimum of our own geodesic cost, again from somewhere else
    rng = np.random.default_rng(0)
    dR, dt = exp6(rng.normal(size=(network.n_stations, 6)) * 0.05)
    t = ours.translations + np.einsum("nij,nj->ni", ours.rotations, dt)
    again = minimize(network, (ours.rotations @ dR, t))
    assert omega_of(again) == pytest.approx(ours.omega, rel=1e-8)
    at_ours = chordal_cost(network, ours.rotations, ours.translations)
    assert at_ours >= chordal.cost
    with capsys.disabled():
        print(f"\n{name}: chordal optimum {chordal.cost:.5g} (certified {CERTIFIED[name]:.4g}), v'Pv of the geodesic "
              f"optimum {ours.omega:.6g}, chordal cost there {at_ours:.5g}")  # fmt: skip


def test_stations_are_added_at_a_constant_price(capsys: pytest.CaptureFixture[str]) -> None:
    done = grow(5000 if LONG else 400, 2)
    with capsys.disabled():
        print(f"\n{done}")
    k = len(done.ms) // 5
    assert np.median(done.ms[-k:]) < 3.0 * np.median(done.ms[k : 2 * k])
    assert done.before[1] < 0.05
    assert done.after[1] < 1e-6


@pytest.mark.parametrize(("nx", "ny"), [(10000, 10), (25000, 4)] if LONG else [(500, 10), (1000, 4)])
def test_large_networks_reach_the_true_minimum(nx: int, ny: int, capsys: pytest.CaptureFixture[str]) -> None:
    done = batch(nx, ny)
    with capsys.disabled():
        print(f"\n{done}")
    test = global_test(done.solution.omega, done.solution.redundancy, 1e-3)
    assert test is not None
    assert test.passed
    assert done.gradient < 1e-6
    assert done.redundancy_sum == pytest.approx(done.solution.redundancy, rel=1e-6)


@pytest.mark.parametrize(("nx", "ny", "extra", "wrong"), [(6, 5, 25, 4), (100, 10, 200, 60)])
def test_planted_wrong_pairs_are_found_and_named(nx: int, ny: int, extra: int, wrong: int) -> None:
    sim = simulate(nx, ny, seed=5, extra=extra, wrong=wrong)
    result = adjust_cleaned(survey_of(sim.network))
    assert {p.pair_id for p in result.survey.pairs if not p.used} == set(sim.wrong)
    assert result.omega < chi2.isf(1e-3, result.redundancy)
