"""What every driver owes to the session, on the real stacks: the same tests for all of them."""

import itertools
import pickle
from collections.abc import Iterator

import numpy as np
import pytest

from capture.devices.camera import (
    Camera,
    CameraError,
    DisconnectedError,
    FetchTimeoutError,
    InUseError,
    OutOfRangeError,
    UnknownFeatureError,
)
from capture.devices.cameras import open_camera
from tests.capture.camera_helpers import GIGE, PYLON, VIKY, gige_port, require_silence, set_up
from tests.capture.gige_server import GigeServer

pytestmark = pytest.mark.slow

TRIGGERED = ("simulated", "pylon", "gige")


@pytest.fixture(
    scope="module",
    params=("simulated", *(pytest.param(name, marks=pytest.mark.hardware) for name in ("pylon", "gige", "gentl"))),
)
def address(request: pytest.FixtureRequest) -> Iterator[str]:
    if request.param == "gige":
        with gige_port(), GigeServer("gradient"):
            yield GIGE
    else:
        yield {"simulated": "simulated:S", "pylon": PYLON, "gentl": VIKY}[request.param]


@pytest.fixture
def camera(address: str) -> Iterator[Camera]:
    with open_camera(address) as opened:
        if address != VIKY:
            set_up(opened)
        else:
            opened.set("PixelFormat", "Mono8")
        yield opened


def is_triggered(camera: Camera) -> bool:
    return camera.address.partition(":")[0] in TRIGGERED


def test_values_come_back_as_they_were_set(camera: Camera) -> None:
    camera.set("Width", 128)
    assert camera.get("Width") == 128
    assert camera.get("PixelFormat") == "Mono8"
    assert camera.get("DeviceSerialNumber") == camera.serial != ""
    if is_triggered(camera):
        camera.set("ExposureTime", 2500)
        assert camera.get("ExposureTime") == 2500.0


@pytest.mark.parametrize(("name", "value"), [("Width", 10**6), ("Width", "wide"), ("PixelFormat", "Mono7")])
def test_a_value_that_it_does_not_take(camera: Camera, name: str, value: object) -> None:
    before = camera.get(name)
    with pytest.raises(OutOfRangeError, match=rf"{name} cannot be {value!r}; it takes .*\d") as caught:
        camera.set(name, value)
    assert caught.value.camera == camera.address
    assert camera.get(name) == before


def test_a_feature_that_it_does_not_have(camera: Camera) -> None:
    with pytest.raises(UnknownFeatureError, match="no feature Exposure"):
        camera.set("Exposure", 3)
    with pytest.raises(UnknownFeatureError, match="no feature Exposure"):
        camera.get("Exposure")


def test_the_region_is_locked_while_it_is_armed(camera: Camera) -> None:
    width = camera.get("Width")
    camera.arm()
    with pytest.raises((InUseError, UnknownFeatureError), match="TriggerMode"):
        camera.set("TriggerMode", "Off")
    with pytest.raises(InUseError, match=r"Width .* disarm"):
        camera.set("Width", 100)
    assert camera.get("Width") == width


def test_it_is_held_by_one(camera: Camera) -> None:
    if camera.address == PYLON:
        pytest.skip("pylon's emulator lets one process open a camera twice")
    with pytest.raises(InUseError, match="close"):
        open_camera(camera.address)
    camera.get("Width")  # and the attempt has not disturbed the first


def test_one_image_for_each_trigger(camera: Camera) -> None:
    if not is_triggered(camera):
        pytest.skip("it has no trigger")
    assert camera.triggered
    camera.arm()
    require_silence(camera)
    frames = []
    for _ in range(4):
        camera.trigger()
        frames.append(camera.fetch(2.0))
    require_silence(camera)
    ids = [f.block_id for f in frames]
    assert ids == list(range(ids[0], ids[0] + 4))
    assert all(f.image.shape == (48, 64) and f.complete and f.serial == camera.serial for f in frames)
    assert all(a.host_monotonic_ns < b.host_monotonic_ns for a, b in itertools.pairwise(frames))


def test_images_are_copies(camera: Camera) -> None:
    camera.arm()
    kept = []
    for _ in range(12):  # more than any stack has buffers
        camera.trigger()
        image = camera.fetch(2.0).image
        kept.append((image, image.copy()))
    assert all(np.array_equal(image, copy) for image, copy in kept)


def test_free_running_images_follow_one_another(camera: Camera) -> None:
    if is_triggered(camera):
        camera.set("TriggerMode", "Off")
    assert not camera.triggered
    camera.arm()
    ids = [camera.fetch(2.0).block_id for _ in range(3)]
    assert ids[0] < ids[1] < ids[2]
    camera.trigger()
    assert camera.fetch(2.0).block_id > ids[2]


def test_a_trigger_without_answer_does_not_spoil_the_next_series(camera: Camera) -> None:
    if not is_triggered(camera):
        pytest.skip("it has no trigger")
    camera.arm()
    camera.trigger()
    camera.disarm()
    camera.arm()
    require_silence(camera)
    camera.trigger()
    camera.fetch(2.0)


def test_what_needs_arming_says_so(camera: Camera) -> None:
    for action in (camera.trigger, lambda: camera.fetch(0.1)):
        with pytest.raises(CameraError, match="not armed; arm it first"):
            action()
    camera.disarm()
    camera.disarm()


def test_after_closing_it_opens_again(address: str) -> None:
    for _ in range(2):
        camera = open_camera(address)
        camera.close()
        camera.close()
        with pytest.raises(CameraError, match="open"):
            camera.get("Width")


@pytest.mark.parametrize("driver", ["pylon", "gige", "u3v", "gentl"])
def test_nothing_at_that_address(driver: str) -> None:
    with pytest.raises(DisconnectedError, match=f"{driver}:NOBODY: .*check"):
        open_camera(f"{driver}:NOBODY")


def test_errors_can_be_sent_to_another_process() -> None:
    error = pickle.loads(pickle.dumps(FetchTimeoutError("pylon:1", "no image within 1 s", "trigger it")))
    assert type(error) is FetchTimeoutError
    assert str(error) == "camera pylon:1: no image within 1 s; trigger it"
    assert error.camera == "pylon:1"
