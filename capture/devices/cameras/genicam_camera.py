"""Cameras whose features are GenICam's nodes: one way to read, write, arm and trigger, whatever library speaks to them.

A driver says how its library finds a node, reads and writes it, and starts and stops images; which of the library's
exceptions mean that a feature refuses a value; and translates all others.
"""

import time
from abc import abstractmethod
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, suppress
from typing import Any, ClassVar

from capture.devices.camera import (
    Camera,
    CameraError,
    FeatureValue,
    FetchTimeoutError,
    IncompleteFrameError,
    OutOfRangeError,
)
from capture.devices.cameras.features import LOCKED_WHILE_ARMED, OLDER_NAMES

READY_S = 2.0  # from the start of acquisition, or from a trigger, until the next trigger is obeyed
_LATE_S = 0.3  # how long after its exposure an image may still arrive


class GenicamCamera(Camera):
    """A camera by its nodes. ``_camera``: the library's object while the camera is open."""

    _refusals: ClassVar[tuple[type[Exception], ...]]
    """The library's exceptions for a value that a node does not take now, or at all."""

    def __init__(self, driver: str, place: str) -> None:
        super().__init__(driver, place)
        self._camera: Any = None

    @abstractmethod
    def _node(self, name: str) -> Any:
        """What the library knows a feature by, None where this camera has none of exactly that name."""

    @abstractmethod
    def _value(self, node: Any) -> FeatureValue:
        """Present value of a node."""

    @abstractmethod
    def _write(self, node: Any, value: FeatureValue) -> None:
        """Give a node a value."""

    @abstractmethod
    def _is_locked(self, node: Any, refusal: Exception) -> bool:
        """Whether a node that refused a value can be written at all."""

    @abstractmethod
    def _takes(self, node: Any) -> str:
        """What a node takes, in words; by ``values_taken``."""

    @abstractmethod
    def _require_format(self, pixel_format: str) -> None:
        """Raise CameraError for what cannot be received."""

    @abstractmethod
    def _receive(self) -> None:
        """Begin to receive images."""

    @abstractmethod
    def _stop(self) -> None:
        """No more images; nothing happens where none are received."""

    @abstractmethod
    def _wait_until_ready(self) -> None:
        """Until the camera waits for a trigger, where it can tell."""

    @abstractmethod
    def _execute(self, command: str) -> None:
        """Execute a command of the camera."""

    @abstractmethod
    def _translated(self, what: str) -> AbstractContextManager[None]:
        """The library's exceptions as ours."""

    def _answers(self) -> bool:
        """Whether the camera is there, as far as the library can tell."""
        return True

    def _found(self, name: str) -> Any:
        """The node of a feature, by its name or its older one."""
        if self._camera is None:
            raise CameraError(self.address, "it is not open", "open it first")
        for candidate in (name, OLDER_NAMES.get(name, name)):
            node = self._node(candidate)
            if node is not None:
                return node
        raise self._unknown(name)

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``."""
        with self._translated(name):
            return self._value(self._found(name))

    def set(self, name: str, value: FeatureValue) -> None:
        """See ``Camera``."""
        with self._translated(name):
            node = self._found(name)
            if self._armed and name in LOCKED_WHILE_ARMED:
                raise self._locked(name)
            try:
                self._write(node, value)
            except self._refusals as error:
                if self._is_locked(node, error):
                    raise self._locked(name) from error
                raise OutOfRangeError(self.address, f"{name} cannot be {value!r}", self._takes(node)) from error

    def arm(self) -> None:
        """See ``Camera``."""
        super().arm()
        self._drain()

    def _start(self) -> None:
        self._require_format(str(self.get("PixelFormat")))
        with self._translated("arm"):
            self._receive()
            if self._triggered_armed:
                self._wait_until_ready()

    def _drain(self) -> None:
        """After arming: a trigger that was given before, and never answered, may still bring an image."""
        if not self._unanswered:
            return
        self._unanswered = False
        if self.triggered:
            with suppress(FetchTimeoutError, IncompleteFrameError):
                self.fetch(_LATE_S + float(self.get("ExposureTime")) * 1e-6)

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

    def disarm(self) -> None:
        """See ``Camera``."""
        super().disarm()
        with self._translated("disarm"):
            self._stop()

    def _execute_trigger(self) -> None:
        with self._translated("trigger"):
            self._wait_until_ready()
            self._execute("TriggerSoftware")

    def _skip_pending(self) -> None:
        with suppress(FetchTimeoutError):
            while True:
                with suppress(IncompleteFrameError):
                    self.fetch(0.0)
        self.fetch(READY_S)  # its exposure began before the call

    def _no_image(self, timeout_s: float) -> CameraError:
        """Why none came in time."""
        return self._gone() if timeout_s > 0.0 and not self._answers() else self._late(timeout_s)


def values_taken(choices: Sequence[str] | None, limits: tuple[float, float] | None, step: float | None) -> str:
    """What a feature takes, in words: its choices, or its limits and the step between values."""
    if choices:
        return f"it takes {', '.join(choices)}"
    if limits is not None:
        return f"it takes {limits[0]:.10g} to {limits[1]:.10g}" + (f" in steps of {step:g}" if step else "")
    return "give another type of value"
