"""Where a point can be: least squares from many starts at once, as few observations have several solutions."""

from collections.abc import Callable

import numpy as np

from adjust.model.survey import FloatArray

_LOST = 1e-9
_SMALL = 1e-10
"""Of a step to the extent of the starts: it stands."""
_LEAST, _LARGEST = 1e-9, 1e30
"""Damping, of the trace: what one ray or circle leaves open keeps its value; without a gain it stays finite."""

Evaluate = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Of places (s, k): what the observations miss there (s, n), and its derivatives (s, n, k)."""


def settled(evaluate: Evaluate, starts: FloatArray, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Minima (s, k) of the sums of squares near ``starts`` (s, k), with misses (s, n) and derivatives (s, n, k) there.

    Levenberg-Marquardt with a damping for each start, ``most`` steps. Source: Madsen, Nielsen and Tingleff, Methods for
    non-linear least squares problems (2004), section 3.2.
    """
    x, size = np.array(starts), float(np.linalg.norm(starts - starts.mean(axis=0), axis=1).max())
    misses, by_x = evaluate(x)
    damping, times, moves = np.full(len(x), 1e-3), np.full(len(x), 2.0), np.arange(len(x))
    for _ in range(most):
        J, r, mu = by_x[moves], misses[moves], damping[moves]
        normal, gradient = np.einsum("sni,snj->sij", J, J), np.einsum("sni,sn->si", J, r)
        mu = mu * np.maximum(np.trace(normal, axis1=1, axis2=2), np.finfo(float).tiny)
        step = -np.linalg.solve(normal + mu[:, None, None] * np.eye(x.shape[1]), gradient[..., None])[..., 0]
        missed, derived = evaluate(x[moves] + step)
        promised = (step * (mu[:, None] * step - gradient)).sum(axis=1)
        gain = ((r * r).sum(axis=1) - (missed * missed).sum(axis=1)) / np.maximum(promised, np.finfo(float).tiny)
        better = gain > 0.0
        at = moves[better]
        x[at], misses[at], by_x[at] = x[at] + step[better], missed[better], derived[better]
        damping[moves] *= np.where(better, np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), times[moves])
        damping[moves] = np.clip(damping[moves], _LEAST, _LARGEST)
        times[moves] = np.where(better, 2.0, np.minimum(2.0 * times[moves], _LARGEST))
        stands = np.linalg.norm(step, axis=1) <= _SMALL * size
        moves = moves[~stands]
        if not len(moves):
            break
    return x, misses, by_x


def positions(
    rays: list[tuple[complex, float]], circles: list[tuple[complex, float]],
    sets: list[list[tuple[complex, float]]],
) -> list[complex]:  # fmt: skip
    """Points that agree with rays to them, distances, and sets of directions from them; none where it is uncertain.

    One: it is unique. Several: each fits as well. Found from starts all round, as few points are concerned.
    """
    centres = np.array([z for z, _ in rays] + [z for z, _ in circles] + [z for s in sets for z, _ in s])
    size = max(float(np.abs(centres - centres.mean()).max()), max((d for _, d in circles), default=0.0), 1e-3)
    around = np.exp(2j * np.pi * np.arange(8) / 8.0)
    starts = np.concatenate(
        [o + d * np.exp(2j * np.pi * np.arange(12) / 12.0) for o, d in circles[:2]] or
        [centres.mean() + r * size * around for r in (0.3, 1.0, 2.5)]
    )  # fmt: skip

    def evaluate(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        z = x[:, :1] + 1j * x[:, 1:]
        parts = [_rays(z, rays, size), _circles(z, circles), *(_set(z, seen, size) for seen in sets)]
        by_z = np.concatenate([d for _, d in parts], axis=1)
        return np.concatenate([r for r, _ in parts], axis=1), np.stack([by_z.real, by_z.imag], axis=2)

    x, misses, by_x = settled(evaluate, np.stack([starts.real, starts.imag], axis=1), 60)
    values = np.linalg.svd(by_x, compute_uv=False)
    sures = (values[:, -1] > 0.02 * np.maximum(values[:, 0], 1.0)) & (values.shape[1] > 1)
    found: list[tuple[float, complex, bool]] = []
    for place, cost, sure in zip(x, np.linalg.norm(misses, axis=1), sures, strict=True):
        z = complex(place[0], place[1])
        if not any(abs(z - other) < 1e-3 * size for _, other, _ in found):
            found.append((float(cost), z, bool(sure)))
    best = min(cost for cost, _, _ in found)
    good = [(c, z, sure) for c, z, sure in found if c < 3.0 * best + 2e-3 * size]
    return [z for _, z, sure in sorted(good, key=lambda g: g[0]) if sure] if all(g[2] for g in good) else []


_Complex = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]
_Missed = tuple[FloatArray, _Complex]
"""What is missed at places z (s, 1) and its derivatives by z (s, n): by the real part + 1j times by the imaginary."""


def _rays(z: _Complex, rays: list[tuple[complex, float]], size: float) -> _Missed:
    """Directions from known points, as metres at the distance ``size``."""
    to = z - np.array([o for o, _ in rays], complex)
    return np.angle(to * np.exp(-1j * np.array([a for _, a in rays]))) * size, _of_angle(to) * size


def _circles(z: _Complex, circles: list[tuple[complex, float]]) -> _Missed:
    to = z - np.array([o for o, _ in circles], complex)
    length: FloatArray = np.abs(to)
    by_z: _Complex = to / np.maximum(length, np.finfo(float).tiny)
    return length - np.array([d for _, d in circles]), by_z


def _set(z: _Complex, seen: list[tuple[complex, float]], size: float) -> _Missed:
    """Directions from the place, against their mean turn."""
    to = np.array([o for o, _ in seen]) - z
    turns = to * np.exp(-1j * np.array([a for _, a in seen]))
    turns /= np.maximum(np.abs(turns), _LOST * size)
    mean = turns.sum(axis=1, keepdims=True)
    by_z = -_of_angle(to)
    share = (turns * mean.conj()).real / np.maximum(np.abs(mean) ** 2, np.finfo(float).tiny)
    return np.angle(turns * mean.conj()) * size, (by_z - (share * by_z).sum(axis=1, keepdims=True)) * size


def _of_angle(w: _Complex) -> _Complex:
    """Derivative of the angle of w by w: by its real part + 1j times by its imaginary part."""
    by_w: _Complex = 1j * w / np.maximum(np.abs(w) ** 2, np.finfo(float).tiny)
    return by_w
