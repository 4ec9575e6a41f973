"""The simulated laboratory: its images show what its truth says, through every way in which they are served."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from capture.devices.camera import Camera
from capture.devices.cameras import open_camera
from capture.session.quality import image_quality
from capture.session.trigger_set import TriggerSet
from capture.simulated.angles import AnglesFile, write_angles
from capture.simulated.folder import ANGLES, read_lab, write_lab
from capture.simulated.laboratory import CAMERA_IDS, LabPose, LabSize, SimulatedLab, make_lab
from survey.detection.batch import detect_image
from survey.detection.results import SpotOptions
from survey.detection.spots import detect_spots
from survey.project import read
from survey.simulate.parts import BOARD
from survey.simulate.scene import Scene
from tests.capture.camera_helpers import GIGE, gige_port
from tests.capture.gige_server import GigeServer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lab") / "lab"
    write_lab(folder, 3, LabSize(1, 1))
    return folder


@pytest.fixture(scope="module")
def lab(folder: Path) -> SimulatedLab:
    return read_lab(folder, noise_seed=5)


def projected(lab: SimulatedLab, pose: LabPose, camera_id: str, x_in_world: FloatArray) -> FloatArray:
    """By OpenCV."""
    truth = {**lab.truth, ("table_angles", "turntable", "e"): np.array([pose.axis1_rad, pose.axis2_rad])}
    return Scene(lab.draft.scene().survey, truth).project(camera_id, "e", x_in_world)


def test_the_board_is_where_the_truth_puts_it(lab: SimulatedLab) -> None:
    for pose in lab.poses[:3]:
        (camera_id,) = pose.camera_ids
        found = detect_image(lab.image(camera_id, (pose.axis1_rad, pose.axis2_rad)), BOARD)
        assert len(found) == 88
        world_from_board = np.eye(4)  # the board is the world
        expected = projected(lab, pose, camera_id, BOARD.points()[1] @ world_from_board[:3, :3])
        errors = found.uv - expected[found.point_idx]
        sigmas = np.sqrt(np.einsum("nii->ni", found.cov))
        assert np.sqrt(np.mean((errors / sigmas) ** 2)) == pytest.approx(1.0, abs=0.25)


def test_beacons_show_when_the_exposure_is_short(lab: SimulatedLab) -> None:
    pose = lab.poses[-1]
    x = lab.draft.scene().world_points()
    for camera_id in CAMERA_IDS:
        uv = projected(lab, pose, camera_id, x)
        image = lab.image(camera_id, (pose.axis1_rad, pose.axis2_rad), pose.exposure_us)
        spots = detect_spots(image, SpotOptions(diameter_px=(1.5, 12.0)))
        inside = uv[np.all((uv > 8.0) & (uv < (631.0, 503.0)), axis=1)]
        assert len(spots) >= len(inside)
        for place in inside:
            assert np.linalg.norm(spots.uv - place, axis=1).min() < 0.2


def test_light_grows_with_exposure_and_gain(lab: SimulatedLab) -> None:
    pose = lab.poses[0]
    angles, camera_id = (pose.axis1_rad, pose.axis2_rad), pose.camera_ids[0]
    means = [lab.image(camera_id, angles, *light).mean() for light in ((4000.0, 0.0), (8000.0, 0.0), (4000.0, 6.0206))]
    assert means[1] / means[0] == pytest.approx(2.0, rel=0.01)
    assert means[2] / means[0] == pytest.approx(2.0, rel=0.01)


def test_every_image_has_noise_of_its_own(lab: SimulatedLab) -> None:
    pose = lab.poses[0]
    a, b = (lab.image(pose.camera_ids[0], (pose.axis1_rad, pose.axis2_rad)).astype(float) for _ in range(2))
    assert np.std(a - b) == pytest.approx(np.sqrt(2.0) * 4.0, rel=0.05)


def test_the_folder_makes_the_same_laboratory_and_a_project_that_can_be_read(folder: Path, lab: SimulatedLab) -> None:
    again = make_lab(3, LabSize(1, 1))
    assert again.poses == lab.poses
    pose = lab.poses[0]
    arguments = (pose.camera_ids[0], (pose.axis1_rad, pose.axis2_rad))
    image = again.image(*arguments)
    np.testing.assert_array_equal(read_lab(folder, noise_seed=0).image(*arguments), image)
    assert not np.array_equal(read_lab(folder).image(*arguments), image)
    survey = read(folder).survey
    assert [c.camera_id for c in survey.cameras] == list(CAMERA_IDS)
    assert len(survey.points) == len(survey.coordinates) == 10


def test_angles_pass_through_the_file(tmp_path: Path) -> None:
    angles = AnglesFile(tmp_path / "a.json")
    with pytest.raises(SurveyError, match="start the simulated table first"):
        angles()
    write_angles(angles.path, 0.125, -1.5)
    assert angles() == (0.125, -1.5)
    assert [p.name for p in tmp_path.iterdir()] == ["a.json"]
    angles.path.write_text("{}")
    with pytest.raises(SurveyError, match="does not tell"):
        angles()


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("lab:{}/X?via=canon:1", "via 'canon' is not known"),
        ("lab:{}/X?vai=pylon:1", "option 'vai' is not known"),
        ("lab:{}/none/X", "no simulated laboratory"),
    ],
)
def test_places_that_mean_nothing(folder: Path, place: str, message: str) -> None:
    with pytest.raises(SurveyError, match=message):
        open_camera(place.format(folder))


@pytest.fixture(scope="module")
def served(folder: Path) -> Iterator[dict[str, Camera]]:
    """X by GigE Vision from another process, Y through pylon's emulator, Z in this process."""
    with ExitStack() as stack:
        stack.enter_context(gige_port())
        stack.enter_context(GigeServer(folder / "X"))
        addresses = {"X": GIGE, "Y": f"lab:{folder}/Y?via=pylon:0815-0001", "Z": f"lab:{folder}/Z"}
        cameras = {name: stack.enter_context(open_camera(address)) for name, address in addresses.items()}
        for camera in cameras.values():
            assert (camera.get("Width"), camera.get("Height")) == (640, 512)
            for name, value in (("TriggerMode", "On"), ("TriggerSource", "Software")):
                camera.set(name, value)
        yield cameras


@pytest.mark.slow
def test_three_cameras_through_two_makers_stacks_see_the_table_as_it_stands(
    served: dict[str, Camera], folder: Path, lab: SimulatedLab
) -> None:
    cameras = TriggerSet(served)
    cameras.arm()
    for pose in (*lab.poses[:3], lab.poses[0]):
        write_angles(folder / ANGLES, pose.axis1_rad, pose.axis2_rad)
        frames = cameras.take(5.0)
        for name, frame in frames.items():
            expected = lab.image(name, (pose.axis1_rad, pose.axis2_rad)).astype(float)
            assert np.std(frame.image - expected) == pytest.approx(np.sqrt(2.0) * 4.0, rel=0.1)
        seen = {name for name, f in frames.items() if len(image_quality(f, {"board": BOARD}).points["board"])}
        assert seen == set(pose.camera_ids)
    cameras.disarm()


@pytest.mark.slow
def test_exposure_reaches_the_scene_through_every_stack(
    served: dict[str, Camera], folder: Path, lab: SimulatedLab
) -> None:
    write_angles(folder / ANGLES, lab.poses[0].axis1_rad, lab.poses[0].axis2_rad)
    cameras = TriggerSet(served)
    bright = {}
    for exposure_us in (2500.0, 10000.0):
        for camera in served.values():
            camera.set("ExposureTime", exposure_us)
        cameras.arm()
        bright[exposure_us] = {name: f.image.mean() for name, f in cameras.take(5.0).items()}
    cameras.disarm()
    for name in CAMERA_IDS:
        assert bright[10000.0][name] / bright[2500.0][name] == pytest.approx(4.0, rel=0.03)
