"""Targets of quite another size than their owner says. Small differences in size and shape are effects."""

from collections.abc import Iterable

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.targets.size import wrong_sizes

__all__ = ["hypotheses"]


def hypotheses(case: Case) -> Iterable[Hypothesis]:
    """The targets that the rest contradicts, as of another size."""
    yield from wrong_sizes(case)
