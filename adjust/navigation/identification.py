"""Which spot is which beacon, and all poses that explain an epoch.

Without a prior: three spots are named at a time in all ways that the distances of the beacons allow, each naming gives
all its poses, and the poses are judged by how many other spots they explain and which beacons they miss. With a prior:
only the beacons that it predicts near a spot are tried. The candidates are adjusted, their spots tested, and compared
by their evidence: what cannot be told apart is reported, all of it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from adjust.lenses.models import MODELS, focal_length_px
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.navigation import FoundArrays, SkyArrays, search
from adjust.navigation.fit import PoseFit, Prior, fit_pose, fit_without_outliers, local, log_evidence
from adjust.navigation.model import NavigateOptions
from adjust.navigation.precision import own_covariance
from adjust.navigation.system import Sightings, System, evaluate, station_rays, visible
from adjust.spatial.rigid import rigid
from adjust.testing.distributions import chi2

_KEPT = 400
_ADJUSTED = 60
_COARSE = 25.0  # difference in the coarse score, about ln of the evidence, beyond which nobody looks
_HOPELESS = 40.0  # difference in -2 ln evidence beyond which a candidate is of no interest
_MARGIN = 0.05  # tangent of an angle; a beacon just outside may be the one of a spot at the border
_GATE = float(chi2.isf(1e-4, 2))
_MOST_NAMINGS = 24
_DOUBTED = 6
_BEYOND_DOUBT = 20.0  # 2 ln of a likelihood ratio
_CROWDED = 3.0  # beacons near a spot beyond which naming in turn is hopeless
_MOST_TRIPLES = 400
_SAME = 1e-3  # rad and m; two roots of the minimal problem that one adjustment brings together


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose that explains an epoch: its fit, what was rejected (spots), -2 ln evidence and posterior probability.

    more: whether there were more explanations than were adjusted.
    """

    fit: PoseFit
    rejected: tuple[int, ...]
    score: float
    probability: float = 1.0
    more: bool = False


def allowed_namings(system: System, seen: Sightings) -> BoolArray:
    """(n, m): all beacons for a spot without a name, its own for one with a name."""
    m = len(system.beacons.beacon_ids)
    out = np.ones((len(seen.uv), m), dtype=np.bool_)
    for row, label in zip(out, seen.label, strict=True):
        if label >= 0:
            row[:] = False
            row[label] = True
    return out


def without_prior(system: System, seen: Sightings, options: NavigateOptions) -> tuple[Candidate, ...]:
    """All explanations of an epoch that are worth naming, best first; empty where fewer than three spots are there."""
    if len(seen.uv) < 3:
        return ()
    poses, matches = _hypotheses(system, seen, allowed_namings(system, seen), options)
    return _judged(system, seen, list(zip(poses, matches, strict=True)), None, options)


def _hypotheses(
    system: System, seen: Sightings, allowed: BoolArray, options: NavigateOptions
) -> tuple[FloatArray, IntArray]:
    """Poses (k, 4, 4) and namings (k, n) by the coarse consensus, best first."""
    n, x = len(seen.uv), np.ascontiguousarray(system.beacons.x_in_world, dtype=float)
    farthest = options.farthest_m
    if farthest is None:
        farthest = 10.0 * float(np.linalg.norm(np.ptp(x, axis=0)))
    R, t = np.empty((_KEPT, 3, 3)), np.empty((_KEPT, 3))
    score, match = np.full(_KEPT, -np.inf), np.empty((_KEPT, n), dtype=np.int64)
    missed = np.where(seen.present, -np.log(1.0 - options.detection), 0.0)
    named = np.log(_sky(system) / np.radians(options.gate_deg) ** 2)[seen.camera]
    origin, ray = station_rays(system, seen)
    sky = SkyArrays(
        origin, np.ascontiguousarray(ray), seen.camera, allowed, x, system.camera_R, system.camera_t, system.field,
        float(np.radians(options.gate_deg)), named, missed,
    )  # fmt: skip
    kept = search(
        sky, _triples(ray), options.nearest_m, farthest, options.max_hypotheses, FoundArrays(R, t, score, match)
    )
    order = np.argsort(-score[:kept], kind="stable")
    order = order[score[order] > score[order[:1]] - _COARSE]
    return rigid(R[order], t[order]), match[order]


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


def with_prior(system: System, seen: Sightings, prior: Prior, options: NavigateOptions) -> tuple[Candidate, ...]:
    """Explanations near a prior, best first. One that leaves components open needs names, or three spots."""
    if len(prior.rows) < 6:
        return _with_partial_prior(system, seen, prior, options)
    distance, support = gate_distances(system, seen, prior, options)
    near = (distance < _GATE) & allowed_namings(system, seen) & (support > 0.0)
    if len(seen.uv) >= 3 and near.sum() > _CROWDED * near.any(axis=1).sum():
        poses, matches = _hypotheses(system, seen, near, options)
        trials = _doubted(list(zip(poses, matches, strict=True)), support)
        found = _judged(system, seen, trials, prior, options)
        if found:
            return _agreed(system, seen, prior, found, options)
    trials = _doubted(_in_turn(system, seen, prior, near, distance, options), support)
    return _agreed(system, seen, prior, _judged(system, seen, trials, prior, options), options)


def _doubted(trials: list[tuple[FloatArray, IntArray]], support: FloatArray) -> list[tuple[FloatArray, IntArray]]:
    """The likeliest trials, and each again without one of the spots that the prior alone does not tell from chance."""
    out = trials[: _MOST_NAMINGS // 3]
    known = {match.tobytes() for _, match in out}
    for pose, match in trials[:_DOUBTED]:
        for i in np.flatnonzero(match >= 0):
            less = match.copy()
            less[i] = -1
            if support[i, match[i]] < _BEYOND_DOUBT and less.tobytes() not in known:
                known.add(less.tobytes())
                out.append((pose, less))
    return out


def _agreed(
    system: System, seen: Sightings, prior: Prior, candidates: tuple[Candidate, ...], options: NavigateOptions
) -> tuple[Candidate, ...]:
    """Where no candidate is certain: what all agree on that together are. Spots in doubt are not used at all.

    The prior and the spots that are beyond doubt give a pose, less precise, whose covariance holds whichever is true.
    """
    if not candidates or candidates[0].probability >= options.probability:
        return candidates
    total, likely = 0.0, []
    for c in candidates:
        likely.append(set(zip(c.fit.used.tolist(), c.fit.beacon.tolist(), strict=True)))
        total += c.probability
        if total >= options.probability:
            break
    pairs = np.array(sorted(set.intersection(*likely)), dtype=np.int64).reshape(-1, 2)
    used, beacon = np.ascontiguousarray(pairs[:, 0]), np.ascontiguousarray(pairs[:, 1])
    fit = fit_pose(system, seen, used, beacon, prior.pose, prior)
    if fit is None or not fit.in_front:
        return candidates
    return (Candidate(fit, (), score_of(system, seen, fit, prior, options), total),)


def _with_partial_prior(
    system: System, seen: Sightings, prior: Prior, options: NavigateOptions
) -> tuple[Candidate, ...]:
    if len(seen.uv) >= 3:
        poses, matches = _hypotheses(system, seen, allowed_namings(system, seen), options)
        return _judged(system, seen, list(zip(poses, matches, strict=True)), prior, options)
    if np.any(seen.label < 0):
        return ()
    return _judged(system, seen, [(prior.pose, seen.label)], prior, options)


def gate_distances(
    system: System, seen: Sightings, prior: Prior, options: NavigateOptions
) -> tuple[FloatArray, FloatArray]:
    """Squared distance (n, m) of every spot from where the prior expects every beacon, in sigmas.

    Infinite for a beacon far outside the field of view, where the distortion may fold it back into the image.

    The second (n, m): 2 ln of how much likelier an origin of the spot the beacon is than chance. A beacon of vague
    position may be near everything and explains nothing. A spot that came with its name needs no such proof.
    """
    margin = _MARGIN + 4.0 * float(np.sqrt(np.diag(prior.total)[:3].max()))
    ahead = visible(system, prior.pose, margin)
    distance, log_det = _gates(system, seen, prior, ahead)
    vague = distance + log_det - 2.0 * np.log(options.detection / (1.0 - options.detection))
    by_chance = 2.0 * np.log(image_areas(system)[seen.camera] / options.false_spots)
    return distance, np.where((seen.label >= 0)[:, None], np.inf, by_chance[:, None] - vague)


def _gates(system: System, seen: Sightings, prior: Prior, ahead: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Squared distance (n, m) in sigmas of spots from beacons at a pose of error ``e + B eta``; ln det(2 pi S).

    ahead (c, m): the others are infinitely far.
    """
    shape = len(seen.uv), ahead.shape[1]
    distance, log_det = np.full(shape, np.inf), np.zeros(shape)
    near_by = ahead & (np.bincount(seen.camera, minlength=len(ahead)) > 0)[:, None]
    camera, beacon = map(np.ascontiguousarray, np.nonzero(near_by))
    n = len(beacon)
    predicted, H, M, _ = evaluate(system, prior.pose, camera, beacon, np.zeros((n, 2)))
    common = H @ prior.B + M
    common = common.reshape(n, 2, common.shape[-1])  # n may be 0: nothing is ahead
    by_pose = (H @ prior.cov).reshape(n, 2, 6)
    base = by_pose @ H.reshape(n, 2, 6).transpose(0, 2, 1) + common @ common.transpose(0, 2, 1)
    spot, near = np.nonzero(seen.camera[:, None] == camera)
    (xx, xy), (_, yy) = (base[near] + seen.cov[spot]).transpose(1, 2, 0)
    x, y = (predicted.reshape(n, 2)[near] - seen.uv[spot]).T
    det = xx * yy - xy * xy
    distance[spot, beacon[near]] = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / det
    log_det[spot, beacon[near]] = np.log(4.0 * np.pi**2 * det)
    return distance, log_det


def image_areas(system: System) -> FloatArray:
    """(c,) px^2."""
    return np.array([c.image_size[0] * c.image_size[1] for c in system.head.cameras], dtype=float)


@dataclass(frozen=True, eq=False)
class _Partial:
    """A naming under way: match (n,) beacons, -1 not (yet) named; which spots are decided; the pose so far."""

    match: IntArray
    decided: BoolArray
    prior: Prior


def _in_turn(
    system: System, seen: Sightings, prior: Prior, near: BoolArray, distance: FloatArray, options: NavigateOptions
) -> list[tuple[FloatArray, IntArray]]:
    """Poses (4, 4) and namings (n,): first what has no rival, each naming narrowing the choice of the next.

    Where only rivals are left the spot with the fewest is tried with each of them, and with none.
    """
    allowed = allowed_namings(system, seen)
    start = _Partial(np.full(len(near), -1, dtype=np.int64), np.logical_not(near.any(axis=1)), prior)
    open_ones = [(start, near, distance)]
    done: list[tuple[FloatArray, IntArray]] = []
    while open_ones and len(done) < _MOST_NAMINGS:
        partial, near, distance = open_ones.pop()
        if partial.decided.all():
            done.append((partial.prior.pose, partial.match))
            continue
        for match, decided in reversed(_extensions(seen, partial, near, distance)):
            posterior = _posterior(system, seen, match, prior) if np.any(match != partial.match) else partial.prior
            if posterior is None:
                continue
            new, support = gate_distances(system, seen, posterior, options)
            free = (new < _GATE) & allowed & (support > 0.0) & ~decided[:, None]
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


def _posterior(system: System, seen: Sightings, match: IntArray, prior: Prior) -> Prior | None:
    """The pose after these namings, as the prior of the next."""
    used = np.flatnonzero(match >= 0)
    fit = fit_pose(system, seen, used, match[used], prior.pose, prior)
    if fit is None:
        return None
    return Prior(fit.pose, own_covariance(seen, fit, prior), fit.B, np.arange(6))


def _judged(
    system: System, seen: Sightings, trials: Sequence[tuple[FloatArray, IntArray]], prior: Prior | None,
    options: NavigateOptions,
) -> tuple[Candidate, ...]:  # fmt: skip
    """Adjust the trials, compare their evidence, and give each its probability."""
    by_naming: dict[tuple[bytes, bytes], list[Candidate]] = {}
    # three spots fit many namings exactly, and all of them are to be named
    most = 2 * _MOST_NAMINGS if prior is not None else (_ADJUSTED if len(seen.uv) > 3 else _KEPT)
    for pose, match in trials[:most]:
        candidate = _adjusted(system, seen, pose, match, prior, options)
        if candidate is not None:
            alike = by_naming.setdefault((candidate.fit.used.tobytes(), candidate.fit.beacon.tobytes()), [])
            if not any(np.linalg.norm(local(candidate.fit.pose, other.fit.pose)) < _SAME for other in alike):
                alike.append(candidate)
    found = sorted((c for alike in by_naming.values() for c in alike), key=lambda c: c.score)
    if not found:
        return ()
    weights = np.exp(-0.5 * (np.array([c.score for c in found]) - found[0].score))
    weights /= weights.sum()
    kept = [
        Candidate(c.fit, c.rejected, c.score, float(w), len(trials) > most or len(trials) == _KEPT)
        for c, w in zip(found, weights, strict=True)
        if c.score < found[0].score + _HOPELESS
    ]
    return tuple(kept)


def _adjusted(
    system: System, seen: Sightings, pose: FloatArray, match: IntArray, prior: Prior | None, options: NavigateOptions
) -> Candidate | None:
    used = np.flatnonzero(match >= 0)
    if prior is None and len(used) < 3:
        return None
    fit, rejected = fit_without_outliers(system, seen, used, match[used], pose, prior, options.alpha)
    if fit is None or not fit.in_front:
        return None
    if prior is None:
        fit = _grown(system, seen, fit, rejected, options)
    if fit.redundancy > 0 and fit.chi_square > chi2.isf(1e-6, fit.redundancy):
        return None
    return Candidate(fit, rejected, score_of(system, seen, fit, prior, options))


def _grown(
    system: System, seen: Sightings, fit: PoseFit, rejected: tuple[int, ...], options: NavigateOptions
) -> PoseFit:
    """Name the spots that the pose explains and the coarse consensus left out."""
    for _ in range(len(seen.uv) - len(fit.used) - len(rejected)):
        prior = Prior(fit.pose, own_covariance(seen, fit, None), fit.B, np.arange(6))
        distance, support = gate_distances(system, seen, prior, options)
        distance[~(allowed_namings(system, seen) & (support > 0.0))] = np.inf
        distance[fit.used] = np.inf
        distance[list(rejected)] = np.inf
        for i, b in zip(fit.used, fit.beacon, strict=True):
            distance[seen.camera == seen.camera[i], b] = np.inf
        i, b = np.unravel_index(int(np.argmin(distance)), distance.shape)
        if distance[i, b] > _GATE:
            return fit
        order = np.argsort(np.append(fit.used, i), kind="stable")
        more = fit_pose(system, seen, np.append(fit.used, i)[order], np.append(fit.beacon, b)[order], fit.pose)
        if more is None:
            return fit
        fit = more
    return fit


def score_of(system: System, seen: Sightings, fit: PoseFit, prior: Prior | None, options: NavigateOptions) -> float:
    """-2 ln of the evidence of an explanation: fit, spots it calls false, beacons it should have seen and did not.

    A false spot may be anywhere in its image; what no prior knows of the pose is uniform over all rotations (8 pi^2)
    and the room.
    """
    false = np.ones(len(seen.uv), dtype=np.bool_)
    false[fit.used] = False
    score = log_evidence(fit)
    known = set() if prior is None else set(prior.rows.tolist())
    score += 2.0 * np.log(8.0 * np.pi**2) * len({0, 1, 2} - known) / 3.0
    score += 2.0 * np.log(options.room_m) * len({3, 4, 5} - known)
    score -= 2.0 * float(np.log(options.false_spots / image_areas(system)[seen.camera[false]]).sum())
    score -= 2.0 * len(fit.used) * np.log(options.detection)
    # only cameras that took part: the others may not have been triggered
    view = visible(system, fit.pose) & seen.present[:, None]
    view[seen.camera[fit.used], fit.beacon] = False
    missing = int(view.sum())
    return float(score - 2.0 * missing * np.log(1.0 - options.detection))
