"""Where a point can be: least squares from many starts at once, as few observations have several solutions."""

from collections.abc import Callable, Iterable
from functools import lru_cache

import numpy as np

from adjust.model.survey import FloatArray

_LOST = 1e-9
_SMALL = 1e-10
"""Of a step to the extent of the starts: it stands."""
_ROUNDING, _TINY = float(np.finfo(float).eps), float(np.finfo(float).tiny)
_LEAST, _LARGEST = 1e-9, 1e30
"""Damping, of the trace: what one ray or circle leaves open keeps its value; without a gain it stays finite."""

Evaluate = Callable[[FloatArray], tuple[FloatArray, FloatArray]]
"""Of places (s, k): what the observations miss there (s, n), and its derivatives (s, n, k)."""


def settled(evaluate: Evaluate, starts: FloatArray, most: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Minima (s, k) of the sums of squares near ``starts`` (s, k), with misses (s, n) and derivatives (s, n, k) there.

    Levenberg-Marquardt with a damping for each start, ``most`` steps, until what a step moves, or promises to gain, is
    nothing. Source: Madsen, Nielsen and Tingleff, Methods for non-linear least squares problems (2004), section 3.2.
    """
    x, size = np.array(starts), float(np.linalg.norm(starts - starts.mean(axis=0), axis=1).max())
    misses, by_x = evaluate(x)
    damping, times, moves = np.full(len(x), 1e-3), np.full(len(x), 2.0), np.arange(len(x))
    squares, no_turn = (misses * misses).sum(axis=1), np.eye(x.shape[1])
    for _ in range(most):
        J, cost = by_x[moves], squares[moves]
        Jt = J.transpose(0, 2, 1)
        normal, gradient = Jt @ J, (Jt @ misses[moves, :, None])[..., 0]
        mu = damping[moves] * np.maximum(np.trace(normal, axis1=1, axis2=2), _TINY)
        step = -np.linalg.solve(normal + mu[:, None, None] * no_turn, gradient[..., None])[..., 0]
        promised = (step * (mu[:, None] * step - gradient)).sum(axis=1)
        missed, derived = evaluate(x[moves] + step)
        left = (missed * missed).sum(axis=1)
        gain = (cost - left) / np.maximum(promised, _TINY)
        better = gain > 0.0
        at = moves[better]
        x[at], misses[at], by_x[at], squares[at] = x[at] + step[better], missed[better], derived[better], left[better]
        eased = np.where(better, np.maximum(1.0 / 3.0, 1.0 - (2.0 * gain - 1.0) ** 3), times[moves])
        damping[moves] = np.minimum(np.maximum(damping[moves] * eased, _LEAST), _LARGEST)
        times[moves] = np.where(better, 2.0, np.minimum(2.0 * times[moves], _LARGEST))
        moves = moves[((step * step).sum(axis=1) > (_SMALL * size) ** 2) & (promised > _ROUNDING * cost)]
        if not len(moves):
            break
    return x, misses, by_x


_Seen = tuple[tuple[complex, float], ...]
"""Known points, and what was measured to each."""


def positions(
    rays: Iterable[tuple[complex, float]], circles: Iterable[tuple[complex, float]],
    sets: Iterable[Iterable[tuple[complex, float]]],
) -> list[complex]:  # fmt: skip
    """Points that agree with rays to them, distances, and sets of directions from them; none where it is uncertain.

    One: it is unique. Several: each fits as well. Found from starts all round, as few points are concerned.
    """
    return list(_positions(tuple(rays), tuple(circles), tuple(map(tuple, sets))))


@lru_cache(maxsize=512)  # surveys that differ in one reading have most of their points in common
def _positions(rays: _Seen, circles: _Seen, sets: tuple[_Seen, ...]) -> tuple[complex, ...]:
    centres = np.array([z for seen in (rays, circles, *sets) for z, _ in seen])
    size = max(float(np.abs(centres - centres.mean()).max()), max((d for _, d in circles), default=0.0), 1e-3)
    around = np.exp(2j * np.pi * np.arange(8) / 8.0)
    starts = np.concatenate(
        [o + d * np.exp(2j * np.pi * np.arange(12) / 12.0) for o, d in circles[:2]] or
        [centres.mean() + r * size * around for r in (0.3, 1.0, 2.5)]
    )  # fmt: skip
    of = [kind(seen, size) for kind, seen in ((_rays, rays), (_circles, circles), *((_set, s) for s in sets)) if seen]

    def evaluate(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        z = x[:, :1] + 1j * x[:, 1:]
        parts = [missed(z) for missed in of]
        by_z = np.concatenate([d for _, d in parts], axis=1)
        return np.concatenate([r for r, _ in parts], axis=1), by_z[..., None].view(np.float64)

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
    return tuple(z for _, z, sure in sorted(good, key=lambda g: g[0]) if sure) if all(g[2] for g in good) else ()


_Complex = np.ndarray[tuple[int, ...], np.dtype[np.complex128]]
_Missed = Callable[[_Complex], tuple[FloatArray, _Complex]]
"""Of places z (s, 1) what is missed there and its derivatives by z (s, n): by the real part + 1j times by the
imaginary."""


def _read(seen: _Seen) -> tuple[_Complex, FloatArray]:
    return np.array([o for o, _ in seen], dtype=complex), np.array([value for _, value in seen])


def _rays(rays: _Seen, size: float) -> _Missed:
    """Directions from known points, as metres at the distance ``size``."""
    origins, angles = _read(rays)
    back = np.exp(-1j * angles)

    def missed(z: _Complex) -> tuple[FloatArray, _Complex]:
        to = z - origins
        return np.angle(to * back) * size, _of_angle(to) * size

    return missed


def _circles(circles: _Seen, _: float) -> _Missed:
    centres, radii = _read(circles)

    def missed(z: _Complex) -> tuple[FloatArray, _Complex]:
        to = z - centres
        length: FloatArray = np.abs(to)
        return length - radii, to / np.maximum(length, _TINY)

    return missed


def _set(seen: _Seen, size: float) -> _Missed:
    """Directions from the place, against their mean turn."""
    targets, angles = _read(seen)
    back = np.exp(-1j * angles)

    def missed(z: _Complex) -> tuple[FloatArray, _Complex]:
        to = targets - z
        turns = to * back
        turns /= np.maximum(np.abs(turns), _LOST * size)
        mean = turns.sum(axis=1, keepdims=True)
        turned, by_z = turns * mean.conj(), -_of_angle(to)
        share = turned.real / np.maximum(np.abs(mean) ** 2, _TINY)
        return np.angle(turned) * size, (by_z - (share * by_z).sum(axis=1, keepdims=True)) * size

    return missed


def _of_angle(w: _Complex) -> _Complex:
    """Derivative of the angle of w by w: by its real part + 1j times by its imaginary part."""
    by_w: _Complex = 1j * w / np.maximum(np.abs(w) ** 2, _TINY)
    return by_w
