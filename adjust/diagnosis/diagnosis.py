"""The way of a diagnosis: hypotheses from cheap evidence, the likeliest tried, those that explain the misfit ranked."""

from collections.abc import Sequence
from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, told_edit
from adjust.diagnosis.search import Search
from adjust.diagnosis.trial import NEVER, Misfit, Trial, misfit_of
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.memory import remembering
from adjust.model.survey import FloatArray
from adjust.start.lens.start import remembering as remembering_lenses
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

if TYPE_CHECKING:
    from adjust.diagnosis.families import Family

_SHOWN = 3
_KEPT, _ONE = 0.75, 1.0  # adjustments for each of the later families, and for a trial of what they find
_AGAIN = 0.2  # share of what was given that is given once more where nothing explains enough, and something waits
_ALPHA = 1e-4
_NOISE = 3.0  # sigmas
_EXPLAINED = 0.5  # share of the excess that a cause takes away at least
_LIKELY = 0.01
"""Probability among all that were tried, and the survey as it stands, below which a cause is not named."""


@frozen(eq=False)
class Candidate:
    """A hypothesis that passed its test. explained: share of the misfit beyond noise that it takes away, 0 to 1.

    statistic: drop of the bounded v'Pv over the variance factor that is left; critical: what it exceeds.
    probability: among all that were tried and the survey as it stands, by their likelihood and number of parameters.
    sigma0: of the adjustment with the change. where: file and line of the project, for who knows it.
    """

    hypothesis: Hypothesis
    explained: float
    statistic: float
    critical: float
    probability: float
    sigma0: float
    where: str = ""


@frozen(eq=False)
class Diagnosis:
    """What explains that a survey does not fit: candidates, the best first; empty where nothing that was tried does.

    tried: names of the kinds of causes that were tried, whether they explain anything or not. untried: of those that
    evidence speaks for, but the time of a diagnosis did not suffice for. passed_over: of those that were not looked for
    in a survey of this size. spoils: whether the first cause concerns observations that take part as well, although
    those that showed it were left out.
    """

    candidates: tuple[Candidate, ...]
    tried: tuple[str, ...]
    misfit: Misfit
    untried: tuple[str, ...] = ()
    passed_over: tuple[str, ...] = ()
    spoils: bool = False

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
        """The candidates for machines: name, cause, change, ids, epochs, how sure it is, where to edit, the edits."""
        return [
            {
                "name": c.hypothesis.name, "cause": c.hypothesis.cause, "change": c.hypothesis.change,
                "kind": c.hypothesis.place.kind, "ids": list(c.hypothesis.place.ids),
                "epochs": list(c.hypothesis.place.epochs), "explained": c.explained, "statistic": c.statistic,
                "critical": c.critical, "probability": c.probability, "sigma0": c.sigma0,
                "where": c.where, "can_be_tried": bool(c.hypothesis.edits),
                "edits": [told_edit(edit) for edit in c.hypothesis.edits],
            }
            for c in self.candidates[:_SHOWN]
        ]  # fmt: skip


def diagnose(case: Case, families: "Sequence[Family] | None" = None) -> Diagnosis:
    """Form the hypotheses of all families, try the likeliest of them, and rank those that explain the misfit.

    families: those of :mod:`adjust.diagnosis.families` where None. As many are tried as the budget of the case allows,
    and where none of them explains anything though not all was looked at, or what says the first one more exactly still
    waits, a few more. Nothing is repaired, nothing is written.
    """
    stages = [families] if families is not None else import_module("adjust.diagnosis.families").families(case)
    with remembering(), remembering_lenses():  # most of what is tried has most of its images in common
        return _diagnosed(case, stages)


def _diagnosed(case: Case, stages: "Sequence[Sequence[Family]]") -> Diagnosis:
    search, given = Search(case, misfit_of(case.result, case.survey)), case.budget.left
    looked_at, cut = 0, list["Family"]()
    for later, rooms in zip(reversed(range(len(stages))), stages, strict=True):
        kept = (_KEPT * later + _ONE) * bool(later and case.survey.image_blocks)
        case.budget.kept = kept + _ONE * (not kept)
        formed = list[Hypothesis]()
        for family in () if search.done() or (case.result is None and search.leaves_noise) else rooms:
            case.budget.refused = False
            formed += _formed(family, case)
            cut += [family] * case.budget.refused
        looked_at += sum(h.looked_at for h in formed)
        search.over(formed, 0.0 if search.done() else kept)
    found = ranked(search.base, search.told, looked_at, search.outdone)
    again = not found and (search.promising or cut)
    if again or (found and search.refines(found[0].hypothesis)):
        case.budget.left, case.budget.kept = max(case.budget.left, 0.0) + _AGAIN * given, 0.0
        search.over([], 0.0)
        for family in cut if again else ():
            if not case.budget.lasts:
                break
            formed = [h for h in _formed(family, case) if search.is_new(h)]
            looked_at += sum(h.looked_at for h in formed)
            search.over(formed, 0.0)
        found = ranked(search.base, search.told, looked_at, search.outdone)
    return Diagnosis(found, tuple(dict.fromkeys(search.names)), search.base, search.untried, tuple(case.passed_over))


def _formed(family: "Family", case: Case) -> list[Hypothesis]:
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


def ranked(base: Misfit, trials: Sequence[Trial], looked_at: int, outdone: bool = False) -> tuple[Candidate, ...]:
    """The trials that explain the misfit by test, the best first.

    Each drop of v'Pv is tested against chi-square with as many degrees of freedom as the change has parameters, or as
    its trial has freed where a simpler change is told, at a level shared by all hypotheses that were looked at (Sidak).
    Compared with each other by v'Pv plus p ln n (Schwarz 1978), with variances of each group as they suit each best:
    else wrong sigmas would explain all that a cause leaves. A cause explains the misfit if half of it goes, or if what
    is left is noise, and was not before; it leaves no more observations out than before, and none where nothing was
    adjusted before, save as few as noise hides. It is not named where another one, though it explains less than that,
    is a hundred times as likely. outdone: whether something was not tried that could not be: it may leave nothing.
    """
    good = [t for t in trials if t.result is not None]
    if not good:
        return ()
    left = 0.0 if outdone else min(t.misfit.omega / max(t.misfit.redundancy, 1) for t in good)
    scale = max(1.0, left)
    number = max(looked_at, len(trials), 1)
    weight = _probabilities(base, good)
    out = []
    for trial, probability in zip(good, weight, strict=True):
        freed = max(1, trial.hypothesis.parameters, _freed(base, trial.misfit))
        critical = float(chi2.isf(sidak(_ALPHA, number), freed))
        statistic = (base.omega - _cost(trial)) / scale
        share = (base.omega - _cost(trial)) / max(base.excess, 1e-9)
        all_noise = trial.misfit.is_noise(_NOISE) and not (base.is_diluted or trial.hypothesis.penalty)
        enough = share > _EXPLAINED or all_noise
        most = base.unused if base.redundancy else 0  # where nothing was adjusted, any part that is explains much
        whole = trial.misfit.unused <= most or trial.misfit.is_noise(_NOISE)
        if statistic > critical and enough and whole and probability > _LIKELY:
            sigma0 = trial.result.sigma0 if trial.result is not None else float("nan")
            explained = float(np.clip(share, 0.0, 1.0))
            out.append(Candidate(trial.hypothesis, explained, statistic, critical, float(probability), sigma0))
    return tuple(sorted(out, key=lambda c: -c.probability))


def _freed(base: Misfit, misfit: Misfit) -> int:
    """By how many parameters a trial has more than the survey as it stands, by their redundancies; 0 without one."""
    return (base.redundancy + base.unused - misfit.redundancy - misfit.unused - misfit.dropped) * (base.redundancy > 0)


def _cost(trial: Trial) -> float:
    return trial.misfit.cost + trial.hypothesis.penalty


def _probabilities(base: Misfit, trials: Sequence[Trial]) -> FloatArray:
    """(k,) of the trials, with the survey as it stands as one more explanation."""
    score = [base.omega, *(t.score(base) for t in trials)]
    half = -0.5 * (np.array(score) - min(score))
    likelihood = np.exp(np.maximum(half, -0.5 * NEVER))
    return np.asarray((likelihood / likelihood.sum())[1:])
