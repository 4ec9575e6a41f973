"""A sequence of image files, played back as a camera: ``images:FOLDER`` or ``images:FOLDER/*.png``."""

from pathlib import Path

import numpy as np

from adjust.model.names import natural_key
from capture.devices.camera import (
    Camera,
    CameraError,
    DisconnectedError,
    FeatureValue,
    FetchTimeoutError,
    Frame,
    GrayImage,
    OutOfRangeError,
)
from capture.devices.cameras.features import LOCKED_WHILE_ARMED, gray_copy
from survey.detection.gray import read_image
from survey.project.images import IMAGE_ENDINGS


class ImageFiles(Camera):
    """The images of a folder or pattern, in natural order of their names.

    Each trigger gives the next file; with ``TriggerMode`` Off, each ``fetch``. ``arm`` begins anew.
    """

    def __init__(self, place: str) -> None:
        super().__init__("images", place)
        self._place = Path(place)
        self._files: list[Path] = []
        self._next = 0
        self._asked = 0
        self._features: dict[str, FeatureValue] = {"TriggerMode": "On", "TriggerSource": "Software"}

    def open(self) -> None:
        """See ``Camera``."""
        folder, pattern = (self._place, "*") if self._place.is_dir() else (self._place.parent, self._place.name)
        found = [p for p in folder.glob(pattern) if p.suffix.lower() in IMAGE_ENDINGS]
        self._files = sorted(found, key=lambda p: natural_key(p.name))
        if not self._files:
            raise DisconnectedError(self.address, "there are no images", "name a folder, or files as DIR/*.png")

    def close(self) -> None:
        """See ``Camera``."""
        self._armed = False

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``. Width, Height and PixelFormat are those of the next image."""
        if name in self._features:
            return self._features[name]
        if name == "DeviceSerialNumber":
            return self.serial
        if name not in ("Width", "Height", "PixelFormat"):
            raise self._unknown(name)
        image = self._image(min(self._next, len(self._files) - 1))
        if name == "PixelFormat":
            return f"Mono{8 * image.dtype.itemsize}"
        return int(image.shape[1] if name == "Width" else image.shape[0])

    def set(self, name: str, value: FeatureValue) -> None:
        """See ``Camera``. Only triggers can be set."""
        allowed = {"TriggerMode": ("On", "Off"), "TriggerSource": ("Software",), "TriggerSelector": ("FrameStart",)}
        if self._armed and name in LOCKED_WHILE_ARMED:
            raise self._locked(name)
        if name not in allowed:
            if name in ("Width", "Height", "PixelFormat", "DeviceSerialNumber"):
                raise self._locked(name)
            raise self._unknown(name)
        if value not in allowed[name]:
            raise OutOfRangeError(self.address, f"{name} cannot be {value!r}", f"it takes {', '.join(allowed[name])}")
        self._features[name] = value

    def _start(self) -> None:
        self._next, self._asked = 0, 0

    def _execute_trigger(self) -> None:
        self._asked += 1

    def _skip_pending(self) -> None:
        """A file waits until it is fetched."""

    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``."""
        self._require_armed("fetch")
        if self.triggered and self._asked <= self._next:
            raise FetchTimeoutError(self.address, f"no image within {timeout_s:g} s", "trigger it")
        if self._next >= len(self._files):
            raise DisconnectedError(self.address, f"all {len(self._files)} images have been played", "arm it again")
        self._next += 1
        return self._frame(self._image(self._next - 1), self._next, None)

    def _image(self, k: int) -> GrayImage:
        image = read_image(self._files[k])
        if image.dtype not in (np.uint8, np.uint16):
            found = f"{self._files[k].name} has values of type {image.dtype}"
            raise CameraError(self.address, found, "save it with 8 or 16 bit")
        return gray_copy(image)


camera = ImageFiles
