"""Least squares for many complete networks of rotations at once: the parametric form, station 0 held.

Arrays are laid out by component, trials last: rotations of stations X (3, 3, n, T), of pairs (3, 3, E, T). Each step is
then arithmetic over all trials of a run, side by side, also the elimination.
"""

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray

_RUN = 512  # trials at a time: what they need stays in the processor's cache


def adjust_trials(
    measured: FloatArray, information: FloatArray, n: int, limit: float, most: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Adjusted ``b_from_a`` (T, E, 3, 3), v'Pv (T,) and iterations (T,), ``most`` + 1 where a trial did not settle.

    measured, information: (T, E, 3, 3), in the order (0, 1), (0, 2), ..., (1, 2), ... limit: of the last step, rad.
    """
    adjusted, omega = np.empty(measured.shape), np.empty(len(measured))
    iterations = np.empty(len(measured), dtype=np.int64)
    for first in range(0, len(measured), _RUN):
        run = slice(first, first + _RUN)
        m, P = (np.ascontiguousarray(np.moveaxis(x[run], (2, 3, 1, 0), (0, 1, 2, 3))) for x in (measured, information))
        X, iterations[run] = _adjusted(m, P, n, limit, most)
        turn = _pairs(X, *np.triu_indices(n, 1))
        r = _log(_times("ji,jk", m, turn))
        omega[run] = np.einsum("iet,ijet,jet->t", r, P, r, optimize=True)
        adjusted[run] = np.moveaxis(turn, (0, 1, 2, 3), (2, 3, 1, 0))
    return adjusted, omega, iterations


def _adjusted(m: FloatArray, P: FloatArray, n: int, limit: float, most: int) -> tuple[FloatArray, IntArray]:
    """Stations ``0_from_i`` X (3, 3, n, T) and iterations (T,) by Gauss-Newton; steps turn a station in the frame of 0.

    The residual Log(m' X_b' X_a) changes by Jr^-1 X_a' (d_a - d_b).
    """
    trials = m.shape[3]
    out, iterations = np.empty((3, 3, n, trials)), np.full(trials, most + 1)
    out[:, :, 0] = np.eye(3)[:, :, None]
    out[:, :, 1:] = np.swapaxes(m[:, :, : n - 1], 0, 1)
    at, (a, b), X = np.arange(trials), np.triu_indices(n, 1), out
    for iteration in range(1, most + 1):
        r = _log(_times("ji,jk", m, _pairs(X, a, b)))
        J = _times("ij,kj", _inverse_jacobian(r), X.take(a, axis=2))
        weighted = _times("ij,jk", P, J)
        step, good = _step(_times("ji,jk", J, weighted), np.einsum("jiet,jet->iet", weighted, r), a, b, n)
        X = X.copy()
        X[:, :, 1:] = _times("ij,jk", _exp(step), X[:, :, 1:])
        out[:, :, :, at] = X
        largest = np.abs(step).max(axis=(0, 1))
        iterations[at[good & (largest < limit)]] = iteration
        go = good & (largest >= limit) & (largest < 10.0)
        if not go.any():
            break
        at, (X, m, P) = at[go], (np.compress(go, array, axis=3) for array in (X, m, P))
    return out, iterations


def _times(indices: str, A: FloatArray, B: FloatArray) -> FloatArray:
    """Products of matrices (3, 3, k, T); the first index of ``indices`` not in both, then the other, remain."""
    left, right = indices.split(",")
    kept = "".join(i for i in "ik" if i in left + right)
    return np.asarray(np.einsum(f"{left}et,{right}et->{kept}et", A, B))


def _pairs(X: FloatArray, a: IntArray, b: IntArray) -> FloatArray:
    """``b_from_a`` (3, 3, E, T)."""
    return _times("ji,jk", X.take(b, axis=2), X.take(a, axis=2))


def _log(R: FloatArray) -> FloatArray:
    """Rotation vectors (3, E, T), for angles below a right angle or so (residuals)."""
    r = np.stack([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine = 0.5 * np.sqrt((r**2).sum(axis=0))
    angle = np.arctan2(sine, 0.5 * (R[0, 0] + R[1, 1] + R[2, 2] - 1.0))
    small = sine <= 1e-9
    return np.asarray(0.5 * np.where(small, 1.0, angle / np.where(small, 1.0, sine)) * r)


def _around(r: FloatArray, a: FloatArray, b: FloatArray) -> FloatArray:
    """1 + a [r]x + b [r]x [r]x (3, 3, k, T) of vectors r (3, k, T)."""
    out = b * r[:, None] * r[None]
    rest = 1.0 - b * (r**2).sum(axis=0)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        out[i, i] += rest
        out[j, k] -= a * r[i]
        out[k, j] += a * r[i]
    return out


def _inverse_jacobian(r: FloatArray) -> FloatArray:
    """Jr^-1 (3, 3, E, T), as of :mod:`adjust.spatial.rigid_motions`."""
    x = (r**2).sum(axis=0)
    half = 0.5 * np.sqrt(np.maximum(x, 1e-3))
    series = 1.0 / 12.0 + x / 720.0 + x * x / 30240.0
    c = np.where(x < 1e-3, series, (1.0 - half * np.cos(half) / np.sin(half)) / np.maximum(x, 1e-3))
    return _around(r, np.full(x.shape, 0.5), c)


def _exp(r: FloatArray) -> FloatArray:
    """Rotations (3, 3, k, T) of vectors (3, k, T) rad (Rodrigues)."""
    angle = np.sqrt((r**2).sum(axis=0))
    return _around(r, np.sinc(angle / np.pi), 0.5 * np.sinc(0.5 * angle / np.pi) ** 2)


def _step(S: FloatArray, t: FloatArray, a: IntArray, b: IntArray, n: int) -> tuple[FloatArray, BoolArray]:
    """The step (3, n - 1, T) of the stations but the first, and where (T,) the normal equations are definite.

    S (3, 3, E, T), t (3, E, T): what each pair adds to them for the difference of its stations' steps.
    """
    trials = t.shape[2]
    H, g = np.zeros((n, 3, n, 3, trials)), np.zeros((n, 3, trials))
    for e, (i, j) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
        H[i, :, i] += S[:, :, e]
        H[j, :, j] += S[:, :, e]
        H[i, :, j] = H[j, :, i] = -S[:, :, e]
        g[i] -= t[:, e]
        g[j] += t[:, e]
    size = 3 * (n - 1)
    x, good = _eliminated(H[1:, :, 1:].reshape(size, size, trials), g[1:].reshape(size, trials))
    return np.swapaxes(x.reshape(n - 1, 3, trials), 0, 1), good


def _eliminated(A: FloatArray, b: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Solutions (n, T) of symmetric A x = b, A (n, n, T), and where (T,) A is positive definite. A and b are lost."""
    n, good = len(b), np.ones(b.shape[1], dtype=np.bool_)
    for k in range(n):
        good &= A[k, k] > 0.0
        A[k, k] = np.where(good, A[k, k], 1.0)
        factor = A[k + 1 :, k] / A[k, k]
        A[k + 1 :, k + 1 :] -= factor[:, None] * A[k, k + 1 :]
        b[k + 1 :] -= factor * b[k]
    for k in range(n - 1, -1, -1):
        b[k] = (b[k] - (A[k, k + 1 :] * b[k + 1 :]).sum(axis=0)) / A[k, k]
    return b, good
