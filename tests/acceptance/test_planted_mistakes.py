"""Planted mistakes are named first, innocent surveys are not blamed, and a named cause can be tried and taken back."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import adjust
from adjust.diagnosis.budget import Budget
from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import diagnose
from adjust.model.errors import SurveyError
from adjust.model.survey import LensParameter
from survey.cli import main
from survey.project.writing import write_project
from survey.simulate.parts import wall_grid
from tests.acceptance.planted_mistakes import MISTAKES, board_of, diagnosed, outcome_of, survey_of

NAMED = {  # one size of each, in one kind of survey; the whole table is python -m tests.acceptance.planted_mistakes
    ("images mirrored", "stereo"): 0.6,
    ("images turned", "stereo"): 0.4,
    ("images shifted", "head"): 12.0,
    ("images resized", "stereo"): 0.8,
    ("focus touched", "stereo"): 0.01,
    ("camera moved", "stereo"): 6.0,
    ("target moved", "relay"): 10.0,
    ("target scaled", "relay"): 0.8,
    ("target stretched", "stereo"): 1.01,
    ("target sheared", "stereo"): 0.01,
    ("target bent", "stereo"): 1.5,
    ("images copied", "stereo"): 0.6,
    ("lens drifts", "stereo"): 3.0,
    ("rows and columns", "stereo"): 0.0,
    ("cameras not simultaneous", "rig"): 0.1,
    ("rolling shutter", "rig"): 0.1,
    ("clock offset", "sweep"): 0.05,
}
SEARCHED = (  # names that closed forms find, and small mistakes among much noise
    ("points exchanged", "beacons", 0.2), ("rows of another set-up", "plane", 2.0), ("slipped decimal", "plane", 0.1),
    ("target height", "hall", 0.1), ("gear ratio", "head", 1e-3), ("clock offset", "hand", 0.05),
    ("left-handed frames", "hand", 0.0), ("images turned", "head", 0.2), ("pairs inverted", "poses", 7.0),
    ("order of quaternions", "poses", 12.0), ("the same twice", "poses", 100.0), ("sigmas of a group", "hall", 0.1),
    ("stations exchanged", "poses", 0.35), ("stations exchanged", "poses", 3.0), ("interlaced", "rig", 0.1),
    ("clock drift", "rig", 0.8), ("station moved", "tripods", 20.0), ("sigmas of a group", "poses", 10.0),
    ("correlated observations", "hall", 12.0), ("motion forgotten", "relay", 11.0), ("pairs inverted", "poses", 0.0),
)  # fmt: skip


@pytest.mark.parametrize(("name", "kind"), NAMED)
def test_planted_mistake_is_named_first(name: str, kind: str) -> None:
    mistake = next(m for m in MISTAKES if m.name == name and kind in m.kinds)
    survey, truth = survey_of(kind, 3)
    planted = mistake.plant(survey, truth, NAMED[name, kind])
    first = diagnosed(planted).candidates[0]
    assert (first.hypothesis.name, first.hypothesis.place.ids) == (name, (mistake.about(survey),))
    assert first.explained > 0.9
    assert first.sigma0 < 1.1


@pytest.mark.parametrize(("name", "kind", "size"), SEARCHED)
def test_small_or_far_off_mistake_is_named_first(name: str, kind: str, size: float) -> None:
    mistake = next(m for m in MISTAKES if m.name == name and kind in m.kinds and size in m.sizes)
    assert outcome_of(mistake, kind, size)["outcome"] == "first"


def test_size_that_makes_it_worse_is_taken_back() -> None:
    """Found at values that the mistake has spoilt, it is no size at those that it has led to."""
    mistake = next(m for m in MISTAKES if m.name == "focus touched")
    assert outcome_of(mistake, "stereo", 0.03, 90210)["outcome"] == "first"


@pytest.mark.parametrize(("model", "free"), [
    ("aicon", "ck xh yh A1 A2"), ("brown_backward", "c xp yp K1 K2"), ("brown_backward_dbat", "c px py K1 K2"),
])  # fmt: skip
def test_focus_is_named_whatever_the_lens_calls_it(model: str, free: str) -> None:
    survey, truth = survey_of("stereo", 3)
    lens = LensParameter(model, tuple(free.split()), pixel_size_mm=0.005)
    survey = replace(survey, cameras=tuple(replace(c, lens=lens) for c in survey.cameras))
    mistake = next(m for m in MISTAKES if m.name == "focus touched")
    first = diagnosed(mistake.plant(survey, truth, 0.01)).candidates[0].hypothesis
    assert (first.name, first.place.ids) == ("focus touched", (mistake.about(survey),))


@pytest.mark.parametrize(("name", "kind", "size"), [
    ("given points exchanged", "plane", 0.0), ("points exchanged", "plane", 0.0),
])  # fmt: skip
def test_where_the_start_is_lost_the_change_still_shows(name: str, kind: str, size: float) -> None:
    """Every sight misses; one column alone was exchanged."""
    mistake = next(m for m in reversed(MISTAKES) if m.name == name and kind in m.kinds and size in m.sizes)
    assert outcome_of(mistake, kind, size, 61740)["outcome"] == "first"


@pytest.mark.parametrize(("name", "kind", "size"), [
    ("camera moved", "stereo", 20.0), ("images turned", "relay", 0.4), ("unit of shifts", "poses", 0.0),
])  # fmt: skip
def test_what_could_fit_anything_ends_no_search(name: str, kind: str, size: float) -> None:
    """Larger sigmas, a camera all of which is another one, shifts that all become smaller than their sigmas."""
    mistake = next(m for m in MISTAKES if m.name == name and kind in m.kinds and size in m.sizes)
    assert outcome_of(mistake, kind, size, 231128)["outcome"] == "first"


@pytest.mark.parametrize(
    ("name", "kind", "size"), [("unit of lengths", "hall", 1000.0), ("slipped decimal", "plane", 10.0)]
)
def test_network_that_is_not_adjusted_is_read_in_other_ways_first(name: str, kind: str, size: float) -> None:
    """As it stands it leads nowhere: no time is spent on scores there."""
    mistake = next(m for m in MISTAKES if m.name == name and kind in m.kinds and size in m.sizes)
    survey, truth = survey_of(kind, 3)
    planted = mistake.plant(survey, truth, size)
    with pytest.raises(SurveyError) as error:
        adjust.solve(planted)
    case = Case(planted, None, error.value)
    assert diagnose(case).candidates[0].hypothesis.name == name
    assert "linear" not in vars(case)


def test_part_that_can_be_adjusted_is_no_explanation() -> None:
    """A camera called another one, whose images are then left out, is not named for that."""
    mistake = next(m for m in MISTAKES if m.title == "or the table")
    assert outcome_of(mistake, "head", 20.0, 90210)["outcome"] != "another"


def test_diagnosis_keeps_to_its_budget() -> None:
    """What is spent ends it, a little more where nothing explains anything; what was not tried any more is told."""
    survey, truth = survey_of("stereo", 3)
    planted = next(m for m in MISTAKES if m.name == "camera moved").plant(survey, truth, 6.0)
    result = adjust.solve(planted)
    whole, short, cut = (diagnose(Case(planted, result, None, Budget(most))) for most in (20.0, 6.0, 0.0))
    for enough in (whole, short):
        assert enough.candidates[0].hypothesis.name == "camera moved"
        assert not enough.untried
    assert "sigmas of a group" in cut.untried
    assert set(cut.untried).isdisjoint(cut.tried)
    assert not cut.candidates
    assert f"not tried, as the time of a diagnosis was spent: {', '.join(cut.untried)}" in cut.note


@pytest.mark.parametrize("kind", ["stereo", "head"])
@pytest.mark.parametrize("smaller", [1.0, 1.3])
def test_innocent_survey_is_not_blamed(kind: str, smaller: float) -> None:
    """Nor one whose image sigmas are given too small, though its global test fails."""
    survey, _ = survey_of(kind, 11)
    blocks = tuple(replace(b, cov=b.cov / smaller**2) for b in survey.image_blocks)
    assert not diagnosed(replace(survey, image_blocks=blocks)).candidates


def test_what_a_whole_camera_gains_says_nothing_of_its_crop() -> None:
    """Lens and place of a camera free from an epoch on: fourteen numbers, though two of them would tell it all."""
    assert not diagnosed(survey_of("relay", 80434)[0]).candidates


def test_nothing_that_was_given_is_changed() -> None:
    survey, truth = survey_of("stereo", 3)
    planted = next(m for m in MISTAKES if m.name == "camera moved").plant(survey, truth, 6.0)
    before = [b.uv.copy() for b in planted.image_blocks]
    diagnosed(planted)
    assert all(np.array_equal(b.uv, uv) for b, uv in zip(planted.image_blocks, before, strict=True))


def test_named_in_results_and_tried(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Half of one camera's images mirrored: refused with the cause; tried: rows changed, the old table kept."""
    survey, truth = survey_of("stereo", 3)
    planted = next(m for m in MISTAKES if m.name == "images mirrored").plant(survey, truth, 0.6)
    lab = tmp_path / "lab"
    write_project(lab, planted)
    table = lab / "observations" / "image_points.csv"
    was = table.read_bytes()
    assert main(["adjust", str(lab), "--quiet"]) == 1
    assert "camera right: 7 of its 12 images" in capsys.readouterr().err
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    assert (lab / "kept" / "image_points-1.csv").read_bytes() == was
    assert table.read_bytes() != was
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert solution["summary"]["sigma0"] < 1.1
    assert "diagnosis" not in solution


def test_size_of_a_target_tried(tmp_path: Path) -> None:
    """The plates' markers given at 25 mm for an inch: the number in survey.toml is changed, its comment stays."""
    survey, truth = survey_of("relay", 3)
    planted = next(m for m in MISTAKES if m.name == "target scaled").plant(survey, truth, 25.0 / 25.4)
    lab = tmp_path / "lab"
    name = board_of(survey)
    true, off = wall_grid(1), 25.0 / 25.4
    wrong = replace(true, marker_m=true.marker_m * off, gap_m=true.gap_m * off)
    write_project(lab, planted, target_kinds={name: wrong})
    definition = lab / "survey.toml"
    text = definition.read_text(encoding="utf-8").replace("marker_mm", "# of the shop\nmarker_mm", 1)
    definition.write_text(text, encoding="utf-8")
    assert main(["adjust", str(lab), "--quiet"]) == 3
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert (solution["diagnosis"][0]["name"], solution["diagnosis"][0]["ids"]) == ("target scaled", [name])
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    new = tomllib.loads(definition.read_text(encoding="utf-8"))["targets"][name]
    assert new["marker_mm"] == pytest.approx(1e3 * true.marker_m)
    assert "# of the shop" in definition.read_text(encoding="utf-8")
    assert (lab / "kept" / "survey-1.toml").read_text(encoding="utf-8") == text


def test_try_says_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    survey, _ = survey_of("stereo", 11)
    lab = tmp_path / "lab"
    write_project(lab, survey)
    said = tomllib.loads((lab / "survey.toml").read_text(encoding="utf-8"))
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 1
    assert "the diagnosis names no cause that it could change" in capsys.readouterr().err
    assert tomllib.loads((lab / "survey.toml").read_text(encoding="utf-8")) == said
