"""Which hypotheses are tried, in which order, and when there is no need for more."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.trial import NEVER, Misfit, Trial, tried, tried_afresh

_FAINT, _FAINT_TO_NOISE = 0.2, 0.7
"""Evidence over that of a trial that leaves little below which nothing is tried; of scores, where it leaves noise."""
_MOST_OF_IT, _ENOUGH = 0.95, 0.5
"""Shares of the misfit beyond noise: what ends a search, and what a cause takes away at least."""
_CLEAR = 3.0
"""Evidence of a hypothesis that is tried from its own start as well before the next one is tried at all."""
_AFRESH = 2


@dataclass
class Search:
    """base: what the case leaves unexplained. names: of all kinds that were tried. queue: what is still to be tried.

    outdone: whether something was not tried because it could not be named, however little it left.
    """

    case: Case
    base: Misfit
    trials: list[Trial] = field(default_factory=list)
    names: list[str] = field(default_factory=list)
    queue: list[Hypothesis] = field(default_factory=list)
    outdone: bool = False

    def over(self, formed: Iterable[Hypothesis], kept: float) -> None:
        """Try these and what is left, the likeliest first, as long as the budget lasts. kept: of it for later ones.

        First from the values of the case; of what no values are near to, afresh. What there was no time for waits until
        the last.
        """
        waiting, astray = self.queue if kept else [], list[Trial]()
        queue = [*formed] if kept else [*self.queue, *formed]
        self.queue = _in_turn(queue, any(h.scored for h in queue) and self.case.is_spoilt)
        self.case.budget.kept = kept
        while self.queue and self.case.budget.lasts:
            if self._outdone(self.queue[0]):
                self.names.append(self.queue.pop(0).name)
                self.outdone = True
                continue
            before, trial = self.case.budget.kept, tried(self.queue.pop(0), self.case)
            clear = trial.hypothesis.evidence > _CLEAR and not trial.explains(_ENOUGH, self.base)
            if not trial.untimely and (clear or trial.misfit.omega >= self.base.omega):
                trial = tried_afresh(trial, self.case, self.base) or trial
            elif not trial.untimely:
                astray.append(trial)
            if trial.result is not None or not trial.untimely:
                self.names.append(trial.hypothesis.name)
                self._note(trial)
            if trial.untimely and self.case.budget.kept < before:
                self.queue.insert(0, trial.hypothesis)
            elif trial.untimely:
                waiting.append(trial.hypothesis)
        for trial in sorted(astray, key=lambda t: -t.hypothesis.evidence)[:_AFRESH]:
            again = None if self.explained(_ENOUGH) else tried_afresh(trial, self.case, self.base)
            if again is not None:
                self._note(again)
        self.queue += [h for h in waiting if not self._beaten(h)]

    def explained(self, share: float) -> bool:
        """Whether one takes away this share of the misfit beyond noise; larger sigmas, which can any, do not count."""
        return any(t.explains(share, self.base) and t.hypothesis.penalty <= 0.0 for t in self.trials)

    def done(self, following: float = 0.0) -> bool:
        """Whether one explains nearly everything, and what follows has much less evidence."""
        best = (t for t in self.trials if t.explains_all_but(_MOST_OF_IT, self.base))
        return any(following < _FAINT * t.hypothesis.evidence for t in best)

    @property
    def leaves_noise(self) -> bool:
        """Whether something leads to a solution with all observations and leaves nothing but noise."""
        good = (t for t in self.trials if t.result is not None and t.misfit.is_noise() and not t.misfit.dropped)
        return any(t.misfit.unused == 0 and not t.hypothesis.of_variances for t in good)

    def is_new(self, h: Hypothesis) -> bool:
        """Whether nothing of that name and place was tried, or waits."""
        known = [*(t.hypothesis for t in self.trials), *self.queue]
        return not any((h.name, h.change, h.place) == (k.name, k.change, k.place) for k in known)

    @property
    def untried(self) -> tuple[str, ...]:
        """Names of what evidence speaks for, but the time did not suffice for."""
        return tuple(dict.fromkeys(h.name for h in self.queue if h.name not in self.names))

    @property
    def promising(self) -> bool:
        """Whether some of that may explain enough to be named."""
        return any(h.name not in self.names and not _hopeless(h) for h in self.queue)

    def refines(self, h: Hypothesis) -> bool:
        """Whether something waits that says the same more exactly, with more evidence."""
        return any(w.place.ids == h.place.ids and w.evidence > h.evidence and not w.scored for w in self.queue)

    @property
    def told(self) -> list[Trial]:
        """The trials to be ranked: scores, and what explains anything, not before what waits with more evidence."""
        left = max((h.evidence for h in self.queue), default=0.0)
        scores = max((h.evidence for h in self.queue if h.scored), default=0.0)
        return [
            t for t in self.trials
            if not (t.hypothesis.penalty and t.hypothesis.evidence < min(left, _CLEAR))  # variances
            and not (t.hypothesis.scored and t.hypothesis.evidence < scores and not t.explains(_MOST_OF_IT, self.base))
        ]  # fmt: skip

    def _note(self, trial: Trial) -> None:
        """With what it tells more exactly, in its place or to be tried next."""
        first = trial.hypothesis
        more = list(first.follow(trial.result)) if first.follow is not None and trial.result is not None else []
        same = [replace(trial, hypothesis=h) for h in more if h.survey is first.survey]
        self.trials = [t for t in self.trials if t.hypothesis.survey is not first.survey] + (same or [trial])
        if trial.explains(_MOST_OF_IT, self.base):
            self.queue = [h for h in self.queue if (h.name, h.place.ids) != (first.name, first.place.ids)]
        self.queue = [h for h in (*more, *self.queue) if h.survey is not first.survey and not self._beaten(h)]
        if self.explained(_ENOUGH):
            self.case.budget.kept = 0.0

    def _outdone(self, h: Hypothesis) -> bool:
        """Whether its variances alone cost so much more than all that another one leaves that it cannot be named."""
        solved = (t for t in self.trials if t.result is not None)
        return h.of_variances and any(h.penalty - t.score(self.base) > NEVER for t in solved)

    def _all_told(self, parameters: int) -> bool:
        """Whether something that was not scored leaves nothing but noise with no more parameters than these."""
        good = (t for t in self.trials if t.misfit.is_noise() and t.explains_all_but(_MOST_OF_IT, self.base))
        return any(not t.hypothesis.scored and t.hypothesis.parameters <= parameters for t in good)

    def _beaten(self, h: Hypothesis) -> bool:
        """Whether what was tried leaves too little for a hypothesis; of scores, also where it drops observations."""
        if h.scored and self.case.is_spoilt and self._all_told(h.parameters):
            return True
        best = [t for t in self.trials if t.explains(_MOST_OF_IT, self.base)] if h.scored else []
        scores = [max(_faint(t), _FAINT * t.misfit.times_less_than(self.base)) for t in best if t.hypothesis.scored]
        return bool(best and _hopeless(h)) or h.evidence < max(scores, default=0.0) or self.done(h.evidence)


def _faint(trial: Trial) -> float:
    """The score that is not worth a trial beside that of one."""
    return trial.hypothesis.evidence * (_FAINT_TO_NOISE if trial.misfit.is_noise() else _FAINT)


def _hopeless(h: Hypothesis) -> bool:
    """Whether it leaves most of the misfit by its score, and could not be named."""
    return h.scored and h.evidence < 1.0 / (1.0 - _ENOUGH)


def _in_turn(formed: Sequence[Hypothesis], spoilt: bool) -> list[Hypothesis]:
    """The most evident first; of every kind one before the second of any: their evidence is not of one measure.

    Last what by its score leaves most of the misfit, and could not be named. spoilt: the values at which that was
    scored promise what they do not hold, so that what is clear without them comes before.
    """
    before: dict[tuple[str, str], int] = {}
    turns = []
    for h in sorted(formed, key=lambda h: -h.evidence):
        kind = h.name, h.place.kind
        turns.append((_hopeless(h), before.setdefault(kind, 0), spoilt and (h.scored or h.evidence < _CLEAR), h))
        before[kind] += 1
    return [h for *_, h in sorted(turns, key=lambda item: item[:3])]
