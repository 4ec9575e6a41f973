"""Changes that no unknown knows, small enough for the score at the solution: steps, drifts, shifts, clocks, shapes.

What shows only where the adjustment has lost its way altogether belongs to the other rooms, which form it from single
images and closed forms.
"""

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.clocks import clocks
from adjust.diagnosis.effects.common import common
from adjust.diagnosis.effects.effect import Effect
from adjust.diagnosis.effects.freed import bent_targets, unsteady_axes, untied
from adjust.diagnosis.effects.pixels import pixels
from adjust.diagnosis.effects.shapes import shapes
from adjust.diagnosis.effects.steps import steps
from adjust.diagnosis.effects.zeros import zeros
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.prediction import Linear
from adjust.model.errors import SurveyError
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_ALPHA = 1e-4
_SHARE = 0.2  # of the misfit beyond noise, by the linear score: less than a cause has to take away in the end
_MOST = 6
_Make = Callable[[Case, Linear], Iterator[Effect]]
_EVERY: tuple[_Make, ...] = (steps, zeros, common, pixels, clocks, shapes)


def hypotheses(case: Case) -> Iterator[Hypothesis]:
    """The few changes that explain most for what they cost, each once; bent targets, uneven axes, lenses not shared."""
    linear = case.linear
    if linear is not None:
        for make in (bent_targets, unsteady_axes, untied, _scored):
            yield from make(case, linear)


def of_tables(case: Case) -> Iterator[Hypothesis]:
    """What all distances of a group, or all observed coordinates, have in common."""
    if case.linear is not None and (case.survey.distances or case.survey.coordinates):
        yield from _scored(case, case.linear, (common,))


def _scored(case: Case, linear: Linear, makes: Sequence[_Make] = _EVERY) -> Iterator[Hypothesis]:
    effects = [e for make in makes for e in _formed(make, case, linear)]
    omega, redundancy = linear.contradicting
    clear = [e for e in effects if e.first.seen and e.first.drop > _SHARE * (omega - redundancy)]
    if not clear:
        return
    redundancy = max(linear.result.redundancy, 1)
    scale = max(1.0, (linear.result.omega - max(e.first.drop for e in clear)) / redundancy)
    limit = sidak(_ALPHA, len(effects))
    clear = [e for e in clear if e.first.drop > scale * float(chi2.isf(limit, e.first.seen))]
    best: dict[tuple[str, ...], Effect] = {}
    for e in sorted(clear, key=lambda e: -e.value(scale, linear.result.n_observations)):
        best.setdefault((e.hypothesis.name, *e.hypothesis.place.ids), e)
    for e in list(best.values())[:_MOST]:
        yield e.formed(case, linear, len(effects))


def _formed(make: _Make, case: Case, linear: Linear) -> list[Effect]:
    try:
        with np.errstate(all="ignore"):
            return list(make(case, linear))
    except SurveyError:
        return []
