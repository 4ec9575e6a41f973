"""One hypothesis, tried: its survey adjusted, and what is left unexplained."""

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np

from adjust.diagnosis.case import CAP, Case, block_squares
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import numbered
from adjust.model.result import Adjustment, names_of
from adjust.model.survey import FloatArray, Survey
from adjust.observations.pair_arrays import pair_arrays
from adjust.testing.criteria import CLEARLY, contradicting, is_noise

_NOISE = 5.0
"""Sigmas of v'Pv up to which what is left is noise."""
_SETTLED = 1.0
"""The same up to which a size that was found in a hurry is good enough."""
_LAST = 0.3
"""Adjustments that finding the size of a change leaves for the one that shows what it explains."""
NEVER = 1200.0
"""Difference of scores from which the likelihood of one is nothing to that of the other."""
_FACTORS = 2.0 ** np.arange(24.0)


@frozen
class Misfit:
    """What a survey leaves unexplained. omega: sum of squares over sigmas, each bounded by ``CAP``, all observations.

    unused: components that take no part, or cannot be predicted. count: of all components. redundancy: of the
    adjustment, 0 where there is none. dropped: components that it does without. fitted: as omega, but with variances
    of each group multiplied by what suits them best, whose logarithms count: so causes are compared that explain most,
    yet leave more than noise. contradicting: square sum and redundancy of all, or where these are noise, of the groups
    that are not.
    """

    omega: float
    unused: int
    count: int
    redundancy: int
    dropped: int = 0
    fitted: float = np.inf
    contradicting: tuple[float, float] = (0.0, 0.0)

    @property
    def cost(self) -> float:
        """What explanations are compared by."""
        return self.omega + 2.0 * self.dropped

    def is_noise(self, sigmas: float = _NOISE) -> bool:
        """Whether what is left is within so many of its own sigmas of what is expected (chi-square)."""
        return is_noise(self.omega, self.redundancy, sigmas)

    @property
    def is_diluted(self) -> bool:
        """Whether all together is noise, though some groups are not."""
        return self.contradicting[0] < self.omega

    @property
    def excess(self) -> float:
        """By how much what contradicts is larger than noise makes it."""
        omega, redundancy = self.contradicting
        return max(0.0, omega - redundancy)

    def times_less_than(self, other: "Misfit") -> float:
        """How many times less than another one it exceeds noise; noise itself is some of it."""
        noise = float(np.sqrt(2.0 * max(self.redundancy, 1)))
        beyond, left = (max(0.0, m.omega - m.redundancy) for m in (other, self))
        return (beyond + noise) / (left + noise)


@frozen(eq=False)
class Trial:
    """A hypothesis, with the misfit of its survey and the adjustment that showed it (None: it led to no solution).

    untimely: there was no time to find out, or to find its size to the end.
    """

    hypothesis: Hypothesis
    misfit: Misfit
    result: Adjustment | None
    survey: Survey | None = None
    untimely: bool = False

    def score(self, base: Misfit) -> float:
        """Minus twice the log likelihood, with what its parameters cost (Schwarz 1978): the less, the likelier."""
        left = self.misfit.fitted + 2.0 * self.misfit.dropped + self.hypothesis.penalty
        return left + self.hypothesis.parameters * float(np.log(max(base.count, 2)))

    def explains(self, share: float, base: Misfit) -> bool:
        """Whether it takes away this share of the misfit beyond noise, where there is any, with all observations.

        Less what it pays for that: larger sigmas, or smaller numbers, could take away any.
        """
        if self.result is None or self.misfit.unused or (base.is_noise(CLEARLY) and not base.is_diluted):
            return False
        others = base.omega - base.redundancy - base.excess
        left = self.misfit.cost + max(self.hypothesis.penalty, 0.0) - self.misfit.redundancy
        return left <= others + (1.0 - share) * base.excess

    def explains_all_but(self, share: float, base: Misfit) -> bool:
        """The same, though all that it does without may have contradicted; save copies, which are no observations."""
        lost = 0.0 if self.hypothesis.penalty < 0.0 else (CAP - 2.0) * self.misfit.dropped
        worse = replace(self, misfit=replace(self.misfit, omega=self.misfit.omega + lost))
        return worse.explains(share, base)


def tried(hypothesis: Hypothesis, case: Case) -> Trial:
    """The survey of a hypothesis adjusted from the values of its case, where there are none from its own start."""
    case.budget.refused = False
    if hypothesis.pair_sigmas is not None:
        again = _again(hypothesis, hypothesis.pair_sigmas, case)
        if again is not None:
            return again
    case.budget.kept += _LAST
    survey = hypothesis.changed()
    case.budget.kept -= _LAST
    if survey is None:
        return Trial(hypothesis, misfit_of(None, case.survey), None, None, case.budget.refused)
    cut, case.budget.refused = case.budget.refused, False
    trial = _adjusted(hypothesis, survey, case, case.run if _afresh_first(hypothesis, case) else case.warm)
    return replace(trial, untimely=trial.untimely or (cut and not trial.misfit.is_noise(_SETTLED)))


def _again(hypothesis: Hypothesis, by: FloatArray, case: Case) -> Trial | None:
    """With other sigmas of pairs in the graph of the case; None where that takes another one."""
    try:
        result = case.reweighted(by)
    except IndeterminateError:  # by rows it may have a solution, ten times as long
        return Trial(hypothesis, misfit_of(None, case.survey), None, None, True)
    except (SurveyError, RuntimeError):  # the latter as below
        return Trial(hypothesis, misfit_of(None, case.survey), None, None, case.budget.refused)
    return None if result is None else Trial(hypothesis, misfit_of(result, case.survey), result)


def _afresh_first(hypothesis: Hypothesis, case: Case) -> bool:
    """Where there are no values, or a start costs less than finding out that they are far off."""
    afresh = not (case.survey.image_blocks or hypothesis.scored or hypothesis.of_variances)
    return case.starts_afresh or (afresh and case.is_spoilt)


def tried_afresh(trial: Trial, case: Case, base: Misfit) -> Trial | None:
    """The same from its own start, where the values of the case led away or may be spoilt by what it does not explain.

    From these values, where its own start was the first. None where that is no better, and of what is scored at these
    values. base: what the case leaves unexplained.
    """
    near = trial.misfit.omega < base.omega and case.is_near
    near |= trial.hypothesis.of_variances and (trial.result is not None or case.is_near)
    if trial.result is not None and case.is_near and case.linear is not None:  # a minimum, if not a better one
        near |= trial.result.omega <= case.linear.result.omega
    if trial.survey is None or case.starts_afresh or near or trial.hypothesis.scored:
        return None
    other = case.warm if _afresh_first(trial.hypothesis, case) else case.run
    again = _adjusted(trial.hypothesis, trial.survey, case, other)
    return again if again.misfit.omega < trial.misfit.omega else None


def _adjusted(hypothesis: Hypothesis, survey: Survey, case: Case, run: Callable[[Survey], Adjustment]) -> Trial:
    try:
        result = run(survey)
    except (SurveyError, RuntimeError):  # the latter from GTSAM, where a hypothesis fits nothing at all
        result = None
    dropped = max(0, misfit_of(None, case.survey).count - misfit_of(None, survey).count)
    misfit = replace(misfit_of(result, survey), dropped=dropped)
    return Trial(hypothesis, misfit, result, survey, result is None and case.budget.refused)


def misfit_of(result: Adjustment | None, survey: Survey) -> Misfit:
    """What an adjustment leaves unexplained of a survey; everything where there is none.

    Observations that the start, a screen or a search left out count as they are predicted, bounded: else an
    explanation that leaves more of them out would look the better one.
    """
    points = 2 * sum(b.n_used for b in survey.image_blocks)
    n_others = n_other_components(survey)
    if result is None:
        omega = CAP * (points + n_others)
        return Misfit(omega, points + n_others, points + n_others, 0, contradicting=(omega, 0.0))
    arrays, out, single = result.other_arrays, _left_out(survey), result.single_residuals
    readings = () if result.reading_residuals is None else result.survey.readings
    names, number = numbered([*(group for _, group, *_ in names_of(single)), *(r.group for r in readings)])
    kept = np.ones(len(number), dtype=np.bool_)
    if out:
        ids: list[tuple[str, ...]] = [*(n[2] for n in names_of(single)), *((r.reading_id,) for r in readings)]
        kept = arrays.used | np.array([not out & {i, i[:1]} for i in ids], dtype=np.bool_)
    of_others = _squares_of_others(result)
    groups = {name: [of_others[(kept & (number == k))[arrays.observation]]] for k, name in enumerate(names)}
    n_adjusted = sum(len(s) for of in groups.values() for s in of)
    for block, squares in zip(survey.image_blocks, block_squares(survey, result), strict=True):
        groups.setdefault(block.group, []).append(np.repeat(0.5 * squares, 2))
    gone = max(0, n_others - n_other_components(result.survey, used_only=False))
    unused = points - 2 * int(result.image_residuals.used.sum()) + gone
    unused += int(arrays.n_components[kept & ~arrays.used].sum())
    every = [np.concatenate(of) for of in groups.values()]
    omega = float(sum(np.minimum(s, CAP).sum() for s in every)) + CAP * gone
    fitted = sum(_at_best_scale(s) for s in every) + CAP * gone
    unknowns = {g.group: g.n_observations - g.redundancy for g in result.groups}  # by its share of the redundancy
    sums = ((float(np.minimum(s, CAP).sum()), len(s), unknowns.get(n, 0.0)) for n, s in zip(groups, every, strict=True))
    parts = [(total, max(0.0, n - taken)) for total, n, taken in sums]
    return Misfit(omega, unused, points + max(n_adjusted, n_others), result.redundancy, fitted=fitted,
                  contradicting=contradicting((omega, result.redundancy), parts))  # fmt: skip


def _squares_of_others(result: Adjustment) -> FloatArray:
    """(K,) over sigmas, 0 of what is none; whitened where readings share a covariance: their sigmas say too little."""
    arrays, readings = result.other_arrays, result.survey.readings
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = (arrays.residual / arrays.sigma) ** 2
    if result.reading_residuals is not None:
        at = {r.reading_id: i for i, r in enumerate(readings, start=len(squares) - len(readings))}
        for block in result.survey.reading_covariances:
            rows = [at[i] for i in block.reading_ids]
            squares[rows] = np.linalg.solve(np.linalg.cholesky(block.cov), arrays.residual[rows]) ** 2
    return np.where(np.isnan(squares), 0.0, squares)


def _at_best_scale(squares: FloatArray) -> float:
    """Minus twice the log likelihood of squares (n,), each bounded, with the best common factor for their variances."""
    total = np.concatenate([[0.0], np.cumsum(ordered := np.sort(squares))])
    within = np.searchsorted(ordered, CAP * _FACTORS)
    n = len(squares)
    return float((total[within] / _FACTORS + CAP * (n - within) + n * np.log(_FACTORS)).min())


@lru_cache(4)  # of the survey of a case, and of what is tried
def n_other_components(survey: Survey, used_only: bool = True) -> int:
    """Observed components in use, or all, that are no image points: the finite variances of covariances, else one."""
    kinds = (kind for name, kind in survey.others.items() if name != "pairs")
    observed = [o for kind in kinds for o in kind if o.used or not used_only]
    pairs = pair_arrays(survey.pairs)
    of_pairs = np.isfinite(np.diagonal(pairs.cov, axis1=1, axis2=2)).sum(axis=1)
    covs = [cov for o in observed if (cov := getattr(o, "cov", None)) is not None]
    variances = np.concatenate([np.zeros(0), *(cov.diagonal() for cov in covs)])
    n_pairs = int(of_pairs[pairs.used].sum() if used_only else of_pairs.sum())
    return len(observed) - len(covs) + int(np.isfinite(variances).sum()) + n_pairs


def _left_out(survey: Survey) -> set[tuple[str, ...]]:
    """Ids of the pairs and table readings that the survey itself does not use."""
    pairs = {(p.pair_id,) for p in survey.pairs if not p.used}
    return pairs | {(r.table_id, r.epoch_id) for r in survey.table_readings if not r.used}
