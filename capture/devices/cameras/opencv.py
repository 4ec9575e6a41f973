"""Webcams and other Video4Linux devices, and films, through OpenCV: ``opencv:/dev/video0``, ``opencv:FILM.avi``.

They run freely and have no clock: block ids count the images that were handed out.
"""

import time
from pathlib import Path

import cv2

from capture.devices.camera import (
    Camera,
    CameraError,
    CameraInfo,
    DisconnectedError,
    FeatureValue,
    FetchTimeoutError,
    Frame,
    InUseError,
    OutOfRangeError,
)
from capture.devices.cameras.features import LOCKED_WHILE_ARMED, gray_copy

_DEVICES = Path("/sys/class/video4linux")
# Video4Linux gives exposures in units of 100 us; its Gain has no unit, so it is not SFNC's
_EXPOSURE_UNIT_US = 100.0
_MANUAL_EXPOSURE = 1.0
_NUMBERS = {"Width": cv2.CAP_PROP_FRAME_WIDTH, "Height": cv2.CAP_PROP_FRAME_HEIGHT}
_BUFFERED_S = 2e-3  # an image that comes sooner had been waiting


def discover() -> tuple[CameraInfo, ...]:
    """The Video4Linux devices of this machine."""
    if not _DEVICES.is_dir():
        return ()
    return tuple(
        CameraInfo(f"opencv:/dev/{entry.name}", "", (entry / "name").read_text().strip(), _serial(entry.name))
        for entry in sorted(_DEVICES.iterdir())
    )


def _serial(device: str) -> str:
    """The serial number of its USB device, else its own name."""
    file = _DEVICES / device / "device" / ".." / "serial"
    return file.read_text().strip() if file.is_file() else device


class OpencvCamera(Camera):
    """A device or a film that OpenCV opens."""

    def __init__(self, place: str) -> None:
        super().__init__("opencv", place)
        self._place = Path(place)
        self._is_device = place.startswith("/dev/")
        self._capture: cv2.VideoCapture | None = None
        self._block_id = 0

    def open(self) -> None:
        """See ``Camera``."""
        if not self._place.exists():
            raise DisconnectedError(self.address, "there is no such device or file", "check name and cable")
        capture = cv2.VideoCapture(str(self._place), cv2.CAP_V4L2 if self._is_device else cv2.CAP_ANY)
        if not capture.isOpened():
            if self._is_device:
                raise InUseError(self.address, "it cannot be opened", "close the program that holds it, check rights")
            raise DisconnectedError(self.address, "OpenCV cannot read it", "give a film that OpenCV reads, such as AVI")
        self._capture = capture
        self.serial = _serial(self._place.name) if self._is_device else self._place.name
        capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)

    def close(self) -> None:
        """See ``Camera``."""
        if self._capture is not None:
            self._capture.release()
        self._capture, self._armed = None, False

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``."""
        if name in _NUMBERS:
            return int(self._opened().get(_NUMBERS[name]))
        if name == "ExposureTime" and self._is_device:
            return _EXPOSURE_UNIT_US * self._opened().get(cv2.CAP_PROP_EXPOSURE)
        if name == "PixelFormat":
            return "Mono8"
        if name == "DeviceSerialNumber":
            return self.serial
        raise self._unknown(name)

    def set(self, name: str, value: FeatureValue) -> None:
        """See ``Camera``. ExposureTime ends automatic exposure."""
        capture = self._opened()
        if name in ("DeviceSerialNumber", "PixelFormat") or (self._armed and name in LOCKED_WHILE_ARMED):
            raise self._locked(name)
        if name not in _NUMBERS and not (name == "ExposureTime" and self._is_device):
            raise self._unknown(name)
        if name == "ExposureTime":
            capture.set(cv2.CAP_PROP_AUTO_EXPOSURE, _MANUAL_EXPOSURE)
            capture.set(cv2.CAP_PROP_EXPOSURE, float(value) / _EXPOSURE_UNIT_US)
        else:
            capture.set(_NUMBERS[name], float(value))
        taken = self.get(name)
        if abs(float(taken) - float(value)) > (_EXPOSURE_UNIT_US if name == "ExposureTime" else 0.0):
            raise OutOfRangeError(self.address, f"{name} cannot be {value!r}", f"the nearest that it took is {taken!r}")

    def _opened(self) -> cv2.VideoCapture:
        if self._capture is None:
            raise CameraError(self.address, "it is not open", "open it first")
        return self._capture

    def _start(self) -> None:
        self._opened()
        self._block_id = 0
        self._skip_pending()

    def _execute_trigger(self) -> None:
        """It has no trigger."""

    def _skip_pending(self) -> None:
        """Images that wait in the device's buffers, and the one that is being exposed; a film waits by itself."""
        while self._is_device:
            before = time.monotonic()
            if not self._opened().grab() or time.monotonic() - before > _BUFFERED_S:
                return

    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``. OpenCV itself decides how long it waits for a device: about 10 s."""
        self._require_armed("fetch")
        ok, image = self._opened().read()
        if ok:
            self._block_id += 1
            return self._frame(gray_copy(image), self._block_id, None)
        if self._is_device and self._place.exists():
            raise FetchTimeoutError(self.address, "the device gave no image", "check exposure and cable")
        what = "the device is gone" if self._is_device else "the film is over"
        raise DisconnectedError(self.address, what, "check the cable, open it anew")


camera = OpencvCamera
