"""Image files and films as cameras, and Video4Linux as far as it goes without a device."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.devices.camera import (
    CameraError,
    DisconnectedError,
    FetchTimeoutError,
    InUseError,
    OutOfRangeError,
    UnknownFeatureError,
)
from capture.devices.cameras import discover, open_camera
from capture.session.trigger_set import TriggerSet

RNG = np.random.default_rng(8)


def write(path: Path, image: np.ndarray) -> np.ndarray:
    assert cv2.imwrite(str(path), image)
    return image


def test_files_in_natural_order_bit_by_bit(tmp_path: Path) -> None:
    written = [write(tmp_path / f"i{k}.png", RNG.integers(0, 65536, (24, 32), np.uint16)) for k in (2, 9, 10, 11)]
    with open_camera(f"images:{tmp_path}") as camera:
        assert (camera.get("Width"), camera.get("Height"), camera.get("PixelFormat")) == (32, 24, "Mono16")
        cameras = TriggerSet({"F": camera})
        for _ in range(2):  # arming begins anew
            cameras.arm()
            frames = [cameras.take(0.1)["F"] for _ in written]
            assert [f.block_id for f in frames] == [1, 2, 3, 4]
            assert all(np.array_equal(f.image, image) for f, image in zip(frames, written, strict=True))
            assert (frames[0].bits, frames[0].device_time_ns) == (16, None)
        camera.trigger()
        with pytest.raises(DisconnectedError, match="all 4 images have been played"):
            camera.fetch(0.1)


def test_files_wait_for_their_trigger(tmp_path: Path) -> None:
    write(tmp_path / "a.png", np.zeros((8, 8), np.uint8))
    write(tmp_path / "b.tif", np.ones((8, 8), np.uint8))
    with open_camera(f"images:{tmp_path}/*.tif") as camera:
        camera.arm()
        with pytest.raises(FetchTimeoutError):
            camera.fetch(0.0)
        with pytest.raises(InUseError):
            camera.set("TriggerMode", "Off")
        camera.disarm()
        camera.set("TriggerMode", "Off")
        with pytest.raises(OutOfRangeError, match=r"TriggerSource .*Software"):
            camera.set("TriggerSource", "Line1")
        camera.arm()
        assert camera.fetch(0.0).image.max() == 1
        with pytest.raises(InUseError):
            camera.set("Width", 4)
        with pytest.raises(UnknownFeatureError):
            camera.set("ExposureTime", 4)


@pytest.mark.parametrize("place", ["", "/none", "/*.png"])
def test_no_files(tmp_path: Path, place: str) -> None:
    with pytest.raises(DisconnectedError, match="there are no images"):
        open_camera(f"images:{tmp_path}{place}")


def test_colour_files_become_gray(tmp_path: Path) -> None:
    colour = write(tmp_path / "c.png", RNG.integers(0, 256, (8, 8, 3), np.uint8))
    expected = np.rint(colour @ np.array([0.114, 0.587, 0.299]))  # B G R, by ITU-R BT.601
    with open_camera(f"images:{tmp_path}") as camera:
        camera.arm()
        camera.trigger()
        np.testing.assert_allclose(camera.fetch(0.1).image, expected, atol=1.0)


def test_a_film_runs_freely(tmp_path: Path) -> None:
    film = tmp_path / "film.avi"
    writer = cv2.VideoWriter(str(film), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (64, 48))
    for k in range(5):
        writer.write(np.full((48, 64, 3), 40 * k + 20, np.uint8))
    writer.release()
    with open_camera(f"opencv:{film}") as camera:
        assert (camera.get("Width"), camera.get("Height")) == (64, 48)
        assert not camera.triggered
        camera.arm()
        frames = []
        for _ in range(5):
            camera.trigger()
            frames.append(camera.fetch(1.0))
        with pytest.raises(DisconnectedError, match="the film is over"):
            camera.fetch(1.0)
        with pytest.raises(UnknownFeatureError):
            camera.get("ExposureTime")
    assert [f.block_id for f in frames] == [1, 2, 3, 4, 5]
    # JPEG keeps plain grey to a few counts
    np.testing.assert_allclose([f.image.mean() for f in frames], [20, 60, 100, 140, 180], atol=3.0)


def test_no_device_and_no_film(tmp_path: Path) -> None:
    with pytest.raises(DisconnectedError, match="no such device or file"):
        open_camera("opencv:/dev/video99")
    (tmp_path / "film.avi").write_text("no film")
    with pytest.raises(DisconnectedError, match="OpenCV cannot read it"):
        open_camera(f"opencv:{tmp_path / 'film.avi'}")
    assert all(info.address.startswith("opencv:/dev/video") for info in discover("opencv"))


def test_an_unfit_kind_of_image(tmp_path: Path) -> None:
    write(tmp_path / "f.tif", np.zeros((8, 8), np.float32))
    with open_camera(f"images:{tmp_path}") as camera:
        camera.arm()
        camera.trigger()
        with pytest.raises(CameraError, match=r"f.tif has values of type float32; save it with 8 or 16 bit"):
            camera.fetch(0.1)
