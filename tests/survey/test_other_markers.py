"""Markers that are not found as declared: the images say in which dictionary, print or mirror image they are."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from survey.detection.markers import other_markers
from survey.jobs.detecting.job import detect_job
from survey.project.targets import Charuco, MarkerGrid
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render

CAMERA = BrownCamera((640, 480), 800.0, 800.0, 319.5, 239.5, (-0.05, 0.01, 0.0, 0.0))
BOARD = Charuco(7, 6, 0.03, 0.022, "4X4_50")
GRID = MarkerGrid(4, 3, 0.04, 0.01, "5X5_100")
PROJECT = """
format = 1
[cameras.c]
station = "tripod"
image_size_px = [640, 480]
lens = { model = "brown", free = ["fx", "fy", "u0", "v0"] }
[stations.tripod]
world_from_station = { treatment = "held" }
[targets.board]
kind = "charuco"
squares_x = 7
squares_y = 6
square_mm = 30
marker_mm = 22
dictionary = "DICTIONARY"
motion = "epoch"
"""


def image_of(target: Charuco | MarkerGrid) -> np.ndarray:
    R = Rot3.RzRyRx(0.2, -0.25, 0.1)
    middle = np.array([0.0, 0.0, 0.32]) - R.matrix() @ target.points()[1].mean(0)
    image = render(CAMERA, (PlacedTarget(target, Pose3(R, middle)),), imaging=Imaging(0.6, 2.0, 235.0), seed=1)
    return np.asarray(image)


def declared(target: Charuco | MarkerGrid, **other: object) -> Charuco | MarkerGrid:
    return type(target)(**{**vars(target), **other})


@pytest.mark.slow
@pytest.mark.parametrize("target", [BOARD, GRID], ids=["charuco", "grid"])
def test_other_dictionary_print_and_mirror_image_are_told(target: Charuco | MarkerGrid) -> None:
    image = image_of(target)
    wrong = declared(target, dictionary="6X6_250")
    found = other_markers(image, wrong)
    assert found is not None
    assert found.dictionary == target.dictionary.replace("_100", "_50")
    assert not found.inverted
    assert not found.mirrored
    for seen, inverted, mirrored in ((255 - image, True, False), (np.ascontiguousarray(image[:, ::-1]), False, True),
                                     (np.ascontiguousarray(255 - image[:, ::-1]), True, True)):  # fmt: skip
        found = other_markers(seen, target)
        assert found is not None
        assert (found.dictionary, found.inverted, found.mirrored) == (target.dictionary, inverted, mirrored)


@pytest.mark.slow
def test_an_old_pattern_is_told() -> None:
    found = other_markers(image_of(declared(BOARD, legacy=True)), BOARD)
    assert found is not None
    assert found.legacy is True


def test_nothing_is_read_out_of_noise() -> None:
    rng = np.random.default_rng(2)
    noise = cv2.GaussianBlur(rng.integers(0, 256, (480, 640)).astype(np.uint8), (0, 0), 2.0)
    assert other_markers(cv2.normalize(noise, None, 0, 255, cv2.NORM_MINMAX), BOARD) is None


@pytest.mark.slow
def test_the_command_says_what_to_write(tmp_path: Path) -> None:
    lab = tmp_path / "lab"
    (lab / "images" / "c").mkdir(parents=True)
    (lab / "survey.toml").write_text(PROJECT.replace("DICTIONARY", "6X6_250"))
    cv2.imwrite(str(lab / "images" / "c" / "e1.png"), image_of(BOARD))
    with pytest.raises(SurveyError, match=r'markers of 4X4_50; set dictionary = "4X4_50"'):
        detect_job(lab, progress=False)
    (lab / "survey.toml").write_text(PROJECT.replace("DICTIONARY", "4X4_50"))
    cv2.imwrite(str(lab / "images" / "c" / "e1.png"), 255 - image_of(BOARD))
    with pytest.raises(SurveyError, match="black and white exchanged"):
        detect_job(lab, progress=False)
