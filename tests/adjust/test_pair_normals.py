"""Networks of pairs in the compiled core against GTSAM's factors and plain arrays."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from scipy import sparse

from adjust.adjustment import adjust
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.cliques import Cliques
from adjust.graph.elimination import pose_cliques
from adjust.graph.pair_normals import PairNormals
from adjust.graph.system import Damping
from adjust.native.elimination import clique_pattern
from adjust.native.pairs import pair_spread
from adjust.pose_network.solve import minimize
from adjust.precision import tree as tree_module
from adjust.precision.precision import precision_of
from adjust.precision.tree import TreeCovariance
from adjust.spatial.rigid_motions import Motions
from adjust.statistics.system import linear_system
from tests.adjust import pose_networks
from tests.adjust.pose_networks import solve_network


def of_network(seed: int, nx: int = 10, extra: int | None = None) -> AdjustmentGraph:
    return minimize(pose_networks.simulate(nx, 4, seed, extra=nx if extra is None else extra).network).graph


def joined(delta: gtsam.VectorValues, keys: np.ndarray) -> np.ndarray:
    return np.array([delta.at(int(k)) for k in keys])


@pytest.mark.parametrize("seed", range(3))
def test_the_system_is_that_of_gtsams_factors(seed: int) -> None:
    graph = of_network(seed)
    assert graph.only_pairs
    normals = PairNormals(graph, [])
    rng = np.random.default_rng(seed)
    for start in (graph.start, graph.start.retract(_shake(graph, rng, 0.1))):  # residuals far from zero
        at = graph.prepare(start, True)
        linear, plain = normals.linearized(at), graph.linearized(at)
        assert graph.objective(at) == pytest.approx(2.0 * graph.others_graph.error(start), rel=1e-10)
        order = gtsam.Ordering.ColamdGaussianFactorGraph(plain)
        for mine, theirs in ((linear, plain), (linear.damped(0.3), Damping(graph, plain).damped(0.3))):
            found = normals.solution(mine)
            assert found is not None
            expected = theirs.optimize(order)
            np.testing.assert_allclose(joined(found[0], normals.keys), joined(expected, normals.keys), atol=1e-9)
            assert found[1] == pytest.approx(-expected.dot(plain.gradientAtZero()), rel=1e-9)


def _shake(graph: AdjustmentGraph, rng: np.random.Generator, size: float) -> gtsam.VectorValues:
    delta = gtsam.VectorValues()
    for key in graph.unknowns.by_key:
        delta.insert(key, size * rng.normal(size=6))
    return delta


@pytest.mark.parametrize("size", [0.0, 0.05, 0.5])
def test_rows_of_pairs_are_those_of_plain_arrays(size: float) -> None:
    """On both sides of the angle where series give way to closed forms."""
    graph = of_network(3)
    assert graph.pairs is not None
    values = graph.start.retract(_shake(graph, np.random.default_rng(1), size))
    found, pairs, state = graph.pairs.jacobians(values), graph.pairs, graph.state
    a, b = (Motions(state.slot_R[slots], state.slot_t[slots]) for slots in (pairs.a_slot, pairs.b_slot))
    expected = pose_networks.pair_jacobians(pairs.arrays.motions, b.inverse() @ a)
    for mine, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-12 * np.abs(theirs).max())


def test_covariances_of_pairs_are_those_of_plain_arrays() -> None:
    """From those of both ends by the derivatives: turned, moved and whitened one product after the other."""
    rng = np.random.default_rng(4)
    n = 7
    factor, turn, by_a = rng.normal(size=(n, 12, 12)), rng.normal(size=(n, 6, 6)), rng.normal(size=(n, 6, 6))
    ends, W = factor @ np.swapaxes(factor, 1, 2), np.triu(rng.normal(size=(n, 6, 6)))
    own, moved, white, apart = pair_spread(ends, turn, by_a, W)
    for e in range(n):
        D = np.hstack([-turn[e], np.eye(6)])
        scatter = by_a[e] @ D @ ends[e] @ D.T @ by_a[e].T
        np.testing.assert_allclose(own[e], D @ ends[e] @ D.T, rtol=1e-10, atol=1e-10)
        np.testing.assert_allclose(moved[e], scatter, rtol=1e-10, atol=1e-9)
        np.testing.assert_allclose(white[e], W[e] @ scatter @ W[e].T, rtol=1e-10, atol=1e-8)
        ends[e, :6, 6:] = ends[e, 6:, :6] = 0.0
        lone = W[e] @ by_a[e] @ D @ ends[e] @ D.T @ by_a[e].T @ W[e].T
        np.testing.assert_allclose(apart[e], np.diag(lone), rtol=1e-10)


@pytest.mark.parametrize(("nx", "extra"), [(1, 1), (3, 3), (20, 20), (40, 240)])
def test_covariances_are_those_of_gtsams_tree(nx: int, extra: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of small cliques in COLAMD's order, and of large ones in that of METIS."""
    if extra > nx:
        monkeypatch.setattr("adjust.graph.elimination._LARGE", 0)
    graph = of_network(5, nx, extra)
    normals = PairNormals(graph, [])
    width = int(normals.factor.pattern.width.max())
    assert extra == nx or width > 300
    at = graph.prepare(graph.start, True)
    found = normals.tree(normals.linearized(at))
    assert found is not None
    dims = dict.fromkeys(graph.unknowns.by_key, 6)
    trees = found[0], graph.linearized(at).eliminateMultifrontal()
    mine, theirs = (TreeCovariance(Cliques.of(tree, dims), dims) for tree in trees)
    keys = list(dims)
    expected = theirs.joint(keys)
    np.testing.assert_allclose(mine.joint(keys), expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
    order = np.concatenate([np.arange(mine.n)[mine.places()[k]] for k in keys])
    np.testing.assert_allclose(mine.full()[np.ix_(order, order)], mine.joint(keys), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("n", [1, 2, 25])
def test_cliques_hold_every_pair_and_every_pose_once(n: int) -> None:
    rng = np.random.default_rng(n)
    a = np.concatenate([np.arange(n - 1), rng.integers(0, n, n)])
    b = np.concatenate([np.arange(1, n), rng.integers(0, n, n)])
    a, b = a[a != b], b[a != b]
    pattern = clique_pattern(n, a, b)
    number = np.argsort(pattern.order)
    cliques = [pattern.keys[i:j].tolist() for i, j in zip(pattern.key_ptr[:-1], pattern.key_ptr[1:], strict=True)]
    fronts = [keys[:k] for keys, k in zip(cliques, pattern.n_front.tolist(), strict=True)]
    assert [k for front in fronts for k in front] == list(range(n))
    assert all(pattern.home[k] == c for c, front in enumerate(fronts) for k in front)
    for x, y in zip(number[a].tolist(), number[b].tolist(), strict=True):
        assert any({x, y} <= set(keys) for keys in cliques)
    for c, (keys, front) in enumerate(zip(cliques, fronts, strict=True)):
        above, p = set(keys) - set(front), int(pattern.parents[c])
        assert p < c
        assert above <= set(cliques[p]) if p >= 0 else not above  # the running intersection of a tree


def test_a_pose_without_a_pivot_has_no_solution() -> None:
    graph = of_network(1)
    normals = PairNormals(graph, [])
    linear = normals.linearized(graph.prepare(graph.start, True))
    linear.by_b[normals.b == 7], linear.by_a[normals.a == 7] = 0.0, 0.0
    assert normals.solution(linear) is None
    assert normals.tree(linear) is None


def test_one_factor_serves_several_steps_to_the_same_minimum(monkeypatch: pytest.MonkeyPatch) -> None:
    network = pose_networks.simulate(15, 4, 2).network
    counts = {"eliminated": 0}
    plain = PairNormals._eliminated

    def counted(self: PairNormals, linear: object) -> bool:
        counts["eliminated"] += 1
        return plain(self, linear)

    monkeypatch.setattr(PairNormals, "_eliminated", counted)
    kept = solve_network(network)
    saved = kept.iterations + 1 - counts["eliminated"]
    monkeypatch.setattr("adjust.graph.solver._CLOSE", ())
    fresh = solve_network(network)
    assert saved > 0
    sigmas = np.sqrt(np.diagonal(fresh.station_cov, axis1=1, axis2=2))[:, 3:]
    assert np.all(np.abs(kept.translations - fresh.translations) <= 1e-6 * sigmas)
    np.testing.assert_allclose(kept.station_cov, fresh.station_cov, rtol=1e-6, atol=1e-15)


def test_covariances_among_sparse_rows_are_those_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tree_module, "_COLUMNS", 7)  # several passes
    rng = np.random.default_rng(0)
    tree = solve_network(pose_networks.simulate(12, 4, 3, extra=12).network).precision.tree
    A = sparse.random_array((40, tree.n), density=0.01, rng=rng, format="csr")
    assert (np.diff(A.indptr) == 0).any()
    found, expected = tree.among(A), A @ (A @ tree.full()).T
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(found, found.T)
    assert tree.among(A[:0]).shape == (0, 0)
    monkeypatch.setattr(tree_module, "_ROOM", 1)  # bytes: every half is made anew for each of the others
    np.testing.assert_array_equal(tree.among(A), found)
    ptr = np.array([0, 12, 12, 30, 40])
    for i, j, alone in zip(ptr, ptr[1:], tree.each_among(A, ptr), strict=False):
        np.testing.assert_allclose(alone, found[i:j, i:j], rtol=1e-9, atol=1e-12 * np.abs(expected).max())


def test_covariances_among_rows_of_neighbours_go_no_further_up_than_they_have_to() -> None:
    """What is above the first clique that holds all their keys may be anything."""
    tree = solve_network(pose_networks.simulate(8, 8, 3).network).precision.tree
    Q, rng, cliques = tree.full(), np.random.default_rng(0), tree.cliques
    number = {n: k for k, n in tree.number.items()}
    data, last = cliques.data.copy(), len(cliques) - 1
    for c in range(len(cliques)):
        keys = cliques.keys_in(c)
        with_leaf = c == cliques.parents[-1]
        below = cliques.keys_in(last)[0] if with_leaf else keys[0]  # of the last leaf too
        rows = tree.rows([number[k] for k in {*keys.tolist(), int(below)}])
        A = np.zeros((20, tree.n))
        A[:, rows] = rng.standard_normal((20, len(rows)))
        expected = A @ Q @ A.T
        cliques.data[: cliques.at[last] if with_leaf else None] = np.nan
        found = tree.among(sparse.csr_array(A))
        cliques.data[:] = data
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9 * np.abs(Q).max())


@pytest.mark.parametrize("n_last", [0, 2])
def test_large_networks_are_eliminated_in_the_order_of_least_work(
    n_last: int, monkeypatch: pytest.MonkeyPatch
) -> None:  # fmt: skip
    """On a torus that of METIS is less work than that of COLAMD; what comes last does so in either."""
    k = 60
    number = np.arange(k * k).reshape(k, k)
    a, b = np.tile(number.ravel(), 2), np.concatenate([np.roll(number, -1, i).ravel() for i in (0, 1)])
    last = number.ravel()[7 : 7 + n_last].tolist()
    found = [pose_cliques([0], a, b, last)]
    monkeypatch.setattr("adjust.graph.elimination._LARGE", k * k)
    found.append(pose_cliques([0], a, b, last))
    for keys, pattern in found:
        assert sorted(keys.tolist()) == list(range(k * k))
        assert {pattern.home[i] for i in np.flatnonzero(np.isin(keys, last))} <= {0}
    assert found[0][1].work < found[1][1].work


def test_columns_cost_their_way_to_the_root() -> None:
    tree = solve_network(pose_networks.simulate(20, 4, 1, extra=10).network).precision.tree
    numbers = tree.arrays.front * tree.arrays.width
    ways = [numbers[tree.cliques.ancestors({c})].sum() for c in range(len(numbers))]
    assert 0 < max(ways) < numbers.sum()  # there are branches
    assert tree.cliques.columns_for(3.0) * max(ways) == pytest.approx(3.0 * float(numbers @ tree.arrays.width))


def test_rows_of_pairs_in_batches_are_those_of_their_factors() -> None:
    """Poses and rotations, in use or not, between free and held stations; nothing else is linearised for them."""
    survey = pose_networks.simulate(6, 3, 1, extra=8).network.as_survey
    pairs = [replace(p, b_from_a=p.b_from_a.rotation(), cov=p.cov[:3, :3]) if i in (5, 9) else p
             for i, p in enumerate(survey.pairs)]  # fmt: skip
    pairs[4] = replace(pairs[4], used=False)
    result = adjust(replace(survey, pairs=tuple(pairs)))
    system, precision = linear_system(result), precision_of(result)
    graph = precision.graph
    assert graph.pairs is not None
    assert (graph.pairs.a_key < 0).any() | (graph.pairs.b_key < 0).any()
    column = {u.key: system.columns.at[name] for name, u in graph.unknowns.by_name.items()}
    for i in range(graph.n_others):
        item = graph.other(i)
        assert item is graph.others[i]
        linear = item.factor.linearize(precision.solved.values)
        (A, b), keys = linear.jacobian(), list(linear.keys())
        rows = slice(system.ptr[system.n_image + i], system.ptr[system.n_image + i + 1])
        expected = np.zeros((len(b), len(system.columns)))
        for k, key in enumerate(keys):
            expected[:, column[key]] = A[:, 6 * k : 6 * k + 6]
        assert system.e[rows] == pytest.approx(-b, abs=1e-9)
        assert system.A[rows].toarray() == pytest.approx(expected, rel=1e-9, abs=1e-9 * np.abs(A).max())
    assert system.group_names == tuple(dict.fromkeys(graph.of_others(lambda o: o.group, lambda p: p.group)))
