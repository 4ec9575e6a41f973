"""Which spot is which beacon, and all poses that explain an epoch.

Without a prior: three spots are named at a time in all ways that the distances of the beacons allow, each naming gives
all its poses, and the poses are judged by how many other spots they explain and which beacons they miss. With a prior:
only the beacons that it predicts near a spot are tried. The candidates are adjusted, their spots tested, and compared
by their evidence: what cannot be told apart is reported, all of it.
"""

from itertools import combinations

import numpy as np

from adjust.lenses.models import MODELS, focal_length_px
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.navigation import FoundArrays, SkyArrays, search
from adjust.navigation.evidence import (
    DETECTION,
    GATE,
    KEPT,
    MOST_NAMINGS,
    Candidate,
    Trial,
    allowed_namings,
    gate_distances,
    image_areas,
    judged,
    score_of,
)
from adjust.navigation.fit import Prior, fit_pose
from adjust.navigation.system import Sightings, System, station_rays
from adjust.spatial.rigid import rigid

PROBABILITY = 0.999
"""What a solution needs to be taken for the only one."""
_GATE = float(np.radians(0.8))
"""How far a beacon may be from a spot in a hypothesis of three."""
_NEAREST_M, _FARTHEST = 0.05, 10.0
"""Distances of beacons: the least, and the largest in extents of them all."""
_MOST_HYPOTHESES = 40_000
"""Three-point problems solved for one epoch at most."""
_COARSE = 25.0  # difference in the coarse score, about ln of the evidence, beyond which nobody looks
_DOUBTED = 6
_BEYOND_DOUBT = 20.0  # 2 ln of a likelihood ratio
_CROWDED = 3.0  # beacons near a spot beyond which naming in turn is hopeless
_MOST_TRIPLES = 400


def without_prior(seen: Sightings, alpha: float) -> tuple[Candidate, ...]:
    """All explanations of an epoch that are worth naming, best first; empty where fewer than three spots are there."""
    if len(seen.uv) < 3:
        return ()
    return judged(seen, _hypotheses(seen, allowed_namings(seen)), None, alpha)


def _hypotheses(seen: Sightings, allowed: BoolArray) -> list[Trial]:
    """Poses (4, 4) and namings (n,) by the coarse consensus, best first."""
    n, system = len(seen.uv), seen.system.arrays
    farthest = _FARTHEST * float(np.linalg.norm(np.ptp(system.x_in_world, axis=0)))
    R, t = np.empty((KEPT, 3, 3)), np.empty((KEPT, 3))
    score, match = np.full(KEPT, -np.inf), np.empty((KEPT, n), dtype=np.int64)
    missed = np.where(seen.present, -np.log(1.0 - DETECTION), 0.0)
    named = np.log(_sky(seen.system) / _GATE**2)[seen.camera]
    origin, ray = station_rays(seen)
    sky = SkyArrays(
        origin, np.ascontiguousarray(ray), seen.camera, allowed, system.x_in_world, system.camera_R, system.camera_t,
        seen.system.field, _GATE, named, missed,
    )  # fmt: skip
    kept = search(sky, _triples(ray), _NEAREST_M, farthest, _MOST_HYPOTHESES, FoundArrays(R, t, score, match))
    order = np.argsort(-score[:kept], kind="stable")
    order = order[score[order] > score[order[:1]] - _COARSE]
    return list(zip(rigid(R[order], t[order]), match[order], strict=True))


def _sky(system: System) -> FloatArray:
    """Solid angle (c,) of each camera's image, about."""
    focal = [focal_length_px(MODELS[c.model], c.lens, c.constants) for c in system.head.cameras]
    return np.asarray(image_areas(system) / np.array(focal) ** 2)


def _triples(ray: FloatArray) -> IntArray:
    """Triples of spots: those that determine a pose best (widest between their rays) mixed with others, no order."""
    every = np.array(list(combinations(range(len(ray)), 3)), dtype=np.int64)
    a, b, c = (ray[every[:, i]] for i in range(3))
    width = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    # quality in steps, and inside a step an order that does not favour any spot
    rng = np.random.default_rng(len(every))
    rank = np.lexsort((rng.random(len(every)), -np.floor(np.log2(np.maximum(width, 1e-9)))))
    return np.ascontiguousarray(every[rank][:_MOST_TRIPLES])


def with_prior(seen: Sightings, prior: Prior, alpha: float) -> tuple[Candidate, ...]:
    """Explanations near a prior, best first. One that leaves components open needs names, or three spots."""
    if len(prior.rows) < 6:
        return _with_partial_prior(seen, prior, alpha)
    distance, support = gate_distances(seen, prior)
    near = (distance < GATE) & allowed_namings(seen) & (support > 0.0)
    if len(seen.uv) >= 3 and near.sum() > _CROWDED * near.any(axis=1).sum():
        trials = _doubted(_hypotheses(seen, near), support)
        found = judged(seen, trials, prior, alpha)
        if found:
            return _agreed(seen, prior, found)
    trials = _doubted(_in_turn(seen, prior, near, distance), support)
    return _agreed(seen, prior, judged(seen, trials, prior, alpha))


def _doubted(trials: list[Trial], support: FloatArray) -> list[Trial]:
    """The likeliest trials, and each again without one of the spots that the prior alone does not tell from chance."""
    out = trials[: MOST_NAMINGS // 3]
    known = {match.tobytes() for _, match in out}
    for pose, match in trials[:_DOUBTED]:
        for i in np.flatnonzero(match >= 0):
            less = match.copy()
            less[i] = -1
            if support[i, match[i]] < _BEYOND_DOUBT and less.tobytes() not in known:
                known.add(less.tobytes())
                out.append((pose, less))
    return out


def _agreed(seen: Sightings, prior: Prior, candidates: tuple[Candidate, ...]) -> tuple[Candidate, ...]:
    """Where no candidate is certain: what all agree on that together are. Spots in doubt are not used at all.

    The prior and the spots that are beyond doubt give a pose, less precise, whose covariance holds whichever is true.
    """
    if not candidates or candidates[0].probability >= PROBABILITY:
        return candidates
    total, likely = 0.0, []
    for c in candidates:
        likely.append(set(zip(c.fit.used.tolist(), c.fit.beacon.tolist(), strict=True)))
        total += c.probability
        if total >= PROBABILITY:
            break
    pairs = np.array(sorted(set.intersection(*likely)), dtype=np.int64).reshape(-1, 2)
    used, beacon = np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])
    fit = fit_pose(seen, used, beacon, prior.pose, prior)
    if fit is None or not fit.in_front:
        return candidates
    return (Candidate(fit, (), score_of(seen, fit, prior), total),)


def _with_partial_prior(seen: Sightings, prior: Prior, alpha: float) -> tuple[Candidate, ...]:
    if len(seen.uv) >= 3:
        return judged(seen, _hypotheses(seen, allowed_namings(seen)), prior, alpha)
    if np.any(seen.label < 0):
        return ()
    return judged(seen, [(prior.pose, seen.label)], prior, alpha)


@frozen(eq=False)
class _Partial:
    """A naming under way: match (n,) beacons, -1 not (yet) named; which spots are decided; the pose so far."""

    match: IntArray
    decided: BoolArray
    prior: Prior


def _in_turn(seen: Sightings, prior: Prior, near: BoolArray, distance: FloatArray) -> list[Trial]:
    """Poses (4, 4) and namings (n,): first what has no rival, each naming narrowing the choice of the next.

    Where only rivals are left the spot with the fewest is tried with each of them, and with none.
    """
    allowed = allowed_namings(seen)
    start = _Partial(np.full(len(near), -1, dtype=np.int64), np.logical_not(near.any(axis=1)), prior)
    open_ones = [(start, near, distance)]
    done: list[Trial] = []
    while open_ones and len(done) < MOST_NAMINGS:
        partial, near, distance = open_ones.pop()
        if partial.decided.all():
            done.append((partial.prior.pose, partial.match))
            continue
        for match, decided in reversed(_extensions(seen, partial, near, distance)):
            posterior = _posterior(seen, match, prior) if np.any(match != partial.match) else partial.prior
            if posterior is None:
                continue
            new, support = gate_distances(seen, posterior)
            free = (new < GATE) & allowed & (support > 0.0) & ~decided[:, None]
            for i in np.flatnonzero(match >= 0):
                free[seen.camera == seen.camera[i], match[i]] = False
            decided = decided | ~free.any(axis=1)
            open_ones.append((_Partial(match, decided, posterior), free, new))
    return done


def _extensions(
    seen: Sightings, partial: _Partial, near: BoolArray, distance: FloatArray
) -> list[tuple[IntArray, BoolArray]]:
    """Next namings and what they decide: all pairs without rivals at once, else each choice of one spot."""
    by_beacon = np.zeros_like(near, dtype=np.int64)
    for c in np.unique(seen.camera):
        rows = seen.camera == c
        by_beacon[rows] = near[rows].sum(axis=0)
    alone = near & (near.sum(axis=1) == 1)[:, None] & (by_beacon == 1) & ~partial.decided[:, None]
    match, decided = partial.match.copy(), partial.decided.copy()
    if alone.any():
        for i, b in np.argwhere(alone):
            match[i], decided[i] = b, True
        return [(match, decided)]
    waiting = np.flatnonzero(~decided)
    i = int(waiting[np.argmin(near[waiting].sum(axis=1))])
    decided[i] = True
    out = []
    for b in sorted(np.flatnonzero(near[i]).tolist(), key=lambda b: float(distance[i, b]))[:3]:
        named = match.copy()
        named[i] = b
        out.append((named, decided.copy()))
    return [*out, (match, decided)]


def _posterior(seen: Sightings, match: IntArray, prior: Prior) -> Prior | None:
    """The pose after these namings, as the prior of the next."""
    used = np.flatnonzero(match >= 0)
    fit = fit_pose(seen, used, match[used], prior.pose, prior)
    return None if fit is None else fit.posterior
