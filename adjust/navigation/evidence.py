"""Explanations of an epoch judged: adjusted, their spots tested, compared by their evidence."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.navigation.fit import PoseFit, Prior, fit_pose, fit_without_outliers, local, log_evidence
from adjust.navigation.system import Sightings, System, evaluate, visible
from adjust.testing.distributions import chi2

DETECTION = 0.9
"""Probability that a beacon in the field of view gives a spot."""
_FALSE_SPOTS = 0.3
"""Expected number of false spots an image."""
_ROOM_M = 3.0
"""Edge of the cube in which the head is, where no prior says more."""
KEPT = 400
_ADJUSTED = 60
_HOPELESS = 40.0  # difference in -2 ln evidence beyond which a candidate is of no interest
_MARGIN = 0.05  # tangent of an angle; a beacon just outside may be the one of a spot at the border
GATE = float(chi2.isf(1e-4, 2))
MOST_NAMINGS = 24
_SAME = 1e-3  # rad and m; two roots of the minimal problem that one adjustment brings together


@frozen(eq=False)
class Candidate:
    """A pose that explains an epoch: its fit, what was rejected (spots), -2 ln evidence and posterior probability.

    more: whether there were more explanations than were adjusted.
    """

    fit: PoseFit
    rejected: tuple[int, ...]
    score: float
    probability: float = 1.0
    more: bool = False


def allowed_namings(seen: Sightings) -> BoolArray:
    """(n, m): all beacons for a spot without a name, its own for one with a name."""
    label = seen.label[:, None]
    return np.asarray((label < 0) | (label == np.arange(len(seen.system.beacons.beacon_ids))))


def gate_distances(seen: Sightings, prior: Prior) -> tuple[FloatArray, FloatArray]:
    """Squared distance (n, m) of every spot from where the prior expects every beacon, in sigmas.

    Infinite for a beacon far outside the field of view, where the distortion may fold it back into the image.

    The second (n, m): 2 ln of how much likelier an origin of the spot the beacon is than chance. A beacon of vague
    position may be near everything and explains nothing. A spot that came with its name needs no such proof.
    """
    margin = _MARGIN + 4.0 * float(np.sqrt(np.diag(prior.total)[:3].max()))
    distance, log_det = _gates(seen, prior, visible(seen.system, prior.pose, margin))
    vague = distance + log_det - 2.0 * np.log(DETECTION / (1.0 - DETECTION))
    by_chance = 2.0 * np.log(image_areas(seen.system)[seen.camera] / _FALSE_SPOTS)
    return distance, np.where((seen.label >= 0)[:, None], np.inf, by_chance[:, None] - vague)


def _gates(seen: Sightings, prior: Prior, ahead: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Squared distance (n, m) in sigmas of spots from beacons at a pose of error ``e + B eta``; ln det(2 pi S).

    ahead (c, m): the others are infinitely far.
    """
    shape = len(seen.uv), ahead.shape[1]
    distance, log_det = np.full(shape, np.inf), np.zeros(shape)
    near_by = ahead & (np.bincount(seen.camera, minlength=len(ahead)) > 0)[:, None]
    camera, beacon = map(np.ascontiguousarray, np.nonzero(near_by))
    n = len(beacon)
    predicted, H, M = evaluate(seen.system, prior.pose, camera, beacon)
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


Trial = tuple[FloatArray, IntArray]
"""A pose (4, 4) and the beacon of every spot (n,), -1 for none."""


def judged(
    seen: Sightings, trials: Sequence[Trial], prior: Prior | None, alpha: float
) -> tuple[Candidate, ...]:
    """Adjust the trials, compare their evidence, and give each its probability. alpha: of the outlier test."""
    by_naming: dict[tuple[bytes, bytes], list[Candidate]] = {}
    # three spots fit many namings exactly, and all of them are to be named
    most = 2 * MOST_NAMINGS if prior is not None else (_ADJUSTED if len(seen.uv) > 3 else KEPT)
    for pose, match in trials[:most]:
        candidate = _adjusted(seen, (pose, match), prior, alpha)
        if candidate is not None:
            alike = by_naming.setdefault((candidate.fit.used.tobytes(), candidate.fit.beacon.tobytes()), [])
            if not any(np.linalg.norm(local(candidate.fit.pose, other.fit.pose)) < _SAME for other in alike):
                alike.append(candidate)
    found = sorted((c for alike in by_naming.values() for c in alike), key=lambda c: c.score)
    if not found:
        return ()
    weights = np.exp(-0.5 * (np.array([c.score for c in found]) - found[0].score))
    weights /= weights.sum()
    more = len(trials) > most or len(trials) == KEPT
    return tuple(replace(c, probability=float(w), more=more) for c, w in zip(found, weights, strict=True)
                 if c.score < found[0].score + _HOPELESS)  # fmt: skip


def _adjusted(seen: Sightings, trial: Trial, prior: Prior | None, alpha: float) -> Candidate | None:
    pose, match = trial
    used = np.flatnonzero(match >= 0)
    if prior is None and len(used) < 3:
        return None
    fit, rejected = fit_without_outliers(seen, used, match[used], pose, prior, alpha)
    if fit is None or not fit.in_front:
        return None
    if prior is None:
        fit = _grown(seen, fit, rejected)
    if fit.redundancy > 0 and fit.chi_square > chi2.isf(1e-6, fit.redundancy):
        return None
    return Candidate(fit, rejected, score_of(seen, fit, prior))


def _grown(seen: Sightings, fit: PoseFit, rejected: tuple[int, ...]) -> PoseFit:
    """Name the spots that the pose explains and the coarse consensus left out."""
    for _ in range(len(seen.uv) - len(fit.used) - len(rejected)):
        distance, support = gate_distances(seen, fit.posterior)
        distance[~(allowed_namings(seen) & (support > 0.0))] = np.inf
        distance[fit.used] = np.inf
        distance[list(rejected)] = np.inf
        for i, b in zip(fit.used, fit.beacon, strict=True):
            distance[seen.camera == seen.camera[i], b] = np.inf
        i, b = np.unravel_index(int(np.argmin(distance)), distance.shape)
        if distance[i, b] > GATE:
            return fit
        order = np.argsort(np.append(fit.used, i), kind="stable")
        more = fit_pose(seen, np.append(fit.used, i)[order], np.append(fit.beacon, b)[order], fit.pose)
        if more is None:
            return fit
        fit = more
    return fit


def score_of(seen: Sightings, fit: PoseFit, prior: Prior | None) -> float:
    """-2 ln of the evidence of an explanation: fit, spots it calls false, beacons it should have seen and did not.

    A false spot may be anywhere in its image; what no prior knows of the pose is uniform over all rotations (8 pi^2)
    and the room.
    """
    false = np.ones(len(seen.uv), dtype=np.bool_)
    false[fit.used] = False
    score = log_evidence(fit)
    known = set() if prior is None else set(prior.rows.tolist())
    score += 2.0 * np.log(8.0 * np.pi**2) * len({0, 1, 2} - known) / 3.0
    score += 2.0 * np.log(_ROOM_M) * len({3, 4, 5} - known)
    score -= 2.0 * float(np.log(_FALSE_SPOTS / image_areas(seen.system)[seen.camera[false]]).sum())
    score -= 2.0 * len(fit.used) * np.log(DETECTION)
    # only cameras that took part: the others may not have been triggered
    view = visible(seen.system, fit.pose) & seen.present[:, None]
    view[seen.camera[fit.used], fit.beacon] = False
    missing = int(view.sum())
    return float(score - 2.0 * missing * np.log(1.0 - DETECTION))
