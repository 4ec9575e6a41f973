"""The way of a diagnosis: hypotheses from cheap evidence, the likeliest tried, those that explain the misfit ranked."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.ranking import Candidate, ranked
from adjust.diagnosis.trial import Misfit, Trial, misfit_of, tried, tried_afresh
from adjust.model.errors import SurveyError

_SHOWN = 3
_FAINT, _FAINT_TO_NOISE = 0.2, 0.5
_KEPT, _ONE = 1.75, 1.0  # adjustments for each of the later families, and for a trial of what they find
_MOST_OF_IT = 0.95
_ENOUGH = 0.5
_CLEAR, _AFRESH = 3.0, 2

FAMILIES: tuple[tuple[str, ...], ...] = (
    ("effects", "images", "names", "units", "time", "weights"),
    ("targets",),
    ("bodies",),
)
"""Rooms of this one, each with ``hypotheses(case) -> Iterable[Hypothesis]``: what cheap evidence makes worth a try.

The later ones adjust to find theirs: they are asked where what the first ones found does not explain everything.
"""

Family = Callable[[Case], Iterable[Hypothesis]]


@dataclass(frozen=True, eq=False)
class Diagnosis:
    """What explains that a survey does not fit: candidates, the best first; empty where nothing that was tried does.

    tried: names of the kinds of causes that were tried, whether they explain anything or not. untried: of those that
    evidence speaks for, but the time of a diagnosis did not suffice for. passed_over: of those that were not looked for
    in a survey of this size.
    """

    candidates: tuple[Candidate, ...]
    tried: tuple[str, ...]
    misfit: Misfit
    untried: tuple[str, ...] = ()
    passed_over: tuple[str, ...] = ()

    @property
    def note(self) -> str:
        """For people: what was not tried, and what was not looked for; empty where all was."""
        left = (("not tried, as the time of a diagnosis was spent", self.untried),
                ("not looked for in a survey of this size", self.passed_over))  # fmt: skip
        return "; ".join(f"{what}: {', '.join(names)}" for what, names in left if names)

    @property
    def lines(self) -> tuple[str, ...]:
        """For people: the first cause, what it changes, how sure it is, and the next one; what was not tried."""
        shown = tuple(_text(i, c) for i, c in enumerate(self.candidates[:_SHOWN], start=1))
        return (*shown[:-1], f"{shown[-1]}; {self.note}") if shown and self.note else shown

    def told(self) -> list[dict[str, Any]]:
        """The candidates for machines: name, cause, change, ids, epochs, how sure it is, and where to edit."""
        return [
            {
                "name": c.hypothesis.name, "cause": c.hypothesis.cause, "change": c.hypothesis.change,
                "kind": c.hypothesis.place.kind, "ids": list(c.hypothesis.place.ids),
                "epochs": list(c.hypothesis.place.epochs), "explained": c.explained, "statistic": c.statistic,
                "critical": c.critical, "probability": c.probability, "sigma0": c.sigma0,
                "where": c.where, "can_be_tried": bool(c.hypothesis.edits),
            }
            for c in self.candidates[:_SHOWN]
        ]  # fmt: skip


def diagnose(case: Case, families: Sequence[Family] | None = None) -> Diagnosis:
    """Form the hypotheses of all families, try the likeliest of them, and rank those that explain the misfit.

    families: those of ``FAMILIES`` where None. As many are tried as the budget of the case allows. Nothing is repaired,
    nothing is written.
    """
    base = misfit_of(case.result, case.survey)
    trials: list[Trial] = []
    names: list[str] = []
    queue: list[Hypothesis] = []
    looked_at = 0

    def noted(trial: Trial) -> None:
        """With what it tells more exactly, in its place or to be tried next."""
        first = trial.hypothesis
        more = list(first.follow(trial.result)) if first.follow is not None and trial.result is not None else []
        same = [replace(trial, hypothesis=h) for h in more if h.survey is first.survey]
        trials.extend(same or [trial])
        same_place = first.name, first.place.ids
        known = [h for h in queue if not trial.explains(_MOST_OF_IT, base) or (h.name, h.place.ids) != same_place]
        queue[:] = [h for h in (*more, *known) if h.survey is not first.survey and not _beaten(trials, h, base)]

    stages = _all_families() if families is None else [families]
    for stage, rooms in enumerate(stages, start=1):
        kept = _KEPT * (len(stages) - stage)
        case.budget.kept = kept + _ONE
        formed = [h for family in rooms for h in _formed(family, case)]
        case.budget.kept = kept
        looked_at += sum(h.looked_at for h in formed)
        queue[:] = _in_turn(queue + formed)
        astray: list[Trial] = []
        while queue and case.budget.lasts:
            trial = tried(queue.pop(0), case)
            clear = trial.hypothesis.evidence > _CLEAR and not trial.explains(_ENOUGH, base)
            if clear or trial.misfit.omega >= base.omega:
                trial = tried_afresh(trial, case, base) or trial
            else:
                astray.append(trial)
            names.append(trial.hypothesis.name)
            noted(trial)
            if any(t.explains(_ENOUGH, base) for t in trials):
                case.budget.kept = 0.0
        for trial in sorted(astray, key=lambda t: -t.hypothesis.evidence)[:_AFRESH]:
            if not any(t.explains(_ENOUGH, base) for t in trials) and case.budget.lasts:
                again = tried_afresh(trial, case, base)
                if again is not None:
                    noted(again)
        if _done(trials, 0.0, base):
            break
    untried = dict.fromkeys(h.name for h in queue if h.name not in names)
    found = ranked(base, trials, looked_at)
    return Diagnosis(found, tuple(dict.fromkeys(names)), base, tuple(untried), tuple(case.passed_over))


def _done(trials: Sequence[Trial], following: float, base: Misfit) -> bool:
    """Whether one explains nearly everything, and what follows has much less evidence."""
    return any(t.misfit.dropped == 0 and following < _faint(t) for t in trials if t.explains(_MOST_OF_IT, base))


def _beaten(trials: Sequence[Trial], h: Hypothesis, base: Misfit) -> bool:
    """Whether what was tried leaves too little for a hypothesis; of scores, also where it drops observations."""
    best = [t for t in trials if t.explains(_MOST_OF_IT, base)]
    by_score = h.scored and any(_hopeless(h) or (t.hypothesis.scored and h.evidence < _faint(t)) for t in best)
    return by_score or _done(best, h.evidence, base)


def _faint(trial: Trial) -> float:
    """Evidence that is not worth a trial beside it."""
    return trial.hypothesis.evidence * (_FAINT_TO_NOISE if trial.misfit.is_noise() else _FAINT)


def _hopeless(h: Hypothesis) -> bool:
    """Whether it leaves most of the misfit by its score, and could not be named."""
    return h.scored and h.evidence < 1.0 / (1.0 - _ENOUGH)


def _in_turn(formed: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The most evident first; of every kind one before the second of any: their evidence is not of one measure.

    Last what by its score leaves most of the misfit, and could not be named.
    """
    before: dict[tuple[str, str], int] = {}
    turns = []
    for h in sorted(formed, key=lambda h: -h.evidence):
        kind = h.name, h.place.kind
        turns.append((_hopeless(h), before.setdefault(kind, 0), h))
        before[kind] += 1
    return [h for *_, h in sorted(turns, key=lambda item: item[:2])]


def _all_families() -> list[list[Family]]:
    return [[import_module(f"adjust.diagnosis.{name}").hypotheses for name in rooms] for rooms in FAMILIES]


def _formed(family: Family, case: Case) -> list[Hypothesis]:
    """The hypotheses of one family; none where the observations do not even suffice to form them."""
    try:
        return list(family(case))
    except SurveyError:
        return []


def _text(number: int, candidate: Candidate) -> str:
    h = candidate.hypothesis
    sure = "" if candidate.probability > 0.99 else f", probability {100.0 * candidate.probability:.0f} %"
    where = f"; {candidate.where}" if candidate.where else ""
    return (
        f"{'' if number == 1 else 'or else: '}{h.cause}; {h.change} (explains {100.0 * candidate.explained:.0f} % of "
        f"the misfit, sigma0 becomes {candidate.sigma0:.3g}{sure}{where}{f'; --try {number}' if h.edits else ''})"
    )
