"""One hypothesis, tried: its survey adjusted, and what is left unexplained."""

from dataclasses import dataclass

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey

CAP = 25.0
"""The most that one component of an observation counts: what is left out, or cannot be predicted, counts so."""


@dataclass(frozen=True)
class Misfit:
    """What a survey leaves unexplained. omega: sum of squares over sigmas, each bounded by ``CAP``, all observations.

    unused: components that take no part, or cannot be predicted. count: of all components. redundancy: of the
    adjustment, 0 where there is none.
    """

    omega: float
    unused: int
    count: int
    redundancy: int

    @property
    def excess(self) -> float:
        """By how much the misfit is larger than noise makes it."""
        return max(0.0, self.omega - self.redundancy)


@dataclass(frozen=True, eq=False)
class Trial:
    """A hypothesis, with the misfit of its survey and the adjustment that showed it (None: it led to no solution)."""

    hypothesis: Hypothesis
    misfit: Misfit
    result: Adjustment | None


def tried(hypothesis: Hypothesis, case: Case) -> Trial:
    """The survey of a hypothesis adjusted as its case is; no change of what the case holds."""
    try:
        result = case.run(hypothesis.survey)
    except SurveyError:
        return Trial(hypothesis, misfit_of(None, hypothesis.survey), None)
    return Trial(hypothesis, misfit_of(result, hypothesis.survey), result)


def misfit_of(result: Adjustment | None, survey: Survey) -> Misfit:
    """What an adjustment leaves unexplained of a survey; everything where there is none.

    Observations that the start, a screen or a search left out count as they are predicted, bounded: else an
    explanation that leaves more of them out would look the better one.
    """
    points = 2 * sum(len(b.uv) if b.used is None else int(b.used.sum()) for b in survey.image_blocks)
    if result is None:
        return Misfit(CAP * points, points, points, 0)
    images = result.image_residuals
    cov = np.concatenate([np.zeros((0, 2, 2)), *(b.cov for b in result.survey.image_blocks)])
    squares = _whitened(images.residuals, cov)
    others = np.concatenate([np.zeros(0), *(_squares(o.residual, o.sigma) for o in result.other_residuals)])
    unused = int(2 * (~images.used).sum()) + max(0, points - 2 * len(cov))
    unused += sum(len(o.residual) for o in result.other_residuals if not o.used)
    omega = float(np.minimum(squares, 2.0 * CAP).sum() + np.minimum(others, CAP).sum())
    omega += CAP * max(0, points - 2 * len(cov))  # blocks that are not even predicted
    return Misfit(omega, unused, points + len(others), result.redundancy)


def _whitened(residuals: FloatArray, cov: FloatArray) -> FloatArray:
    """(n,) v' inv(C) v of image points; what cannot be predicted counts as the bound."""
    if not len(residuals):
        return np.zeros(0)
    squares = np.einsum("ni,nij,nj->n", residuals, np.linalg.inv(cov), residuals)
    return np.where(np.isfinite(squares), squares, np.inf)


def _squares(residual: FloatArray, sigma: FloatArray) -> FloatArray:
    with np.errstate(invalid="ignore", divide="ignore"):
        squares = (residual / sigma) ** 2
    return np.where(np.isnan(squares), 0.0, squares)
