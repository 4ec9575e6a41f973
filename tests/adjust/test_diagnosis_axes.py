"""Tables whose axes do not turn evenly are named, with the harmonics that mend them; even ones are not."""

from dataclasses import replace

import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import diagnose
from adjust.diagnosis.effects.freed import unsteady_axes
from adjust.diagnosis.hypothesis import SetKey
from adjust.model.survey import TABLE_GEOMETRY, Survey
from survey.simulate import resample
from tests.acceptance.remedies import table


def taken_for_even(harmonics: dict[str, float], seed: int = 3) -> Survey:
    """A survey on a table with harmonics of which its model knows nothing."""
    made = table("", "", {"angle_2": 2, "radial_2": 2, "tilt_2": 2}, harmonics)
    survey = resample(made.survey, made.truth, seed)
    (turntable,) = survey.tables
    given = turntable.geometry
    geometry = replace(given, names=TABLE_GEOMETRY, values=given.values[:4], free=TABLE_GEOMETRY[:2])
    return replace(survey, tables=(replace(turntable, geometry=geometry),))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("harmonics", "name", "said", "key"),
    [
        ({"angle_2_cos_1": 4e-4, "angle_2_sin_1": -2e-4}, "encoder of a table", "angle 2 order 1", "angle_2"),
        ({"radial_2_re_m1": 6e-4, "tilt_2_im_m1": 4e-4}, "axis of a table runs out", "radial 2 order -1", "radial_2"),
    ],
)
def test_uneven_axes_are_named_first(
    harmonics: dict[str, float], name: str, said: str, key: str
) -> None:
    survey = taken_for_even(harmonics)
    first = diagnose(Case(survey, adjust(survey))).candidates[0].hypothesis
    assert first.name == name
    assert said in first.cause
    assert any(isinstance(e, SetKey) and e.path == ("tables", "turntable", "harmonics", key) for e in first.edits)


@pytest.mark.slow
def test_an_even_axis_is_not_suspected() -> None:
    survey = taken_for_even({})
    case = Case(survey, adjust(survey))
    assert not list(unsteady_axes(case, case.linear))
