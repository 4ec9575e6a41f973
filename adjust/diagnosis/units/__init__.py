"""Numbers read in another unit, sign, sense or convention than they were written in: readings, given values, pairs."""

from collections.abc import Iterator

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.units.heights import wrong_heights
from adjust.diagnosis.units.pairs import misread_pairs
from adjust.diagnosis.units.readings import misread_readings


def hypotheses(case: Case) -> Iterator[Hypothesis]:
    """Of readings, heights, constants and pairs."""
    yield from misread_readings(case)
    yield from wrong_heights(case)
    yield from misread_pairs(case)
