"""A camera in this process: images from a function, and failures on demand.

``simulated:NAME?faults=timeout@5,incomplete@9`` fails at the 5th and the 9th image that it takes, counted from the
first of its process. Without ``source`` its images are a gradient with the number of the image in the first pixels.
"""

import time
from collections import deque
from collections.abc import Sequence
from typing import Literal, cast, get_args
from urllib.parse import parse_qs

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from capture.devices.camera import (
    Camera,
    CameraError,
    FeatureValue,
    Frame,
    GrayImage,
    ImageSource,
    InUseError,
    OutOfRangeError,
)
from capture.devices.cameras.features import LOCKED_WHILE_ARMED, bits_of

FaultKind = Literal["timeout", "incomplete", "disconnect", "wrong_id", "duplicate", "swap", "extra", "lost"]
_RANGES = {"Width": (16, 8192), "Height": (16, 8192), "OffsetX": (0, 8191), "OffsetY": (0, 8191),
           "ExposureTime": (10.0, 1e7), "Gain": (0.0, 48.0)}  # fmt: skip
_CHOICES = {
    "PixelFormat": ("Mono8", "Mono12", "Mono16"),
    "TriggerSelector": ("FrameStart",),
    "TriggerMode": ("Off", "On"),
    "TriggerSource": ("Software", "Line1"),
}
_HELD: set[str] = set()


@frozen
class Fault:
    """What goes wrong at image ``at`` (1 is the first).

    timeout: the trigger is not obeyed. incomplete: parts are missing. disconnect: the camera is gone until it is opened
    anew. wrong_id: the block id jumps ahead by 7. duplicate: the image comes twice with one id. swap: it comes after
    the next one. extra: another image, with an id of its own, follows unasked. lost: it counts but never arrives.
    """

    kind: FaultKind
    at: int


def camera(place: str, source: ImageSource | None = None, faults: Sequence[Fault] = ()) -> "SimulatedCamera":
    """The camera of that name, not opened."""
    name, _, query = place.partition("?")
    told = ",".join(parse_qs(query).get("faults", ()))
    return SimulatedCamera(name, source, (*faults, *parsed_faults(told)))


def parsed_faults(text: str) -> list[Fault]:
    """Faults from ``timeout@5,incomplete@9``. Raises SurveyError for another form."""
    faults = []
    for item in text.split(","):
        kind, at, number = item.partition("@")
        if item and (kind not in get_args(FaultKind) or not at or not number.isdigit()):
            kinds = ", ".join(get_args(FaultKind))
            raise SurveyError(f"simulated camera: fault {item!r}: give kind@number with a kind out of {kinds}")
        if item:
            faults.append(Fault(cast(FaultKind, kind), int(number)))
    return faults


class SimulatedCamera(Camera):
    """See the module."""

    def __init__(
        self, name: str, source: ImageSource | None = None, faults: Sequence[Fault] = (), driver: str = "simulated"
    ) -> None:
        super().__init__(driver, name)
        self._source = source or self._gradient
        self._faults = {fault.at: fault.kind for fault in faults}
        self._features: dict[str, FeatureValue] = {
            "Width": 640, "Height": 512, "OffsetX": 0, "OffsetY": 0, "PixelFormat": "Mono8", "ExposureTime": 10000.0,
            "Gain": 0.0, "TriggerSelector": "FrameStart", "TriggerMode": "Off", "TriggerSource": "Software",
        }  # fmt: skip
        self._queue: deque[Frame] = deque()
        self._delayed: Frame | None = None
        self._open = self._vanished = False
        self._block_id = 0
        self.n_taken = 0

    def open(self) -> None:
        """See ``Camera``."""
        if self.address in _HELD:
            raise InUseError(self.address, "it is open already", "close it there first")
        _HELD.add(self.address)
        self._open, self._vanished = True, False

    def close(self) -> None:
        """See ``Camera``."""
        if self._open:
            _HELD.discard(self.address)
        self._open = self._armed = False

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``."""
        self._require_there()
        if name == "DeviceSerialNumber":
            return self.serial
        if name not in self._features:
            raise self._unknown(name)
        return self._features[name]

    def set(self, name: str, value: FeatureValue) -> None:
        """See ``Camera``."""
        self._require_there()
        if name == "DeviceSerialNumber" or (self._armed and name in LOCKED_WHILE_ARMED):
            raise self._locked(name)
        if name in _CHOICES and value not in _CHOICES[name]:
            raise OutOfRangeError(self.address, f"{name} cannot be {value!r}", f"it takes {', '.join(_CHOICES[name])}")
        if name in _RANGES:
            low, high = _RANGES[name]
            if isinstance(value, str) or not low <= value <= high:
                raise OutOfRangeError(self.address, f"{name} cannot be {value!r}", f"it takes {low:g} to {high:g}")
        elif name not in _CHOICES:
            raise self._unknown(name)
        self._features[name] = value

    def _start(self) -> None:
        self._queue.clear()
        self._delayed, self._block_id = None, 0

    def pulse(self) -> None:
        """A pulse on Line1."""
        if self._armed and self.triggered and self._features["TriggerSource"] == "Line1":
            self._take()

    def _execute_trigger(self) -> None:
        self._require_there()
        self._take()

    def _skip_pending(self) -> None:
        self._queue.clear()

    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``."""
        self._require_there()
        self._require_armed("fetch")
        if not self._queue and not self.triggered:
            self._take()
        if not self._queue:
            time.sleep(timeout_s)
            self._require_there()
            raise self._late(timeout_s)
        frame = self._queue.popleft()
        if frame.complete:
            return frame
        raise self._incomplete(f"image {frame.block_id}", "simulated", frame)

    def _require_there(self) -> None:
        if self._vanished:
            raise self._gone()
        if not self._open:
            raise CameraError(self.address, "it is not open", "open it first")

    def _take(self) -> None:
        self.n_taken += 1
        kind = self._faults.get(self.n_taken)
        if kind == "disconnect":
            self._vanished = True
        if kind in ("timeout", "disconnect"):
            return
        self._block_id += 8 if kind == "wrong_id" else 1
        frame = self._exposed(complete=kind != "incomplete")
        late, self._delayed = self._delayed, None
        if kind == "swap":
            self._delayed = frame
        elif kind != "lost":
            self._queue.append(frame)
        if kind == "duplicate":
            self._queue.append(frame)
        if kind == "extra":
            self._block_id += 1
            self._queue.append(self._exposed())
        if late is not None:
            self._queue.append(late)

    def _exposed(self, complete: bool = True) -> Frame:
        exposure_us, gain = self._features["ExposureTime"], self._features["Gain"]
        image = self._source(float(exposure_us), float(gain))
        bits = bits_of(str(self._features["PixelFormat"]))
        x, y, width, height = (int(self._features[n]) for n in ("OffsetX", "OffsetY", "Width", "Height"))
        part = image[y : y + height, x : x + width]
        full = np.array(part, np.uint8) if bits == 8 else np.array(part, np.uint16) << np.uint16(bits - 8)
        return self._frame(full, self._block_id, time.monotonic_ns(), bits, complete)

    def _gradient(self, exposure_us: float, gain: float) -> GrayImage:
        height, width = int(self._features["Height"]), int(self._features["Width"])
        y, x = int(self._features["OffsetY"]), int(self._features["OffsetX"])
        rows, columns = np.arange(y + height) // 4, np.arange(x + width) // 4
        image = np.asarray((rows[:, None] + columns[None, :]) % 256, np.uint8)
        image[y, x : x + 4] = np.frombuffer(self.n_taken.to_bytes(4, "big"), np.uint8)
        return image
