"""Compiled least squares for many complete networks of rotations at once: the parametric form, station 0 held."""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def small_log(m: FloatArray, p: FloatArray, r: FloatArray) -> None:
    """Logarithm r of m' p, for angles below a right angle or so (residuals)."""
    x = y = z = trace = 0.0
    for k in range(3):
        x += m[k, 2] * p[k, 1] - m[k, 1] * p[k, 2]
        y += m[k, 0] * p[k, 2] - m[k, 2] * p[k, 0]
        z += m[k, 1] * p[k, 0] - m[k, 0] * p[k, 1]
        trace += m[k, 0] * p[k, 0] + m[k, 1] * p[k, 1] + m[k, 2] * p[k, 2]
    sine = 0.5 * np.sqrt(x * x + y * y + z * z)
    angle = np.arctan2(sine, 0.5 * (trace - 1.0))
    f = 0.5 * (angle / sine if sine > 1e-9 else 1.0)
    r[0], r[1], r[2] = f * x, f * y, f * z


@njit(cache=True, nogil=True, error_model="numpy")
def inverse_jacobian(r: FloatArray, J: FloatArray) -> None:
    """J = Jr^-1(r)."""
    x = r[0] * r[0] + r[1] * r[1] + r[2] * r[2]
    if x < 1e-3:
        c = 1.0 / 12.0 + x / 720.0 + x * x / 30240.0
    else:
        half = 0.5 * np.sqrt(x)
        c = (1.0 - half * np.cos(half) / np.sin(half)) / x
    for i in range(3):
        for j in range(3):
            J[i, j] = c * r[i] * r[j]
        J[i, i] += 1.0 - c * x
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        J[j, k] -= 0.5 * r[i]
        J[k, j] += 0.5 * r[i]


@njit(cache=True, nogil=True, error_model="numpy")
def retract(X: FloatArray, d: FloatArray) -> None:
    """X <- X Exp(d), in place (Rodrigues)."""
    x = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    angle = np.sqrt(x)
    a = np.sin(angle) / angle if angle > 1e-6 else 1.0 - x / 6.0
    h = np.sin(0.5 * angle) / (0.5 * angle) if angle > 1e-6 else 1.0
    b = 0.5 * h * h
    E = np.empty((3, 3))
    for i in range(3):
        for j in range(3):
            E[i, j] = b * d[i] * d[j]
        E[i, i] += 1.0 - b * x
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        E[j, k] -= a * d[i]
        E[k, j] += a * d[i]
    row = np.empty(3)
    for i in range(3):
        for j in range(3):
            row[j] = X[i, 0] * E[0, j] + X[i, 1] * E[1, j] + X[i, 2] * E[2, j]
        X[i, :] = row


@njit(cache=True, nogil=True, error_model="numpy")
def solve_in_place(H: FloatArray, g: FloatArray, n: int) -> bool:
    """Overwrite g with H^-1 g by Cholesky on the lower triangle; False where H is not positive definite."""
    for j in range(n):
        s = H[j, j]
        for k in range(j):
            s -= H[j, k] * H[j, k]
        if not s > 0.0:
            return False
        root = np.sqrt(s)
        H[j, j] = root
        for i in range(j + 1, n):
            s = H[i, j]
            for k in range(j):
                s -= H[i, k] * H[j, k]
            H[i, j] = s / root
    for i in range(n):
        s = g[i]
        for k in range(i):
            s -= H[i, k] * g[k]
        g[i] = s / H[i, i]
    for i in range(n - 1, -1, -1):
        s = g[i]
        for k in range(i + 1, n):
            s -= H[k, i] * g[k]
        g[i] = s / H[i, i]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def adjust_trial(
    m: FloatArray, info: FloatArray, n: int, limit: float, most: int, X: FloatArray, H: FloatArray, g: FloatArray
) -> int:
    """Adjust one network: m (E, 3, 3) ``j_from_i`` for i < j, info (E, 3, 3). X (n, 3, 3) gets ``0_from_i``.

    Returns the number of iterations, ``most`` + 1 where it did not settle.
    """
    P, J, G, GP = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    r, t, h = np.empty(3), np.empty(3), np.empty(3)
    X[0] = np.eye(3)
    for j in range(1, n):
        X[j] = m[j - 1].T
    size = 3 * (n - 1)
    for iteration in range(1, most + 1):
        H[:size, :size] = 0.0
        g[:size] = 0.0
        e = 0
        for i in range(n):
            for j in range(i + 1, n):
                for p in range(3):
                    for q in range(3):
                        P[p, q] = X[j, 0, p] * X[i, 0, q] + X[j, 1, p] * X[i, 1, q] + X[j, 2, p] * X[i, 2, q]
                small_log(m[e], P, r)
                inverse_jacobian(r, J)
                for p in range(3):
                    h[p] = info[e, p, 0] * r[0] + info[e, p, 1] * r[1] + info[e, p, 2] * r[2]
                    for q in range(3):
                        GP[p, q] = info[e, p, 0] * J[0, q] + info[e, p, 1] * J[1, q] + info[e, p, 2] * J[2, q]
                for p in range(3):
                    t[p] = J[0, p] * h[0] + J[1, p] * h[1] + J[2, p] * h[2]
                    for q in range(3):
                        G[p, q] = J[0, p] * GP[0, q] + J[1, p] * GP[1, q] + J[2, p] * GP[2, q]
                # i is station a, j is station b; b enters through -P
                for p in range(3):
                    for q in range(3):
                        GP[p, q] = P[p, 0] * G[0, q] + P[p, 1] * G[1, q] + P[p, 2] * G[2, q]
                b = 3 * (j - 1)
                for p in range(3):
                    g[b + p] += P[p, 0] * t[0] + P[p, 1] * t[1] + P[p, 2] * t[2]
                    for q in range(3):
                        H[b + p, b + q] += GP[p, 0] * P[q, 0] + GP[p, 1] * P[q, 1] + GP[p, 2] * P[q, 2]
                if i > 0:
                    a = 3 * (i - 1)
                    for p in range(3):
                        g[a + p] -= t[p]
                        for q in range(3):
                            H[a + p, a + q] += G[p, q]
                            H[b + p, a + q] -= GP[p, q]
                e += 1
        if not solve_in_place(H, g, size):
            return most + 1
        largest = 0.0
        for j in range(1, n):
            retract(X[j], g[3 * j - 3 : 3 * j])
            for p in range(3):
                largest = max(largest, abs(g[3 * j - 3 + p]))
        if not largest < 10.0:
            return most + 1
        if largest < limit:
            return iteration
    return most + 1


@njit(cache=True, nogil=True, error_model="numpy")
def adjust_trials(
    measured: FloatArray, information: FloatArray, n: int, limit: float, most: int, adjusted: FloatArray,
    omega: FloatArray, iterations: IntArray,
) -> None:  # fmt: skip
    """All trials: measured, information, adjusted (T, E, 3, 3), omega and iterations (T,)."""
    X, H, g, r = np.empty((n, 3, 3)), np.empty((3 * n, 3 * n)), np.empty(3 * n), np.empty(3)
    for trial in range(len(measured)):
        m, info = measured[trial], information[trial]
        iterations[trial] = adjust_trial(m, info, n, limit, most, X, H, g)
        e, total = 0, 0.0
        for i in range(n):
            for j in range(i + 1, n):
                P = adjusted[trial, e]
                for p in range(3):
                    for q in range(3):
                        P[p, q] = X[j, 0, p] * X[i, 0, q] + X[j, 1, p] * X[i, 1, q] + X[j, 2, p] * X[i, 2, q]
                small_log(m[e], P, r)
                for p in range(3):
                    for q in range(3):
                        total += r[p] * info[e, p, q] * r[q]
                e += 1
        omega[trial] = total
