"""Kalibr's camchain and targets: its own equations in plain lines, and back."""

import numpy as np
import pytest
import yaml

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.interop.cameras.formats import write_cameras
from survey.interop.cameras.kalibr import read_kalibr, target_text
from survey.project import read
from survey.project.targets import Checkerboard, MarkerBlock, MarkerGrid, PointList
from tests.survey.camera_lab import BOARD, pixels, points_before, same_rig


def _radtan(camera, q):
    """Kalibr's pinhole-radtan (aslam_cv: PinholeProjection, RadialTangentialDistortion)."""
    x, y = (q[:, :2] / q[:, 2:]).T
    k1, k2, p1, p2 = camera["distortion_coeffs"]
    r2 = x * x + y * y
    radial = k1 * r2 + k2 * r2 * r2
    u = x + x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y + y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)
    fu, fv, pu, pv = camera["intrinsics"]
    return np.column_stack([fu * u + pu, fv * v + pv])


def test_the_chain_says_what_the_survey_says_and_comes_back(lab, there_and_back, tmp_path):
    _, values = lab
    back = there_and_back("kalibr", "chain.yaml")
    same_rig(values, back, {"left": "cam0", "right": "cam1"})
    chain = yaml.safe_load((tmp_path / "chain.yaml").read_text(encoding="utf-8"))
    left, right = values.survey.cameras
    x = points_before(values, right)
    q0 = np.array([values.station_from_camera(left).transformTo(p) for p in x])
    T = np.array(chain["cam1"]["T_cn_cnm1"])
    q1 = q0 @ T[:3, :3].T + T[:3, 3]
    np.testing.assert_allclose(_radtan(chain["cam1"], q1), pixels(values, right, x), rtol=0, atol=1e-9)
    assert chain["cam1"]["resolution"] == [1280, 960]
    assert chain["cam1"]["rostopic"] == "/right/image_raw"


def test_a_chain_over_the_imu(tmp_path):
    path = tmp_path / "c.yaml"
    own = "  camera_model: pinhole\n  intrinsics: [400, 401, 320, 240]\n  distortion_model: equidistant\n"
    own += "  distortion_coeffs: [1e-2, 0, 0, 1e-5]\n  resolution: [640, 480]\n"
    imu = "  T_cam_imu:\n  - [1, 0, 0, {}]\n  - [0, 1, 0, 0]\n  - [0, 0, 1, 0]\n  - [0, 0, 0, 1]\n"
    path.write_text(f"cam0:\n{own}{imu.format(0.1)}cam1:\n{own}{imu.format(-0.2)}", encoding="utf-8")
    cameras = read_kalibr(path).survey.cameras
    assert [c.lens.model for c in cameras] == ["fisheye", "fisheye"]
    np.testing.assert_allclose([c.station_from_camera.value.x() for c in cameras], [-0.1, 0.2])
    assert cameras[0].lens.values[5:].tolist() == [1e-2, 0, 0, 1e-5]  # PyYAML takes 1e-2 for text


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("camera_model: pinhole", "camera_model: omni", "only pinhole"),
        ("distortion_model: radtan", "distortion_model: fov", "fov has no such lens"),
        ("resolution: [1280, 960]", "resolution: [1280]", "width and height"),
        ("T_cn_cnm1", "T_x", "neither T_cn_cnm1 nor T_cam_imu"),
        ("- [0.0, 0.0, 0.0, 1.0]", "- [0.0, 0.0, 0.5, 1.0]", "no rigid motion"),
    ],
)
def test_what_cannot_be_read_is_named(lab, tmp_path, old, new, says):
    path = tmp_path / "c.yaml"
    write_cameras(lab[1], path, "kalibr", None)
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(SurveyError, match=says) as found:
        read_kalibr(path)
    assert "c.yaml, line" in str(found.value)


def test_the_ending_yaml_alone_is_ambiguous_and_the_error_says_between_what(lab, tmp_path, capsys):
    assert main(["convert", str(lab[0]), str(tmp_path / "x.yaml")]) == 1
    said = capsys.readouterr().err
    assert "--format" in said
    assert all(f in said for f in ("kalibr", "opencv", "ros", "mc-calib"))


@pytest.mark.slow
def test_targets_both_ways(lab, tmp_path):
    path = tmp_path / "target.yaml"
    assert main(["convert", str(lab[0]), str(path), "--format", "kalibr-target", "--quiet"]) == 0
    assert yaml.safe_load(path.read_text(encoding="utf-8")) == {
        "target_type": "checkerboard", "targetCols": 6, "targetRows": 5, "rowSpacingMeters": 0.08,
        "colSpacingMeters": 0.08,
    }  # fmt: skip
    assert main(["convert", str(path), str(tmp_path / "t"), "--format", "kalibr-target", "--quiet"]) == 0
    assert read(tmp_path / "t").target_kinds == {"target": BOARD}


def test_an_aprilgrid_counts_from_its_lower_left(tmp_path):
    path = tmp_path / "grid.yaml"
    text = "target_type: aprilgrid\ntagCols: 3\ntagRows: 2\ntagSize: 0.08\ntagSpacing: 0.25\n"
    path.write_text(text, encoding="utf-8")
    kind = read_kalibr(path).target_kinds["target"]
    assert isinstance(kind, MarkerBlock)
    assert sorted(kind.corners) == list(range(6))
    # tag 4: second row from below, second column; corner 0 is its upper left one, corner 3 its lower left one
    np.testing.assert_allclose(kind.corners[4], [[0.1, 0.18, 0], [0.18, 0.18, 0], [0.18, 0.1, 0], [0.1, 0.1, 0]])
    assert yaml.safe_load(target_text(kind)) == pytest.approx(
        {"target_type": "aprilgrid", "tagCols": 3, "tagRows": 2, "tagSize": 0.08, "tagSpacing": 0.25}
    )
    with pytest.raises(SurveyError, match="no target of Kalibr"):
        target_text(MarkerGrid(3, 2, 0.08, 0.02, "APRILTAG_36H11"))


def test_grids_of_circles_and_oblong_boards_are_lists_of_points(tmp_path):
    path = tmp_path / "t.yaml"
    path.write_text(
        "target_type: circlegrid\ntargetCols: 3\ntargetRows: 2\nspacingMeters: 0.02\nasymmetricGrid: 1\n",
        encoding="utf-8",
    )
    kind = read_kalibr(path).target_kinds["target"]
    assert isinstance(kind, PointList)
    # as cv2.findCirclesGrid's sample has them: (2 c + r mod 2, r) times the spacing
    np.testing.assert_allclose(kind.x_in_target[3:, :2], 0.02 * np.array([[1, 1], [3, 1], [5, 1]]))
    path.write_text(
        "target_type: checkerboard\ntargetCols: 3\ntargetRows: 2\nrowSpacingMeters: 0.02\ncolSpacingMeters: 0.03\n",
        encoding="utf-8",
    )
    kind = read_kalibr(path).target_kinds["target"]
    assert not isinstance(kind, Checkerboard)
    np.testing.assert_allclose(kind.points()[1][-1], [0.06, 0.02, 0])
