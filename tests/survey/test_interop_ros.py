"""ROS: camera_info with extrinsics, and ROS-Industrial's files."""

import numpy as np
import pytest
import yaml
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from survey.interop.cameras.formats import write_cameras
from survey.interop.cameras.ros import read_industrial, read_ros
from tests.survey.camera_lab import opencv_pixels, pixels, points_before, same_rig


def _tf(tf, x):
    """Points of the parent frame in the child frame, by tf's meaning of a transform."""
    t = np.array([tf["translation"][a] for a in "xyz"])
    R = Rotation.from_quat([tf["rotation"][a] for a in "xyzw"]).as_matrix()
    return (x - t) @ R


def test_camera_info_and_transforms_say_what_the_survey_says_and_come_back(lab, there_and_back, tmp_path):
    _, values = lab
    back = there_and_back("ros", "ros")
    same_rig(values, back, {"left": "left", "right": "right"})
    info = yaml.safe_load((tmp_path / "ros/right.yaml").read_text(encoding="utf-8"))
    assert info["distortion_model"] == "plumb_bob"
    assert info["camera_matrix"]["rows"] == 3
    assert len(info["projection_matrix"]["data"]) == 12
    assert info["image_width"] == 1280
    transforms = yaml.safe_load((tmp_path / "ros/extrinsics.yaml").read_text(encoding="utf-8"))["transforms"]
    right = next(t for t in transforms if t["child_frame_id"] == "right_optical_frame")
    assert right["header"]["frame_id"] == "head"
    camera = values.survey.cameras[1]
    x = points_before(values, camera)
    q = _tf(right["transform"], x)
    fx, _, u0, _, fy, v0, *_ = info["camera_matrix"]["data"]
    k = dict(zip(("k1", "k2", "p1", "p2", "k3"), info["distortion_coefficients"]["data"], strict=True))
    uv = opencv_pixels(dict(fx=fx, fy=fy, u0=u0, v0=v0, **k), Pose3(), q)
    np.testing.assert_allclose(uv, pixels(values, camera, x), rtol=0, atol=1e-9)


_INFO = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [438.783, 0, 305.594, 0, 437.303, 243.738, 0, 0, 1]
distortion_model: {}
distortion_coefficients:
  rows: 1
  cols: {}
  data: [{}]
"""


def test_files_of_calibrators_are_read(tmp_path):
    path = tmp_path / "ost.yaml"
    path.write_text(_INFO.format("rational_polynomial", 8, "1e-1, 2e-1, 1e-3, 0, 0, 0.1, 0.2, 0.3"), encoding="utf-8")
    camera = read_ros(path).survey.cameras[0]
    assert camera.camera_id == "narrow_stereo"
    assert camera.lens.values[5:].tolist() == [
        0.1, 0.2, 0.001, 0, 0, 0.1, 0.2, 0.3
    ]
    path.write_text(_INFO.format("equidistant", 4, "1e-1, 2e-1, 1e-3, 0"), encoding="utf-8")
    assert read_ros(path).survey.cameras[0].lens.model == "fisheye"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (_INFO.format("fov", 1, "1.0"), "line 8: distortion_model: found 'fov'"),
        (_INFO.format("plumb_bob", 3, "1, 2, 3"), "line 9: distortion_coefficients: found 3 coefficients"),
        (_INFO.format("plumb_bob", 5, "1, 2, 3, 4"), "found 4 numbers, rows and cols say 1 x 5"),
        (_INFO.replace("640", "-3"), "line 1: image_width: found -3"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_line(tmp_path, text, says):
    path = tmp_path / "x.yaml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyError, match=says):
        read_ros(path)


def test_industrial_files_come_back_and_mean_the_pose_of_the_camera(lab, tmp_path):
    _, values = lab
    write_cameras(values, tmp_path / "ri", "ros-industrial", None)
    found = read_industrial(tmp_path / "ri/right.yaml").survey.cameras[0]
    own = values.survey.cameras[1]
    np.testing.assert_array_equal(found.lens.values, values.lens(own))
    pose = values.station_from_camera(own)
    np.testing.assert_allclose(found.station_from_camera.value.matrix(), pose.matrix(), atol=1e-14)
    # Eigen's isometry camera_mount_to_camera takes the camera's coordinates to the mount's: its origin is x y z
    plain = yaml.safe_load((tmp_path / "ri/right.yaml").read_text(encoding="utf-8"))["camera_mount_to_camera"]
    np.testing.assert_array_equal([plain[a] for a in "xyz"], pose.translation())


def test_the_older_list_of_cameras(tmp_path):
    path = tmp_path / "cameras.yaml"
    keys = {"angle_axis_ax": 0.0, "angle_axis_ay": 0.0, "angle_axis_az": 0.5, "position_x": 0.1, "position_y": 0.2,
            "position_z": 1.5, "focal_length_x": 525, "focal_length_y": 526, "center_x": 320, "center_y": 240,
            "distortion_k1": 0.01, "distortion_k2": 0.02, "distortion_k3": 0.03, "distortion_p1": 0.04,
            "distortion_p2": 0.05}  # fmt: skip
    own = "".join(f"    {k}: {v}\n" for k, v in keys.items())
    path.write_text(f"---\nstatic_cameras:\n -\n    camera_name: Asus1\n{own}", encoding="utf-8")
    network = read_industrial(path)
    camera = network.survey.cameras[0]
    assert camera.camera_id == "Asus1"
    assert camera.lens.values.tolist() == [525, 526, 0, 320, 240, 0.01, 0.02, 0.04, 0.05, 0.03, 0, 0, 0]
    inverse = camera.station_from_camera.value.inverse()
    np.testing.assert_allclose(inverse.translation(), [0.1, 0.2, 1.5], atol=1e-15)
    np.testing.assert_allclose(inverse.rotation().matrix(), Rotation.from_rotvec([0, 0, 0.5]).as_matrix())


def test_files_of_industrial_cameras_come_back_from_their_folder(lab, there_and_back, tmp_path):
    _, values = lab
    same_rig(values, there_and_back("ros-industrial", "ros-industrial"), {"left": "left", "right": "right"})


@pytest.mark.parametrize("read", [read_ros, read_industrial])
def test_a_folder_of_very_many_cameras_is_refused_and_not_cut(read, tmp_path, monkeypatch):
    for n in range(3):
        text = _INFO.format("plumb_bob", 5, "0, 0, 0, 0, 0").replace("narrow_stereo", f"c{n}")
        (tmp_path / f"c{n}.yaml").write_text(text, encoding="utf-8")
    monkeypatch.setattr("survey.interop.cameras.rig.MOST_FILES", 2)
    with pytest.raises(SurveyError, match=r"holds 3 \.yaml files; one per camera is expected, 2 at most"):
        read(tmp_path)
