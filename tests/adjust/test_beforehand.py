"""What is told of a survey before it is adjusted: planted weaknesses by kind, and nothing of a sound survey."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from adjust.diagnosis.beforehand import look_beforehand
from adjust.model.survey import Survey
from survey.simulate import head_on_table, single_camera, stereo
from tests.adjust.planted import hall, reread


def kinds(survey: Survey) -> dict[str, tuple[str, ...]]:
    return {f.kind: f.ids for f in look_beforehand(survey).findings}


@pytest.mark.parametrize("made", [hall, lambda: hall(2, plane=True), lambda: stereo(1)[0]])
def test_a_sound_survey_has_no_problems(made: Callable[[], Survey]) -> None:
    assert [f for f in look_beforehand(made()).findings if f.level == "problem"] == []


def test_nothing_is_changed_and_the_redundancy_is_that_of_the_adjustment() -> None:
    expected = look_beforehand(hall()).expected
    assert expected is not None
    assert (expected.n_observations, expected.redundancy) == (88, 66)


def test_a_name_that_appears_once() -> None:
    good = hall()
    at = next(i for i, r in enumerate(good.readings) if r.to.point_id == "P6" and r.kind == "direction")
    lost = replace(good.readings[at], to=replace(good.readings[at].to, point_id="P66"))
    points = (*good.points, replace(good.points[6], point_id="P66"))
    wrong = replace(good, points=points, readings=(*good.readings[:at], lost, *good.readings[at + 1 :]))
    assert kinds(wrong)["id appears once"] == ("P66",)


def test_points_that_nothing_checks() -> None:
    good = hall()
    first = {r.kind: r.reading_id for r in good.readings if r.to.point_id == "P7" and r.setup_id == "S0"
             and r.kind != "angle"}  # fmt: skip
    kept = tuple(r for r in good.readings if r.reading_id in first.values()
                 or not any(x is not None and x.point_id == "P7" for x in (r.at, r.to, r.second)))  # fmt: skip
    assert kinds(replace(good, readings=kept))["no redundancy"] == ("P7",)


def test_a_survey_without_datum_is_undetermined() -> None:
    good = hall()
    floating = replace(good, points=tuple(replace(p, x_in_world=replace(p.x_in_world, treatment="free")) for p in
                                          good.points))  # fmt: skip
    assert "undetermined" in kinds(floating)


@pytest.mark.parametrize("factor", [1000.0, 0.001])
def test_distances_of_a_set_up_in_another_unit(factor: float) -> None:
    wrong = reread(hall(), lambda r: r.setup_id == "S2" and r.kind == "slope_distance", lambda v: factor * v)
    assert kinds(wrong)["suspicious unit"] == ("S2",)


def test_a_sigma_of_a_metre() -> None:
    good = hall()
    readings = tuple(replace(r, sigma=1.0) if r.reading_id == "slope_distance1-4" else r for r in good.readings)
    assert kinds(replace(good, readings=readings))["suspicious sigma"] == ("slope_distance1-4",)


def shrunk(survey: Survey, factor: float) -> Survey:
    """The images smaller, about the middle of the first point: as from far away."""
    blocks = tuple(replace(b, uv=b.uv[0] + factor * (b.uv - b.uv[0])) for b in survey.image_blocks)
    return replace(survey, image_blocks=blocks)


def test_a_board_too_far_and_small_and_an_image_not_covered() -> None:
    found = kinds(shrunk(single_camera(1)[0], 0.1))
    assert {"target too far", "target small in the image", "image not covered"} <= set(found)


def test_a_camera_with_three_views() -> None:
    survey = single_camera(1)[0]
    assert kinds(replace(survey, image_blocks=survey.image_blocks[:3]))["few views"] == ("C1",)


def test_epochs_that_one_camera_alone_sees() -> None:
    survey = stereo(1)[0]
    alone = tuple(replace(b, epoch_id=f"{b.epoch_id}r") if b.camera_id == "right" else b for b in survey.image_blocks)
    found = kinds(replace(survey, image_blocks=alone))
    assert len(found["epochs without partners"]) == 24


@pytest.mark.slow
def test_readings_of_a_table_without_images() -> None:
    survey = head_on_table(1, n_table_epochs=4, n_free_epochs=3)[0]
    extra = replace(survey.table_readings[0], epoch_id="t99", angles=np.array([0.1, 0.2]))
    found = kinds(replace(survey, table_readings=(*survey.table_readings, extra)))
    assert found["epochs without partners"] == ("t99",)
