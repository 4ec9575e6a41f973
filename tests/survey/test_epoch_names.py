"""Images of one moment that have different names: the first thing that goes wrong with one's own images."""

from dataclasses import replace

import pytest

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from survey.jobs.adjusting.probable_causes import explained, separate_epochs
from survey.project import read, write_project
from survey.simulate import stereo


@pytest.fixture(scope="module")
def rig():
    return stereo(seed=1)[0]


def renamed(survey):
    """Images called after their camera, as cameras' software likes to do."""
    blocks = tuple(replace(b, epoch_id=f"{b.camera_id}{b.epoch_id}") for b in survey.image_blocks)
    return replace(survey, image_blocks=blocks)


def test_nothing_is_said_of_a_rig_whose_images_belong_together(rig):
    assert separate_epochs(rig) == ()


def test_the_error_names_the_cameras_and_what_to_do(rig, tmp_path):
    wrong = renamed(rig)
    write_project(tmp_path / "lab", wrong)
    with pytest.raises(SurveyError) as raised:
        adjust(wrong)
    said = str(explained(wrong, raised.value, read(tmp_path / "lab")))
    assert "share no epoch" in said
    assert "give images of one moment the same name" in said
    assert said.index("share no epoch") < said.index("undetermined")
