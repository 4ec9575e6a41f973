"""What a camera is to the session: its frames, its triggers, and the ways in which it fails.

Features are named as in GenICam's SFNC, verbatim: Width Height OffsetX OffsetY PixelFormat ExposureTime (us) Gain
TriggerSelector TriggerMode TriggerSource TriggerSoftware DeviceSerialNumber. Drivers are in
``capture.devices.cameras``, which also opens and discovers cameras by address.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Self

import numpy as np
import numpy.typing as npt

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen

GrayImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
FeatureValue = bool | int | float | str
ImageSource = Callable[[float, float], GrayImage]
"""What a simulated camera looks at: of exposure time (us) and gain (dB), the image (h, w) that is seen now, 8 bit."""


@frozen(eq=False)
class Frame:
    """One image that a camera handed over.

    image: (h, w), a copy of its own; uint8, or uint16 with the grey values in the lower ``bits`` bits. block_id: the
    number that the camera gave it. device_time_ns: the camera's clock, None where it has none. host_time_ns: UTC, when
    the image arrived here; host_monotonic_ns: the same moment on a clock that no one sets. complete: nothing of it was
    lost on the way.
    """

    image: GrayImage
    block_id: int
    host_time_ns: int
    host_monotonic_ns: int
    serial: str
    bits: int = 8
    device_time_ns: int | None = None
    complete: bool = True


@frozen
class CameraInfo:
    """A camera that a driver can reach: ``open_camera(info.address)`` opens it."""

    address: str
    vendor: str
    model: str
    serial: str
    in_use: bool = False


class CameraError(SurveyError):
    """Something is wrong with a camera; ``camera`` is its address. The message says what was found and what to do."""

    def __init__(self, camera: str, found: str, advice: str) -> None:
        super().__init__(f"camera {camera}: {found}; {advice}")
        self.camera, self.found, self.advice = camera, found, advice

    def __reduce__(self) -> tuple[object, ...]:
        return type(self), (self.camera, self.found, self.advice)


class FetchTimeoutError(CameraError):
    """No image within the time; trying again may help."""


class IncompleteFrameError(CameraError):
    """An image arrived with parts missing; ``frame`` holds what there is. Trying again may help."""

    frame: Frame | None = None


class DisconnectedError(CameraError):
    """The camera does not answer any more, or was never found; it has to be opened anew."""


class OutOfRangeError(CameraError):
    """A feature was given a value that the camera does not take."""


class UnknownFeatureError(CameraError):
    """The camera has no feature of that name."""


class InUseError(CameraError):
    """Another program holds the camera, or it is in a state that forbids what was asked."""


class DriverMissingError(CameraError):
    """The software of a driver is not installed; the message names the extra that brings it."""


class Camera(ABC):
    """A camera of any driver; the drivers fill in what is abstract.

    ``with open_camera(address) as camera`` closes it at the end. Between ``arm`` and ``disarm`` it takes images, one
    for each trigger where ``TriggerMode`` is On (by ``trigger`` where ``TriggerSource`` is Software), else one after
    the other. Block ids may start anew with ``arm``.

    address: ``driver:place``, by which it was opened. serial: DeviceSerialNumber, or what stands for it; known after
    ``open``.
    """

    def __init__(self, driver: str, place: str) -> None:
        self.address = f"{driver}:{place}"
        self.serial = place
        self._armed = False
        self._unanswered = False
        self._triggered_armed = False
        self._source_armed = ""

    @property
    def last_block_id(self) -> int | None:
        """The block id that is followed by 1 (65535 on a GigE Vision 1 camera); None where it counts on."""
        return None

    @property
    def triggered(self) -> bool:
        """Whether every trigger gives exactly one image, so that block ids advance by one; False: it runs freely.

        A camera that runs freely, as where it has no TriggerMode, still answers ``trigger``: the next ``fetch`` then
        gives an image whose exposure began after the call.
        """
        if self._armed:
            return self._triggered_armed
        try:
            return self.get("TriggerMode") == "On"
        except UnknownFeatureError:
            return False

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def open(self) -> None:
        """Take hold of the camera. Raises InUseError, DisconnectedError."""

    @abstractmethod
    def close(self) -> None:
        """Let go of it; never raises, may be called twice."""

    @abstractmethod
    def get(self, name: str) -> FeatureValue:
        """The value of a feature. Raises UnknownFeatureError, DisconnectedError."""

    @abstractmethod
    def set(self, name: str, value: FeatureValue) -> None:
        """Give a feature a value. Raises OutOfRangeError, UnknownFeatureError, InUseError, DisconnectedError."""

    @abstractmethod
    def fetch(self, timeout_s: float) -> Frame:
        """The next image. Raises FetchTimeoutError, IncompleteFrameError, DisconnectedError."""

    @abstractmethod
    def _start(self) -> None:
        """Begin to take images, or to wait for triggers."""

    @abstractmethod
    def _execute_trigger(self) -> None:
        """Execute TriggerSoftware."""

    @abstractmethod
    def _skip_pending(self) -> None:
        """Forget images whose exposure may have begun already; for cameras that run freely."""

    def arm(self) -> None:
        """Start; on return a trigger is obeyed and no image from before is left."""
        self.disarm()
        self._triggered_armed = self.triggered
        self._source_armed = str(self.get("TriggerSource")) if self._triggered_armed else ""
        self._start()
        self._armed = True

    def disarm(self) -> None:
        """Stop; may be called twice. After it ``arm`` starts again, whatever has happened before."""
        self._armed = False

    def trigger(self) -> None:
        """Ask for an image (TriggerSoftware)."""
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
