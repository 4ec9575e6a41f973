"""Linear algebra of matrices with a few rows, compiled: one piece of code for every size, and no library call."""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray

_SWEEPS = 30  # cyclic Jacobi converges quadratically: five to eight are used


@njit(cache=True, nogil=True, error_model="numpy")
def solve_in_place(A: FloatArray, b: FloatArray) -> bool:
    """The solution of A x = b in b (n,), by elimination with row pivots; False where a pivot vanishes. A is lost."""
    n = len(b)
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(A[i, k]) > abs(A[best, k]):
                best = i
        if not abs(A[best, k]) > 0.0:
            return False
        if best != k:
            for j in range(k, n):
                A[k, j], A[best, j] = A[best, j], A[k, j]
            b[k], b[best] = b[best], b[k]
        for i in range(k + 1, n):
            f = A[i, k] / A[k, k]
            for j in range(k + 1, n):
                A[i, j] -= f * A[k, j]
            b[i] -= f * b[k]
    for k in range(n - 1, -1, -1):
        for j in range(k + 1, n):
            b[k] -= A[k, j] * b[j]
        b[k] /= A[k, k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def eigen_in_place(A: FloatArray, V: FloatArray) -> None:
    """Eigenvalues of a symmetric A (n, n), ascending on its diagonal, their vectors in the columns of V.

    Source: the cyclic Jacobi method (Golub and Van Loan, Matrix Computations, 8.5). The rest of A is lost.
    """
    n = len(A)
    for i in range(n):
        for j in range(n):
            V[i, j] = 1.0 if i == j else 0.0
    for _ in range(_SWEEPS):
        turned = False
        for p in range(n):
            for q in range(p + 1, n):
                small = 1e-3 * abs(A[p, q])
                if abs(A[p, p]) + small == abs(A[p, p]) and abs(A[q, q]) + small == abs(A[q, q]):
                    A[p, q] = A[q, p] = 0.0
                    continue
                turned = True
                tau = (A[q, q] - A[p, p]) / (2.0 * A[p, q])
                t = (1.0 if tau >= 0 else -1.0) / (abs(tau) + np.sqrt(1.0 + tau * tau))
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = t * c
                for i in range(n):
                    A[i, p], A[i, q] = c * A[i, p] - s * A[i, q], s * A[i, p] + c * A[i, q]
                    V[i, p], V[i, q] = c * V[i, p] - s * V[i, q], s * V[i, p] + c * V[i, q]
                for i in range(n):
                    A[p, i], A[q, i] = c * A[p, i] - s * A[q, i], s * A[p, i] + c * A[q, i]
        if not turned:
            break
    for k in range(n):
        least = k
        for i in range(k + 1, n):
            if A[i, i] < A[least, least]:
                least = i
        A[k, k], A[least, least] = A[least, least], A[k, k]
        for i in range(n):
            V[i, k], V[i, least] = V[i, least], V[i, k]


@njit(cache=True, nogil=True, error_model="numpy")
def product(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """A B (n, m); out is neither of them."""
    for i in range(A.shape[0]):
        for j in range(B.shape[1]):
            total = 0.0
            for k in range(A.shape[1]):
                total += A[i, k] * B[k, j]
            out[i, j] = total


@njit(cache=True, nogil=True, error_model="numpy")
def select(a: FloatArray, n: int, k: int) -> float:
    """The k-th smallest, from 0, of the first n; they are put in another order with none before k larger than it.

    Source: Hoare, Algorithm 65: FIND, Comm. ACM 4(7), 1961.
    """
    low, high = 0, n - 1
    while low < high:
        pivot = a[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while a[i] < pivot:
                i += 1
            while pivot < a[j]:
                j -= 1
            if i <= j:
                a[i], a[j] = a[j], a[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    return float(a[k])


@njit(cache=True, nogil=True, error_model="numpy")
def median_in_place(a: FloatArray, n: int) -> float:
    """The median of the first n, which are put in another order; NaN of none, and where one is NaN."""
    largest = -np.inf
    for i in range(n):
        if np.isnan(a[i]):
            return np.nan
    if n == 0:
        return np.nan
    upper = select(a, n, n // 2)
    if n % 2:
        return upper
    for i in range(n // 2):
        largest = max(largest, a[i])
    return float(0.5 * (largest + upper))
