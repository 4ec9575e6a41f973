"""Approximate coordinates in space from slope distances alone, where no angle, level or height goes before."""

from collections.abc import Mapping

import numpy as np

from adjust.model.survey import FloatArray
from adjust.start.readings.places import settled
from adjust.start.readings.sights import Node, Sights, best_of_places


def spread_space(sights: Sights, xy: dict[Node, complex], height: dict[Node, float]) -> None:
    """Add to ``xy`` and ``height`` the points that three or more slope distances fix in space.

    Does nothing where there is any angle, height difference or horizontal distance: these give better ways.
    """
    if sights.directions or sights.azimuths or sights.level or sights.rise or sights.zenith or not sights.slope:
        return
    if any(n in height and n not in xy for n in sights.nodes) or len({*xy} ^ {*height}) > 0:
        return  # heights are held: distances in a plane
    distance: dict[Node, dict[Node, float]] = {}
    for (a, b), values in sights.slope.items():
        d = float(np.median([v for v, _ in values]))
        distance.setdefault(a, {})[b] = d
        distance.setdefault(b, {})[a] = d
    known = {n: np.array([xy[n].real, xy[n].imag, height[n]]) for n in xy}
    if not known:
        known = _seed(distance)
    _grow(distance, known)
    for n, x in known.items():
        xy[n], height[n] = complex(x[0], x[1]), float(x[2])


def _seed(distance: Mapping[Node, Mapping[Node, float]]) -> dict[Node, FloatArray]:
    """A triangle with its three sides in the horizontal plane."""
    best: tuple[float, dict[Node, FloatArray]] = (0.0, {})
    for a in sorted(distance, key=lambda n: (-len(distance[n]), n))[:4]:
        near = sorted(distance[a])
        for i, b in enumerate(near):
            for c in near[:i]:
                if c in distance[b]:
                    p, q, r = distance[a][b], distance[a][c], distance[b][c]
                    x = (p * p + q * q - r * r) / (2.0 * p)
                    y2 = q * q - x * x
                    if y2 > 0.0 and p * np.sqrt(y2) > best[0]:
                        corners = (np.zeros(3), np.array([p, 0.0, 0.0]), np.array([x, np.sqrt(y2), 0.0]))
                        best = float(p * np.sqrt(y2)), dict(zip((a, b, c), corners, strict=True))
    return best[1]


def _grow(distance: Mapping[Node, Mapping[Node, float]], known: dict[Node, FloatArray]) -> None:
    """Sure points first; then of two mirrored places the one from which the rest fits."""

    def grown(node: Node, place: FloatArray) -> dict[Node, FloatArray]:
        return _sure(distance, {**known, node: place})

    def possible(node: Node) -> list[FloatArray]:
        return places(distance[node], known)

    found: dict[Node, FloatArray] | None = _sure(distance, known)
    while found is not None:
        known.update(found)
        found = best_of_places(
            set(distance) - set(known), possible, grown, lambda trial: (-len(trial), misfit(distance, trial))
        )


def _sure(distance: Mapping[Node, Mapping[Node, float]], known: Mapping[Node, FloatArray]) -> dict[Node, FloatArray]:
    """With all points that follow from the known ones without a choice."""
    out, before = dict(known), -1
    while len(out) > before:
        before = len(out)
        for n in sorted(set(distance) - set(out)):
            found = places(distance[n], out)
            if len(found) == 1:
                out[n] = found[0]
    return out


def places(mine: Mapping[Node, float], known: Mapping[Node, FloatArray]) -> list[FloatArray]:
    """Where a point with these distances to known points can be: one place, two mirrored ones, or none certain."""
    nodes = [n for n in mine if n in known]
    if len(nodes) < 3:
        return []
    X, d = np.array([known[n] for n in nodes]), np.array([mine[n] for n in nodes])
    centre = X.mean(axis=0)
    _, s, Vt = np.linalg.svd(X - centre)
    if s[1] < 0.05 * s[0]:
        return []
    flat = s[2] < 0.05 * s[0] if len(s) > 2 else True
    out: list[FloatArray] = []

    def evaluate(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        to = x[:, None] - X
        length = np.linalg.norm(to, axis=2)
        return length - d, to / np.maximum(length, np.finfo(float).tiny)[..., None]

    found, misses, _ = settled(evaluate, centre + np.median(d) * np.array([Vt[2], -Vt[2]]), 100)
    for place, missed in zip(found, misses, strict=True):
        cost = float(np.linalg.norm(missed))
        if cost < 0.02 * float(np.median(d)) and not any(np.linalg.norm(place - x) < 0.02 * d.min() for x in out):
            out.append(place)
    if len(out) == 2 and not flat:
        costs = [float(np.abs(np.linalg.norm(x - X, axis=1) - d).max()) for x in out]
        if min(costs) < 0.2 * max(costs):
            return [out[int(np.argmin(costs))]]
    return out


def misfit(distance: Mapping[Node, Mapping[Node, float]], x: Mapping[Node, FloatArray]) -> float:
    """Sum of what the distances between known points miss."""
    return float(sum(abs(np.linalg.norm(x[a] - x[b]) - d) for a, near in distance.items() if a in x
                     for b, d in near.items() if b in x))  # fmt: skip
