"""Tests of image points and of changes in the core against the same in NumPy, with little control and none."""

from itertools import pairwise

import numpy as np
import pytest
from scipy import sparse

from adjust.native.point_tests import (
    AdjustedPoints,
    ColumnsOfRows,
    SparseRows,
    UnitVectors,
    change_squares,
    controlled_directions,
    farthest_points,
    point_tests,
    residual_tests,
    sums_of_blocks,
)
from adjust.testing.single_tests import component_tests, whitened

PTR = np.array([0, 7, 7, 5000, 20_001])
LAMBDA0 = np.array([17.1, 19.4])


def some_points(n: int = 4000, seed: int = 1) -> AdjustedPoints:
    """Of all sorts: correlated, hardly controlled, uncontrolled in one direction or both, not used."""
    rng = np.random.default_rng(seed)
    angle = rng.uniform(0.0, np.pi, n)
    shares = np.sort(rng.uniform(0.0, 1.0, (n, 2)), axis=1)
    shares[: n // 4, 1] = 1.0
    shares[: n // 8, 0] = 1.0
    shares[n // 4 : n // 2] = shares[n // 4 : n // 2, :1]  # nothing tells directions apart
    R = np.stack([np.stack([np.cos(angle), -np.sin(angle)], 1), np.stack([np.sin(angle), np.cos(angle)], 1)], 1)
    M = np.einsum("nij,nj,nkj->nik", R, shares, R)
    used = rng.random(n) < 0.7
    W = np.stack([rng.uniform(1.0, 20.0, n), rng.uniform(-5.0, 5.0, n), rng.uniform(1.0, 20.0, n)], axis=1)
    return AdjustedPoints(rng.normal(0.0, 0.2, (n, 2)), np.stack([M[:, 0, 0], M[:, 0, 1], M[:, 1, 1]], 1), W, used)


def matrices(points: AdjustedPoints) -> tuple[np.ndarray, np.ndarray]:
    """W and M (n, 2, 2)."""
    W = np.zeros((len(points.v), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = points.W.T
    return W, np.stack([points.M[:, :2], points.M[:, 1:]], axis=1)


def table(points: AdjustedPoints) -> list[np.ndarray]:
    n = len(points.v)
    out = tuple(np.full((n,) if i < 5 else (n, 2), 7.0) for i in range(9))
    point_tests(points, LAMBDA0, out)
    return list(out)


def test_the_table_is_that_of_the_plain_formulas() -> None:
    points = some_points()
    W, M = matrices(points)
    x = whitened(np.einsum("nij,nj->ni", W, points.v), M, points.used)
    freedom = np.zeros(len(points.v), dtype=np.int64)
    controlled_directions(points, freedom)
    np.testing.assert_array_equal(freedom, x.freedom)
    assert {0, 1, 2} == set(freedom.tolist())
    redundancy, least, statistic, detectable, external, w, error, component, bias = table(points)
    np.testing.assert_allclose(redundancy, np.where(x.used, np.trace(x.K, axis1=1, axis2=2), 0.0), atol=1e-12)
    np.testing.assert_allclose(least, np.clip(x.values.min(axis=1), 0.0, 1.0), atol=1e-12)
    near = x.values.min(axis=1)
    clear = (near > 1e-3) | ((near < 1e-9) & (freedom < 2))  # what is hardly controlled has lost its digits
    some = clear & (freedom > 0)
    np.testing.assert_allclose(statistic[some], x.statistic[some], rtol=1e-8)
    assert np.isnan(statistic[freedom == 0]).all()
    weakest, direction = x.weakest()
    size = np.sqrt(LAMBDA0[np.maximum(freedom, 1) - 1] / weakest)
    np.testing.assert_allclose(detectable[some], size[some], rtol=1e-8)
    assert np.isinf(detectable[freedom == 0]).all()
    moved = np.where(x.used, size * np.sqrt(np.maximum(1.0 - weakest, 0.0)), 0.0)
    np.testing.assert_allclose(external[some], moved[some], rtol=1e-6, atol=1e-6)
    back = np.linalg.inv(W)
    np.testing.assert_allclose(error[some], np.einsum("nij,nj->ni", back, x.error)[some], rtol=1e-7, atol=1e-9)
    expected = np.einsum("nij,nj->ni", back, direction * size[:, None])
    apart = some & (np.diff(x.values, axis=1)[:, 0] > 1e-6)
    np.testing.assert_allclose(bias[apart], expected[apart], rtol=1e-6, atol=1e-8)
    K_bias = np.einsum("ni,nji,njk,nkl,nl->n", bias, W, x.K, W, bias)
    np.testing.assert_allclose(K_bias[some], LAMBDA0[freedom[some] - 1], rtol=1e-7)
    alone, information = component_tests(x, W)
    np.testing.assert_allclose(w[some], alone[some], rtol=1e-7, atol=1e-9)
    with np.errstate(divide="ignore"):
        np.testing.assert_allclose(component[some], np.sqrt(LAMBDA0[0] / information)[some], rtol=1e-7)


def test_residuals_over_their_sigmas() -> None:
    points = some_points()
    W, M = matrices(points)
    Q = np.eye(2) - np.where(points.used, 1.0, -1.0)[:, None, None] * M
    redundancy, standardized, test = residual_tests(points)
    np.testing.assert_allclose(redundancy, np.where(points.used[:, None], np.diagonal(Q, axis1=1, axis2=2), 0.0))
    seen = np.linalg.det(Q) > 1e-3
    back = np.linalg.inv(W)
    of_v = back @ Q @ back.transpose(0, 2, 1)
    squares = [v @ np.linalg.solve(C, v) for v, C in zip(points.v[seen], of_v[seen], strict=True)]
    np.testing.assert_allclose(test[seen], squares, rtol=1e-8)
    sigma = np.sqrt(np.diagonal(of_v[seen], axis1=1, axis2=2))
    np.testing.assert_allclose(standardized[seen], points.v[seen] / sigma, rtol=1e-9)
    assert np.isnan(test[points.used & (points.M[:, 0] + points.M[:, 2] > 2.0 - 1e-12)]).all()


def test_every_point_by_itself(monkeypatch) -> None:
    """The same to the bit in any ranges."""
    points = some_points(20_001)
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("LABSURVEY_THREADS", threads)
        sums = sums_of_blocks(PTR, points), farthest_points(PTR, points.v, np.zeros((len(PTR) - 1, 2)))
        found.append([*table(points), *residual_tests(points), *sums])
    for a, b in zip(*found, strict=True):
        np.testing.assert_array_equal(a, b)


def test_sums_and_farthest_points_of_blocks() -> None:
    points, centre = some_points(20_001), np.array([[0.1, -0.2], [3.0, 4.0], [0.0, 0.0], [-1.0, 0.5]])
    W, _ = matrices(points)
    squares = np.square(np.einsum("nij,nj->ni", W, points.v)).sum(axis=1)
    sums, farthest = sums_of_blocks(PTR, points), farthest_points(PTR, points.v, centre)
    for b, (i, j) in enumerate(pairwise(PTR.tolist())):
        used = np.flatnonzero(points.used[i:j]) + i
        expected = [2 * len(used), residual_tests(points)[0][used].sum(), squares[used].sum()]
        np.testing.assert_allclose(sums[b], expected, rtol=1e-12)
        distance = np.linalg.norm(points.v[i:j] - centre[b], axis=1).max(initial=0.0)
        np.testing.assert_allclose(farthest[b], distance, rtol=1e-14)


def test_changes_from_every_run_on_are_those_of_the_dense_matrices() -> None:
    """Runs of several rows, of none, and with unknowns that other runs have too."""
    rng = np.random.default_rng(3)
    first, m, n = np.array([0, 4, 4, 9, 15, 16]), 30, 20
    rows, e = rng.permutation(m)[:16], rng.standard_normal(m)
    A = sparse.random_array((m, n), density=0.2, rng=rng, format="csr")
    half = sparse.block_diag([rng.standard_normal((k, k)) for k in (3, 5, 1, 7, 4)])
    own = (half @ half.T).tocsr()
    for q, c in ((1, 6), (6, 8), (8, 1), (14, 19)):
        table, at, U = rng.standard_normal((40, q + 3)), rng.permutation(40)[:16], rng.standard_normal((n, c))
        table[at[[2, 5]]] = 0.0
        B, columns = table[at, 2 : q + 2], ColumnsOfRows(rows, at * (q + 3) + 2, table.ravel())
        A_rows, own_rows = (SparseRows(x.indptr.astype(int), x.indices.astype(int), x.data) for x in (A, own))
        squares, M, g = change_squares(first, columns, q, A_rows, e, own_rows, U)
        for j, start in enumerate(first[:-1]):
            C, X = B[start:], A.toarray()[rows[start:]].T @ B[start:]
            expected = C.T @ C - X.T @ (own.toarray() + U @ U.T) @ X
            np.testing.assert_allclose(M[j], expected, rtol=0.0, atol=1e-12 * np.abs(expected).max(initial=1.0))
            np.testing.assert_allclose(squares[j], (C**2).sum(axis=0))
            np.testing.assert_allclose(g[j], C.T @ e[rows[start:]])


@pytest.mark.parametrize("least", [0.3, 0.7, 0.99])
@pytest.mark.parametrize("smooth", [0.0, 1.5])
def test_nearly_parallel_vectors(least: float, smooth: float) -> None:
    """Of all products those that are as large, whether few axes hold most of the vectors or none do."""
    rng = np.random.default_rng(4)
    u = rng.normal(size=(333, 64)) * np.arange(1, 65) ** -smooth @ np.linalg.qr(rng.normal(size=(64, 64)))[0]
    u[200:260] = rng.choice([-1.0, 1.0], 60)[:, None] * u[:60] + 0.1 * rng.normal(size=(60, 64)) * np.abs(u[:60]).mean()
    u[300] = u[7]
    u /= np.linalg.norm(u, axis=1)[:, None]
    for first, last, end in ((0, 333, 333), (5, 6, 333), (64, 97, 97), (10, 250, 301)):
        found = UnitVectors(u).parallel(first, last, end, least)
        size = np.abs(np.tril(u @ u.T, -1))
        mine = np.zeros_like(size)
        mine[tuple(found[:, :2].astype(np.int64).T)] = found[:, 2]
        size[:, :first] = size[:, last:] = size[end:] = 0.0
        sure = np.abs(size - least) > 1e-6  # single numbers
        np.testing.assert_allclose(mine[sure], np.where(size >= least, size, 0.0)[sure], atol=1e-6)
    assert (size >= least).any()
