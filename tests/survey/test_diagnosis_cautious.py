"""Sigmas of a group that are far too large: told with factor and interval, tried, and no contradiction."""

from pathlib import Path

import pytest

from adjust.statistics.group_sums import scaled_survey
from survey.cli import main
from survey.jobs.adjusting.job import adjust_job
from survey.project.writing import write_project
from tests.acceptance.planted_surveys import survey_of


@pytest.mark.slow
def test_a_group_that_is_too_good_is_named_and_mended(tmp_path: Path) -> None:
    survey = scaled_survey(survey_of("poses", 5)[0], {"north": 36.0})
    write_project(tmp_path / "lab", survey)
    first = adjust_job(tmp_path / "lab", progress=False).adjustment
    assert first.warnings[0].startswith(
        "too good: the sigmas of group north are 7.3 times too large (5.8 to 8.7 at 95 %)"
    )
    assert not any(w.startswith("probable cause") for w in first.warnings)
    assert main(["adjust", str(tmp_path / "lab"), "--quiet", "--try", "1"]) == 0
    again = adjust_job(tmp_path / "lab", progress=False).adjustment
    assert not any(w.startswith("too good") for w in again.warnings)
    assert {g.group: g.factor for g in again.groups}["north"] == pytest.approx(1.0, abs=0.15)


@pytest.mark.parametrize("kind", ["poses", "hall", "stereo"])
def test_sigmas_that_are_right_are_not_too_good(tmp_path: Path, kind: str) -> None:
    write_project(tmp_path / "lab", survey_of(kind, 6)[0])
    assert not any(w.startswith("too good") for w in adjust_job(tmp_path / "lab", progress=False).adjustment.warnings)
