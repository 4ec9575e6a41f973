"""What a camera is to the session: one small protocol, its frames, and the ways in which it fails.

Features are named as in GenICam's SFNC, verbatim: Width Height OffsetX OffsetY PixelFormat ExposureTime (us) Gain
TriggerSelector TriggerMode TriggerSource TriggerSoftware DeviceSerialNumber. Drivers are in
``capture.devices.cameras``, which also opens and discovers cameras by address.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import TracebackType
from typing import Protocol, Self

import numpy as np
import numpy.typing as npt

from adjust.model.errors import SurveyError

GrayImage = npt.NDArray[np.uint8] | npt.NDArray[np.uint16]
FeatureValue = bool | int | float | str
ImageSource = Callable[[float, float], GrayImage]
"""What a simulated camera looks at: of exposure time (us) and gain (dB), the image (h, w) that is seen now, 8 bit."""


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True)
class CameraInfo:
    """A camera that a driver can reach: ``open_camera(info.address)`` opens it."""

    address: str
    vendor: str
    model: str
    serial: str
    in_use: bool = False


class Camera(Protocol):
    """A camera of any driver.

    ``with open_camera(address) as camera`` closes it at the end. Between ``arm`` and ``disarm`` it takes images, one
    for each trigger where ``TriggerMode`` is On (by ``trigger`` where ``TriggerSource`` is Software), else one after
    the other. Block ids may start anew with ``arm``.
    """

    @property
    def address(self) -> str:
        """``driver:address``, by which it was opened."""
        ...

    @property
    def serial(self) -> str:
        """DeviceSerialNumber, or what stands for it."""
        ...

    @property
    def last_block_id(self) -> int | None:
        """The block id that is followed by 1 (65535 on a GigE Vision 1 camera); None where it counts on."""
        ...

    @property
    def triggered(self) -> bool:
        """Whether every trigger gives exactly one image, so that block ids advance by one; False: it runs freely.

        A camera that runs freely still answers ``trigger``: the next ``fetch`` then gives an image whose exposure began
        after the call.
        """
        ...

    def open(self) -> None:
        """Take hold of the camera. Raises InUseError, DisconnectedError."""
        ...

    def close(self) -> None:
        """Let go of it; never raises, may be called twice."""
        ...

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def get(self, name: str) -> FeatureValue:
        """The value of a feature. Raises UnknownFeatureError, DisconnectedError."""
        ...

    def set(self, name: str, value: FeatureValue) -> None:
        """Give a feature a value. Raises OutOfRangeError, UnknownFeatureError, InUseError, DisconnectedError."""
        ...

    def arm(self) -> None:
        """Start; on return a trigger is obeyed and no image from before is left."""
        ...

    def trigger(self) -> None:
        """Ask for an image (TriggerSoftware)."""
        ...

    def fetch(self, timeout_s: float) -> Frame:
        """The next image. Raises FetchTimeoutError, IncompleteFrameError, DisconnectedError."""
        ...

    def disarm(self) -> None:
        """Stop; may be called twice. After it ``arm`` starts again, whatever has happened before."""
        ...


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
