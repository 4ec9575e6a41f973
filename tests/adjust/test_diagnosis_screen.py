"""Readings that are read otherwise, all at once, against a graph built for each of them."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import Diagnosis
from adjust.diagnosis.names.points import ends_exchanged, exchanged
from adjust.diagnosis.names.setups import as_of_setup, given_to
from adjust.diagnosis.screen import Screen, screen
from adjust.diagnosis.trial import Misfit
from adjust.diagnosis.units.conventions import MISREADINGS
from adjust.diagnosis.units.readings import mended
from adjust.model.survey import Survey
from tests.adjust.planted import hall


def screened(survey: Survey) -> Screen:
    found = screen(survey)
    assert found is not None
    return found


@pytest.mark.parametrize("plane", [False, True])
def test_other_values_are_those_of_a_graph_of_their_own(plane: bool) -> None:
    survey = hall(plane=plane)
    before = screened(survey)
    sets = [np.array([i for i, r in enumerate(survey.readings) if r.setup_id == s and r.kind == "direction"])
            for s in ("S1", "S2")]  # fmt: skip
    ways = [m for m in MISREADINGS if "direction" in m.kinds]
    every = [(rows, m) for rows in sets for m in ways]
    values = np.array([r.value for r in survey.readings])
    found = before.alternatives([r for r, _ in every], observed=np.concatenate([m.mend(values[r]) for r, m in every]))
    for (rows, m), squares in zip(every, found, strict=True):
        alone = screen(mended(survey, rows, m), before.start)
        assert alone is not None
        assert squares == pytest.approx(alone.readings[rows], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("plane", [False, True])
def test_other_ends_are_those_of_a_graph_of_their_own(plane: bool) -> None:
    survey = hall(plane=plane)
    before = screened(survey)
    rows = np.array([i for i, r in enumerate(survey.readings)
                     if {"P4", "P6"} & {r.to.point_id, r.second.point_id if r.second else ""}])  # fmt: skip
    (squares,) = before.alternatives([rows], **ends_exchanged(before, [rows], [("P4", "P6")]))
    alone = screen(exchanged(survey, rows, "P4", "P6"), before.start)
    assert alone is not None
    assert squares.max() > 1e3
    assert squares == pytest.approx(alone.readings[rows], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("plane", [False, True])
def test_rows_of_another_set_up_are_those_of_a_graph_of_their_own(plane: bool) -> None:
    survey = hall(plane=plane)
    before = screened(survey)
    home = next(r for r in survey.readings if r.setup_id == "S1")
    rows = np.array([i for i, r in enumerate(survey.readings)
                     if r.setup_id == "S2" and r.to.point_id == "P7" and r.second is None])  # fmt: skip
    (squares,) = before.alternatives([rows], **as_of_setup(before, [rows], "S1"))
    alone = screen(given_to(survey, rows, home), before.start)
    assert alone is not None
    assert squares.max() > 1e3
    assert squares == pytest.approx(alone.readings[rows], rel=1e-6, abs=1e-6)


@pytest.mark.parametrize("plane", [False, True])
def test_a_start_of_their_own(plane: bool) -> None:
    """Of values misread throughout, and of given points elsewhere."""
    survey = hall(plane=plane)
    values = [mended(survey, np.array([i for i, r in enumerate(survey.readings) if r.kind in m.kinds]), m)
              for m in MISREADINGS[:3]]  # fmt: skip
    given = survey.points[1]
    moved = replace(given, x_in_world=replace(given.x_in_world, value=np.asarray(given.x_in_world.value) * 1.01))
    every = [*values, replace(survey, points=(survey.points[0], moved, *survey.points[2:]))]
    for changed, fit in zip(every, screened(survey).afresh(every), strict=True):
        alone = screened(changed)
        assert fit is not None
        assert fit.readings == pytest.approx(alone.readings, rel=1e-6, abs=1e-6)
        assert fit.scale == pytest.approx(alone.scale, rel=1e-6)


def test_what_is_not_looked_for_is_told() -> None:
    case = Case(hall())
    assert case.few("rows of another set-up", 600, 600)
    assert not case.passed_over
    assert not case.few("rows of another set-up", 601, 600)
    assert not case.few("rows of another set-up", 602, 600)
    found = Diagnosis((), (), Misfit(0.0, 0, 0, 0), ("target scaled",), tuple(case.passed_over))
    assert found.lines == ()
    assert found.note == ("not tried, as the time of a diagnosis was spent: target scaled; "
                          "not looked for in a survey of this size: rows of another set-up")  # fmt: skip
