"""Least squares for many complete networks of rotations at once: the parametric form, station 0 held.

Arrays are laid out by component, trials last: rotations of stations X (3, 3, n, T), of pairs (3, 3, E, T). Each step is
then arithmetic over all trials of a run, side by side, also the elimination.
"""

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray

_RUN = 1024  # trials at a time: what they need stays near the processor
_SETTLED = 1e-4  # rad; a step so small does not change the normal matrix by more


def adjust_trials(
    measured: FloatArray, information: FloatArray, n: int, limit: float, most: int
) -> tuple[FloatArray, FloatArray, IntArray]:
    """Adjusted ``b_from_a`` (T, E, 3, 3), v'Pv (T,) and iterations (T,), ``most`` + 1 where a trial did not settle.

    measured, information: (T, E, 3, 3), in the order (0, 1), (0, 2), ..., (1, 2), ... limit: of the last step, rad.
    """
    adjusted, omega = np.empty(measured.shape), np.empty(len(measured))
    iterations = np.empty(len(measured), dtype=np.int64)
    a, b = np.triu_indices(n, 1)
    room = np.empty((7, 3, 3, len(a), min(_RUN, len(measured))))  # of every run, made once
    for first in range(0, len(measured), _RUN):
        run = slice(first, first + _RUN)
        m, P, *rest = room[..., : len(measured[run])]
        for to, of in ((m, measured), (P, information)):
            to[:] = np.moveaxis(of[run], (2, 3, 1, 0), (0, 1, 2, 3))
        X, iterations[run] = _adjusted(m, P, n, limit, most, rest)
        turn = _turns(X, a, b, rest)
        r = _log(_times("ji,jk", m, turn, rest[0]))
        omega[run] = (r * _along("ij", P, r)).sum(axis=(0, 1))
        adjusted[run] = np.moveaxis(turn, (0, 1, 2, 3), (2, 3, 1, 0))
    return adjusted, omega, iterations


def _adjusted(
    m: FloatArray, P: FloatArray, n: int, limit: float, most: int, room: list[FloatArray]
) -> tuple[FloatArray, IntArray]:
    """Stations ``0_from_i`` X (3, 3, n, T) and iterations (T,) by Gauss-Newton; steps turn a station in the frame of 0.

    The residual Log(m' X_b' X_a) changes by Jr^-1 X_a' (d_a - d_b). Once all steps are below ``_SETTLED`` the normal
    matrix is kept, as in simplified Newton steps: they end in the same point.
    """
    trials, kept = m.shape[3], False
    out, iterations = np.empty((3, 3, n, trials)), np.full(trials, most + 1)
    out[:, :, 0] = np.eye(3)[:, :, None]
    out[:, :, 1:] = np.swapaxes(m[:, :, : n - 1], 0, 1)
    at, (a, b), X = np.arange(trials), np.triu_indices(n, 1), out.copy()
    H, good = np.empty((n - 1, 3, n - 1, 3, trials)), np.ones(trials, dtype=np.bool_)
    for iteration in range(1, most + 1):
        here = X_a, _, J, more, last = [part[..., : len(at)] for part in room]
        r = _log(_times("ji,jk", m, _turns(X, a, b, here), more))
        _times("ij,kj", _inverse_jacobian(r), X_a, J)
        if not kept:
            _fill_normal(_times("ji,jk", J, _times("ij,jk", P, J, more), last), a, b, H)
            good = _eliminate(H.reshape(3 * n - 3, 3 * n - 3, len(at)))
        step = _step(H, _along("ji", J, _along("ij", P, r)), a, b)
        X[:, :, 1:] = _times("ij,jk", _exp(step), X[:, :, 1:])
        largest = np.abs(step).max(axis=(0, 1))
        done = good & (largest < limit)
        iterations[at[done]] = iteration
        go = good & ~done & (largest < 10.0)
        kept = bool((largest[go] < _SETTLED).all())
        if go.all():
            continue
        out[:, :, :, at] = X
        if not go.any():
            break
        at, good, (X, m, P, H) = at[go], good[go], (np.compress(go, array, axis=-1) for array in (X, m, P, H))
    else:
        out[:, :, :, at] = X
    return out, iterations


def _times(indices: str, A: FloatArray, B: FloatArray, out: FloatArray | None = None) -> FloatArray:
    """Products of matrices (3, 3, k, T); the first index of ``indices`` not in both, then the other, remain."""
    left, right = indices.split(",")
    kept = "".join(i for i in "ik" if i in left + right)
    return np.asarray(np.einsum(f"{left}et,{right}et->{kept}et", A, B, out=out))


def _turns(X: FloatArray, a: IntArray, b: IntArray, room: list[FloatArray]) -> FloatArray:
    """``b_from_a`` (3, 3, E, T), in the last of ``room``; the first two hold the stations a and b."""
    for ends, out in ((a, room[0]), (b, room[1])):
        X.take(ends, axis=2, out=out, mode="clip")
    return _times("ji,jk", room[1], room[0], room[-1])


def _along(indices: str, A: FloatArray, v: FloatArray) -> FloatArray:
    """Products (3, k, T) of matrices (3, 3, k, T), or their transposes ("ji"), and vectors (3, k, T)."""
    return np.asarray(np.einsum(f"{indices}et,jet->iet", A, v))


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


def _fill_normal(S: FloatArray, a: IntArray, b: IntArray, H: FloatArray) -> None:
    """The upper triangle of the normal matrices H (n - 1, 3, n - 1, 3, T) of the stations but the first.

    S (3, 3, E, T): what each pair adds for the difference of its stations' steps.
    """
    for e, (i, j) in enumerate(zip((a - 1).tolist(), (b - 1).tolist(), strict=True)):
        if i < 0:  # the first pair of every other station
            H[j, :, j] = S[:, :, e]
            continue
        H[i, :, i] += S[:, :, e]
        H[j, :, j] += S[:, :, e]
        np.negative(S[:, :, e], out=H[i, :, j])


def _eliminate(A: FloatArray) -> BoolArray:
    """Symmetric A (n, n, T) eliminated in its upper triangle; where (T,) it is positive definite."""
    n, good = len(A), np.ones(A.shape[2], dtype=np.bool_)
    for k in range(n):
        good &= A[k, k] > 0.0
        A[k, k] = np.where(good, A[k, k], 1.0)
        factor = A[k, k + 1 :] / A[k, k]
        for i in range(k + 1, n):
            A[i, i:] -= factor[i - k - 1] * A[k, i:]
    return good


def _step(H: FloatArray, t: FloatArray, a: IntArray, b: IntArray) -> FloatArray:
    """The step (3, n - 1, T) of the stations but the first, H as eliminated; t (3, E, T) of the pairs."""
    k, trials = H.shape[0], H.shape[4]
    g = np.zeros((k + 1, 3, trials))
    for e, (i, j) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
        g[i] -= t[:, e]
        g[j] += t[:, e]
    A, x = H.reshape(3 * k, 3 * k, trials), g[1:].reshape(3 * k, trials)
    for i in range(3 * k):
        x[i + 1 :] -= A[i, i + 1 :] * (x[i] / A[i, i])
    for i in range(3 * k - 1, -1, -1):
        x[i] = (x[i] - (A[i, i + 1 :] * x[i + 1 :]).sum(axis=0)) / A[i, i]
    return np.swapaxes(x.reshape(k, 3, trials), 0, 1)
