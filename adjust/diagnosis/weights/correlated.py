"""Readings that share an error which nobody gives: those of a set-up and kind differ together from what they should be.

One variance component beside their own (Searle, Casella, McCulloch 1992, balanced one-way model): the mean squares of
the means of such sets exceed what independent residuals make by ``n s^2``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.weights.likeliest import likeliest_size
from adjust.model.names import grouped
from adjust.model.observations import ReadingCovariance
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.testing.distributions import chi2

_Common = tuple[str, list[IntArray], float]
"""A kind of readings, its sets, and the error that each set has in common over their own sigma."""
_ALPHA = 1e-6
_FEWEST, _SETS = 3, 3
_SIZES = tuple(np.geomspace(0.5, 30.0, 12).tolist())
"""Of a common error, over what the residuals show of it: the unknowns take some of it over."""
_UNKNOWN = 3.0
_LESS_LIKELY = 30.0
"""Minus twice the log likelihood by which one kind alone explains less than all together, and is not tried."""
_LAST = 1.5
"""Evidence: as for sigmas, larger variances fit anything, so what else there is to try is tried first."""


def correlated_readings(case: Case) -> Iterator[Hypothesis]:
    """Of every kind of readings the common error of a set-up."""
    result, survey = case.result, case.survey
    if result is None or result.reading_residuals is None or survey.reading_covariances:
        return
    if len(result.survey.readings) != len(survey.readings):
        return
    w = result.reading_residuals.residual / result.reading_residuals.sigma
    found = list[_Common]()
    for kind in dict.fromkeys(r.kind for r in survey.readings if r.kind != "direction"):
        sets = _sets(survey, kind)
        if len(sets) < _SETS:
            continue
        between = sum(len(s) * float(w[s].mean()) ** 2 for s in sets)
        if between > float(chi2.isf(_ALPHA, len(sets))):
            n = float(np.mean([len(s) for s in sets]))
            found.append((kind, sets, float(np.sqrt(max(between / len(sets) - 1.0, 0.0) / n))))
    every = [(some, *_best_size(case, some)) for some in ([found] if len(found) > 1 else []) + [[one] for one in found]]
    least = min((cost for *_, cost in every), default=0.0)
    yield from (_hypothesis(survey, some, size) for some, size, cost in every if cost < least + _LESS_LIKELY)


def _best_size(case: Case, found: Sequence[_Common]) -> tuple[float, float]:
    """That of ``_SIZES`` for which all residuals are likeliest, see :func:`likeliest_size`."""
    if case.linear is None:
        return _UNKNOWN, 0.0
    sets, own = [s for _, of, _ in found for s in of], np.array([max(k, 1e-6) for _, of, k in found for _ in of])
    first = case.linear.system.ptr[-1 - len(case.survey.readings)]
    s, M = case.linear.apart([(first + rows, np.ones((len(rows), 1))) for rows in sets])
    return likeliest_size(own * s, M * np.outer(own, own), _SIZES)


def _sets(survey: Survey, kind: str) -> list[IntArray]:
    mine = [(r.setup_id, i) for i, r in enumerate(survey.readings) if r.kind == kind and r.setup_id and r.used]
    by_setup = grouped(mine)
    return [np.array(rows) for rows in by_setup.values() if len(rows) >= _FEWEST]


def _hypothesis(survey: Survey, found: Sequence[_Common], factor: float) -> Hypothesis:
    joint, penalty = [], 0.0
    for _, sets, own in found:
        for rows in sets:
            sigma: FloatArray = np.array([survey.readings[i].sigma for i in rows])
            cov = np.diag(sigma**2) + (factor * own) ** 2 * np.outer(sigma, sigma)
            joint.append(ReadingCovariance(tuple(survey.readings[i].reading_id for i in rows), cov))
            penalty += float(np.log1p(len(rows) * (factor * own) ** 2))
    kinds, common = tuple(kind for kind, _, _ in found), factor * max(own for _, _, own in found)
    return Hypothesis(
        "correlated observations", f"the readings of kind {' and '.join(kinds)} of a set-up have an error in common, "
        f"about {common:.2g} times their own sigma: they are given as independent",
        "give their covariance, or free the constant they share (an instrument's offset or index, a height)",
        Place("group", kinds, "sigma"), replace(survey, reading_covariances=tuple(joint)), (), _LAST, len(found),
        len(_SIZES), penalty=penalty, of_variances=True,
    )  # fmt: skip
