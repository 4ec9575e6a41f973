"""Which of the tried hypotheses explains a misfit, and how much better than the next one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.trial import Misfit, Trial
from adjust.model.survey import FloatArray
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_ALPHA = 1e-4
_NOISE = 3.0  # sigmas
_EXPLAINED = 0.5  # share of the excess that a cause takes away at least
_LIKELY = 0.01
"""Probability among all that were tried, and the survey as it stands, below which a cause is not named."""
_LOG_LARGEST = 600.0


@dataclass(frozen=True, eq=False)
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


def ranked(base: Misfit, trials: Sequence[Trial], looked_at: int) -> tuple[Candidate, ...]:
    """The trials that explain the misfit by test, the best first.

    Each drop of v'Pv is tested against chi-square with as many degrees of freedom as the change has parameters, or as
    its trial has freed where a simpler change is told, at a level shared by all hypotheses that were looked at (Sidak).
    Compared with each other by v'Pv plus p ln n (Schwarz 1978), with variances of each group as they suit each best:
    else wrong sigmas would explain all that a cause leaves. A cause explains the misfit if half of it goes, or if what
    is left is noise; it leaves no more observations out than before, and none where nothing was adjusted before, save
    as few as noise hides. It is not named where another one, though it explains less than that, is a hundred times as
    likely.
    """
    good = [t for t in trials if t.result is not None]
    if not good:
        return ()
    scale = max(1.0, min(t.misfit.omega / max(t.misfit.redundancy, 1) for t in good))
    number = max(looked_at, len(trials), 1)
    weight = _probabilities(base, good)
    out = []
    for trial, probability in zip(good, weight, strict=True):
        freed = max(1, trial.hypothesis.parameters, _freed(base, trial.misfit))
        critical = float(chi2.isf(sidak(_ALPHA, number), freed))
        statistic = (base.omega - _cost(trial)) / scale
        share = (base.omega - _cost(trial)) / max(base.excess, 1e-9)
        enough = share > _EXPLAINED or (trial.misfit.is_noise(_NOISE) and not trial.hypothesis.penalty)
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
    n = max(base.count, 2)
    fitted = [t.misfit.fitted + 2.0 * t.misfit.dropped + t.hypothesis.penalty for t in trials]
    score = [base.omega, *(f + t.hypothesis.parameters * np.log(n) for f, t in zip(fitted, trials, strict=True))]
    half = -0.5 * (np.array(score) - min(score))
    likelihood = np.exp(np.maximum(half, -_LOG_LARGEST))
    return np.asarray((likelihood / likelihood.sum())[1:])
