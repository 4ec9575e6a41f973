"""Corridors of thousands of stations, where the normal matrix has no digits left for the far end."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.pair_normals import PairLinear, PairNormals
from adjust.graph.solver import SolveOptions, solve
from adjust.model.errors import IndeterminateError
from adjust.model.survey import PoseParameter, Survey
from adjust.native.elimination import PoseFactor
from adjust.native.pairs import compose_poses
from adjust.observations import pairs as pairs_module
from adjust.pose_network.solve import minimize
from adjust.precision.precision import precision_of
from adjust.spatial.rigid_motions import Motions, exp
from tests.adjust import pose_networks
from tests.adjust.pose_networks import omega_of, pose_network, solve_network
from tests.adjust.test_pair_normals import of_network


def system(graph: AdjustmentGraph) -> tuple[PairNormals, PairLinear]:
    normals = PairNormals(graph, [])
    return normals, normals.linearized(graph.prepare(graph.start, True))


@pytest.mark.parametrize(("nx", "extra"), [(1, 1), (3, 3), (20, 20), (40, 240)])
def test_reflections_of_the_rows_give_the_factor_of_the_normal_matrix(nx: int, extra: int) -> None:
    """Of networks with enough digits in either, also with what is known of single poses."""
    normals, plain = system(of_network(5, nx, extra))
    rng = np.random.default_rng(nx)
    own = np.zeros_like(plain.own)
    some = rng.normal(size=(len(own[::3]), 6, 6))
    own[::3] = np.swapaxes(some, 1, 2) @ some
    own[0] = np.diag([4.0, 0.0, 0.0, 9.0, 0.0, 1.0])
    for known in (plain.own, own):
        rows = normals.b, normals.a, plain.by_b, plain.by_a, known
        assert normals.factor.eliminate(*rows) == -1
        expected = normals.factor.data.copy()
        normals.factor.data[:] = np.nan
        assert normals.factor.eliminate_rows(*rows) == -1
        np.testing.assert_allclose(normals.factor.data, expected, rtol=1e-7, atol=1e-8 * np.abs(expected).max())


def test_a_pose_that_nothing_tells_of_is_without_a_pivot_in_rows() -> None:
    normals, linear = system(of_network(1))
    linear.by_b[normals.b == 7], linear.by_a[normals.a == 7] = 0.0, 0.0
    assert normals.factor.eliminate_rows(normals.b, normals.a, linear.by_b, linear.by_a, linear.own) == 7


def test_where_cholesky_refuses_what_is_only_compared_does_without_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take ten times as long: a comparison says that there was no time for them."""
    graph, asked = of_network(1), list[int]()
    rough, exact = PairNormals(graph, [], exact=False), PairNormals(graph, [])
    linear = rough.linearized(graph.prepare(graph.start, True))
    linear.by_b[rough.b == 7], linear.by_a[rough.a == 7] = 0.0, 0.0
    monkeypatch.setattr(PoseFactor, "eliminate_rows", lambda *_: asked.append(1) or 7)
    assert exact.solution(linear) is None
    assert asked == [1]
    with pytest.raises(IndeterminateError, match="too few digits"):
        rough.solution(linear)
    assert asked == [1]


def test_a_survey_that_is_only_compared_has_its_rows_unless_it_does_without(monkeypatch: pytest.MonkeyPatch) -> None:
    graph = of_network(1)
    expected = solve(graph, SolveOptions(determined=True)).omega
    monkeypatch.setattr(PoseFactor, "eliminate", lambda *_: 0)
    assert solve(graph, SolveOptions(determined=True, settled=1e-9)).omega == pytest.approx(expected, rel=1e-6)
    with pytest.raises(IndeterminateError, match="too few digits"):
        solve(graph, SolveOptions(determined=True, settled=1e-9, exact=False))


def test_the_clique_after_all_below_it_beside_each_other() -> None:
    pattern = system(of_network(2, 12))[0].factor.pattern
    order, parents = pattern.leaves_first.tolist(), pattern.parents.tolist()
    assert sorted(order) == list(range(len(parents)))
    waiting = list[int]()
    for c in order:
        below = {i for i, p in enumerate(parents) if p == c}
        assert set(waiting[len(waiting) - len(below) :]) == below
        waiting = [*waiting[: len(waiting) - len(below)], c]


def test_rows_are_eliminated_where_the_normal_matrix_has_no_pivot() -> None:
    """Two stations tied to each other 1e11 times as firmly as to what is held: Cholesky's last pivot is rounding."""
    loose, firm = np.diag([1e-3] * 3 + [1e-2] * 3) ** 2, np.diag([1e-14] * 3 + [1e-13] * 3) ** 2
    b, a = np.array([1, 1, 2, 2]), np.array([0, 0, 1, 1])
    network = pose_network(("s0", "s1", "s2"), ("p0", "p1", "p2", "p3"), b, a, np.tile(np.eye(3), (4, 1, 1)),
                           np.zeros((4, 3)), np.array([loose, loose, firm, firm]), held={0: np.eye(4)})  # fmt: skip
    solved = minimize(network)
    normals, linear = system(solved.graph)
    assert normals.factor.eliminate(normals.b, normals.a, linear.by_b, linear.by_a, linear.own) >= 0
    assert normals.solution(linear) is not None
    np.testing.assert_allclose(solve_network(network).joint([2]), loose / 2.0, atol=1e-16)


@pytest.mark.slow
def test_the_far_end_of_a_chain_has_the_sigmas_that_its_pairs_add_up_to() -> None:
    """Each pair measured twice: half of the sum of their covariances, carried to the end; Cholesky loses 8e-5 of it."""
    rng, n = np.random.default_rng(4), 6000
    motions = exp(np.c_[rng.normal(size=(n - 1, 3)) * 0.02, 10.0 + rng.normal(size=(n - 1, 1)), np.zeros((n - 1, 2))])
    sigmas = np.r_[np.full(3, 1e-3), np.full(3, 1e-2)]
    twice = Motions(*(np.tile(x, (2, *[1] * (x.ndim - 1))) for x in (motions.rotation, motions.shifts)))
    seen = twice @ exp(rng.normal(size=(2 * (n - 1), 6)) * sigmas)
    ids, first = tuple(f"s{i}" for i in range(n)), np.tile(np.arange(n - 1), 2)
    names, cov = tuple(f"p{i}" for i in range(2 * (n - 1))), np.tile(np.diag(sigmas**2), (2 * (n - 1), 1, 1))
    network = pose_network(ids, names, first + 1, first, seen.rotation, seen.shifts, cov, held={0: np.eye(4)})
    solved = solve_network(network)
    poses = solved.world_from_station
    # of a_from_b = before_from_after the error stands in the frame after it; to the end from there
    last = poses[np.array([n - 1])].inverse()
    to_end = Motions(np.repeat(last.rotation, n - 1, 0), np.repeat(last.shifts, n - 1, 0)) @ poses[np.arange(1, n)]
    A = to_end.adjoint()
    expected = (A @ np.diag(sigmas**2 / 2.0) @ np.swapaxes(A, 1, 2)).sum(axis=0)
    found = solved.joint([n - 1])
    unit = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(unit, unit), expected / np.outer(unit, unit), atol=5e-6)


def test_a_corridor_that_bends_turns_and_shifts_every_pair_by_its_share() -> None:
    """By some thousandths of a radian each, which add up; moved each for itself, poses end up apart by far more."""
    graph, rng = of_network(7, 60, extra=0), np.random.default_rng(0)
    normals = PairNormals(graph, [])
    keys, order, parent = (tree := normals.bending).keys, tree.order, tree.parent
    before = Motions.of(np.array([graph.start.atPose3(k).matrix() for k in keys]))
    share, x, delta = rng.normal(size=(len(keys), 6)) * 3e-3, np.zeros((len(keys), 6)), gtsam.VectorValues()
    below = np.flatnonzero(parent >= 0)
    pairs = before[parent[below]].inverse() @ before[below]
    carried = dict(zip(below.tolist(), pairs.inverse().adjoint(), strict=True))
    for i in order.tolist():
        x[i] = share[i] + (carried[i] @ x[parent[i]] if parent[i] >= 0 else 0.0)
        delta.insert(keys[i], x[i])
    assert np.abs(x[:, :3]).max() > 20 * 3e-3
    aside = graph.start.retract(delta)
    bent, straight = (Motions.of(np.array([values.atPose3(k).matrix() for k in keys]))
                      for values in (tree.bent(graph.start, delta, aside), aside))  # fmt: skip
    expected = (pairs @ exp(share[below])).matrices()
    np.testing.assert_allclose((bent[parent[below]].inverse() @ bent[below]).matrices(), expected, atol=1e-9)
    assert np.abs((straight[parent[below]].inverse() @ straight[below]).matrices() - expected).max() > 1e-3


def test_rotations_stay_so_along_thousands_of_pairs() -> None:
    rng, n = np.random.default_rng(0), 20_000
    each = exp(np.c_[rng.normal(size=(n, 3)), np.zeros((n, 3))])
    R, t = each.rotation.copy(), np.ones((n, 3))
    compose_poses(np.arange(n), np.arange(n) - 1, R, t)
    np.testing.assert_allclose(np.swapaxes(R, 1, 2) @ R, np.broadcast_to(np.eye(3), R.shape), atol=1e-15)
    first, second, third = each.rotation[:3]
    np.testing.assert_allclose(R[2], first @ second @ third, atol=1e-14)
    np.testing.assert_allclose(t[2], 1.0 + first @ (1.0 + second @ np.ones(3)), atol=1e-14)


def ends_held(nx: int, held: int) -> Survey:
    survey = pose_networks.simulate(nx, 2).network.as_survey
    place = replace(survey.stations[0].world_from_station, treatment="held")
    stations = [replace(s, world_from_station=PoseParameter()) for s in survey.stations]
    stations[held] = replace(stations[held], world_from_station=place)
    return replace(survey, stations=tuple(stations))


def test_pairs_too_far_from_the_datum_are_not_tested_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairs_module, "MOST_ROUNDING", 1e-10)
    result = adjust(ends_held(300, 0))
    far, residuals = precision_of(result).pairs.too_far, result.other_residuals
    assert far[-200:].all()
    assert not far[:200].any()
    assert [bool(np.isnan(o.test)) for o in residuals] == far.tolist()
    assert np.isnan(residuals[-1].standardized).all()
    assert any(w.startswith(f"{far.sum()} of {len(far)} pairs are not tested") for w in result.warnings)


@pytest.mark.slow
def test_tests_of_pairs_are_as_good_as_their_rounding_says() -> None:
    """They do not depend on the datum: held at the near end, and at the far one, where the same digits are there."""
    near, far = (precision_of(adjust(ends_held(8000, end))).pairs for end in (0, -1))
    assert not near.too_far.any()
    np.testing.assert_allclose(near.redundancy, far.redundancy, rtol=0.0, atol=0.1 * pairs_module.MOST_ROUNDING)
    np.testing.assert_allclose(near.test, far.test, rtol=2e-3)


@pytest.mark.slow
def test_a_long_corridor_is_solved_in_few_steps_from_wherever_it_begins() -> None:
    network = pose_networks.simulate(4000, 2).network
    cold = minimize(network)
    assert cold.solved.iterations <= 5
    sigma, rng = np.array([1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 1e-2]), np.random.default_rng(1)
    shaken = Motions(cold.rotations, cold.translations) @ exp(rng.normal(size=(network.n_stations, 6)) * sigma)
    warm = minimize(network, (shaken.rotation, shaken.shifts))
    assert warm.solved.iterations <= 5
    assert omega_of(warm) == pytest.approx(omega_of(cold), rel=1e-9)
