"""Targets whose points are not where their owner says: wrong size, stretched, sheared, bent."""

from collections.abc import Iterable

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.targets.shape import bent_targets, stretched_targets
from adjust.diagnosis.targets.size import wrong_sizes

__all__ = ["hypotheses"]


def hypotheses(case: Case) -> Iterable[Hypothesis]:
    """The targets with the largest misfit, as of another size, stretched or sheared, and bent."""
    yield from wrong_sizes(case)
    yield from stretched_targets(case)
    yield from bent_targets(case)
