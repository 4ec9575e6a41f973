"""One camera whose images contradict all others before a table: it is named, not the boards that it sees."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.diagnosis.case import Case
from adjust.diagnosis.diagnosis import diagnose
from adjust.diagnosis.table.misread import misread_tables
from adjust.model.survey import Survey
from survey.simulate import head_on_table
from tests.adjust.planted import case_of

pytestmark = pytest.mark.slow


def mirrored(survey: Survey, camera_id: str) -> Survey:
    """Its images mirrored left to right."""
    width = next(c.image_size[0] for c in survey.cameras if c.camera_id == camera_id)
    blocks = tuple(
        replace(b, uv=np.stack([width - 1.0 - b.uv[:, 0], b.uv[:, 1]], axis=1)) if b.camera_id == camera_id else b
        for b in survey.image_blocks
    )
    return replace(survey, image_blocks=blocks)


def test_a_mirrored_camera_is_named() -> None:
    survey, _ = head_on_table(2, n_cameras=3, n_table_epochs=8, n_free_epochs=2)
    assert list(misread_tables(Case(survey))) == []
    wrong = survey.cameras[1].camera_id
    first = diagnose(case_of(mirrored(survey, wrong))).candidates[0].hypothesis
    assert (first.name, first.place.ids) == ("images mirrored", (wrong,))
