"""The distribution of a sum of weighted squares of residuals that belong together: ``sum of lambda_i chi-square_1``.

v'Pv of a group has the eigenvalues lambda of its part R_gg of the redundancy matrix: they lie between 0 and 1, add up
to its redundancy r, and their squares to half its variance.
"""

import numpy as np
import scipy

from adjust.model.survey import FloatArray, IntArray
from adjust.testing.distributions import chi2, norm

_STEPS = 100
_DETERMINED = 1e-9
"""Share that is not rounding: of a correlation matrix's largest eigenvalue, of a variance; joint ones lose digits."""
_NEAR = 1e-4


def pseudo_half(M: FloatArray, least: float, share: float = 0.0) -> tuple[FloatArray, IntArray]:
    """H (..., n, n) with ``H H' = M^+`` and the rank (...,) of symmetric matrices M.

    Open are directions whose eigenvalue is not above ``least``, nor above that ``share`` of the largest one.
    """
    values, vectors = np.linalg.eigh(M)
    seen = values > np.maximum(least, share * values.max(axis=-1, keepdims=True, initial=0.0))
    half = vectors * np.where(seen, 1.0 / np.sqrt(np.where(seen, values, 1.0)), 0.0)[..., None, :]
    return half, seen.sum(axis=-1)


def pseudo_squares(g: FloatArray, M: FloatArray, least: float, share: float = 0.0) -> tuple[FloatArray, IntArray]:
    """``g' M^+ g`` (...,) of g (..., n), and the rank of M."""
    half, rank = pseudo_half(M, least, share)
    return np.asarray((np.einsum("...qk,...q->...k", half, g) ** 2).sum(axis=-1)), rank


def many_pseudo_squares(g: FloatArray, M: FloatArray, least: float) -> tuple[FloatArray, IntArray]:
    """The same of many g (k, n) and M (k, n, n) without negative eigenvalues: by inverses, where none shows one open.

    No eigenvalue of the inverse is larger than the root of its squares; a quarter of the work of all eigenvalues.
    """
    T, rank = np.zeros(len(M)), np.zeros(len(M), dtype=np.int64)
    some = np.flatnonzero(np.einsum("kii->k", M) > least)
    try:
        inverse = np.linalg.inv(M[some])
        full = np.einsum("kij,kij->k", inverse, inverse) < least**-2
    except np.linalg.LinAlgError:
        inverse, full = M[some], np.zeros(len(some), dtype=np.bool_)
    at, rest = some[full], some[~full]
    T[at], rank[at] = np.einsum("ki,kij,kj->k", g[at], inverse[full], g[at]), M.shape[2]
    T[rest], rank[rest] = pseudo_squares(g[rest], M[rest], least)
    return T, rank


def explaining(M: FloatArray, g: FloatArray, T: float, spread: float, least: float) -> list[int]:
    """The fewest components that leave nothing significant of ``T = g' M^+ g`` (n,), one added after the other.

    spread: variance factor of g. least: as in :func:`pseudo_half`.
    """

    def part(index: list[int]) -> float:
        return float(g[index] @ np.linalg.pinv(M[np.ix_(index, index)], rcond=least, hermitian=True) @ g[index])

    index: list[int] = []
    possible = [i for i in range(len(g)) if M[i, i] > least]
    limit = spread * float(norm.isf(0.005)) ** 2
    while possible:
        taken = [part([*index, i]) for i in possible]
        # of those that say the same, such as width and height of a board, the first
        best = next(i for i, x in enumerate(taken) if x >= max(taken) - 1e-6 * abs(T))
        if index and taken[best] - part(index) < limit:
            break
        index.append(possible.pop(best))
        if T - taken[best] < limit:
            break
    return index


def normal_score(T: FloatArray, q: IntArray) -> FloatArray:
    """As a standard normal quantity, also where p is too small for a number (Wilson and Hilferty 1931)."""
    c = 2.0 / (9.0 * q)
    return np.asarray(((T / q) ** (1.0 / 3.0) - 1.0 + c) / np.sqrt(c))


def squares_in_sigmas(d: FloatArray, Q: FloatArray) -> tuple[FloatArray, IntArray]:
    """``d' Q^+ d`` (...,) and the rank of Q (..., n, n), of d (..., n) with covariance Q, as :func:`pseudo_square`."""
    s = np.sqrt(np.maximum(np.diagonal(Q, axis1=-2, axis2=-1), 1e-300))
    return pseudo_squares(d / s, Q / (s[..., :, None] * s[..., None, :]), _DETERMINED, _DETERMINED)


def pseudo_square(d: FloatArray, Q: FloatArray) -> tuple[float, int, FloatArray]:
    """``d' Q^+ d``, the rank of Q, and ``Q^+`` (n, n), of d (n,) with covariance Q; in sigmas, as units do not mix."""
    s = np.sqrt(np.maximum(np.diag(Q), 1e-300))
    half, rank = pseudo_half(Q / np.outer(s, s), _DETERMINED, _DETERMINED)
    half = half / s[:, None]
    y = half.T @ d
    return float(y @ y), int(rank), half @ half.T


def pseudo_square_beside(d: FloatArray, Q: FloatArray, held: FloatArray) -> tuple[float, int]:
    """``d' Q^+ d`` and the rank of Q, by Cholesky's method where nothing is open but directions held (n, k).

    Q held = 0 and held' d = 0: with N that spans these in sigmas, Q^+ is inv(Q + N N') on d. Nothing is taken for
    rounding there but what the components before one leave of its variance: in a long chain, where all neighbours move
    together, eigenvalues span far more than that, and the smallest tell of the neighbours. Else :func:`pseudo_square`.
    """
    s, _, factor = _factored(Q, held)
    if factor is None:
        return pseudo_square(d, Q)[:2]
    y = scipy.linalg.lapack.dtrtrs(factor, d / s, lower=0, trans=1)[0]
    return float(y @ y), len(d) - held.shape[1]


def pseudo_precision(Q: FloatArray, held: FloatArray) -> FloatArray:
    """The diagonal (n,) of ``Q^+`` as :func:`pseudo_square` has it, of a Q (n, n) with nothing open but ``held``."""
    s, N, factor = _factored(Q, held)
    if factor is None:
        return np.diag(pseudo_square(np.zeros(len(Q)), Q)[2])
    inverse = scipy.linalg.lapack.dpotri(factor, lower=0, overwrite_c=1)[0]
    return np.asarray((np.diag(inverse) - (N**2).sum(axis=1)) / s**2)


def _factored(Q: FloatArray, held: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray | None]:
    """Sigmas s (n,), N (n, k) that spans what is held in sigmas, and R with R'R = Q in sigmas + N N'; None if lost."""
    s = np.sqrt(np.maximum(np.diag(Q), 1e-300))
    N = np.linalg.qr(s[:, None] * held)[0]
    full = Q / s[:, None]
    full /= s
    full += N @ N.T
    least = _DETERMINED * np.diag(full)
    factor, lost = scipy.linalg.lapack.dpotrf(full.T, lower=0, clean=0, overwrite_a=1) if len(Q) else (full, 1)
    return s, N, None if lost or (np.diag(factor) ** 2 < least).any() else factor


def upper_tail(x: float, weights: FloatArray) -> float:
    """P(sum of weights_i chi-square_1 > x), weights (k,) positive: the saddlepoint formula of Lugannani and Rice.

    Kuonen (1999), Biometrika 86, 929-935; its relative error stays small far out, where that of chi-square with the
    same two moments (Satterthwaite 1946) grows without bound. At the mean its limit.
    """
    weights = weights[weights > 0.0]
    mean, squares = float(weights.sum()), float((weights**2).sum())
    if x <= 0.0:
        return 1.0
    if len(weights) == 1 or np.ptp(weights) < 1e-9 * weights.max():
        return float(chi2.sf(x / weights[0], len(weights)))
    if abs(x - mean) > _NEAR * np.sqrt(2.0 * squares):
        t = _saddlepoint(x, weights)
        rest = 1.0 - 2.0 * t * weights
        w = np.sign(t) * np.sqrt(max(2.0 * t * x + float(np.log(rest).sum()), 0.0))
        v = t * np.sqrt(2.0 * float(((weights / rest) ** 2).sum()))
        if abs(w) > _NEAR and v != 0.0:
            return float(np.clip(norm.sf(w + np.log(v / w) / w), 0.0, 1.0))
    skewness = 8.0 * float((weights**3).sum()) / (2.0 * squares) ** 1.5
    return float(0.5 - skewness / (6.0 * np.sqrt(2.0 * np.pi)))


def _saddlepoint(x: float, weights: FloatArray) -> float:
    """T with K'(t) = sum of lambda / (1 - 2 t lambda) = x, which grows with t up to 1 / (2 max lambda)."""
    high = 0.5 / float(weights.max())
    # K' is at least its largest term, and at most k of them
    low = min(0.0, 0.5 * (1.0 / float(weights.max()) - len(weights) / x)) - 1.0
    while float((weights / (1.0 - 2.0 * low * weights)).sum()) > x:
        low *= 2.0
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        if float((weights / np.maximum(1.0 - 2.0 * middle * weights, 1e-300)).sum()) > x:
            high = middle
        else:
            low = middle
    return low


def upper_tail_bound(x: FloatArray | float, redundancy: FloatArray | float) -> FloatArray:
    """At least P(sum > x) (k,), far above its mean, whatever the weights: chi-square with r degrees of freedom (k,).

    Of all weights up to 1 with the sum r those that are 1 or 0 spread most (Szekely and Bakirov 2003).
    """
    return np.asarray(chi2.sf(x, redundancy))
