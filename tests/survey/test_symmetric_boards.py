"""Boards that look the same after a turn, and cameras that name their corners from the other end."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adjust.adjustment import AdjustOptions, adjust
from adjust.model.survey import PoseParameter
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.adjusting.symmetric_boards import consistent_turns
from survey.project import read
from survey.project.targets import Checkerboard
from tests.data import data_folder

HELD = PoseParameter(treatment="held")


@pytest.fixture(scope="module")
def upside_down():
    return read(data_folder("calibration", "upside_down"))


def with_turns(survey, turned):
    """Half a turn in the names of some blocks."""
    blocks = list(survey.image_blocks)
    for i in turned:
        blocks[i] = replace(blocks[i], point_idx=47 - blocks[i].point_idx)
    return replace(survey, image_blocks=tuple(blocks))


def right_blocks(survey):
    return [i for i, b in enumerate(survey.image_blocks) if b.camera_id == "right"]


def left_from_right(survey):
    result = adjust(survey, options=AdjustOptions(reject_points=True))
    return result.estimates["station_from_camera", "right"].value


def half_a_turn_without_shift(pose):
    angle = Rotation.from_matrix(pose.rotation().matrix()).magnitude()
    return np.rad2deg(angle) == pytest.approx(180.0, abs=0.02) and np.linalg.norm(pose.translation()) < 2e-4


@pytest.mark.parametrize("columns", range(3, 8))
@pytest.mark.parametrize("rows", range(3, 8))
def test_turns_are_those_that_take_all_colours_to_themselves(columns, rows):
    colours = np.indices((rows + 1, columns + 1)).sum(0) % 2
    same = [k for k in (1, 2, 3) if np.array_equal(np.rot90(colours, k), colours)]
    turns = Checkerboard(columns, rows, 0.02).turns()
    assert len(turns) == len(same)
    x = Checkerboard(columns, rows, 0.02).points()[1]
    for turn in turns:
        assert sorted(turn) == list(range(columns * rows))
        # a rigid turn in the plane: distances stay, and so does the handedness
        assert np.linalg.norm(x[turn][1:] - x[turn][0], axis=1) == pytest.approx(np.linalg.norm(x[1:] - x[0], axis=1))
        right, down = x[turn][1] - x[turn][0], x[turn][columns] - x[turn][0]
        assert np.cross(right, down)[2] > 0


@pytest.mark.slow
def test_a_camera_mounted_upside_down_is_named_and_resolved(tmp_path):
    folder = data_folder("calibration", "upside_down")
    outcome = adjust_job(folder, out=tmp_path / "out", progress=False)
    pose = outcome.adjustment.estimates["station_from_camera", "right"].value
    assert half_a_turn_without_shift(pose)
    lines = [w for w in outcome.summary()["warnings"] if "half a turn" in str(w)]
    assert len(lines) == 1
    assert "camera 'right', target 'board'" in str(lines[0])
    assert "15 of 15 images" in str(lines[0])
    assert "half a turn" in (tmp_path / "out" / "results" / "report.html").read_text()


def test_names_that_agree_stay_as_they_are(upside_down):
    survey = with_turns(upside_down.survey, right_blocks(upside_down.survey))
    same, notes = consistent_turns(survey, upside_down.target_kinds)
    assert same is survey
    assert notes == ()


@pytest.mark.slow
def test_single_images_named_from_the_other_end_are_resolved_too(upside_down):
    survey = upside_down.survey
    rng = np.random.default_rng(4)
    mixed = with_turns(survey, np.flatnonzero(rng.random(len(survey.image_blocks)) < 0.5))
    resolved, notes = consistent_turns(mixed, upside_down.target_kinds)
    assert notes
    assert half_a_turn_without_shift(left_from_right(resolved))


def test_without_any_way_to_tell_camera_and_target_are_named(upside_down):
    survey = upside_down.survey
    one = replace(survey, image_blocks=tuple(b for b in survey.image_blocks if b.epoch_id == "e00"))
    lenses = {
        "left": [1064.46, 1066.5, 0, 314.38, 239.06, -0.2197, 0.1507, 0.0003, 0.0006, 0, 0, 0, 0],
        "right": [1064.48, 1066.5, 0, 324.59, 239.94, -0.2196, 0.15, -0.0003, -0.0006, 0, 0, 0, 0],
    }
    cameras = tuple(
        replace(c, lens=replace(c.lens, free=(), values=np.array(lenses[c.camera_id]))) for c in survey.cameras
    )
    same, notes = consistent_turns(replace(one, cameras=cameras), upside_down.target_kinds)
    assert [b.point_idx.tolist() for b in same.image_blocks] == [b.point_idx.tolist() for b in one.image_blocks]
    assert len(notes) == 1
    assert "camera 'right', target 'board'" in notes[0]
    assert "either way" in notes[0]


def test_a_camera_carried_round_a_board_that_stands_still_is_told_once(upside_down):
    survey = upside_down.survey
    blocks = tuple(b for b in survey.image_blocks if b.camera_id == "left")
    parameter = replace(survey.stations[0].world_from_station, treatment="free", value=None)
    carried = replace(
        survey,
        cameras=tuple(c for c in survey.cameras if c.camera_id == "left"),
        stations=(replace(survey.stations[0], motion="epoch", world_from_station=parameter),),
        targets=(replace(survey.targets[0], motion="fixed", carrier_from_target=HELD),),
        image_blocks=blocks,
    )
    same, notes = consistent_turns(carried, upside_down.target_kinds)
    assert same is carried
    assert len(notes) == 1
    assert "target 'board'" in notes[0]
    assert "bar at e00" in notes[0]
    assert "12 more" in notes[0]


def test_boards_that_show_which_way_round_they_are_cost_nothing(upside_down):
    kinds = {"board": Checkerboard(8, 5, 0.02)}
    assert consistent_turns(upside_down.survey, kinds) == (upside_down.survey, ())
