from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.graph.assembly import values_of
from adjust.graph.solver import _Loop
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import Adjustment
from adjust.model.survey import Datum, FloatArray, Point, PointParameter, PoseParameter, Station, Survey
from adjust.pose_network.cycles import connected_parts, loop_labels
from adjust.pose_network.from_survey import network_from_survey, network_of_pairs
from adjust.pose_network.network import PoseNetwork
from adjust.pose_network.network import survey_of as survey_of_network
from adjust.pose_network.solve import minimize
from adjust.pose_network.start import find_network_start
from adjust.spatial.rigid_motions import Motions
from adjust.statistics.condensed import condensed_system
from adjust.statistics.outliers.snooping import Snooping
from adjust.statistics.outliers.watched import WatchedSnooping
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned
from tests.adjust.chordal import chordal_cost, minimize_chordal
from tests.adjust.pose_networks import exp6, network_jacobians, omega_of, pose_network, simulate, solve_network


def screened(network: PoseNetwork) -> Adjustment:
    """As a survey, without its wrong pairs."""
    return adjust_cleaned(survey_of_network(network))


def left_out(result: Adjustment) -> set[str]:
    return {p.pair_id for p in result.survey.pairs if not p.used}


def motions_of(solution) -> Motions:
    return Motions(solution.rotations, None if solution.network.rotation_only else solution.translations)


def dense(network: PoseNetwork, here: Motions) -> np.ndarray:
    """Whitened Jacobian of the pairs in use by all stations, dense."""
    _, by_b, by_a, _ = network_jacobians(network, here)
    d = network.dim
    A = np.zeros((network.n_pairs * d, network.n_stations * d))
    for e in np.flatnonzero(network.used):
        rows = slice(e * d, e * d + d)
        for i, J in ((network.b_idx[e], by_b[e]), (network.a_idx[e], by_a[e])):
            A[rows, i * d : i * d + d] += network.whitening[e] @ J
    return A


def test_exact_measurements_give_the_stations_back() -> None:
    sim = simulate(4, 3, sigma_rad=1e-10, sigma_m=1e-10)
    solution = solve_network(sim.network)
    assert solution.rotations == pytest.approx(sim.rotations, abs=2e-9)
    assert solution.translations == pytest.approx(sim.translations, abs=1e-8)


def test_a_triangle_of_turns_spreads_its_misclosure_evenly() -> None:
    # three equal rotations about one axis that should close but miss by 3 d: each is corrected by d
    d, third = 1e-3, 2 * np.pi / 3
    R = Rotation.from_rotvec(np.tile([0, 0, third + d], (3, 1))).as_matrix()
    net = pose_network("abc", ["ab", "bc", "ca"], [1, 2, 0], [0, 1, 2], R, None, np.tile(np.eye(3) * 1e-6, (3, 1, 1)),
                       held={0: np.eye(4)})  # fmt: skip
    solution = solve_network(net)
    assert solution.pairs.residual == pytest.approx(np.tile([0, 0, -d], (3, 1)), abs=1e-12)
    assert solution.omega == pytest.approx(3.0)
    # two thirds of the variance is left, by hand; every pair has redundancy 1/3 in each component
    assert solution.station_cov[1] == pytest.approx(np.eye(3) * 2e-6 / 3, rel=1e-9)
    assert solution.pairs.redundancy == pytest.approx(np.full((3, 3), 1 / 3), rel=1e-9)


@pytest.mark.parametrize("rotations_only", [False, True])
def test_jacobians_away_from_zero_error(rotations_only: bool) -> None:
    sim = simulate(3, 2, sigma_rad=0.3, sigma_m=0.5, rotations_only=rotations_only)
    net, rng = sim.network, np.random.default_rng(1)
    turned = sim.rotations @ Rotation.from_rotvec(rng.normal(size=(6, 3)) * 0.2).as_matrix()
    here = Motions(turned, None if rotations_only else sim.translations + rng.normal(size=(6, 3)))
    _, by_b, by_a, _ = network_jacobians(net, here)
    assert np.abs(network_jacobians(net, here)[0]).max() > 0.3
    h = 1e-6
    for k in range(net.dim):
        for station, J in ((net.b_idx, by_b), (net.a_idx, by_a)):
            for e in range(net.n_pairs):
                r = []
                for sign in (1, -1):
                    step = np.zeros((6, 6))
                    step[station[e], k] = sign * h
                    dR, dt = exp6(step)
                    t = None if here.translation is None else (
                        here.translation + np.einsum("nij,nj->ni", here.rotation, dt)
                    )
                    r.append(network_jacobians(net, Motions(here.rotation @ dR, t))[0][e])
                assert (r[0] - r[1]) / (2 * h) == pytest.approx(J[e, :, k], abs=1e-7)


def test_minimum_is_stationary_and_the_same_from_another_start() -> None:
    sim = simulate(6, 5, sigma_rad=0.05, sigma_m=0.3)
    net = sim.network
    first = minimize(net)
    rng = np.random.default_rng(0)
    away = first.rotations @ Rotation.from_rotvec(rng.normal(size=(30, 3)) * 0.2).as_matrix()
    second = minimize(net, (away, first.translations + rng.normal(size=(30, 3))))
    assert omega_of(second) == pytest.approx(omega_of(first), rel=1e-12)
    assert second.translations == pytest.approx(first.translations, abs=1e-5)
    for m in (first, second):
        here = Motions(m.rotations, m.translations)
        A = dense(net, here)[:, 6:]
        e = np.einsum("nij,nj->ni", net.whitening, network_jacobians(net, here)[0]).ravel()
        # gradient in units of the largest it could be
        assert np.abs(A.T @ e).max() < 1e-6 * np.linalg.norm(A, axis=0).max() * np.linalg.norm(e)


def test_a_wrong_start_is_survived() -> None:
    sim = simulate(5, 4)
    R = Rotation.from_rotvec(np.random.default_rng(0).normal(size=(20, 3)) * 0.5).as_matrix() @ sim.rotations
    good = minimize(sim.network)
    assert omega_of(minimize(sim.network, (R, sim.translations + 5.0))) == pytest.approx(omega_of(good), rel=1e-9)


@pytest.mark.parametrize("rotations_only", [False, True])
def test_covariances_and_statistics_equal_dense_algebra(rotations_only: bool) -> None:
    sim = simulate(5, 3, extra=6, sigma_rad=0.01, sigma_m=0.1, rotations_only=rotations_only)
    used = np.ones(sim.network.n_pairs, dtype=bool)
    used[[2, 7]] = False
    net = sim.network.with_used(used)
    solution = solve_network(net)
    d, here = net.dim, motions_of(solution)
    A = dense(net, here)[:, d:]
    Q = np.zeros((net.n_stations * d,) * 2)
    Q[d:, d:] = np.linalg.inv(A.T @ A)
    P = solution
    for i in range(net.n_stations):
        assert P.station_cov[i] == pytest.approx(Q[i * d : i * d + d, i * d : i * d + d], rel=1e-7, abs=1e-14)
    apart = [1, 14, 7, 0]
    rows = np.concatenate([np.arange(i * d, i * d + d) for i in apart])
    assert P.joint(apart) == pytest.approx(Q[np.ix_(rows, rows)], rel=1e-6, abs=1e-13)
    rows = np.flatnonzero(used)
    uncontrolled = rows[loop_labels(net.n_stations, net.a_idx[rows], net.b_idx[rows]) == 0]
    everything = dense(net.with_used(np.ones_like(used)), here)
    e = np.einsum("nij,nj->ni", net.whitening, network_jacobians(net, here)[0])
    for k in range(net.n_pairs):
        J = everything[k * d : k * d + d]
        M = J @ Q @ J.T
        Qvv = np.eye(d) - M if used[k] else np.eye(d) + M
        if k in uncontrolled:
            assert P.pairs.freedom[k] == 0
        else:
            assert P.pairs.test[k] == pytest.approx(e[k] @ np.linalg.solve(Qvv, e[k]), rel=1e-6)
        assert P.pairs.redundancy[k] == pytest.approx(np.diag(Qvv) if used[k] else np.zeros(d), abs=1e-8)
        a, b = net.a_idx[k], net.b_idx[k]
        _, own = P.relative(*(net.station_ids[i] for i in (a, b)))
        assert P.pairs.adjusted_cov[k] == pytest.approx(own, rel=1e-7, abs=1e-14)
    assert P.pairs.redundancy.sum() == pytest.approx(solution.redundancy, abs=1e-7)


def test_inner_datum_is_the_pseudo_inverse_and_relative_precision_does_not_depend_on_it() -> None:
    sim = simulate(4, 3, extra=4, free=True, sigma_rad=0.01, sigma_m=0.1)
    net = sim.network
    free = solve_network(net)
    A = dense(net, motions_of(free))
    Q = np.linalg.pinv(A.T @ A, rcond=1e-13, hermitian=True)
    assert free.station_cov[5] == pytest.approx(Q[30:36, 30:36], rel=1e-6, abs=1e-12)
    assert free.station_cov[0] == pytest.approx(Q[:6, :6], rel=1e-6, abs=1e-12)
    rows = np.r_[6:12, 60:66]
    assert free.joint([1, 10]) == pytest.approx(Q[np.ix_(rows, rows)], rel=1e-6, abs=1e-12)
    held = solve_network(
        pose_network(net.station_ids, net.pair_ids, net.a_idx, net.b_idx, net.rotations, net.translations, net.cov,
                     held={7: np.eye(4)}),
    )  # fmt: skip
    assert held.omega == pytest.approx(free.omega, rel=1e-10)
    for one, other in zip(held.relative("s1", "s10"), free.relative("s1", "s10"), strict=True):
        assert one == pytest.approx(other, rel=1e-6, abs=1e-9)


def test_covariances_that_are_brought_together_are_those_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    precision = solve_network(simulate(15, 4, extra=3).network).precision
    tree, by_key, rng = precision.tree, precision.unknowns.by_key, np.random.default_rng(0)
    keys = list(tree.places())
    pairs = [(keys[i], keys[j]) for i, j in rng.integers(0, len(keys), (60, 2)).tolist() if i != j]
    names = [(by_key[a].name, by_key[b].name) for a, b in pairs]
    each, turned = ([precision.joint(pair[::way]) for pair in names] for way in (1, -1))
    precision.bring_together(names)
    monkeypatch.setattr(tree, "among", None)  # no way of its own is left to take
    monkeypatch.setattr(tree, "full", None)
    together = [precision.joint(pair) for pair in names]
    monkeypatch.undo()
    whole = tree.full()
    for pair, alone, back, found in zip(pairs, each, turned, together, strict=True):
        rows = np.concatenate([np.arange(len(whole))[tree.places()[key]] for key in pair])
        for Q in (alone, found, back[np.ix_(*[np.roll(np.arange(12), 6)] * 2)]):
            np.testing.assert_allclose(Q, whole[np.ix_(rows, rows)], rtol=1e-9, atol=1e-12 * np.abs(whole).max())


def test_covariance_equals_the_scatter_of_repeated_networks() -> None:
    total, n = 0.0, 0
    for seed in range(40):
        sim = simulate(4, 3, seed=seed)
        solution = solve_network(sim.network)
        error = (Motions(sim.rotations, sim.translations).inverse() @ motions_of(solution)).log()
        last = error[-1]
        total, n = total + last @ np.linalg.solve(solution.station_cov[-1], last), n + 6
    assert chi2.ppf(1e-4, n) < total < chi2.ppf(1 - 1e-4, n)


@pytest.mark.slow
def test_wrong_pairs_are_found_and_named_in_a_small_network() -> None:
    for seed in range(6):
        sim = simulate(6, 5, seed=seed, wrong=3, extra=25)
        result = screened(sim.network)
        assert left_out(result) == set(sim.wrong)
        clean = solve_network(sim.network.with_used(~np.isin(sim.network.pair_ids, sim.wrong)))
        assert result.omega == pytest.approx(clean.omega, rel=1e-9)
        assert result.omega < chi2.isf(1e-4, result.redundancy)
        assert solve_network(sim.network).omega > 100 * result.omega


def test_sigmas_that_are_too_small_throughout_make_no_pair_wrong() -> None:
    net = simulate(6, 5, seed=4, extra=25).network
    bold = pose_network(net.station_ids, net.pair_ids, net.a_idx, net.b_idx, net.rotations, net.translations,
                        net.cov / 25.0, held={0: np.eye(4)})  # fmt: skip
    result = screened(bold)
    assert not left_out(result)
    assert result.sigma0 == pytest.approx(5.0, rel=0.2)


def _with_sigmas(net: PoseNetwork, factor: float, **changes: FloatArray) -> PoseNetwork:
    """The network with sigmas that are given ``factor`` times as large."""
    return pose_network(net.station_ids, net.pair_ids, net.a_idx, net.b_idx, net.rotations,
                        changes.get("translations", net.translations), net.cov * factor**2,
                        held={0: np.eye(4)})  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_sigmas_that_are_too_small_throughout_make_no_pair_of_a_few_wrong(seed: int) -> None:
    net = simulate(3, 2, seed=seed, extra=9).network
    assert net.n_pairs < 20
    result = screened(_with_sigmas(net, 0.2))
    assert not left_out(result)
    assert result.sigma0 == pytest.approx(5.0, rel=0.4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
def test_a_wrong_pair_of_a_few_is_found_with_sigmas_right_and_too_small(seed: int) -> None:
    sim = simulate(3, 2, seed=seed, extra=9, wrong=1)
    for factor in (1.0, 0.2):
        assert left_out(screened(_with_sigmas(sim.network, factor))) == set(sim.wrong)


def test_nothing_is_rejected_where_residuals_are_far_smaller_than_their_sigmas() -> None:
    net = simulate(6, 5, seed=4, extra=25).network
    moved = net.translations.copy()
    moved[60, 0] += 10.0 * np.sqrt(net.cov[60, 3, 3]) * 7.0
    timid = _with_sigmas(net, 10.0, translations=moved)
    result = screened(timid)
    assert result.sigma0 < 0.5
    assert result.other_residuals[60].test > 30.0  # far beyond the limit of a single test
    assert not left_out(result)
    # the same pair with sigmas that are right
    assert left_out(screened(_with_sigmas(net, 1.0, translations=moved))) == {net.pair_ids[60]}


def test_wrong_turns_are_found_among_rotations() -> None:
    sim = simulate(6, 5, seed=2, wrong=3, extra=25, rotations_only=True)
    result = screened(sim.network)
    assert left_out(result) == set(sim.wrong)
    assert sum(w.startswith("left out: pair ") and "deg" in w for w in result.warnings) == len(sim.wrong)


@pytest.mark.slow
def test_false_alarms_stay_at_their_rate() -> None:
    alarms = sum(bool(left_out(screened(simulate(4, 3, seed=s, extra=8).network))) for s in range(100, 220))
    # alpha = 0.001 a network: 0.12 expected in 120
    assert alarms <= 2


def test_a_wrong_pair_that_cannot_be_told_from_its_neighbour_says_so() -> None:
    R = np.tile(np.eye(3), (4, 1, 1))
    t = np.tile([1.0, 0, 0], (4, 1))
    t[3] = [-3.0, 0.5, 0.0]
    ids = ["ab", "bc", "cd", "da"]
    net = pose_network("abcd", ids, [1, 2, 3, 0], [0, 1, 2, 3], R, t, np.tile(np.eye(6) * 1e-6, (4, 1, 1)),
                       held={0: np.eye(4)})  # fmt: skip
    result = screened(net)
    (wrong,) = left_out(result)
    told = " ".join(w for w in result.warnings if w.startswith("either "))
    assert all(i in told for i in set(ids) - {wrong})


def test_loop_labels_name_bridges() -> None:
    mark = loop_labels(4, np.array([0, 1, 2, 2]), np.array([1, 2, 0, 3]))
    assert (mark != 0).tolist() == [1, 1, 1, 0]
    assert len(set(mark[:3])) == 1


@pytest.mark.parametrize(("n", "pairs"), [(1, 0), (7, 0), (60, 40), (300, 280), (300, 900)])
def test_connected_parts_are_those_of_scipy(n: int, pairs: int) -> None:
    a, b = np.random.default_rng(n + pairs).integers(0, n, (2, pairs))
    joined = coo_array((np.ones(pairs), (a, b)), shape=(n, n))
    assert connected_parts(n, a, b).tolist() == connected_components(joined, directed=False)[1].tolist()


@pytest.mark.parametrize("rotations_only", [False, True])
def test_a_start_with_weights_of_any_spread(rotations_only: bool) -> None:
    sim = simulate(5, 4, rotations_only=rotations_only, sigma_rad=1e-9, sigma_m=1e-9)
    net = sim.network
    spread = 10.0 ** np.random.default_rng(3).uniform(-9.0, 9.0, net.n_pairs)
    R, t = find_network_start(replace(net, arrays=replace(net.arrays, cov=net.cov / spread[:, None, None])))
    assert pytest.approx(sim.rotations, abs=1e-7) == R
    if not rotations_only:
        assert pytest.approx(sim.translations, abs=1e-6) == t
    cut = net.with_used((net.a_idx != 7) & (net.b_idx != 7))  # is tied to nothing, and stays where it is
    assert np.delete(find_network_start(cut)[0], 7, 0) == pytest.approx(np.delete(sim.rotations, 7, 0))


def test_what_floats_is_named() -> None:
    sim = simulate(3, 2)
    net = sim.network
    cut = net.with_used((net.a_idx != 5) & (net.b_idx != 5))
    with pytest.raises(IndeterminateError, match="s5"):
        solve_network(cut)
    t = net.translations.copy()
    t[(net.a_idx == 5) | (net.b_idx == 5)] = np.nan
    half = pose_network(net.station_ids, net.pair_ids, net.a_idx, net.b_idx, net.rotations, t, net.cov,
                        held={0: np.eye(4)})  # fmt: skip
    with pytest.raises(IndeterminateError, match="the position of s5"):
        solve_network(half)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"a_idx": [0, 9]}, "'p1' names a station that does not exist"),
        ({"b_idx": [1, 1]}, "'p1' joins a station with itself"),
        ({"rotations": np.array([np.eye(3), -np.eye(3)])}, "'p1' has a matrix that is no rotation"),
        ({"cov": np.array([np.eye(6), np.diag([1.0, 1, 1, 1, 1, -1])])}, "'p1' has a covariance"),
        ({"cov": np.array([np.eye(6), np.full((6, 6), np.nan)])}, "'p1' has a covariance"),
        ({"pair_ids": ["p0", "p0"]}, "'p0' occurs twice"),
    ],
)
def test_wrong_arrays_are_refused_by_name(change: dict, message: str) -> None:
    good = {
        "station_ids": ["a", "b"], "pair_ids": ["p0", "p1"], "a_idx": [0, 1], "b_idx": [1, 0],
        "rotations": np.tile(np.eye(3), (2, 1, 1)), "translations": np.zeros((2, 3)),
        "cov": np.tile(np.eye(6), (2, 1, 1)),
    }  # fmt: skip
    pose_network(**good, held={0: np.eye(4)})
    with pytest.raises(SurveyError, match=message):
        pose_network(**{**good, **change}, held={0: np.eye(4)})


def survey_of(sim, inner: bool) -> Survey:
    net = sim.network
    first = Pose3(Rot3(sim.rotations[0]), sim.translations[0])
    mean = Pose3(Rot3(sim.rotations[7]), sim.translations[7])
    known = {} if inner else {
        0: PoseParameter(first, "held"), 7: PoseParameter(mean, "prior", np.diag([1e-2] * 3 + [0.01] * 3) ** 2)
    }
    stations = tuple(Station(s, "fixed", known.get(i, PoseParameter())) for i, s in enumerate(net.station_ids))
    pairs = []
    for e, p in enumerate(net.pair_ids):
        a, b = (FrameRef("station", net.station_ids[i[e]]) for i in (net.a_idx, net.b_idx))
        full = e % 7 > 0
        motion = Pose3(Rot3(net.rotations[e]), net.translations[e]) if full else Rot3(net.rotations[e])
        pairs.append(Pair(p, a, b, motion, net.cov[e] if full else net.cov[e][:3, :3], used=e != 5))
    return Survey(stations=stations, pairs=tuple(pairs), datum=Datum("inner") if inner else Datum())


@pytest.mark.parametrize("inner", [False, True])
def test_a_survey_of_pairs_is_adjusted_alike_both_ways(inner: bool) -> None:
    survey = survey_of(simulate(5, 4, extra=6, sigma_rad=0.01, sigma_m=0.1), inner)
    network = adjust_cleaned(survey, CleanOptions(reject_pairs=False))
    # a point that nothing observes makes it no network any more
    beside = replace(survey, points=(Point("B", PointParameter(np.zeros(3), "held")),))
    general = adjust(beside, values_of(network) if inner else None)
    assert network_of_pairs(general.survey) is None
    assert network.omega == pytest.approx(general.omega, rel=1e-9)
    for field in ("n_observations", "n_unknowns", "datum_defect", "redundancy"):
        assert getattr(network, field) == getattr(general, field)
    for name in network.estimates:
        estimate = general.estimates[name]
        assert network.estimates[name].value.matrix() == pytest.approx(estimate.value.matrix(), abs=1e-6)
        assert network.estimates[name].cov == pytest.approx(estimate.cov, rel=1e-5, abs=1e-12)
    for ours, theirs in zip(network.other_residuals, general.other_residuals, strict=True):
        assert ours.ids == theirs.ids
        for field in ("observed", "adjusted", "residual", "sigma", "redundancy", "standardized", "test"):
            assert getattr(ours, field) == pytest.approx(getattr(theirs, field), rel=1e-5, abs=1e-6, nan_ok=True)
    names = [("world_from_station", "s3"), ("world_from_station", "s12")]
    assert network.precision.joint(names) == pytest.approx(general.precision.joint(names), rel=1e-5, abs=1e-12)


def test_a_survey_of_pairs_starts_from_nothing_where_a_spanning_tree_fails() -> None:
    sim = simulate(12, 10, sigma_rad=0.05, sigma_m=0.3, wrong=0)
    net = sim.network
    stations = tuple(Station(s, "fixed", PoseParameter(Pose3(), "held") if i == 0 else PoseParameter())
                     for i, s in enumerate(net.station_ids))  # fmt: skip
    pairs = tuple(
        Pair(p, FrameRef("station", net.station_ids[net.a_idx[e]]), FrameRef("station", net.station_ids[net.b_idx[e]]),
             Pose3(Rot3(net.rotations[e]), net.translations[e]), net.cov[e])
        for e, p in enumerate(net.pair_ids)
    )  # fmt: skip
    general = adjust(Survey(stations=stations, pairs=pairs))
    assert general.omega == pytest.approx(solve_network(net).omega, rel=1e-8)
    assert general.iterations <= 8
    with pytest.raises(IndeterminateError, match="datum"):
        network_from_survey(Survey(stations=tuple(Station(s.station_id) for s in stations), pairs=pairs))


def test_chordal_cost_by_hand_and_its_minimum_against_gtsam() -> None:
    sim = simulate(4, 3, sigma_rad=0.05, sigma_m=0.3)
    net = sim.network
    R, t = sim.rotations, sim.translations
    expected = 0.0
    for e in range(net.n_pairs):
        info = np.linalg.inv(net.cov[e])
        kappa, tau = 1.5 / np.trace(np.linalg.inv(info[:3, :3])), 3.0 / np.trace(np.linalg.inv(info[3:, 3:]))
        i, j = net.b_idx[e], net.a_idx[e]
        expected += kappa * np.sum((R[j] - R[i] @ net.rotations[e]) ** 2)
        expected += tau * np.sum((t[j] - t[i] - R[i] @ net.translations[e]) ** 2)
    assert chordal_cost(net, R, t) == pytest.approx(expected, rel=1e-12)
    found = minimize_chordal(net)
    assert found.cost < expected
    rng = np.random.default_rng(0)
    for _ in range(20):  # no way down from there
        dR = Rotation.from_rotvec(rng.normal(size=(12, 3)) * 1e-4).as_matrix()
        t = found.translations + rng.normal(size=(12, 3)) * 1e-4
        assert chordal_cost(net, found.rotations @ dR, t) > found.cost


def test_our_least_squares_equals_gtsams_optimiser() -> None:
    sim = simulate(4, 3)
    net = sim.network
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for e in range(net.n_pairs):
        noise = gtsam.noiseModel.Gaussian.Covariance(net.cov[e])
        z = Pose3(Rot3(net.rotations[e]), net.translations[e])
        graph.add(gtsam.BetweenFactorPose3(int(net.b_idx[e]), int(net.a_idx[e]), z, noise))
    for i in range(net.n_stations):
        values.insert(i, Pose3(Rot3(sim.rotations[i]), sim.translations[i]))
    graph.add(gtsam.NonlinearEqualityPose3(0, values.atPose3(0)))
    theirs = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
    ours = solve_network(net)
    assert ours.omega == pytest.approx(2 * graph.error(theirs), rel=1e-6)
    for i, s in enumerate(net.station_ids):
        assert theirs.atPose3(i).matrix() == pytest.approx(ours.pose(s).matrix(), abs=1e-4)


def test_a_place_without_a_step_on_the_way_is_no_verdict_on_the_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step that cannot be taken is damped from the best place; only at the start it speaks of what is measured."""
    sim = simulate(4, 3)
    plain, step, calls = minimize(sim.network), _Loop.step, []

    def failing(loop: _Loop) -> gtsam.VectorValues:
        calls.append(loop.damping)
        if len(calls) == at:
            raise IndeterminateError("the normal equations have no solution here")
        return step(loop)

    monkeypatch.setattr(_Loop, "step", failing)
    at = 2
    found = minimize(sim.network)
    assert omega_of(found) == pytest.approx(omega_of(plain), rel=1e-9)
    assert calls[2] > 0.0
    at, calls[:] = 1, []
    with pytest.raises(IndeterminateError):
        minimize(sim.network)


@pytest.mark.parametrize("rotations_only", [False, True])
def test_following_only_what_fails_finds_what_following_all_does(
    rotations_only: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    sim = simulate(6, 5, seed=1, wrong=2, extra=25, rotations_only=rotations_only)
    every = screened(sim.network)
    monkeypatch.setattr("adjust.statistics.outliers.watched._LARGE", 0.0)
    made = []
    monkeypatch.setattr("adjust.statistics.outliers.round.WatchedSnooping",
                        lambda *a: made.append(WatchedSnooping(*a)) or made[-1])  # fmt: skip
    few = screened(sim.network)
    assert left_out(few) == left_out(every) == set(sim.wrong)
    assert few.omega == pytest.approx(every.omega, rel=1e-9)
    assert 0 < len(made[-1].used) < sim.network.n_pairs
    assert [w for w in few.warnings if w.startswith("left out")] == [
        w for w in every.warnings if w.startswith("left out")]  # fmt: skip


def test_tests_of_what_is_followed_are_those_of_all() -> None:
    survey = survey_of_network(simulate(4, 3, seed=3, extra=8).network)
    pairs = tuple(replace(p, used=i not in (2, 9)) for i, p in enumerate(survey.pairs))
    now = adjust(replace(survey, pairs=pairs))  # two that the survey uses are out for now
    given = np.ones(len(pairs), dtype=bool)
    system = replace(condensed_system(now.precision).system, used=given)
    every, index = Snooping(system, given), np.array([1, 2, 5, 9, 12])
    few = WatchedSnooping(now, index, given)
    for out in ([], [1], [1, 3]):
        states = [s.using(~np.isin(np.arange(len(s.used)), at)) for s, at in ((every, index[out]), (few, out))]
        theirs, mine = (s.tests() for s in states)
        assert mine.statistic == pytest.approx(theirs.statistic[index], rel=1e-6)
        assert mine.freedom.tolist() == theirs.freedom[index].tolist()
        assert states[1].omega == pytest.approx(states[0].omega, rel=1e-9)
        assert states[1].left == states[0].left
        for i, o in enumerate(index.tolist()):
            assert states[1].verdict(i) == pytest.approx(states[0].verdict(o), rel=1e-6)
    both = every, WatchedSnooping(now, np.arange(len(pairs)), given)
    squares = [s.robust_squares(np.full(len(pairs), 6), np.ones(1)) for s in both]
    assert squares[1] == pytest.approx(squares[0], rel=0.02)  # they end where weights change by less than 0.01
