from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import IndeterminateError, NotConvergedError, SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import Datum, PoseParameter, Station, Survey
from adjust.pose_network import loops as loops_module
from adjust.pose_network.loops import evaluate_loops, loop_vectors, misclosures
from adjust.relay.conditions import MAX_HARD_LOOPS, ConditionOptions, adjust_condition_factors, adjust_conditions
from adjust.relay.loops import loop_basis, loop_misclosures
from adjust.relay.network import MeasuredPairs, network_from_pairs, topology
from adjust.spatial.rigid_motions import Motions
from tests.adjust.relay_networks import (
    ARCMIN,
    as_gtsam,
    chain_with_chords,
    complete,
    differences,
    ends,
    grid,
    motions,
    pairs_of,
    simulate,
    suspects,
)
from tests.adjust.relay_parametric import adjust_parametric

NETWORKS = {"complete": complete(7), "grid": grid(4, 5), "chain": chain_with_chords(12, 9)}


def forms(network):
    """Every way to the same solution."""
    yield adjust_parametric(network).pairs
    for loops in ("shortest", "tree"):
        yield adjust_conditions(network, ConditionOptions(loops=loops)).pairs
    yield adjust_condition_factors(network).pairs


def turned(pairs, other):
    return np.abs((pairs.b_from_a.inverse() @ other.b_from_a).log()).max()


# -- closed forms ------------------------------------------------------------------------------------------------------


def test_equal_triangle_shares_its_misclosure_by_thirds():
    top, angle = complete(3), 30 * ARCMIN
    about_z = [0.3, 0.5 + angle, 0.2]  # C1-C2, C1-C3, C2-C3: the loop misses by minus the angle
    measured = Motions(np.array([Rot3.Rz(a).matrix() for a in about_z]))
    cov = np.broadcast_to(np.eye(3) * ARCMIN**2, (3, 3, 3))
    for pairs in forms(MeasuredPairs(top, measured, cov)):
        expected = np.zeros((3, 3))
        expected[:, 2] = np.array([1, -1, 1]) * angle / 3
        np.testing.assert_allclose(pairs.residual, expected, atol=1e-14)
        # two thirds of the variance are left, one third is redundant, all of it about every axis
        # the tangents turn with the residuals of 10', in second order
        np.testing.assert_allclose(pairs.cov, cov * 2 / 3, rtol=1e-5, atol=1e-15)
        np.testing.assert_allclose(pairs.redundancy, 1 / 3, rtol=1e-6)
        assert pairs.omega == pytest.approx((angle / ARCMIN) ** 2 / 3)
        np.testing.assert_allclose(pairs.test, (angle / ARCMIN) ** 2 / 3, rtol=1e-5)
        assert pairs.redundancy_total == 3


def test_two_parallel_pairs_give_their_weighted_mean():
    top = topology([("weak", "A", "B"), ("strong", "A", "B")])
    measured = Motions(np.array([Rot3.Rx(0.0).matrix(), Rot3.Rx(0.004).matrix()]))
    cov = np.array([np.eye(3) * 3e-6, np.eye(3) * 1e-6])
    for pairs in forms(MeasuredPairs(top, measured, cov)):
        np.testing.assert_allclose(pairs.residual[:, 0], [0.003, -0.001], atol=1e-14)
        np.testing.assert_allclose(pairs.cov, np.broadcast_to(np.eye(3) * 0.75e-6, (2, 3, 3)), rtol=1e-4, atol=1e-15)


# -- the two forms -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("dim", [3, 6])
@pytest.mark.parametrize("name", NETWORKS)
def test_all_forms_agree(name, dim):
    network = simulate(NETWORKS[name], dim, seed=4).network
    reference, *others = forms(network)
    for other in others:
        assert turned(reference, other) < 1e-10
        np.testing.assert_allclose(other.cov, reference.cov, atol=1e-9 * np.abs(reference.cov).max())
        np.testing.assert_allclose(other.redundancy, reference.redundancy, atol=1e-9)
        np.testing.assert_allclose(other.test, reference.test, rtol=1e-6)
        assert other.omega == pytest.approx(reference.omega, rel=1e-9)
        some = [0, 5, 2]
        np.testing.assert_allclose(other.joint(some), reference.joint(some), atol=1e-9 * np.abs(reference.cov).max())
    assert reference.redundancy.sum() == pytest.approx(reference.redundancy_total, abs=1e-8)
    assert reference.redundancy_total == dim * len(loop_basis(network.topology))


def dense_linear(simulated):
    """Adjusted covariance by the stations' design matrix written out with GTSAM's adjoints, at the truth."""
    top, dim = simulated.network.topology, simulated.network.dim
    A = np.zeros((top.n_pairs * dim, top.n_stations * dim))
    weight = np.zeros((top.n_pairs * dim,) * 2)
    for e, (a, b) in enumerate(zip(top.a_idx, top.b_idx, strict=True)):
        rows = slice(dim * e, dim * e + dim)
        back = simulated.true[e].inverse()
        A[rows, dim * a : dim * a + dim] = np.eye(dim)
        A[rows, dim * b : dim * b + dim] = -(back.matrix() if dim == 3 else back.AdjointMap())
        weight[rows, rows] = np.linalg.inv(simulated.network.cov[e])
    normal = A[:, dim:].T @ weight @ A[:, dim:]
    return A[:, dim:] @ np.linalg.inv(normal) @ A[:, dim:].T


@pytest.mark.parametrize("dim", [3, 6])
def test_covariances_are_those_of_dense_normal_equations(dim):
    simulated = simulate(NETWORKS["grid"], dim, seed=1, noise=1e-6)
    expected = dense_linear(simulated)
    index = list(range(simulated.network.topology.n_pairs))
    for pairs in forms(simulated.network):
        np.testing.assert_allclose(pairs.joint(index), expected, atol=1e-6 * np.abs(expected).max())
        blocks = expected.reshape(len(index), dim, len(index), dim)[index, :, index, :]
        np.testing.assert_allclose(pairs.cov, blocks, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("dim", [3, 6])
def test_misclosures_and_their_derivatives(dim):
    network = simulate(grid(3, 3), dim, seed=2, noise=100.0).network
    basis = loop_basis(network.topology)
    w, blocks = evaluate_loops(basis, network.b_from_a)
    assert np.abs(w).max() > 0.1  # far from closed
    k, h = 2, 1e-6
    for i in range(basis.ptr[k], basis.ptr[k + 1]):
        e = basis.pair_idx[i]
        for c in range(dim):
            moved = []
            for sign in (h, -h):
                d = np.zeros((network.topology.n_pairs, dim))
                d[e, c] = sign
                moved.append(evaluate_loops(basis, network.b_from_a.retract(d))[0][k])
            np.testing.assert_allclose((moved[0] - moved[1]) / (2 * h), blocks[i][:, c], atol=1e-7)
    # the misclosure itself, walked by GTSAM
    product = Rot3() if dim == 3 else Pose3()
    for i in range(basis.ptr[k], basis.ptr[k + 1]):
        step = as_gtsam(network.b_from_a, int(basis.pair_idx[i]))
        product = (step if basis.sense[i] > 0 else step.inverse()) * product
    np.testing.assert_allclose(w[k], type(product).Logmap(product), atol=1e-12)


@pytest.mark.parametrize("dim", [3, 6])
def test_covariances_of_misclosures_are_those_by_their_derivatives(dim, monkeypatch):
    monkeypatch.setattr(loops_module, "_AT_ONCE", 5)  # several portions, and loops that are longer
    network = simulate(chain_with_chords(15, 9), dim, seed=2, noise=100.0).network
    basis = loop_basis(network.topology, "tree")
    assert basis.lengths.max() > 5
    expected, blocks = evaluate_loops(basis, network.b_from_a)
    for loops in (basis, replace(basis, tree=None)):  # along the tree that they share, and one by one
        w, cov = misclosures(loops, network.b_from_a, network.cov)
        np.testing.assert_allclose(w, expected, atol=1e-12)
        np.testing.assert_array_equal(w, loop_vectors(loops, network.b_from_a))
        for k in range(len(basis)):
            rows = slice(basis.ptr[k], basis.ptr[k + 1])
            C = np.einsum("kij,kjl,kml->im", blocks[rows], network.cov[basis.pair_idx[rows]], blocks[rows])
            np.testing.assert_allclose(cov[k], C, rtol=1e-9, atol=1e-12 * np.abs(C).max())


def test_misclosure_tests_are_chi_square():
    tests = np.concatenate([loop_misclosures(simulate(grid(4, 4), 6, seed=s).network).test for s in range(60)])
    # loops share pairs, so the band is that of about half as many
    low, high = chi2.ppf([0.001, 0.999], 6 * len(tests) / 2)
    assert low < tests.sum() / 2 < high
    assert len(loop_misclosures(simulate(grid(4, 4), 3, seed=0).network).failed()) == 0


# -- datum, relative precision -----------------------------------------------------------------------------------------


def test_pairs_do_not_depend_on_the_datum_and_unmeasured_ones_have_their_covariance():
    simulated = simulate(NETWORKS["grid"], 6, seed=3)
    network, top = simulated.network, simulated.network.topology
    first = adjust_parametric(network)
    other = adjust_parametric(network, held=top.station_ids[7])
    inner = adjust_parametric(network, inner=True)
    for solution in (other, inner):
        assert turned(first.pairs, solution.pairs) < 1e-10
        a, b = (s.pair(top.station_ids[0], top.station_ids[19]) for s in (first, solution))
        assert a[0].equals(b[0], 1e-9)
        np.testing.assert_allclose(a[1], b[1], atol=1e-9 * np.abs(a[1]).max())
    np.testing.assert_array_equal(other.station(top.station_ids[7])[1], 0.0)
    # a measured pair by its ends, along and against its direction
    a, b = ends(top, 4)
    np.testing.assert_allclose(first.pair(a, b)[1], first.pairs.cov[4], atol=1e-12)
    backward, Ad = first.pair(b, a)[1], as_gtsam(first.pairs.b_from_a, 4).AdjointMap()
    np.testing.assert_allclose(backward, Ad @ first.pairs.cov[4] @ Ad.T, atol=1e-9 * np.abs(backward).max())
    np.testing.assert_array_equal(first.pair(a, a)[1], 0.0)


def test_inner_datum_is_the_survey_cores():
    simulated = simulate(complete(6), 6, seed=5)
    top = simulated.network.topology
    stations = tuple(
        Station(s, world_from_station=PoseParameter(simulated.world[i])) for i, s in enumerate(top.station_ids)
    )
    survey = Survey(stations=stations, pairs=pairs_of(simulated), datum=Datum("inner"))
    names = [("world_from_station", s) for s in top.station_ids]
    core = adjust(survey, StartValues({}, dict(zip(names, simulated.world, strict=True)), {}))
    # the core's inner constraints are about its solution
    about = motions([core.estimates[name].value for name in names])
    found = adjust_parametric(simulated.network, inner=True, start=about)
    assert found.pairs.omega == pytest.approx(core.omega, rel=1e-9)
    for name in names:
        station, cov = found.station(name[1])
        np.testing.assert_allclose(cov, core.estimates[name].cov, rtol=0, atol=1e-7 * np.abs(cov).max())
        # the core stops at 1e-6 sigma
        assert np.abs(core.estimates[name].value.localCoordinates(station)).max() < 1e-7
    residuals = {o.ids[0]: o for o in core.other_residuals}
    for e, pair_id in enumerate(top.pair_ids):
        np.testing.assert_allclose(found.pairs.residual[e], residuals[pair_id].residual, atol=1e-7)
        np.testing.assert_allclose(found.pairs.redundancy[e], residuals[pair_id].redundancy, atol=1e-6)
        np.testing.assert_allclose(found.pairs.standardized[e], residuals[pair_id].standardized, atol=1e-5)
        assert found.pairs.test[e] == pytest.approx(residuals[pair_id].test, rel=1e-5)


def test_inner_datum_is_the_pseudo_inverse():
    simulated = simulate(NETWORKS["grid"], 3, seed=6, noise=1e-6)
    found = adjust_parametric(simulated.network, inner=True, start=motions(simulated.world))
    top, dim = simulated.network.topology, 3
    A = np.zeros((top.n_pairs * dim, top.n_stations * dim))
    for e, (a, b) in enumerate(zip(top.a_idx, top.b_idx, strict=True)):
        W = np.linalg.cholesky(np.linalg.inv(simulated.network.cov[e])).T
        A[3 * e : 3 * e + 3, 3 * a : 3 * a + 3] = W
        A[3 * e : 3 * e + 3, 3 * b : 3 * b + 3] = -W @ simulated.true[e].matrix().T
    Q = np.linalg.pinv(A.T @ A, rcond=1e-10, hermitian=True)
    for i, station in enumerate(top.station_ids):
        block = Q[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]
        np.testing.assert_allclose(found.station(station)[1], block, atol=1e-6 * np.abs(Q).max())


# -- errors in the observations ----------------------------------------------------------------------------------------


def test_uncontrolled_pair_keeps_its_measurement_and_is_not_tested():
    top = topology([("ab", "A", "B"), ("bc", "B", "C"), ("ca", "C", "A"), ("cd", "C", "D")])
    network = simulate(top, 3, seed=0).network
    for pairs in forms(network):
        np.testing.assert_allclose(pairs.residual[3], 0.0, atol=1e-12)
        np.testing.assert_allclose(pairs.cov[3], network.cov[3], rtol=1e-9)
        np.testing.assert_allclose(pairs.redundancy[3], 0.0, atol=1e-9)
        assert (pairs.freedom[3], np.isnan(pairs.test[3]), np.isnan(pairs.standardized[3]).all()) == (0, True, True)
        assert pairs.freedom[0] == 3


def test_parts_adjust_by_conditions_but_not_as_stations():
    rows = [("ab", "A", "B"), ("bc", "B", "C"), ("ca", "C", "A"), ("xy", "X", "Y"), ("yz", "Y", "Z"), ("zx", "Z", "X")]
    network = simulate(topology(rows), 3, seed=0).network
    assert adjust_conditions(network).pairs.redundancy_total == 6
    with pytest.raises(IndeterminateError, match="no measured pair ties X, Y, Z to the datum"):
        adjust_parametric(network)


@pytest.mark.parametrize("dim", [3, 6])
def test_covariances_where_gtsam_refuses_the_normal_equations(dim, monkeypatch):
    network = simulate(NETWORKS["chain"], dim, seed=2).network
    expected = adjust_parametric(network).pairs.cov
    monkeypatch.setattr("adjust.relay.normal_equations.Elimination.of", lambda *_: None)
    found = adjust_conditions(network, ConditionOptions(loops="shortest")).pairs.cov
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-8 * np.abs(expected).max())


def test_too_many_hard_loops_are_refused():
    network = simulate(grid(16, 16), 3, seed=0).network
    with pytest.raises(SurveyError, match=rf"225 loops are too many hard constraints \(at most {MAX_HARD_LOOPS}\)"):
        adjust_condition_factors(network)


def test_failure_names_the_loop():
    network = simulate(complete(5), 3, seed=0).network
    options = ConditionOptions(max_iterations=1)
    with pytest.raises(NotConvergedError, match=r"wrong pair in C\d -> C\d"):
        adjust_conditions(network, options)
    with pytest.raises(NotConvergedError, match=r"do not close after 1 steps .*use the normal equations"):
        adjust_condition_factors(network, options)


def test_large_misclosures_still_agree():
    # one pair wrong by 20 degrees: 240 sigma
    network = simulate(complete(6), 3, seed=1).network
    d = np.zeros((15, 3))
    d[7] = np.radians([10.0, -15.0, 8.0])
    network = replace(network, b_from_a=network.b_from_a.retract(d))
    reference, *others = forms(network)
    for other in others:
        assert turned(reference, other) < 1e-9
    assert suspects(reference)[0] == 7


# -- observations of a survey ------------------------------------------------------------------------------------------


def test_network_from_pairs():
    simulated = simulate(complete(4), 6, seed=0)
    pairs = pairs_of(simulated)
    network = network_from_pairs((*pairs, replace(pairs[0], pair_id="unused", used=False)))
    assert network.topology.n_pairs == 6
    assert ends(network.topology, 0) == ("station:C1", "station:C2")
    np.testing.assert_array_equal(network.b_from_a.translation, simulated.network.b_from_a.translation)
    rotations = network_from_pairs(pairs, rotations_only=True)
    assert rotations.dim == 3
    np.testing.assert_array_equal(rotations.cov, network.cov[:, :3, :3])


def pair(value, cov, pair_id="p"):
    return Pair(pair_id, FrameRef("camera", "A"), FrameRef("camera", "B", "e1"), value, cov)


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([], "no measured pair is in use"),
        ([pair(Rot3(), np.eye(3)), pair(Pose3(), np.eye(6), "q")], "pair 'p' is a rotation while others are poses"),
        (
            [pair(Rot3(), np.eye(6))],
            r"'p' \(camera:A to camera:B@e1\): its covariance has shape \(6, 6\), expected \(3, 3\)",
        ),
        ([pair(Rot3(), np.diag([1.0, 1.0, 0.0]))], "not symmetric and positive definite"),
        ([pair(Rot3(), np.array([[1.0, 0.5, 0], [0, 1, 0], [0, 0, 1]]))], "not symmetric"),
    ],
)
def test_wrong_pairs(pairs, message):
    with pytest.raises(SurveyError, match=message):
        network_from_pairs(pairs)


def test_truth_without_noise_is_found():
    simulated = simulate(NETWORKS["chain"], 6, seed=8, noise=0.0)
    for pairs in forms(simulated.network):
        assert np.abs(differences(pairs.b_from_a, simulated.true)).max() < 1e-12
        assert suspects(pairs) == []
    assert adjust_parametric(simulated.network).pairs.redundancy_total == 54
