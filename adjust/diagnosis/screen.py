"""A survey evaluated at rough values, without adjusting: which of its observations fit what the others say.

The closed forms of the start are robust: what one set-up or one pair says wrongly leaves the rest where it belongs.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from adjust.adjustment import start_values
from adjust.diagnosis.case import CAP, Case
from adjust.graph.assembly import AdjustmentGraph, GraphBuilder, StartValues, values_of
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, Survey
from adjust.start import find_start

_MEDIAN = 0.455  # of chi-square with one degree of freedom


@dataclass(frozen=True, eq=False)
class Screen:
    """A graph at its start values. ``start``: these; orientations of set-ups are medians of their directions."""

    graph: AdjustmentGraph
    start: StartValues

    @cached_property
    def readings(self) -> FloatArray:
        """(N,) squares over sigmas of all readings."""
        batch = self.graph.terrestrial
        return np.zeros(0) if batch is None else _finite(batch.unweighted(self.graph.start) ** 2)

    @cached_property
    def predicted(self) -> FloatArray:
        """(N,) rad or m, predicted values of all readings."""
        if self.graph.terrestrial is None:
            return np.zeros(0)
        self.graph.terrestrial.evaluate(self.graph.start)
        return np.array(self.graph.terrestrial.predicted)

    @cached_property
    def others(self) -> FloatArray:
        """(k,) mean squares over sigmas of the components of what is neither a reading nor an image point."""
        found = [(2.0 * o.factor.error(self.graph.start), max(1, len(o.components))) for o in self.graph.others]
        return _finite(np.array([square / n for square, n in found]))

    @cached_property
    def scale(self) -> float:
        """Variance factor of the rough values: they miss by more than noise; of the typical observation."""
        every = np.concatenate([self.readings, self.others])
        return max(1.0, float(np.median(every)) / _MEDIAN) if len(every) else 1.0

    def misfit(self, scale: float = 1.0) -> float:
        """Sum of squares, each bounded, over a variance factor."""
        return float(np.minimum(np.concatenate([self.readings, self.others]) / scale, CAP).sum())


def _finite(squares: FloatArray) -> FloatArray:
    return np.where(np.isfinite(squares), squares, np.inf)


def screen(survey: Survey, start: StartValues | None = None) -> Screen | None:
    """The survey at given or at its own start values; None where none can be found."""
    try:
        if start is None:
            start = start_values(find_start(survey))
        vectors = {n: v for n, v in start.vectors.items() if n[0] != "orientation"}
        graph = GraphBuilder(survey, start.lenses).build(replace(start, vectors=vectors))
        return Screen(graph, start)
    except (SurveyError, RuntimeError):  # GTSAM raises the latter where a convention that is not meant fits nothing
        return None


@lru_cache(maxsize=2)
def at_best(case: Case) -> Screen | None:
    """At the adjustment where there is one that left out what contradicts, else at the start."""
    if case.result is not None and case.result.global_test is not None and case.result.global_test.passed:
        return screen(case.survey, values_of(case.result)) or screen(case.survey)
    return screen(case.survey)


def improvement(before: float, after: float, n: int) -> float:
    """How many times less than before the bounded misfits of n observations exceed their noise, which is about n."""
    return (before - n) / (max(after - n, 0.0) + 5.0 + 0.02 * n)
