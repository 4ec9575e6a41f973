"""Weights that contradict the residuals: sigmas of a group wrong by a factor, single sigmas far from all others'."""

from collections.abc import Iterator

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.weights.correlated import correlated_readings
from adjust.diagnosis.weights.sigmas import odd_sigmas, wrong_factors


def hypotheses(case: Case) -> Iterator[Hypothesis]:
    """Of single sigmas, then of groups."""
    yield from odd_sigmas(case)
    yield from wrong_factors(case)
    yield from correlated_readings(case)
