# mypy: ignore-errors
# (numba's decorator and its array arguments have no static types)
"""Compiled solution of the few damped normal equations of a small fit."""

from math import sqrt

import numpy as np

from adjust.compiling import njit


@njit(cache=True, nogil=True, error_model="numpy")
def _cholesky_solve(A, n, B):
    """Solves A X = B in place for the leading n rows; False where A is not positive definite."""
    for i in range(n):
        for j in range(i + 1):
            total = A[i, j]
            for k in range(j):
                total -= A[i, k] * A[j, k]
            if i == j:
                if not total > 1e-14:
                    return False
                A[i, i] = sqrt(total)
            else:
                A[i, j] = total / A[j, j]
    for c in range(B.shape[1]):
        for i in range(n):
            for k in range(i):
                B[i, c] -= A[i, k] * B[k, c]
            B[i, c] /= A[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                B[i, c] -= A[k, i] * B[k, c]
            B[i, c] /= A[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def scaled_solve(H, n, damping, B):
    """Solves (H + damping diag(H)) X = B in place, scaled to a unit diagonal."""
    d = np.empty(n)
    for i in range(n):
        d[i] = 1.0 / sqrt(H[i, i]) if H[i, i] > 0.0 else 0.0
    A = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            A[i, j] = H[i, j] * d[i] * d[j]
        A[i, i] += damping + 1e-12
        for c in range(B.shape[1]):
            B[i, c] *= d[i]
    if not _cholesky_solve(A, n, B):
        return False
    for i in range(n):
        for c in range(B.shape[1]):
            B[i, c] *= d[i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def put_state(p, H, g, to_p, to_H, to_g):
    """Parameters (m,), normal equations (n, n), right side (n, 1) into other arrays; assignments compile longer."""
    for i in range(len(p)):
        to_p[i] = p[i]
    for i in range(len(H)):
        to_g[i, 0] = g[i, 0]
        for j in range(len(H)):
            to_H[i, j] = H[i, j]
