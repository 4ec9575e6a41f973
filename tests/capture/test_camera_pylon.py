"""Basler's own software, with its emulator as the camera."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.devices.camera import CameraError, DisconnectedError, IncompleteFrameError
from capture.devices.cameras.pylon import PylonCamera
from tests.capture.camera_helpers import PYLON, open_camera, require_silence, set_up

pytestmark = pytest.mark.hardware
RNG = np.random.default_rng(4)


@pytest.fixture
def camera() -> Iterator[PylonCamera]:
    with open_camera(PYLON) as opened:
        set_up(opened)
        assert isinstance(opened, PylonCamera)
        yield opened


def show(camera: PylonCamera, path: Path, image: np.ndarray) -> None:
    assert cv2.imwrite(str(path), image)
    camera.set("TestImageSelector", "Off")
    camera.set("ImageFileMode", "On")
    camera.set("ImageFilename", str(path))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pixel_format", "bits", "shift"), [("Mono8", 8, 0), ("Mono10", 10, 6), ("Mono12", 12, 4), ("Mono16", 16, 0)]
)
def test_images_bit_by_bit(camera: PylonCamera, tmp_path: Path, pixel_format: str, bits: int, shift: int) -> None:
    """The emulator shifts a file of 16 bit to the depth of the format."""
    deep = np.uint8 if bits == 8 else np.uint16
    image = RNG.integers(0, np.iinfo(deep).max, (48, 64), deep, endpoint=True)
    camera.set("PixelFormat", pixel_format)
    show(camera, tmp_path / "image.png", image)
    camera.arm()
    camera.trigger()
    frame = camera.fetch(2.0)
    assert frame.bits == bits
    assert frame.image.dtype == deep
    np.testing.assert_array_equal(frame.image, image >> shift)


def test_an_emulated_camera_has_no_clock(camera: PylonCamera) -> None:
    camera.arm()
    camera.trigger()
    assert camera.fetch(2.0).device_time_ns is None


def test_failed_buffers_are_incomplete_images(camera: PylonCamera) -> None:
    camera.arm()
    camera.set("ForceFailedBufferCount", 1)
    camera._node("ForceFailedBuffer").Execute()
    camera.trigger()
    with pytest.raises(IncompleteFrameError, match=r"image 0 arrived incomplete .*take it again") as caught:
        camera.fetch(2.0)
    assert caught.value.frame is not None
    assert not caught.value.frame.complete
    camera.trigger()
    assert camera.fetch(2.0).block_id == 1


def test_an_error_of_the_stream_is_told_and_arming_again_helps(camera: PylonCamera) -> None:
    node = camera._camera.GetStreamGrabberNodeMap().GetNode("ImposedError")
    camera.arm()
    node.Value = "the cable has been bitten"
    camera.trigger()
    with pytest.raises(CameraError, match="bitten"):
        camera.fetch(2.0)
    node.Value = ""
    camera.arm()
    camera.trigger()
    camera.fetch(2.0)
    require_silence(camera)


def test_colour_is_refused_with_advice(camera: PylonCamera) -> None:
    camera.set("PixelFormat", "RGB8Packed")
    camera.arm()
    camera.trigger()
    with pytest.raises(CameraError, match=r"RGB8Packed.*set PixelFormat to Mono8"):
        camera.fetch(2.0)


def test_a_trigger_from_a_line_is_not_software(camera: PylonCamera) -> None:
    camera.set("TriggerSource", "Line1")
    camera.arm()
    with pytest.raises(CameraError, match="comes from Line1"):
        camera.trigger()


def test_every_trigger_counts_from_the_first(camera: PylonCamera) -> None:
    """A trigger right after the start of acquisition is lost unless one waits; here none may be."""
    for _ in range(10):
        camera.arm()
        camera.trigger()
        assert camera.fetch(2.0).block_id == 0


def test_a_camera_that_was_pulled_out(camera: PylonCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    camera.arm()
    monkeypatch.setattr(type(camera._camera), "IsCameraDeviceRemoved", lambda _: True)
    with pytest.raises(DisconnectedError, match="does not answer any more"):
        camera.fetch(0.05)
