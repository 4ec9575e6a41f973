"""transforms.json: OpenGL's camera and a half pixel, by plain lines, and back."""

import json

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from survey.interop.cameras.nerf import read_nerf
from tests.survey.camera_lab import BEACONS, opencv_pixels
from tests.survey.test_interop_trajectories import same_pose


def test_a_camera_that_looks_along_minus_z_sees_what_ours_sees(lab, there_and_back, tmp_path):
    _, values = lab
    back = there_and_back("nerf", "transforms.json")
    frames = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))["frames"]
    assert len(frames) == 18
    for frame in frames[::5]:
        _, camera_id, name = frame["file_path"].split("/")
        camera = next(c for c in values.survey.cameras if c.camera_id == camera_id)
        M = np.linalg.inv(np.array(frame["transform_matrix"]))
        q = BEACONS @ M[:3, :3].T + M[:3, 3]
        assert (q[:, 2] < 0).all()
        x, y = q[:, 0] / -q[:, 2], q[:, 1] / q[:, 2]
        r2 = x * x + y * y
        k1, k2, p1, p2 = (frame[k] for k in ("k1", "k2", "p1", "p2"))
        radial = 1 + r2 * (k1 + r2 * k2)
        u = frame["fl_x"] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + frame["cx"] - 0.5
        v = frame["fl_y"] * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + frame["cy"] - 0.5
        pose = values.world_from(FrameRef("camera", camera_id, name.removesuffix(".png")))
        lens = dict(zip(("fx", "fy", "skew", "u0", "v0", "k1", "k2", "p1", "p2"), values.lens(camera), strict=False))
        np.testing.assert_allclose(np.column_stack([u, v]), opencv_pixels(lens, pose.inverse(), BEACONS), atol=1e-9)
    for camera in values.survey.cameras:
        other = next(c for c in back.survey.cameras if c.camera_id == camera.camera_id)
        np.testing.assert_allclose(back.lens(other), values.lens(camera), rtol=0, atol=1e-12)
        ours, theirs = (v.world_from(FrameRef("camera", camera.camera_id, "e03")) for v in (values, back))
        same_pose(ours, theirs)


_FILE = {"fl_x": 500, "cx": 320, "cy": 240, "w": 640, "h": 480,
         "frames": [{"file_path": "images/a.png", "transform_matrix": np.eye(4).tolist()}]}  # fmt: skip


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"camera_model": "EQUIRECTANGULAR"}, "found 'EQUIRECTANGULAR'"),
        ({"k4": 0.1}, "fourth radial term"),
        ({"applied_scale": 2}, "scaled poses"),
        ({"w": 0}, "whole number"),
        ({"frames": []}, "no image"),
        ({"frames": [{"file_path": "../../..", "transform_matrix": []}]}, "cannot be an id"),
        ({"frames": [*_FILE["frames"], *_FILE["frames"]]}, "there twice"),
    ],
)
def test_what_cannot_be_read_is_named(tmp_path, change, says):
    path = tmp_path / "t.json"
    path.write_text(json.dumps(_FILE | change), encoding="utf-8")
    with pytest.raises(SurveyError, match=says) as found:
        read_nerf(path)
    assert "t.json, line" in str(found.value)


def test_an_applied_transform_is_undone(tmp_path):
    path = tmp_path / "t.json"
    turn = [[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]]
    stored = np.vstack([turn, [0, 0, 0, 1]]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    frame = {"file_path": "images/a.png", "transform_matrix": stored.tolist()}
    path.write_text(json.dumps(_FILE | {"applied_transform": turn, "frames": [frame]}), encoding="utf-8")
    station = read_nerf(path).survey.stations[0]
    # what was the world's own camera, stored turned and in OpenGL's axes
    np.testing.assert_allclose(station.epochs["a"].value.matrix(), np.eye(4), atol=1e-12)
