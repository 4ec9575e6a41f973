"""Linear algebra of small matrices against LAPACK and NumPy."""

import numpy as np
import pytest

from adjust.closed_forms.small_kernels import eigen_in_place, median_in_place, product, select, solve_in_place


@pytest.mark.parametrize("n", [1, 2, 3, 6, 9])
def test_solution_as_lapack_has_it(n):
    rng = np.random.default_rng(n)
    for _ in range(50):
        A, b = rng.normal(size=(n, n)) * 10.0 ** rng.uniform(-8, 8, (n, 1)), rng.normal(size=n)
        x = b.copy()
        assert solve_in_place(A.copy(), x)
        np.testing.assert_allclose(x, np.linalg.solve(A, b), rtol=1e-9 * np.linalg.cond(A / np.abs(A).max(1)[:, None]))


def test_pivots_are_sought():
    x = np.array([1.0, 2.0, 3.0])
    assert solve_in_place(np.array([[0.0, 2.0, 0.0], [0.0, 0.0, 4.0], [5.0, 0.0, 0.0]]), x)
    np.testing.assert_allclose(x, [0.6, 0.5, 0.5])


@pytest.mark.parametrize("A", [np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([1.0, 0.0, 1.0])])
def test_no_solution_is_said(A):
    assert not solve_in_place(A.copy(), np.ones(3))


@pytest.mark.parametrize("n", [2, 3, 9])
def test_eigenvalues_as_lapack_has_them(n):
    rng = np.random.default_rng(n)
    for rank in range(n + 1):
        for _ in range(20):
            F = rng.normal(size=(n, rank)) * 10.0 ** rng.uniform(-3, 3, rank)
            A = F @ F.T
            D, V = A.copy(), np.empty((n, n))
            eigen_in_place(D, V)
            scale = max(np.abs(A).max(), 1e-300)
            np.testing.assert_allclose(np.diag(D), np.linalg.eigvalsh(A), atol=1e-13 * n * scale)
            np.testing.assert_allclose(V.T @ V, np.eye(n), atol=1e-13)
            np.testing.assert_allclose(V * np.diag(D) @ V.T, A, atol=1e-13 * n * scale)


def test_equal_eigenvalues():
    D, V = np.diag([2.0, 1.0, 2.0]), np.empty((3, 3))
    eigen_in_place(D, V)
    np.testing.assert_array_equal(np.diag(D), [1.0, 2.0, 2.0])
    np.testing.assert_array_equal(np.abs(V[:, 0]), [0.0, 1.0, 0.0])


def test_not_finite_ends():
    D, V = np.full((9, 9), np.nan), np.empty((9, 9))
    eigen_in_place(D, V)
    assert np.isnan(D).all()


def test_product():
    A, B = np.random.default_rng(1).normal(size=(2, 3, 3))
    out = np.empty((3, 3))
    product(A, B, out)
    np.testing.assert_allclose(out, A @ B, rtol=1e-14)


@pytest.mark.parametrize("values", ["different", "equal", "sorted", "infinite"])
def test_order_statistics(values):
    rng = np.random.default_rng(3)
    for n in range(1, 40):
        a = {
            "different": rng.normal(size=n),
            "equal": rng.integers(0, 3, n).astype(float),
            "sorted": np.arange(n, dtype=float),
            "infinite": np.where(rng.random(n) < 0.3, np.inf, 1.0 * n),
        }[values]
        for k in range(n):
            assert select(a.copy(), n, k) == np.sort(a)[k]
        assert median_in_place(np.append(a, [-7.0, np.nan]), n) == np.median(a)


def test_median_of_nothing_and_of_what_is_no_number():
    assert np.isnan(median_in_place(np.ones(3), 0))
    assert np.isnan(median_in_place(np.array([1.0, np.nan, 2.0]), 3))
