"""A project begun with nothing but images."""

import shutil

import cv2
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.jobs.starting import start_project
from survey.project import read
from tests import labs

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def images(tmp_path_factory):
    """Images of a stereo head before a checkerboard of 9 x 6 inner corners."""
    place = tmp_path_factory.mktemp("images")
    labs.example("stereo", place / "lab")
    for path in sorted((place / "lab/images").glob("*/*")):
        if path.stem > "e03":
            path.unlink()
    return place / "lab/images"


def test_cameras_sizes_and_board_are_read_out_of_the_images(images, tmp_path, capsys):
    assert main(["init", str(images), str(tmp_path / "new")]) == 0
    said = capsys.readouterr().out
    assert "camera left: 3 images of 1280 x 1024 px" in said
    assert "checkerboard of 9 x 6 inner corners in 6 of 6" in said
    project = read(tmp_path / "new")
    assert project.images.keys() == read(images.parent).images.keys()
    assert [c.image_size for c in project.survey.cameras] == [(1280, 1024)] * 2
    assert project.target_kinds["board"].columns == 9
    assert main(["adjust", str(tmp_path / "new"), "--quiet"]) == 0, "and it is adjusted as it is"
    text = (tmp_path / "new/survey.toml").read_text()
    with pytest.raises(SurveyError, match="there is a project already"):
        start_project(images, tmp_path / "new")
    assert (tmp_path / "new/survey.toml").read_text() == text


def test_images_that_lie_in_the_project_already_stay(images, tmp_path):
    shutil.copytree(images, tmp_path / "lab/images", ignore=shutil.ignore_patterns("e02*", "e03*"))
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "lab/images").glob("*/*")}
    assert start_project(tmp_path / "lab/images", tmp_path / "lab").board == (9, 6)
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "lab/images").glob("*/*")} == before
    assert read(tmp_path / "lab").images.keys() == {key for key in read(images.parent).images if "e01" in key}
    shutil.copytree(images / "left", tmp_path / "flat/images")
    with pytest.raises(SurveyError, match="in a folder of their camera"):
        start_project(tmp_path / "flat/images", tmp_path / "flat")
    assert not (tmp_path / "flat/survey.toml").exists()


def test_one_folder_is_one_camera_and_a_name_may_be_anything(images, tmp_path):
    place = tmp_path / 'my "camera" 1'
    shutil.copytree(images / "left", place, ignore=shutil.ignore_patterns("e02*", "e03*"))
    with pytest.raises(SurveyError, match="its name is that of the camera"):
        start_project(place, tmp_path / "no")
    assert not (tmp_path / "no").exists()
    outcome = start_project(place.rename(tmp_path / "camera-1"), tmp_path / "yes")
    assert list(outcome.cameras.values()) == [(1, (1280, 1024))]
    assert outcome.summary()["board"] == [9, 6]


def test_markers_are_no_checkerboard(tmp_path):
    (tmp_path / "m").mkdir()
    board = cv2.aruco.CharucoBoard((8, 6), 0.04, 0.03, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    for k in range(2):
        cv2.imwrite(str(tmp_path / f"m/e{k}.png"), board.generateImage((1000, 760), marginSize=60))
    outcome = start_project(tmp_path / "m", tmp_path / "lab")
    assert (outcome.board, outcome.n_with_markers) == (None, 2)
    assert "2 show markers" in outcome.text()
    assert "# (!) no checkerboard was recognised" in (tmp_path / "lab/survey.toml").read_text()


@pytest.mark.parametrize("fault", ["size", "nothing", "missing"])
def test_what_cannot_be_begun_is_named_and_nothing_is_written(tmp_path, fault):
    place = tmp_path / "c"
    if fault != "missing":
        place.mkdir()
    if fault == "size":
        for k, width in enumerate((640, 641)):
            cv2.imwrite(str(place / f"e{k}.png"), np.zeros((480, width), np.uint8))
    words = {"size": "images of one camera have one size", "nothing": "no images", "missing": "no such folder"}[fault]
    with pytest.raises(SurveyError, match=words):
        start_project(place, tmp_path / "lab")
    assert not (tmp_path / "lab").exists()
