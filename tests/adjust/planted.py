"""Surveys with one mistake planted, for tests of what a diagnosis names."""

from collections.abc import Callable
from dataclasses import replace

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import Diagnosis, diagnose
from adjust.diagnosis.families import Family
from adjust.model.errors import SurveyError
from adjust.model.observations import Reading
from adjust.model.survey import Survey
from tests.adjust.terrestrial_networks import measured, polar_network


def case_of(survey: Survey) -> Case:
    try:
        return Case(survey, adjust(survey))
    except SurveyError as error:
        return Case(survey, None, error)


def diagnosed(survey: Survey, *families: Family) -> Diagnosis:
    return diagnose(case_of(survey), families)


def hall(seed: int = 1, plane: bool = False) -> Survey:
    """A network of four set-ups and eight points, in space or in a plane."""
    survey, truth = polar_network(seed, plane=plane)
    return measured(survey, truth, seed + 100)


def reread(survey: Survey, wrong: Callable[[Reading], bool], value: Callable[[float], float]) -> Survey:
    readings = tuple(replace(r, value=value(r.value)) if wrong(r) else r for r in survey.readings)
    return replace(survey, readings=readings)
