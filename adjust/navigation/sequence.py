"""A sequence of epochs navigated: poses with covariance, without initial values and, where need be, without names."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.navigation.evidence import Candidate
from adjust.navigation.fit import PoseFit, Prior, fit_pose, local
from adjust.navigation.identification import with_prior, without_prior
from adjust.navigation.model import (
    Beacons,
    Bridge,
    EpochPose,
    Head,
    NavigateOptions,
    NavigationEpoch,
    Solution,
    Trajectory,
)
from adjust.navigation.motion import MotionState, given_prior, predicted, started, table_prior, updated
from adjust.navigation.precision import open_directions, own_covariance, shares, some_pose, spot_noise
from adjust.navigation.system import Sightings, System, make_sightings, make_system, station_rays, visible, with_rays
from adjust.spatial.rigid import as_pose3
from adjust.testing.distributions import chi2

_AGREES = 1e-6
_WEAKEST_RAD = 0.2  # a covariance from first derivatives means nothing beyond
_NOTHING = np.diag(np.full(6, np.inf))


@dataclass(frozen=True, eq=False)
class _Step:
    """One epoch solved: the result, and the motion after it (None where it is not known)."""

    result: EpochPose
    state: MotionState | None


def navigate(
    head: Head,
    beacons: Beacons,
    epochs: Sequence[NavigationEpoch],
    options: NavigateOptions = NavigateOptions(),  # noqa: B008  frozen
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Poses of the head at all epochs, in their order, which is that of time.

    Spots without names are identified. Epochs whose spots do not determine the pose are bridged by their own prior, the
    table, or the motion from the epochs before; the first ones, until a pose is certain, by the motion from later ones.
    progress: called with (epochs done, epochs). Raises SurveyError.
    """
    system = make_system(head, beacons)
    times = _times(epochs)
    seen = with_rays(system, [make_sightings(system, epoch) for epoch in epochs])
    results: list[EpochPose] = []
    state: MotionState | None = None
    backwards: tuple[int, MotionState] | None = None
    for i, epoch in enumerate(epochs):
        step = _solve(system, seen[i], epoch, times[i], state, options)
        results.append(step.result)
        if state is None and step.state is not None and backwards is None:
            backwards = (i, step.state)
        state = step.state
        if progress is not None:
            progress(i + 1, len(epochs))
    if backwards is not None and options.motion is not None:
        first, state = backwards
        # the rates at the first certain pose are better known from what follows
        for i in range(first - 1, -1, -1):
            step = _solve(system, seen[i], epochs[i], times[i], state, options)
            results[i], state = step.result, step.state
    return Trajectory(tuple(results))


def _times(epochs: Sequence[NavigationEpoch]) -> FloatArray:
    given = [e.time_s for e in epochs]
    if any(t is None for t in given):
        return np.arange(len(epochs), dtype=float)
    return np.array(given, dtype=float)


@dataclass(frozen=True, eq=False)
class _At:
    """An epoch that is to be solved."""

    system: System
    seen: Sightings
    epoch: NavigationEpoch
    time_s: float
    options: NavigateOptions


def _solve(
    system: System, seen: Sightings, epoch: NavigationEpoch, time_s: float, state: MotionState | None,
    options: NavigateOptions,
) -> _Step:  # fmt: skip
    motion, at = options.motion, _At(system, seen, epoch, time_s, options)
    now = predicted(state, time_s, motion) if state is not None and motion is not None else None
    prior, bridge = _prior(system, epoch, now, options)
    candidates: tuple[Candidate, ...] = ()
    if prior is not None and len(seen.uv):
        candidates = with_prior(system, seen, prior, options)
        if not _plausible(system, seen, prior, candidates):
            afresh = without_prior(system, seen, options)
            if _certain(seen, afresh, options):
                return _from_candidates(at, afresh, None, "", None)
            candidates = candidates if bridge == "motion" else ()
    elif len(seen.uv):
        candidates = without_prior(system, seen, options)
    if candidates:
        return _from_candidates(at, candidates, prior, bridge, now)
    return _Step(_from_little(system, seen, epoch, prior, bridge), now)


def _prior(
    system: System, epoch: NavigationEpoch, now: MotionState | None, options: NavigateOptions
) -> tuple[Prior | None, Bridge]:
    if epoch.prior is not None:
        return given_prior(epoch.prior, system), "prior"
    table = table_prior(system, epoch) if options.use_table else None
    if table is not None:
        return table, "table"
    # a motion that has lost its way says nothing any more
    if now is not None and float(np.sqrt(np.diag(now.prior.total)[:3].max())) < 3.0 * _WEAKEST_RAD:
        return now.prior, "motion"
    return None, ""


def _plausible(system: System, seen: Sightings, prior: Prior, candidates: Sequence[Candidate]) -> bool:
    """Whether what was found near the prior explains enough of what is seen and of what should be."""
    if len(seen.uv) < 3 or len(prior.rows) < 6:
        return True
    if not candidates:
        return False
    expected = int((visible(system, candidates[0].fit.pose) & seen.present[:, None]).sum())
    return 2 * len(candidates[0].fit.used) >= min(expected, len(seen.uv))


def _certain(seen: Sightings, candidates: Sequence[Candidate], options: NavigateOptions) -> bool:
    """Whether the first candidate is the only one; three spots without names never say so by themselves."""
    if not candidates or candidates[0].probability < options.probability:
        return False
    return candidates[0].fit.redundancy >= 2 or bool(np.all(seen.label[candidates[0].fit.used] >= 0))


def _from_candidates(
    at: _At, candidates: Sequence[Candidate], prior: Prior | None, bridge: Bridge, now: MotionState | None
) -> _Step:
    best, system, seen, options = candidates[0], at.system, at.seen, at.options
    certain = _certain(seen, candidates, options) if prior is None else best.probability >= options.probability
    own = _own(system, seen, best, prior)
    fit, used_prior = (own, None) if own is not None else (best.fit, prior)
    if not certain and prior is None:
        return _Step(_result(at, fit, best, candidates, None, "", "ambiguous"), now)
    status = "ambiguous" if not certain else ("fixed" if used_prior is None else "bridged")
    result = _result(at, fit, best, candidates, used_prior, bridge, status)
    if options.motion is None or not certain:
        return _Step(result, now)
    return _Step(result, _next_state(at, best, fit, used_prior, now))


def _own(system: System, seen: Sightings, best: Candidate, prior: Prior | None) -> PoseFit | None:
    """The pose from the spots alone, where they determine it well and it agrees with the prior."""
    if prior is None:
        return best.fit
    if len(best.fit.used) < 3:
        return None
    own = fit_pose(system, seen, best.fit.used, best.fit.beacon, best.fit.pose)
    if own is None or not own.in_front or np.sqrt(np.diag(own.cov)[:3].max()) > _WEAKEST_RAD:
        return None
    apart = local(own.pose, best.fit.pose)
    return own if float(apart @ np.linalg.solve(own.cov, apart)) < chi2.isf(_AGREES, 6) else None


def _next_state(
    at: _At, best: Candidate, fit: PoseFit, used_prior: Prior | None, now: MotionState | None
) -> MotionState | None:
    system, seen, options = at.system, at.seen, at.options
    if options.motion is None:
        return None
    if now is not None:
        filtered = fit_pose(system, seen, best.fit.used, best.fit.beacon, best.fit.pose, now.prior)
        if filtered is not None and filtered.chi_square < chi2.isf(_AGREES, max(filtered.redundancy, 1)):
            return updated(now, filtered, spot_noise(seen, best.fit.used))
    return started(fit, own_covariance(seen, fit, used_prior), at.time_s, options.motion)


def _labels(
    system: System, seen: Sightings, epoch: NavigationEpoch, used: IntArray, beacon: IntArray
) -> tuple[tuple[str | None, ...], ...]:
    out: list[list[str | None]] = [[None] * len(s.uv) for s in epoch.spots]
    for i, b in zip(used, beacon, strict=True):
        out[seen.block[i]][seen.row[i]] = system.beacons.beacon_ids[b]
    return tuple(tuple(row) for row in out)


def _solution(system: System, seen: Sightings, epoch: NavigationEpoch, candidate: Candidate) -> Solution:
    fit = candidate.fit
    labels = _labels(system, seen, epoch, fit.used, fit.beacon)
    return Solution(
        as_pose3(fit.pose), fit.cov, labels, fit.chi_square, fit.redundancy, candidate.score, candidate.probability,
    )  # fmt: skip


def _result(
    at: _At, fit: PoseFit, best: Candidate, candidates: Sequence[Candidate], prior: Prior | None, bridge: Bridge,
    status: str,
) -> EpochPose:  # fmt: skip
    system, seen, epoch = at.system, at.seen, at.epoch
    several = tuple(_solution(system, seen, epoch, c) for c in candidates[: at.options.max_alternatives])
    result = EpochPose(
        epoch.epoch_id, "fixed", bridge if prior is not None else "", as_pose3(fit.pose), fit.cov,
        _labels(system, seen, epoch, fit.used, fit.beacon),
        tuple((epoch.spots[seen.block[i]].camera_id, int(seen.row[i])) for i in best.rejected),
        fit.chi_square, fit.redundancy, best.probability, shares(system, seen, fit, prior),
    )  # fmt: skip
    if status == "bridged":
        return replace(result, status="bridged")
    if status == "fixed":
        return result
    cut = best.more or len(several) < len(candidates)
    notes = (f"more solutions fit than the {len(several)} likeliest, which are listed",) if cut else ()
    return replace(result, status="ambiguous", alternatives=several, undetermined=notes)


def _from_little(
    system: System, seen: Sightings, epoch: NavigationEpoch, prior: Prior | None, bridge: Bridge
) -> EpochPose:
    """The pose where no spot could be used, or too few with nothing to bridge."""
    unnamed = tuple(tuple([None] * len(s.uv)) for s in epoch.spots)
    none: FloatArray = np.zeros((0,))
    if prior is not None and len(prior.rows) == 6:
        fit = fit_pose(system, seen, none.astype(np.int64), none.astype(np.int64), prior.pose, prior)
        if fit is not None:
            return EpochPose(epoch.epoch_id, "bridged", bridge, as_pose3(fit.pose), fit.cov, unnamed,
                             chi_square=0.0, shares=shares(system, seen, fit, prior))  # fmt: skip
    used = np.flatnonzero(seen.label >= 0)
    if not len(used):
        reason = f"{len(seen.uv)} spots without names are too few, and nothing bridges: all six directions are open"
        if len(seen.uv) >= 3:
            reason = f"{len(seen.uv)} spots fit no arrangement of the beacons: all six directions are open"
        return EpochPose(epoch.epoch_id, "none", "", None, _NOTHING, unnamed, undetermined=(reason,))
    return _undetermined(system, seen, epoch, prior)


def _undetermined(system: System, seen: Sightings, epoch: NavigationEpoch, prior: Prior | None) -> EpochPose:
    """Too few beacons with names: one of the poses that fit, with the directions in which it could go on."""
    used = np.flatnonzero(seen.label >= 0)
    beacon = seen.label[used]
    start = _facing(system, seen, used) if prior is None else prior.pose
    pose = some_pose(system, seen, used, beacon, start)
    cov, names = open_directions(system, seen, used, beacon, pose, prior)
    labels = _labels(system, seen, epoch, used, beacon)
    return EpochPose(epoch.epoch_id, "undetermined", "", as_pose3(pose), cov, labels, undetermined=names)


def _facing(system: System, seen: Sightings, used: IntArray) -> FloatArray:
    """A pose (4, 4) with the first named beacon on its ray, as far as the beacons lie apart."""
    x = system.beacons.x_in_world
    i = int(used[0])
    depth = max(0.5 * float(np.linalg.norm(np.ptp(x, axis=0))), 0.1)
    pose = np.eye(4)
    origin, ray = station_rays(system, seen)
    pose[:3, 3] = x[seen.label[i]] - origin[i] - depth * ray[i]
    return pose
