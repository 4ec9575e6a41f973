"""A change of what was observed, of a size to be estimated; scored at the solution, then tried."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.prediction import Linear
from adjust.diagnosis.trial import misfit_of
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.precision.precision import noise_of
from adjust.statistics.score import Score

ROUNDS = 6
_SLOW = 0.5  # share of the last drop, or of the last v'Pv, that the next one is at most, while it is on its way
_CLEAR_PART = 0.05  # of the misfit beyond noise
_SMALL = 9.0  # a further drop of v'Pv that is not worth another adjustment


@frozen(eq=False)
class Effect:
    """hypothesis: without its survey and the size in its words. first: its score.

    score: once more, at another adjustment of the same observations. mended: the survey without it, of size theta (k,),
    with the values of an adjustment. said: its cause in words, by theta and sigmas. added: theta and a further change.
    known: a size that explains itself near this one, and what that makes of the hypothesis; None where there is none.
    nearer: the same change at another epoch, that an adjustment with the change shows to be the right one, or None.
    model: the hypothesis with a survey in which the size is an unknown, tried in place of ``mended``. further: the
    same, tried after it where that leaves a clear part of the misfit.
    """

    hypothesis: Hypothesis
    first: Score
    score: Callable[[Linear], Score]
    mended: Callable[[Adjustment, FloatArray], Survey]
    said: Callable[[FloatArray, FloatArray], str]
    added: Callable[[FloatArray, FloatArray], FloatArray] = np.add
    known: Callable[[FloatArray, FloatArray], tuple[FloatArray, Fields] | None] = lambda theta, sigmas: None
    nearer: Callable[[Adjustment, FloatArray], "Effect | None"] = lambda result, theta: None
    model: Callable[[Hypothesis], Hypothesis] | None = None
    further: Callable[[Hypothesis], Hypothesis] | None = None

    def value(self, scale: float, n: int) -> float:
        """By how much more it explains than its parameters cost (Schwarz 1978), over a variance factor."""
        return self.first.drop / scale - (self.hypothesis.parameters + self.first.seen) * float(np.log(max(n, 2)))

    def formed(self, case: Case, linear: Linear, looked_at: int) -> Hypothesis:
        """The hypothesis, whose survey is found by Gauss-Newton over adjustments (Golub and Pereyra 1973)."""
        found: list[Fields] = []

        def made() -> Survey | None:
            begin = self._last[-1][0] if self._last else self.first.theta  # where the time did not suffice before
            at, (theta, result, sigmas) = self, self._estimated(case, linear, begin)
            if not self._last:
                return None
            fits = misfit_of(result, result.survey).is_noise()
            nearer = None if fits else self.nearer(result, theta)
            found_there = None if nearer is None else nearer._estimated(case, linear, theta)
            if nearer is not None and found_there is not None and found_there[1].omega < result.omega:
                at, (theta, result, sigmas) = nearer, found_there
            of = at.hypothesis
            as_found = {"cause": at.said(theta, sigmas), "place": of.place, "edits": of.edits, "change": of.change}
            theta, changes = at.known(theta, sigmas) or (theta, as_found)
            found.append(changes)
            return at.made(result, theta)

        def told(result: Adjustment) -> Sequence[Hypothesis]:
            named = [replace(hypothesis, **found[-1])] if found else []
            if self.further is None or (left := misfit_of(result, case.survey)).is_noise():
                return named
            clear = left.excess > _CLEAR_PART * misfit_of(case.result, case.survey).excess
            return [*named, self.further(hypothesis)] if clear else named

        sigmas = np.sqrt(np.maximum(np.diag(self.first.cov), 0.0))
        hypothesis = replace(self.hypothesis, survey=made, cause=self.said(self.first.theta, sigmas),
                             parameters=self.hypothesis.parameters + self.first.seen, looked_at=looked_at,
                             evidence=linear.ratio(self.first.drop), scored=True)  # fmt: skip
        return replace(hypothesis, follow=told) if self.model is None else self.model(hypothesis)

    def made(self, result: Adjustment, theta: FloatArray) -> Survey:
        """The survey that was adjusted last, where it is that of theta."""
        last = self._last[-1] if self._last else None
        return last[1] if last is not None and np.array_equal(last[0], theta) else self.mended(result, theta)

    @cached_property
    def _last(self) -> list[tuple[FloatArray, Survey]]:
        return []

    def _estimated(self, case: Case, linear: Linear, theta: FloatArray) -> tuple[FloatArray, Adjustment, FloatArray]:
        """Its size, the adjustment at which that was found, and the sigmas (k,).

        A size is one of a change of the values there: where these were spoilt, the next one may be worse, and is none.
        Where v'Pv falls by what the score has promised, the change is linear, and there is nothing more to be scored.
        """
        cov, now, last, made = self.first.cov, linear, np.inf, list[tuple[FloatArray, Survey]]()
        promised = linear.result.omega - self.first.drop
        for _ in range(ROUNDS - 1):
            try:
                survey = self.mended(now.result, theta)
                new = Linear(case.warm(survey))
                kept = abs(new.result.omega - promised) < _SMALL * new.scale
                more = Score(theta, cov, 0.0, 0) if kept else self.score(new)
            except SurveyError:
                theta = made[-1][0] if made else theta
                break
            if new.result.omega > min(now.result.omega, linear.result.omega):
                theta = made[-1][0] if made else theta
                break
            made.append((theta, survey))
            if more.drop < _SMALL * new.scale:
                cov, now = more.cov if more.seen else cov, new
                break
            if more.drop > _SLOW * last and new.result.omega > _SLOW * now.result.omega:
                break
            theta, cov, now, last = self.added(theta, more.theta), more.cov, new, more.drop
            promised = new.result.omega - more.drop
        self._last.extend(made[-1:])
        return theta, now.result, np.sqrt(np.maximum(np.diag(cov), 0.0) * now.scale)


Shifts = Mapping[int, FloatArray]
"""By the position of an image block: (n, 2, k) px that a change of size one has shifted its points by."""


def of_shifts(linear: Linear, shifts: Shifts) -> Score:
    """The score of shifts of the image points of ``linear.result.survey``."""
    return linear.of_parts(linear.image_parts(shifts))


def of_shape(linear: Linear, target_id: str, change: FloatArray) -> Score:
    """The score of a change (P, 3, k) of the points of a target."""
    found = {i: linear.prediction.by_shape(b, change) for i, b in enumerate(linear.result.survey.image_blocks)
             if b.target_id == target_id}  # fmt: skip
    return of_shifts(linear, {i: D for i, D in found.items() if D is not None})


def of_others(linear: Linear, kind: str, shifts: Mapping[tuple[str, ...], FloatArray]) -> Score:
    """The score of shifts (d, k) in the tangents of observations of a kind, by their ids."""
    parts = []
    for i, o in enumerate(linear.system.precision.graph.others):
        if o.kind == kind and o.ids in shifts:
            at = linear.system.n_image + i
            rows = np.arange(linear.system.ptr[at], linear.system.ptr[at + 1])
            parts.append((rows, np.asarray(noise_of(o).R()) @ shifts[o.ids]))
    return linear.of_parts(parts)


def shifted_back(survey: Survey, shifts: Shifts, theta: FloatArray) -> Survey:
    """The survey with its image points where they are without these shifts."""
    blocks = {i: survey.image_blocks[i] for i in shifts}
    return with_rows(survey, "image_blocks", {i: replace(b, uv=b.uv - shifts[i] @ theta) for i, b in blocks.items()})
