"""Surveys that lead nowhere because readings of a kind are misread, or known coordinates are in other axes or units.

A search among what these contradict takes long.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned

if TYPE_CHECKING:
    from adjust.diagnosis.case import Case

Progress = Callable[[int, float], None]
_STEPS = 40
"""What right readings never take, from closed forms on."""
_MOST = 2 * _STEPS
"""What is not worth more: a solution that what is misread spoils anyway."""
_FAR = 1e6
"""v'Pv of a component after these steps that no single gross error is worth."""
_TRIED = 4
"""Ways to read them that are tried, the most evident first."""
_PART = 1e-3
"""Of v'Pv that is left as soon as what is misread throughout is read as it was meant."""


class _AstrayError(Exception):
    """The steps lead nowhere."""


def cleaned(
    survey: Survey, options: CleanOptions, progress: Progress, start: StartValues | None
) -> Adjustment:
    """:func:`adjust_cleaned`; without a search where misread readings or coordinates are all that is wrong."""
    if survey.image_blocks or not survey.readings or not options.reject_pairs:
        return adjust_cleaned(survey, options, progress, start)
    steps, most = 0, _FAR * survey.n_others_used

    def watched(iteration: int, omega: float) -> None:
        nonlocal steps
        steps += 1
        if steps > _STEPS and omega > most:
            raise _AstrayError
        progress(iteration, omega)

    try:
        return adjust_cleaned(survey, options, watched, start)
    except _AstrayError:
        if not _misread(survey, _PART * most):
            return adjust_cleaned(survey, options, progress, start)
        solve = replace(options.adjust.solve, max_iterations=_MOST)
        how = replace(options, reject_pairs=False, adjust=replace(options.adjust, solve=solve))
        return adjust_cleaned(survey, how, progress, start)


def _misread(survey: Survey, most: float) -> bool:
    """Whether by one way to read several of its readings, or its coordinates, v'Pv comes below that."""
    from adjust.diagnosis.case import Case  # here: most surveys go without
    from adjust.diagnosis.names.given import wrong_given
    from adjust.diagnosis.units.readings import misread_readings

    case = Case(survey)
    for find in (misread_readings, wrong_given):
        try:
            found = [h for h in find(case) if h.name != "slipped decimal"][:_TRIED]
        except SurveyError:
            continue
        if any(_leaves(case, h.changed(), most) for h in found):
            return True
    return False


def _leaves(case: "Case", survey: Survey | None, most: float) -> bool:
    try:
        return survey is not None and case.run(survey).omega < most
    except (SurveyError, RuntimeError):  # the latter from GTSAM, where nothing fits at all
        return False
