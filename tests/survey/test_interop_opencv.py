"""OpenCV's files: read by cv2.FileStorage, projected by cv2, and back."""

import cv2
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.interop.cameras.opencv_files import read_opencv
from tests.survey.camera_lab import pixels, points_before, same_rig


@pytest.mark.parametrize("name", ["rig.yaml", "rig.json"])
def test_opencv_reads_the_pair_and_projects_as_the_survey_does(lab, there_and_back, tmp_path, name):
    _, values = lab
    back = there_and_back("opencv", name)
    same_rig(values, back, {"left": "left", "right": "right"})
    storage = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_READ)
    left, right = values.survey.cameras
    x = points_before(values, right)
    in_left = np.array([values.station_from_camera(left).transformTo(p) for p in x])
    R, T = storage.getNode("R").mat(), storage.getNode("T").mat()
    uv = cv2.projectPoints(in_left, cv2.Rodrigues(R)[0], T, storage.getNode("M2").mat(), storage.getNode("D2").mat())[0]
    np.testing.assert_allclose(uv.reshape(-1, 2), pixels(values, right, x), rtol=0, atol=1e-9)
    assert storage.getNode("image_width1").real() == 1280


def test_a_file_that_opencv_wrote(tmp_path):
    path = tmp_path / "calibration.yml"
    K = np.array([[800.0, 0, 320.5], [0, 810.0, 240.25], [0, 0, 1]])
    k = np.array([[-0.2, 0.1, 1e-5, -2e-4, 0.03]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.writeComment("from the calibration sample")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("camera_matrix", K)
    storage.write("distortion_coefficients", k)
    storage.release()
    camera = read_opencv(path).survey.cameras[0]
    assert camera.image_size == (640, 480)
    assert camera.lens.values is not None
    np.testing.assert_array_equal(camera.lens.values, [800, 810, 0, 320.5, 240.25, *k[0], 0, 0, 0])
    assert camera.lens.free == ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3")


_HEAD = "%YAML:1.0\n---\nimage_width: 640\nimage_height: 480\n"
_K = "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ {} ]\n"
_D = "distortion_coefficients: !!opencv-matrix\n   rows: 1\n   cols: {}\n   dt: d\n   data: [ {} ]\n"
_GOOD_K = _K.format("800, 0, 320, 0, 800, 240, 0, 0, 1")


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        (_HEAD + _GOOD_K, 3, "'distortion_coefficients' is missing"),
        (_HEAD + _GOOD_K + _D.format(14, ", ".join(["0.1"] * 14)), 10, "thin prisms and tilted sensors"),
        (_HEAD + _K.format("800, 0, 320, 5, 800, 240, 0, 0, 1") + _D.format(4, "0, 0, 0, 0"), 10, "camera matrix must"),
        (_HEAD + _GOOD_K + _D.format(5, "0, 0, 0, 0"), 14, "found 4 numbers"),
        (_HEAD + _GOOD_K + _D.format(4, "0, 0, .nan, 0"), 14, "where a number is expected"),
        (_HEAD + "a: &x [1, 2]\nb: *x\n", 6, "alias"),
        (_HEAD + "a: !!python/object/apply:os.system ['true']\n", 5, "tag"),
        (_HEAD + "a: " + "[" * 100 + "]" * 100 + "\n", 5, "levels"),
        (_HEAD + "image_width: 3\n", 5, "there already"),
        ('{ "a": [1, 2', 2, "no YAML or JSON"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_line(tmp_path, text, line, says):
    path = tmp_path / "bad.yml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyError, match=says) as found:
        read_opencv(path)
    assert f"bad.yml, line {line}" in str(found.value)


def test_a_bomb_of_aliases_is_refused_at_once(tmp_path):
    path = tmp_path / "bomb.yaml"
    rows = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    rows += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, 12)]
    path.write_text("\n".join(rows), encoding="utf-8")
    with pytest.raises(SurveyError, match="alias"):
        read_opencv(path)
