"""A sequence of epochs navigated: poses with covariance, without initial values and, where need be, without names."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.navigation.evidence import Candidate
from adjust.navigation.fit import PoseFit, Prior, fit_pose, local
from adjust.navigation.identification import PROBABILITY, with_prior, without_prior
from adjust.navigation.model import (
    Beacons,
    Bridge,
    EpochPose,
    Head,
    Labels,
    NavigateOptions,
    NavigationEpoch,
    Solution,
    Status,
    Trajectory,
)
from adjust.navigation.motion import MotionState, given_prior, predicted, started, table_prior, updated
from adjust.navigation.precision import open_directions, shares, some_pose
from adjust.navigation.system import Sightings, make_sightings, make_system, station_rays, visible, with_rays
from adjust.spatial.rigid import as_pose3
from adjust.testing.distributions import chi2

_AGREES = 1e-6
_MOST_LISTED = 400  # solutions of one epoch
_WEAKEST_RAD = 0.2  # a covariance from first derivatives means nothing beyond
_NOTHING = np.diag(np.full(6, np.inf))


class _Step(NamedTuple):
    """One epoch solved: the result, and the motion after it (None where it is not known)."""

    result: EpochPose
    state: MotionState | None


def navigate(
    head: Head,
    beacons: Beacons,
    epochs: Sequence[NavigationEpoch],
    options: NavigateOptions = NavigateOptions(),
    progress: Callable[[int, int], None] | None = None,
) -> Trajectory:
    """Poses of the head at all epochs, in their order, which is that of time.

    Spots without names are identified. Epochs whose spots do not determine the pose are bridged by their own prior, the
    table, or the motion from the epochs before; the first ones, until a pose is certain, by the motion from later ones.
    progress: called with (epochs done, epochs). Raises SurveyError.
    """
    system = make_system(head, beacons)
    seen = with_rays([make_sightings(system, epoch) for epoch in epochs])
    every = [_Epoch(s, epoch, t, options) for s, epoch, t in zip(seen, epochs, _times(epochs), strict=True)]
    results: list[EpochPose] = []
    state: MotionState | None = None
    first, begun = 0, state
    for i, epoch in enumerate(every):
        result, state = epoch.solved(state)
        results.append(result)
        if begun is None and state is not None:
            first, begun = i, state
        if progress is not None:
            progress(i + 1, len(epochs))
    # the rates at the first certain pose are better known from what follows
    for i in range(first - 1, -1, -1):
        results[i], begun = every[i].solved(begun)
    return Trajectory(tuple(results))


def _times(epochs: Sequence[NavigationEpoch]) -> list[float]:
    given = [e.time_s for e in epochs if e.time_s is not None]
    return given if len(given) == len(epochs) else [float(i) for i in range(len(epochs))]


@frozen(eq=False)
class _Epoch:
    """An epoch that is to be solved."""

    seen: Sightings
    given: NavigationEpoch
    time_s: float
    options: NavigateOptions

    def solved(self, state: MotionState | None) -> _Step:
        """The pose, by the spots and what is known of it beforehand: state, of the motion at another epoch."""
        seen, motion, alpha = self.seen, self.options.motion, self.options.alpha
        now = predicted(state, self.time_s, motion) if state is not None and motion is not None else None
        prior, bridge = self._prior(now)
        candidates: tuple[Candidate, ...] = ()
        if prior is not None and len(seen.uv):
            candidates = with_prior(seen, prior, alpha)
            if not _plausible(seen, prior, candidates):
                afresh = without_prior(seen, alpha)
                if self._certain(afresh):
                    return self._from_candidates(afresh, None, "", None)
                candidates = candidates if bridge == "motion" else ()
        elif len(seen.uv):
            candidates = without_prior(seen, alpha)
        if candidates:
            return self._from_candidates(candidates, prior, bridge, now)
        return _Step(self._from_little(prior, bridge), now)

    def _prior(self, now: MotionState | None) -> tuple[Prior | None, Bridge]:
        if self.given.prior is not None:
            return given_prior(self.given.prior, self.seen.system), "prior"
        table = table_prior(self.seen.system, self.given) if self.options.use_table else None
        if table is not None:
            return table, "table"
        # a motion that has lost its way says nothing any more
        if now is not None and float(np.sqrt(np.diag(now.prior.total)[:3].max())) < 3.0 * _WEAKEST_RAD:
            return now.prior, "motion"
        return None, ""

    def _certain(self, candidates: Sequence[Candidate]) -> bool:
        """Whether the first candidate is the only one; three spots without names never say so by themselves."""
        if not candidates or candidates[0].probability < PROBABILITY:
            return False
        fit = candidates[0].fit
        return fit.redundancy >= 2 or bool(np.all(self.seen.label[fit.used] >= 0))

    def _from_candidates(
        self, candidates: Sequence[Candidate], prior: Prior | None, bridge: Bridge, now: MotionState | None
    ) -> _Step:
        best = candidates[0]
        certain = self._certain(candidates) if prior is None else best.probability >= PROBABILITY
        own = best.fit if prior is None else self._own(best.fit)
        fit, used = (best.fit, bridge) if own is None else (own, "")
        if not certain:
            return _Step(self._result(fit, candidates, used, "ambiguous"), now)
        result = self._result(fit, candidates, used, "bridged" if own is None else "fixed")
        return _Step(result, self._next_state(best.fit, fit, now))

    def _own(self, best: PoseFit) -> PoseFit | None:
        """The pose from the spots alone, where they determine it well and it agrees with the prior."""
        if len(best.used) < 3:
            return None
        own = fit_pose(self.seen, best.used, best.beacon, best.pose)
        if own is None or not own.in_front or np.sqrt(np.diag(own.cov)[:3].max()) > _WEAKEST_RAD:
            return None
        apart = local(own.pose, best.pose)
        return own if float(apart @ np.linalg.solve(own.cov, apart)) < chi2.isf(_AGREES, 6) else None

    def _next_state(self, best: PoseFit, fit: PoseFit, now: MotionState | None) -> MotionState | None:
        if now is not None:
            filtered = fit_pose(self.seen, best.used, best.beacon, best.pose, now.prior)
            if filtered is not None and filtered.chi_square < chi2.isf(_AGREES, max(filtered.redundancy, 1)):
                return updated(now, filtered)
        return None if self.options.motion is None else started(fit, self.time_s, self.options.motion)

    def _labels(self, used: IntArray, beacon: IntArray) -> Labels:
        out: list[list[str | None]] = [[None] * len(s.uv) for s in self.given.spots]
        for i, b in zip(used, beacon, strict=True):
            out[self.seen.block[i]][self.seen.row[i]] = self.seen.system.beacons.beacon_ids[b]
        return tuple(map(tuple, out))

    def _solution(self, candidate: Candidate) -> Solution:
        fit = candidate.fit
        return Solution(as_pose3(fit.pose), fit.cov, self._labels(fit.used, fit.beacon), fit.chi_square, fit.redundancy,
                        candidate.score, candidate.probability)  # fmt: skip

    def _result(self, fit: PoseFit, candidates: Sequence[Candidate], bridge: Bridge, status: Status) -> EpochPose:
        best, seen = candidates[0], self.seen
        several: tuple[Solution, ...] = ()
        notes: tuple[str, ...] = ()
        if status == "ambiguous":
            several = tuple(map(self._solution, candidates[:_MOST_LISTED]))
            if best.more or len(several) < len(candidates):
                notes = (f"more solutions fit than the {len(several)} likeliest, which are listed",)
        rejected = tuple((self.given.spots[seen.block[i]].camera_id, int(seen.row[i])) for i in best.rejected)
        return EpochPose(
            self.given.epoch_id, status, bridge, as_pose3(fit.pose), fit.cov, self._labels(fit.used, fit.beacon),
            rejected, fit.chi_square, fit.redundancy, best.probability, shares(fit, seen.system), several, notes,
        )  # fmt: skip

    def _from_little(self, prior: Prior | None, bridge: Bridge) -> EpochPose:
        """The pose where no spot could be used, or too few with nothing to bridge."""
        epoch_id, seen, none = self.given.epoch_id, self.seen, np.zeros(0, dtype=np.int64)
        if prior is not None and len(prior.rows) == 6:
            fit = fit_pose(seen, none, none, prior.pose, prior)
            if fit is not None:
                return EpochPose(epoch_id, "bridged", bridge, as_pose3(fit.pose), fit.cov, self._labels(none, none),
                                 chi_square=0.0, shares=shares(fit, seen.system))  # fmt: skip
        used = np.flatnonzero(seen.label >= 0)
        if not len(used):
            reason = f"{len(seen.uv)} spots without names are too few, and nothing bridges: all six directions are open"
            if len(seen.uv) >= 3:
                reason = f"{len(seen.uv)} spots fit no arrangement of the beacons: all six directions are open"
            return EpochPose(epoch_id, "none", "", None, _NOTHING, self._labels(none, none), undetermined=(reason,))
        # too few beacons with names: one of the poses that fit, with the directions in which it could go on
        beacon = seen.label[used]
        pose = some_pose(seen, used, beacon, _facing(seen, int(used[0])) if prior is None else prior.pose)
        cov, names = open_directions(seen, used, beacon, pose, prior)
        labels = self._labels(used, beacon)
        return EpochPose(epoch_id, "undetermined", "", as_pose3(pose), cov, labels, undetermined=names)


def _plausible(seen: Sightings, prior: Prior, candidates: Sequence[Candidate]) -> bool:
    """Whether what was found near the prior explains enough of what is seen and of what should be."""
    if len(seen.uv) < 3 or len(prior.rows) < 6:
        return True
    if not candidates:
        return False
    fit = candidates[0].fit
    expected = int((visible(seen.system, fit.pose) & seen.present[:, None]).sum())
    return 2 * len(fit.used) >= min(expected, len(seen.uv))


def _facing(seen: Sightings, i: int) -> FloatArray:
    """A pose (4, 4) with the beacon of a named spot on its ray, as far as the beacons lie apart."""
    x, (origin, ray), pose = seen.system.beacons.x_in_world, station_rays(seen), np.eye(4)
    depth = max(0.5 * float(np.linalg.norm(np.ptp(x, axis=0))), 0.1)
    pose[:3, 3] = x[seen.label[i]] - origin[i] - depth * ray[i]
    return pose
