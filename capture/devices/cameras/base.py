"""What all drivers share: opening by ``with``, the armed state, triggers, and frames with the host's time."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import suppress
from types import TracebackType
from typing import Self

import numpy as np

from capture.devices.camera import (
    CameraError,
    DisconnectedError,
    FeatureValue,
    FetchTimeoutError,
    Frame,
    GrayImage,
    IncompleteFrameError,
    InUseError,
    UnknownFeatureError,
)
from survey.detection.gray import AnyImage, gray_values

# names of SFNC's first edition, which many cameras still use, in the same units. Not Gain: GainRaw has none
OLDER_NAMES = {
    "ExposureTime": "ExposureTimeAbs",
    "Gain": "GainAbs",
    "DeviceSerialNumber": "DeviceID",
    "AcquisitionFrameRate": "AcquisitionFrameRateAbs",
}
# SFNC locks the region while images are sent; not every camera does. What starts an image is asked for once, when the
# camera is armed
LOCKED_WHILE_ARMED = (
    *("Width", "Height", "OffsetX", "OffsetY", "PixelFormat"),
    *("TriggerSelector", "TriggerMode", "TriggerSource"),
)
READY_S = 2.0  # from the start of acquisition, or from a trigger, until the next trigger is obeyed
_LATE_S = 0.3  # how long after its exposure an image may still arrive


class DriverCamera(ABC):
    """A camera of one driver; the drivers fill in what begins with an underscore."""

    def __init__(self, driver: str, place: str) -> None:
        self._address = f"{driver}:{place}"
        self._serial = place
        self._armed = False
        self._unanswered = False
        self._triggered_armed = False
        self._source_armed = ""

    @property
    def address(self) -> str:
        """``driver:place``."""
        return self._address

    @property
    def serial(self) -> str:
        """The serial number; known after ``open``."""
        return self._serial

    @property
    def last_block_id(self) -> int | None:
        """See ``Camera``; most cameras count on."""
        return None

    @property
    def triggered(self) -> bool:
        """TriggerMode is On; False where the camera has none."""
        if self._armed:
            return self._triggered_armed
        try:
            return self.get("TriggerMode") == "On"
        except UnknownFeatureError:
            return False

    def _note_trigger(self) -> None:
        """To be called when the camera is about to be armed: what starts an image."""
        self._triggered_armed = self.triggered
        self._source_armed = str(self.get("TriggerSource")) if self._triggered_armed else ""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @abstractmethod
    def open(self) -> None:
        """See ``Camera``."""

    @abstractmethod
    def close(self) -> None:
        """See ``Camera``."""

    @abstractmethod
    def get(self, name: str) -> FeatureValue:
        """See ``Camera``."""

    @abstractmethod
    def set(self, name: str, value: FeatureValue) -> None:
        """See ``Camera``."""

    @abstractmethod
    def arm(self) -> None:
        """See ``Camera``."""

    @abstractmethod
    def disarm(self) -> None:
        """See ``Camera``."""

    @abstractmethod
    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``."""

    @abstractmethod
    def _execute_trigger(self) -> None:
        """Execute TriggerSoftware."""

    @abstractmethod
    def _skip_pending(self) -> None:
        """Forget images whose exposure may have begun already; for cameras that run freely."""

    def trigger(self) -> None:
        """See ``Camera``."""
        self._require_armed("trigger")
        if not self.triggered:
            self._skip_pending()
            return
        if self._source_armed != "Software":
            raise CameraError(
                self.address,
                f"its trigger comes from {self._source_armed}, not from software",
                "fire that line, or set TriggerSource to Software",
            )
        self._unanswered = True
        self._execute_trigger()

    def _drain(self) -> None:
        """After arming: a trigger that was given before, and never answered, may still bring an image."""
        if not self._unanswered:
            return
        self._unanswered = False
        if self.triggered:
            with suppress(FetchTimeoutError, IncompleteFrameError):
                self.fetch(_LATE_S + float(self.get("ExposureTime")) * 1e-6)

    def _require_armed(self, what: str) -> None:
        if not self._armed:
            raise CameraError(self.address, f"{what} while it is not armed", "arm it first")

    def _unknown(self, name: str) -> UnknownFeatureError:
        return UnknownFeatureError(
            self.address, f"it has no feature {name}", "correct the name, or leave the feature out for this camera"
        )

    def _locked(self, name: str) -> InUseError:
        found = f"{name} cannot be written now"
        return InUseError(self.address, found, "disarm the camera first; if it is disarmed, the feature is read-only")

    def _gone(self) -> DisconnectedError:
        return DisconnectedError(self.address, "it does not answer any more", "check cable and power, open it anew")

    def _late(self, timeout_s: float) -> FetchTimeoutError:
        found = f"no image within {timeout_s:g} s"
        return FetchTimeoutError(self.address, found, "was it triggered? check trigger, exposure, cable and firewall")

    def _incomplete(self, what: str, why: str, frame: Frame | None = None) -> IncompleteFrameError:
        advice = "take it again; if it repeats, check cable, packet size and bandwidth"
        error = IncompleteFrameError(self.address, f"{what} arrived incomplete ({why})", advice)
        error.frame, self._unanswered = frame, False
        return error

    def _wait_for(self, ready: Callable[[], object]) -> None:
        """Until the camera waits for a trigger: one sent before is lost without a word."""
        end = time.monotonic() + READY_S
        while not ready():
            if time.monotonic() > end:
                raise FetchTimeoutError(
                    self.address,
                    f"it does not wait for a trigger within {READY_S:.0f} s",
                    "check that TriggerSelector is FrameStart, and that the exposure is shorter than that",
                )

    def _frame(
        self,
        image: GrayImage,
        block_id: int,
        device_time_ns: int | None,
        bits: int | None = None,
        complete: bool = True,
    ) -> Frame:
        self._unanswered = False
        return Frame(
            image,
            block_id,
            time.time_ns(),
            time.monotonic_ns(),
            self.serial,
            bits or 8 * image.dtype.itemsize,
            device_time_ns or None,  # a camera without a clock says 0
            complete,
        )


def gray_copy(image: AnyImage) -> GrayImage:
    """A copy of its own, (h, w) uint8 or uint16; colour (B G R) becomes grey of the same depth."""
    gray = np.rint(gray_values(image)) if image.ndim == 3 else image
    return np.array(gray, np.uint8) if image.dtype == np.uint8 else np.array(gray, np.uint16)


def bits_of(pixel_format: str) -> int:
    """Depth of a format of GenICam's PFNC: 12 for Mono12, Mono12p, Mono12Packed; 8 where the name holds no depth."""
    digits = "".join(c if c.isdigit() else " " for c in pixel_format).split()
    return int(digits[0]) if digits else 8


def is_mosaic_or_gray(pixel_format: str) -> bool:
    """Whether one value a pixel is sent: grey, or a colour mosaic, which is kept as it is."""
    return pixel_format.startswith(("Mono", "Bayer"))
