"""Which pairs of a network agree with each other, by their loops alone."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray
from adjust.pose_network import PoseNetwork
from adjust.pose_network.agreement import _connected, agreeing, disagreeing
from adjust.pose_network.cycles import flat, short_loops
from adjust.pose_network.loops import evaluate_loops, walked
from adjust.pose_network.network import survey_of
from adjust.statistics.outliers import search
from adjust.statistics.screened_adjustment import adjust_cleaned
from tests.adjust.pose_networks import exp6, pose_network, simulate


def _disagreeing(network: PoseNetwork) -> set[str]:
    return set(np.array(network.pair_ids)[network.used & ~agreeing(network)].tolist())


def _left_out(result: Adjustment) -> set[str]:
    return {p.pair_id for p in result.survey.pairs if not p.used}


def _scaled(network: PoseNetwork, factor: float) -> PoseNetwork:
    return replace(network, arrays=replace(network.arrays, cov=network.cov * factor))


def test_short_loops_are_walks_that_end_where_they_begin() -> None:
    net = simulate(12, 4, seed=2, extra=30, sigma_rad=1e-9, sigma_m=1e-9).network
    every = np.arange(net.n_pairs)
    loops = short_loops(net.n_stations, net.a_idx, net.b_idx, every, every, 100)
    found = walked(net.a_idx, net.b_idx, flat(loops), net.a_idx[[loop[0] for loop in loops]])
    assert np.abs(evaluate_loops(found, net.arrays.motions)[0]).max() < 1e-6
    assert {e for loop in loops for e in loop} == set(every.tolist())
    assert len({frozenset(loop) for loop in loops}) == len(loops)
    only = every[every % 3 > 0]
    for loop in short_loops(net.n_stations, net.a_idx, net.b_idx, every[:5], only, 100):
        assert loop[0] < 5
        assert set(loop[1:]) <= set(only.tolist())


@pytest.mark.parametrize("rotations_only", [False, True])
@pytest.mark.parametrize("wrong", [0, 5, 20])
def test_wrong_pairs_and_no_others_leave_all_their_loops_open(wrong: int, rotations_only: bool) -> None:
    sim = simulate(20, 5, seed=wrong, wrong=wrong, extra=80, rotations_only=rotations_only)
    assert _disagreeing(sim.network) == set(sim.wrong)
    assert _disagreeing(_scaled(sim.network, 1 / 100.0)) == set(sim.wrong)  # sigmas ten times too small


def test_rotations_among_poses_are_tested_by_what_they_say() -> None:
    sim = simulate(20, 5, seed=3, wrong=10, extra=80)
    net, t, cov = sim.network, sim.network.translations.copy(), sim.network.cov.copy()
    turns = np.arange(net.n_pairs) % 4 == 1
    t[turns] = np.nan
    mixed = pose_network(net.station_ids, net.pair_ids, net.a_idx, net.b_idx, net.rotations, t, cov,
                         held={0: np.eye(4)})  # fmt: skip
    assert turns[[net.pair_ids.index(p) for p in sim.wrong]].any()
    found = disagreeing(mixed, 1e-3)
    assert found is not None
    assert set(np.array(mixed.pair_ids)[found[0]].tolist()) == set(sim.wrong)


def _spoiled(errors: FloatArray) -> PoseNetwork:
    """A station c whose pairs to x, y and z are off by errors (3, 6); x with y and z by two ways each."""
    names, rng = ["x", "y", "z", "p", "q", "c"], np.random.default_rng(4)
    ends = ["cx", "cy", "cz", "yx", "zx", "yp", "px", "zq", "qx"]
    a, b = (np.array([names.index(e[i]) for e in ends]) for i in (0, 1))
    R, t = exp6(rng.normal(size=(6, 6)))
    back = np.swapaxes(R[b], 1, 2)
    Z_R, Z_t = back @ R[a], np.einsum("nij,nj->ni", back, t[a] - t[b])
    off_R, off_t = exp6(np.vstack([errors, rng.normal(size=(6, 6)) * 1e-3]))
    Z_t = Z_t + np.einsum("nij,nj->ni", Z_R, off_t)
    return pose_network(names, ends, a, b, Z_R @ off_R, Z_t, np.tile(np.eye(6) * 1e-6, (9, 1, 1)),
                        held={0: np.eye(4)})  # fmt: skip


def test_what_a_wrong_pair_spoils_agrees_by_other_loops() -> None:
    """All short loops of the pairs at c go through the wrong one."""
    assert _disagreeing(_spoiled(np.diag([0.5, 0.0, 0.0]) @ np.ones((3, 6)))) == {"cx"}


def test_of_pairs_that_all_contradict_the_one_nearest_to_the_others_holds_the_station() -> None:
    errors = np.array([[0, 0, 0, 1.0, 0, 0], [0, 0, 0, 0, 0, 0], [0, 0, 0, -1.0, 0, 0]])
    network = _spoiled(errors)
    assert _disagreeing(network) == {"cx", "cy", "cz"}
    used = _connected(network, agreeing(network))
    assert [network.pair_ids[e] for e in np.flatnonzero(~used)] == ["cx", "cz"]


def test_nothing_is_said_where_all_agree() -> None:
    assert disagreeing(simulate(10, 5, seed=3, extra=60).network, 1e-3) is None


def test_pairs_sorted_out_by_mistake_are_taken_back(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = simulate(10, 5, seed=3, wrong=6, extra=60)
    first = agreeing(sim.network)
    first[::7] = False
    monkeypatch.setattr("adjust.pose_network.agreement.agreeing", lambda *_: first)
    found = disagreeing(sim.network, 1e-3)
    assert found is not None
    assert len(sim.wrong) <= found[0].sum() < 0.5 * (~first).sum()
    monkeypatch.setattr("adjust.statistics.outliers.watched._LARGE", 0.0)
    assert _left_out(adjust_cleaned(survey_of(sim.network))) == set(sim.wrong)


def test_wrong_pairs_that_passed_the_first_sorting_are_found_by_their_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = simulate(6, 5, seed=1, wrong=2, extra=25)
    some = agreeing(sim.network) | (np.array(sim.network.pair_ids) == sim.wrong[0])
    monkeypatch.setattr("adjust.pose_network.agreement.agreeing", lambda *_: some)
    monkeypatch.setattr("adjust.statistics.outliers.watched._LARGE", 0.0)
    assert _left_out(adjust_cleaned(survey_of(sim.network))) == set(sim.wrong)


@pytest.mark.slow
def test_a_crowd_of_wrong_pairs_costs_one_solution(monkeypatch: pytest.MonkeyPatch) -> None:
    sim = simulate(30, 6, seed=1, wrong=40, extra=200)
    solutions, adjusted = [], search.adjust
    monkeypatch.setattr("adjust.statistics.outliers.watched._LARGE", 0.0)
    monkeypatch.setattr(search, "adjust", lambda *a: solutions.append(adjusted(*a)) or solutions[-1])
    result = adjust_cleaned(survey_of(sim.network))
    assert _left_out(result) == set(sim.wrong)
    assert len(solutions) == 1
