"""TUM's and KITTI's trajectories: by their own meaning, and back."""

import numpy as np
import pytest
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from survey.interop.trajectories import read_kitti, read_tum


def same_pose(a, b, tolerance=1e-12):
    """Two poses are one to rounding."""
    np.testing.assert_allclose(Pose3.Logmap(a.between(b)), 0.0, atol=tolerance)


@pytest.mark.parametrize("format", ["tum", "kitti"])
def test_a_moving_head_there_and_back(lab, there_and_back, tmp_path, format):
    _, values = lab
    back = there_and_back(format, "t.txt")
    rows = np.loadtxt(tmp_path / "t.txt")
    assert rows.shape == ((9, 8) if format == "tum" else (9, 12))
    for i, row in enumerate(rows):
        pose = values.world_from(FrameRef("station", "head", f"e{i:02d}"))
        if format == "tum":
            np.testing.assert_allclose(Rotation.from_quat(row[4:]).as_matrix(), pose.rotation().matrix(), atol=1e-14)
            np.testing.assert_array_equal(row[1:4], pose.translation())
        else:
            np.testing.assert_array_equal(row.reshape(3, 4), pose.matrix()[:3])
        name = f"e{i:02d}" if format == "tum" else f"{i:06d}"
        same_pose(back.world_from(FrameRef("station", "body", name)), pose)


def test_times_are_epochs(tmp_path):
    path = tmp_path / "t.txt"
    path.write_text("# a trajectory\n1305031102.1758 1 2 3 0 0 0 1\n1305031102.2111 1 2 4 0 0 -1 0\n", encoding="utf-8")
    epochs = read_tum(path).survey.stations[0].epochs
    assert list(epochs) == ["1305031102.1758", "1305031102.2111"]
    assert epochs["1305031102.2111"].value.z() == 4


@pytest.mark.parametrize(
    ("read", "text", "says"),
    [
        (read_tum, "1 2 3\n", "line 1: found 3 numbers"),
        (read_tum, "# x\n1 0 0 0 0 0 0 2\n", "line 2: the quaternion has the length 2"),
        (read_tum, "1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2: epoch '1' is there already"),
        (read_tum, "# epoch ../x\n1 0 0 0 0 0 0 1\n", "line 2: '../x' cannot be an id"),
        (read_kitti, "1 0 0 0 0 1 0 0 0 0 -1 0\n", "line 1: the matrix is no rigid motion"),
        (read_kitti, "\n", "holds no pose"),
    ],
)
def test_what_cannot_be_read_is_named_with_its_line(tmp_path, read, text, says):
    path = tmp_path / "t.txt"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(SurveyError, match=says):
        read(path)
