"""The example folders: complete, readable, reproducible, and showing what their truth says."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.cli import main
from survey.examples import write_example
from survey.examples.folders import MAKERS
from survey.examples.pictures import picture
from survey.project import read
from survey.simulate.draft import Shot


@pytest.fixture(scope="module")
def one_camera(tmp_path_factory):
    folder = tmp_path_factory.mktemp("examples") / "one"
    assert main(["example", "one-camera", str(folder), "--quiet"]) == 0
    return folder


@pytest.fixture(scope="module")
def full_lab():
    """Draft and files; its 121 images are not written here."""
    return MAKERS["full-lab"](1)


def test_the_command_tells_what_it_wrote_and_what_comes_next(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("survey.examples.pictures.write_images", lambda *_: None)
    assert main(["example", "stereo", str(tmp_path / "s")]) == 0
    assert capsys.readouterr().out.endswith(f"Next: labsurvey adjust {tmp_path / 's'}\n")
    assert main(["--json", "example", "stereo", str(tmp_path / "t")]) == 0
    assert json.loads(capsys.readouterr().out)["images"] == 24


def test_one_camera_is_read_with_all_its_images(one_camera):
    project = read(one_camera)
    assert len(project.images) == 12
    assert {camera for camera, _ in project.images} == {"C1"}
    for path in project.images.values():
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert image.shape == (1024, 1280)
        assert image.dtype == np.uint8


def test_boards_are_where_the_truth_says(one_camera):
    draft, _ = MAKERS["one-camera"](1)
    scene = draft.scene()
    for epoch in ("e01", "e05", "e12"):
        image = cv2.imread(str(one_camera / "images" / "C1" / f"{epoch}.png"), cv2.IMREAD_GRAYSCALE)
        found, corners = cv2.findChessboardCornersSB(image, (9, 6), flags=cv2.CALIB_CB_ACCURACY)
        assert found
        true = scene.project("C1", epoch, scene.target_points("board", epoch))
        nearest = np.linalg.norm(corners.reshape(-1, 1, 2) - true, axis=2).min(axis=1)
        # OpenCV's corners are good to some hundredths; a displaced pixel origin would show as 0.5
        assert nearest.max() < 0.2


@pytest.mark.parametrize("name", MAKERS)
def test_every_camera_and_image_of_an_example_is_defined(name, tmp_path):
    draft, files = MAKERS[name](1)
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    survey = read(tmp_path).survey
    assert [c.camera_id for c in survey.cameras] == [c.camera_id for c in draft.cameras]
    assert {shot.camera_id for shot in draft.shots} == {c.camera_id for c in survey.cameras}
    for ours, theirs in zip(draft.targets, survey.targets, strict=True):
        assert (ours.target_id, ours.point_ids, ours.motion) == (theirs.target_id, theirs.point_ids, theirs.motion)
        np.testing.assert_allclose(ours.x_in_target, theirs.x_in_target, atol=1e-12)
    assert {r.epoch_id for r in survey.table_readings} == set(draft.table_epochs)


def test_observations_of_the_full_lab_agree_with_its_truth(full_lab, tmp_path):
    draft, files = full_lab
    for path, text in files.items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    survey = read(tmp_path).survey
    scene = draft.scene()
    errors = [
        (r.angles - scene.vector("table_angles", "turntable", r.epoch_id)) / np.sqrt(np.diag(r.cov))
        for r in survey.table_readings
    ]
    assert 0.8 < np.sqrt(np.mean(np.square(errors))) < 1.2  # 90 readings: 1 +- 0.075
    for coordinates in survey.coordinates:
        true = np.array([scene.position(p) for p in coordinates.positions])
        sigmas = np.sqrt(np.diag(coordinates.cov)).reshape(-1, 3)
        assert np.abs((coordinates.values - true) / sigmas).max() < 4.5
    for distance in survey.distances:
        true = np.linalg.norm(scene.position(distance.a) - scene.position(distance.b))
        assert abs(distance.value - true) < 4.5 * distance.sigma
    rough = [p.x_in_world for p in survey.points if p.x_in_world.value is not None]
    assert len(rough) == 2
    assert all(p.treatment == "free" for p in rough)


def test_plates_and_beacons_of_the_full_lab_are_visible(full_lab):
    draft, _ = full_lab
    scene = draft.scene()
    wall = next(shot for shot in draft.shots if shot.epoch_id == "r01")
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    _, ids, _ = detector.detectMarkers(picture(draft, scene, wall, seed=1))
    assert len(ids) == 12
    night: Shot = next(shot for shot in draft.shots if shot.beacons)
    image = picture(draft, scene, night, seed=1)
    uv = scene.project(night.camera_id, night.epoch_id, scene.world_points())
    seen = uv[scene.inside(night.camera_id, uv, 5.0)]
    assert len(seen) >= 1
    for u, v in np.rint(seen).astype(int):
        assert image[v - 1 : v + 2, u - 1 : u + 2].max() > 100
    assert np.median(image) < 20


def test_equal_seeds_write_equal_images_and_others_do_not(one_camera, tmp_path):
    write_example("one-camera", tmp_path / "again", jobs=1)
    for path in sorted(one_camera.rglob("*.*")):
        again = tmp_path / "again" / path.relative_to(one_camera)
        assert path.read_bytes() == again.read_bytes()
    assert MAKERS["one-camera"](1)[1] != MAKERS["one-camera"](2)[1]


def test_a_folder_in_use_is_left_alone(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(SurveyError, match="not empty"):
        write_example("one-camera", tmp_path)
    assert os.listdir(tmp_path) == ["notes.txt"]


def test_an_interrupted_example_leaves_nothing(tmp_path, monkeypatch):
    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("survey.examples.pictures.write_images", stop)
    with pytest.raises(KeyboardInterrupt):
        write_example("stereo", tmp_path / "x")
    assert os.listdir(tmp_path) == []


def test_no_command_needs_the_truth(one_camera, tmp_path):
    copy = tmp_path / "copy"
    shutil.copytree(one_camera, copy)
    (copy / "truth.json").unlink()
    assert read(copy).inputs == read(one_camera).inputs
