"""The way of a diagnosis: hypotheses from cheap evidence, the likeliest tried, those that explain the misfit ranked."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.ranking import Candidate, ranked
from adjust.diagnosis.trial import Misfit, Trial, misfit_of, tried
from adjust.model.errors import SurveyError

_SHOWN = 3
_FAINT = 0.2
_KEPT = 4.0  # adjustments for the second families

FAMILIES: tuple[tuple[str, ...], ...] = (
    ("effects", "images", "names", "units", "time", "weights"),
    ("targets", "bodies"),
)
"""Rooms of this one, each with ``hypotheses(case) -> Iterable[Hypothesis]``: what cheap evidence makes worth a try.

The second ones adjust to find theirs: they are asked where what the first ones found does not explain everything.
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
    stages = _all_families() if families is None else [families]
    for stage, rooms in enumerate(stages, start=1):
        reserve = _KEPT * (stage < len(stages))
        formed = [h for family in rooms for h in _formed(family, case)]
        looked_at += sum(h.looked_at for h in formed)
        queue = _in_turn(queue + formed)
        while queue and case.budget.left > (0.0 if _done(trials, 0.0) else reserve):
            first = queue.pop(0)
            names.append(first.name)
            trial = tried(first, case, base)
            more = list(first.follow(trial.result)) if first.follow is not None and trial.result is not None else []
            same = [replace(trial, hypothesis=h) for h in more if h.survey is first.survey]
            trials += same or [trial]
            queue = [h for h in more if h.survey is not first.survey] + queue
            queue = [h for h in queue if not _done(trials, h.evidence)]
        if _done(trials, 0.0):
            break
    untried = dict.fromkeys(h.name for h in queue if h.name not in names)
    found = ranked(base, trials, looked_at)
    return Diagnosis(found, tuple(dict.fromkeys(names)), base, tuple(untried), tuple(case.passed_over))


def _done(trials: Sequence[Trial], following: float) -> bool:
    """Whether one explains everything down to the noise, and what follows has much less evidence."""
    return any(
        t.result is not None and t.misfit.unused + t.misfit.dropped == 0
        and t.misfit.is_noise() and following < _FAINT * t.hypothesis.evidence
        for t in trials
    )  # fmt: skip


def _in_turn(formed: Sequence[Hypothesis]) -> list[Hypothesis]:
    """The most evident first; of every kind one before the second of any: their evidence is not of one measure."""
    before: dict[str, int] = {}
    turns = []
    for h in sorted(formed, key=lambda h: -h.evidence):
        turns.append((before.setdefault(h.name, 0), h))
        before[h.name] += 1
    return [h for _, h in sorted(turns, key=lambda item: item[0])]


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
