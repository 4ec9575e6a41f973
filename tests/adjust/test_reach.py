"""What biases move furthest in large surveys is what the whole covariance matrix says, and sets are told apart."""

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from adjust.model.arrays import largest, ranked
from adjust.statistics.effects import Reach, furthest_of
from adjust.statistics.normal import Inverse, sets_apart


@pytest.mark.parametrize("shared", [0.05, 1.0, 20.0])
def test_what_moves_furthest(shared: float) -> None:
    """40 sets of six unknowns, three of them coordinates, and a core of four that all share."""
    random = np.random.default_rng(3)
    n_sets, core = 40, 4
    n = 6 * n_sets + core
    blocks = random.normal(size=(n_sets, 6, 6))
    own = sparse.block_diag([*(b @ b.T for b in blocks), np.zeros((core, core))], "csr")
    own.eliminate_zeros()
    U = shared * random.normal(size=(core, n)) * np.exp(random.normal(size=n))
    member = np.append(np.repeat(np.arange(n_sets), 6), np.full(core, -1))
    Q = Inverse(own, U, member)
    sigmas = np.sqrt(own.diagonal() + (U**2).sum(axis=0))
    at = (6 * np.arange(n_sets)[:, None] + np.arange(3, 6)).ravel()
    coordinates = sparse.csr_matrix((np.ones(len(at)), (np.repeat(np.arange(n_sets), 3), at)), (n_sets, n))
    right = np.zeros((n, 30))
    for j in range(30):
        right[6 * j : 6 * j + 6, j] = random.normal(size=6) * 10.0 ** random.integers(-3, 3)
        right[-core:, j] = random.normal(size=core)
    found = Reach.of(Q, sigmas, coordinates).furthest(sparse.csc_matrix(right))
    whole = own.toarray() + U.T @ U
    for mine, known in zip(found, furthest_of(whole @ right, sigmas, coordinates), strict=True):
        np.testing.assert_allclose(mine, known, rtol=1e-11)
    far = (found.unknown < n - core) & (found.unknown // 6 != np.arange(30))
    assert far.any() == (shared >= 1.0)  # others than those of the bias's own set are seen where they move most


def test_sets_that_have_nothing_in_common() -> None:
    random = np.random.default_rng(5)
    order = random.permutation(300)
    chain = sparse.diags([np.ones(300), np.ones(299), np.ones(299)], [0, 1, -1]).tolil()
    for cut in (1, 2, 40, 41, 200):
        chain[cut, cut - 1] = chain[cut - 1, cut] = 0.0
    N = chain.tocsr()[order][:, order]
    N.eliminate_zeros()
    assert sets_apart(N).tolist() == connected_components(N, directed=False)[1].tolist()


@pytest.mark.parametrize("far", [0.0, 1e9])
def test_values_of_some_ranks(far: float) -> None:
    random = np.random.default_rng(7)
    for values in (random.normal(size=30_000), random.integers(0, 4, 20_000).astype(float), np.full(15_000, 2.5),
                   random.normal(size=12)):  # fmt: skip
        values[3] += far
        ranks = np.unique(np.linspace(0, len(values) - 1, 160).astype(np.int64))
        assert ranked(values, ranks).tolist() == np.sort(values)[ranks].tolist()


@pytest.mark.parametrize("most", [0, 1, 3, 300, 5_000])
def test_the_largest_of_many_values_are_the_first_in_order(most: int) -> None:
    random = np.random.default_rng(8)
    drawn, few = random.normal(size=12_345), random.integers(0, 9, 12_345).astype(float)
    for values in (drawn, np.sort(drawn), np.sort(drawn)[::-1], few, drawn[:12]):
        assert largest(values, most).tolist() == np.argsort(-values, kind="stable")[:most].tolist()
