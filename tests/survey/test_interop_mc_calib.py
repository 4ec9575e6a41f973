"""MC-Calib's result: read by cv2.FileStorage, and back."""

import cv2
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.interop.cameras.opencv_files import read_mc_calib
from tests.survey.camera_lab import pixels, points_before, same_rig


def test_opencv_reads_it_and_it_comes_back(lab, there_and_back, tmp_path):
    _, values = lab
    back = there_and_back("mc-calib", "calibrated_cameras_data.yml")
    same_rig(values, back, {"left": "camera_0", "right": "camera_1"})
    storage = cv2.FileStorage(str(tmp_path / "calibrated_cameras_data.yml"), cv2.FILE_STORAGE_READ)
    assert storage.getNode("nb_camera").real() == 2
    node = storage.getNode("camera_1")
    # the pose of camera 1 in the frame of camera 0
    pose = np.linalg.inv(node.getNode("camera_pose_matrix").mat())
    left, right = values.survey.cameras
    x = points_before(values, right)
    in_left = np.array([values.station_from_camera(left).transformTo(p) for p in x])
    K, k = node.getNode("camera_matrix").mat(), node.getNode("distortion_vector").mat()
    uv = cv2.projectPoints(in_left, cv2.Rodrigues(pose[:3, :3])[0], pose[:3, 3], K, k)[0].reshape(-1, 2)
    np.testing.assert_allclose(uv, pixels(values, right, x), rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("nb_camera: 2", "nb_camera: 3", "'camera_2' is missing"),
        ("nb_camera: 2", "nb_camera: 1000000000", "whole number from 1 to 1000"),
        ("distortion_type: 0", "distortion_type: 7", "found 7"),
        ("camera_group: 0", "camera_group: 1", "2 groups"),
        ("img_width: 1280", "img_width: x", "where a number is expected"),
    ],
)
def test_what_cannot_be_read_is_named(lab, there_and_back, tmp_path, old, new, says):
    there_and_back("mc-calib", "a.yml")
    text = (tmp_path / "a.yml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "a.yml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(SurveyError, match=says) as found:
        read_mc_calib(tmp_path / "a.yml")
    assert "a.yml, line" in str(found.value)
