import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from survey.detection import DetectionTask, SpotOptions, detect_images
from survey.project.targets import Charuco, Checkerboard, MarkerGrid
from survey.simulate.rendering import Beacons, BrownCamera, Imaging, PlacedTarget, render

pytestmark = pytest.mark.slow

CAMERA = BrownCamera((480, 360), 600.0, 600.0, 239.5, 179.5)
BOARD = Checkerboard(6, 5, 0.02)
TAGS = MarkerGrid(2, 2, 0.03, 0.01, "4X4_50")


def tasks_in(folder):
    view = PlacedTarget(BOARD, Pose3(Rot3.Rz(0.2), np.array([-0.05, -0.04, 0.35])))
    leds = Beacons(np.array([[0.0, 0.0, 1.0], [0.1, 0.1, 1.0]]), 0.006)
    images = {
        "e1": render(CAMERA, [view]),
        "e2": render(CAMERA, beacons=leds, imaging=Imaging(background_gray=20.0)),
        "e3": render(CAMERA),
    }
    for name, image in images.items():
        cv2.imwrite(str(folder / f"{name}.png"), image)
    (folder / "e4.png").write_text("this is no image")
    (folder / "e5.png").write_bytes(b"")
    targets = {"board": BOARD, "tags": TAGS}
    return [
        DetectionTask(folder / f"e{k}.png", "X", f"e{k}", targets, SpotOptions() if k == 2 else None)
        for k in range(1, 7)
    ]


def check(reports, folder):
    assert [r.epoch_id for r in reports] == ["e1", "e2", "e3", "e4", "e5", "e6"]
    assert [r.status for r in reports] == ["found", "found", "nothing", "failed", "failed", "failed"]
    assert len(reports[0].detections["board"]) == 30
    assert reports[0].message == "tags: none of the 4 markers (4X4_50) was found"
    assert reports[0].image_size == (480, 360)
    assert reports[0].spots is None
    assert len(reports[1].spots) == 2
    for report, words in zip(reports[3:], ("not an image", "0 bytes", "no such file"), strict=True):
        assert str(report.path) in report.message
        assert words in report.message
    assert sorted(p.name for p in folder.iterdir()) == ["X_e1.png", "X_e2.png", "X_e3.png"]
    picture = cv2.imread(str(folder / "X_e1.png"))
    assert picture.shape == (720, 960, 3)
    u, v = np.rint((reports[0].detections["board"].uv[0] + 0.5) * 2 - 0.5).astype(int)
    around = picture[v - 8 : v + 9, u - 8 : u + 9].astype(int)
    assert (around.max(2) - around.min(2)).max() > 100  # a coloured ring on a grey image


def test_one_bad_image_does_not_stop_the_others(tmp_path, capsys):
    (tmp_path / "images").mkdir()
    tasks = tasks_in(tmp_path / "images")
    check(detect_images(tasks, jobs=1, progress=False, pictures=tmp_path / "seen"), tmp_path / "seen")
    assert capsys.readouterr().err == ""
    detect_images(tasks[:1], jobs=1)
    assert "detect" in capsys.readouterr().err


def test_several_processes_give_the_same_reports_in_the_same_order(tmp_path):
    (tmp_path / "images").mkdir()
    tasks = tasks_in(tmp_path / "images")
    reports = detect_images(tasks, jobs=2, progress=False, pictures=tmp_path / "seen")
    check(reports, tmp_path / "seen")
    alone = detect_images(tasks[:1], jobs=1, progress=False)
    assert np.array_equal(alone[0].detections["board"].uv, reports[0].detections["board"].uv)


def test_a_board_beside_its_charuco_twin_and_beacons_beside_both_are_told_apart(tmp_path):
    camera = BrownCamera((1280, 1024), 1600.0, 1600.0, 639.5, 511.5, (-0.2, 0.05))
    targets = {"board": Checkerboard(8, 5, 0.02), "charuco": Charuco(9, 6, 0.02, 0.015, "4X4_50")}
    poses = (
        Pose3(Rot3.Rx(0.3), np.array([-0.27, -0.16, 0.75])),
        Pose3(Rot3.Rz(0.1), np.array([0.08, -0.15, 0.75])),
    )
    views = [PlacedTarget(t, pose) for t, pose in zip(targets.values(), poses, strict=True)]
    leds = np.array([[0.15, 0.15, 0.8], [0.2, 0.2, 0.8]])
    cv2.imwrite(str(tmp_path / "e.png"), render(camera, views, Beacons(leds, 0.003, 400.0)))
    task = DetectionTask(tmp_path / "e.png", "X", "e", targets, SpotOptions())
    report = detect_images([task], progress=False)[0]
    for view, detection in zip(views, report.detections.values(), strict=True):
        x = view.camera_from_target.transformFrom(np.ascontiguousarray(view.target.points()[1].T)).T
        assert len(detection) == 40
        assert np.abs(detection.uv - camera.project(x)).max() < 0.05
    assert len(report.spots) == 2
    assert np.linalg.norm(report.spots.uv[:, None] - camera.project(leds)[None], axis=2).min(1).max() < 0.05
