"""GigE Vision and USB3 Vision cameras without a maker's SDK, through viva-genicam."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, cast

import viva_genicam as vg

from capture.devices.camera import (
    CameraError,
    DisconnectedError,
    FeatureValue,
    Frame,
    GrayImage,
    IncompleteFrameError,
    InUseError,
)
from capture.devices.cameras.features import bits_of, is_mosaic_or_gray
from capture.devices.cameras.genicam_camera import GenicamCamera, values_taken


class GenicamClientCamera(GenicamCamera):
    """What is common to both transports; ``_connect`` and ``_answers`` differ."""

    _refusals = (vg.GenApiError, vg.ParseError)

    def __init__(self, driver: str, place: str) -> None:
        super().__init__(driver, place)
        self._stream: Any = None
        self._ns_per_tick = 1.0

    def _connect(self) -> Any:
        raise NotImplementedError

    def open(self) -> None:
        """See ``Camera``."""
        self._camera = self._connect()
        with suppress(CameraError):
            self.serial = str(self.get("DeviceSerialNumber"))

    def close(self) -> None:
        """See ``Camera``."""
        with suppress(CameraError, vg.GenicamError):
            self.disarm()
        if self._camera is not None:
            with suppress(vg.GenicamError):
                self._camera.close()
        self._camera = None

    def _node(self, name: str) -> str | None:
        return None if self._camera.node_info(name) is None else name

    def _value(self, node: str) -> FeatureValue:
        return cast(FeatureValue, self._camera.feature_state(node).value)

    def _write(self, node: str, value: FeatureValue) -> None:
        if isinstance(value, bool):
            self._camera.set_bool(node, value)
        else:
            self._camera.set(node, str(value))

    def _is_locked(self, node: str, refusal: Exception) -> bool:
        if not self._answers():
            raise self._gone() from refusal
        return "W" not in self._camera.feature_state(node).access

    def _takes(self, node: str) -> str:
        state = self._camera.feature_state(node)
        if state.range is None and not state.enum_entries:
            return f"it takes a value of kind {state.kind}"
        limits, step = (None, None) if state.range is None else ((state.range.min, state.range.max), state.range.inc)
        return values_taken(state.enum_entries, limits, step)

    def _require_format(self, pixel_format: str) -> None:
        if not is_mosaic_or_gray(pixel_format):
            raise CameraError(self.address, f"it sends colour ({pixel_format})", "set PixelFormat to Mono8 or Mono12")

    def _receive(self) -> None:
        # incomplete ones too, to tell them from images that never came
        self._stream = self._camera.stream(deliver_incomplete=True)
        self._stream.__enter__()

    def _stop(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.__exit__(None, None, None)

    def _execute(self, command: str) -> None:
        self._camera.execute(command)

    def _wait_until_ready(self) -> None:
        if self._camera.node_info("AcquisitionStatus") is not None:
            self._camera.set_enum("AcquisitionStatusSelector", "FrameTriggerWait")
            self._wait_for(lambda: self._camera.get_bool("AcquisitionStatus"))

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

    @contextmanager
    def _translated(self, what: str) -> Iterator[None]:
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
