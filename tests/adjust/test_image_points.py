"""The image points of a survey as one table, whose blocks are cut out of it or put together."""

import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adjust.adjustment import with_used
from adjust.model.observations import ImageBlocks, ImagePoints
from survey.project import read
from survey.project.writing import write_project
from survey.simulate import head_on_table
from tests.adjust import helpers as h


def test_blocks_that_are_read_are_cut_out_of_one_table(tmp_path: Path) -> None:
    survey, _ = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    write_project(tmp_path / "lab", survey)
    blocks = read(tmp_path / "lab").survey.image_blocks
    assert isinstance(blocks, ImageBlocks)
    together = ImagePoints.of(tuple(blocks))
    for name in ("ptr", "point_idx", "uv", "cov", "used"):
        np.testing.assert_array_equal(getattr(blocks.points, name), getattr(together, name))
    assert all(np.shares_memory(b.uv, blocks.points.uv) for b in blocks)
    sent = pickle.loads(pickle.dumps(blocks))
    np.testing.assert_array_equal(sent.points.uv, blocks.points.uv)
    np.testing.assert_array_equal(sent[-1].uv, blocks[-1].uv)


def test_points_out_of_use_change_their_blocks_alone() -> None:
    survey, _ = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    used = survey.image_points.used.copy()
    assert with_used(survey, used) is survey
    used[survey.image_points.ptr[1] + 2] = False
    less = with_used(survey, used)
    assert [b.used is None for b in less.image_blocks] == [i != 1 for i in range(len(less.image_blocks))]
    np.testing.assert_array_equal(ImagePoints.of(tuple(less.image_blocks)).used, used)
    np.testing.assert_array_equal(less.image_points.used, used)
    again = with_used(less, survey.image_points.used)
    assert again.image_points.used.all()
    assert again.image_blocks[1].mask.all()


def test_a_point_that_its_target_does_not_have() -> None:
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    first = survey.image_blocks[0]
    n = len(survey.targets_by_id[str(first.target_id)].point_ids)
    for wrong in (-1, n):
        block = replace(first, point_idx=np.append(first.point_idx[:-1], wrong))
        with pytest.raises(IndexError, match="points that its target does not have"):
            h.build(replace(survey, image_blocks=(block, *survey.image_blocks[1:])), h.start_at(truth))
