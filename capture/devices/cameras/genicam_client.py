"""GigE Vision and USB3 Vision cameras without a maker's SDK, through viva-genicam."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, cast

import viva_genicam as vg

from capture.devices.camera import (
    CameraError,
    DisconnectedError,
    FeatureValue,
    FetchTimeoutError,
    Frame,
    GrayImage,
    IncompleteFrameError,
    InUseError,
    OutOfRangeError,
)
from capture.devices.cameras.base import (
    LOCKED_WHILE_ARMED,
    OLDER_NAMES,
    READY_S,
    DriverCamera,
    bits_of,
    is_mosaic_or_gray,
)


class GenicamClientCamera(DriverCamera):
    """What is common to both transports; ``_connect`` and ``_answers`` differ."""

    def __init__(self, driver: str, place: str) -> None:
        super().__init__(driver, place)
        self._camera: Any = None
        self._stream: Any = None
        self._ns_per_tick = 1.0

    def _connect(self) -> Any:
        raise NotImplementedError

    def _answers(self) -> bool:
        raise NotImplementedError

    def open(self) -> None:
        """See ``Camera``."""
        self._camera = self._connect()
        with suppress(CameraError):
            self._serial = str(self.get("DeviceSerialNumber"))

    def close(self) -> None:
        """See ``Camera``."""
        with suppress(CameraError, vg.GenicamError):
            self.disarm()
        if self._camera is not None:
            with suppress(vg.GenicamError):
                self._camera.close()
        self._camera = None

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``."""
        with self._translated(name):
            return cast(FeatureValue, self._state(self._found(name)).value)

    def set(self, name: str, value: FeatureValue) -> None:
        """See ``Camera``."""
        found = self._found(name)
        if self._armed and name in LOCKED_WHILE_ARMED:
            raise self._locked(name)
        with self._translated(name):
            try:
                self._write(found, value)
            except (vg.GenApiError, vg.ParseError) as error:
                if not self._answers():
                    raise self._gone() from error
                state = self._state(found)
                if "W" not in state.access:
                    raise self._locked(name) from error
                raise OutOfRangeError(self.address, f"{name} cannot be {value!r}", _range(state)) from error

    def _write(self, name: str, value: FeatureValue) -> None:
        if isinstance(value, bool):
            self._camera.set_bool(name, value)
        else:
            self._camera.set(name, str(value))

    def _found(self, name: str) -> str:
        """The name by which this camera knows the feature."""
        if self._camera is None:
            raise CameraError(self.address, "it is not open", "open it first")
        with self._translated(name):
            for candidate in (name, OLDER_NAMES.get(name, name)):
                if self._camera.node_info(candidate) is not None:
                    return candidate
        raise self._unknown(name)

    def _state(self, name: str) -> Any:
        return self._camera.feature_state(name)

    def arm(self) -> None:
        """See ``Camera``."""
        self.disarm()
        self._note_trigger()
        pixel_format = str(self.get("PixelFormat"))
        if not is_mosaic_or_gray(pixel_format):
            raise CameraError(self.address, f"it sends colour ({pixel_format})", "set PixelFormat to Mono8 or Mono12")
        with self._translated("arm"):
            # incomplete ones too, to tell them from images that never came
            self._stream = self._camera.stream(deliver_incomplete=True)
            self._stream.__enter__()
            self._armed = True
            if self.triggered:
                self._wait_until_ready()
        self._drain()

    def _wait_until_ready(self) -> None:
        """Cameras that can tell whether they wait for a trigger are asked."""
        if self._camera.node_info("AcquisitionStatus") is not None:
            self._camera.set_enum("AcquisitionStatusSelector", "FrameTriggerWait")
            self._wait_for(lambda: self._camera.get_bool("AcquisitionStatus"))

    def disarm(self) -> None:
        """See ``Camera``."""
        self._armed = False
        stream, self._stream = self._stream, None
        if stream is not None:
            with self._translated("disarm"):
                stream.__exit__(None, None, None)

    def _execute_trigger(self) -> None:
        with self._translated("trigger"):
            self._wait_until_ready()
            self._camera.execute("TriggerSoftware")

    def _skip_pending(self) -> None:
        with suppress(FetchTimeoutError):
            while True:
                self.fetch(0.0)
        self.fetch(READY_S)  # its exposure began before the call

    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``."""
        self._require_armed("fetch")
        try:
            received = self._stream.next_frame(round(1e3 * timeout_s))
        except vg.TransportError as error:
            raise self._no_image(timeout_s) from error
        except vg.GenicamError as error:
            raise CameraError(self.address, f"fetch: {error}", "disarm and arm it again") from error
        if received is None:
            raise self._gone()
        if not received.is_complete:
            raise self._part(received)
        return self._converted(received, complete=True)

    def _converted(self, received: Any, complete: bool) -> Frame:
        image = cast(GrayImage, received.to_numpy())
        ticks = received.ts_dev
        device_time_ns = None if not ticks else round(ticks * self._ns_per_tick)
        return self._frame(image, received.block_id, device_time_ns, bits_of(received.pixel_format), complete)

    def _part(self, received: Any) -> IncompleteFrameError:
        missing, frame = received.missing_packets, None
        with suppress(vg.GenicamError):  # where the end is missing it is no image
            frame = self._converted(received, complete=False)
        why = f"{missing} packets are missing" if missing else f"status {received.status.value}"
        return self._incomplete(f"image {received.block_id}", why, frame)

    def _no_image(self, timeout_s: float) -> CameraError:
        if timeout_s > 0.0 and not self._answers():
            return self._gone()
        return self._late(timeout_s)

    @contextmanager
    def _translated(self, what: str) -> Iterator[None]:
        """The client's exceptions as ours."""
        try:
            yield
        except vg.GenicamError as error:
            if not self._answers():
                raise self._gone() from error
            raise CameraError(self.address, f"{what}: {error}", "see the camera's manual") from error


def not_found(address: str, seen: list[str]) -> DisconnectedError:
    """No camera answers at that address."""
    found = f"nothing answers there (seen: {', '.join(seen) or 'no camera at all'})"
    return DisconnectedError(address, found, "check cable, power and address")


def held_by_another(address: str) -> InUseError:
    """Another program controls the camera."""
    return InUseError(address, "another program controls it", "close that program")


def _range(state: Any) -> str:
    """What the feature takes, in words."""
    if state.enum_entries:
        return f"it takes {', '.join(state.enum_entries)}"
    if state.range is not None:
        step = f" in steps of {state.range.inc:g}" if state.range.inc else ""
        return f"it takes {state.range.min:g} to {state.range.max:g}{step}"
    return f"it takes a value of kind {state.kind}"
