"""Any camera whose maker gives a GenTL producer (.cti), through harvesters.

``gentl:SERIAL`` looks through the producers in GENICAM_GENTL64_PATH, ``gentl:/path/to/file.cti#SERIAL`` names one.
"""

import atexit
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from genicam import genapi, gentl
from harvesters.core import Harvester, ImageAcquirer

from capture.devices.camera import (
    CameraError,
    CameraInfo,
    DisconnectedError,
    FeatureValue,
    Frame,
    InUseError,
    UnknownFeatureError,
)
from capture.devices.cameras.features import bits_of, gray_copy, is_mosaic_or_gray
from capture.devices.cameras.genicam_camera import GenicamCamera, values_taken

_BUFFERS = 8
# a producer can be loaded once in a process, so its harvester stays until the end
_HARVESTERS: dict[tuple[str, ...], Harvester] = {}
_OPEN: set[tuple[tuple[str, ...], str]] = set()


def discover() -> tuple[CameraInfo, ...]:
    """The cameras of all producers in GENICAM_GENTL64_PATH."""
    return discover_in(_producers())


def discover_in(producers: tuple[str, ...]) -> tuple[CameraInfo, ...]:
    """The cameras of these producers (.cti files)."""
    prefix = f"{producers[0]}#" if len(producers) == 1 else ""
    devices = _harvester(producers).device_info_list
    return tuple(
        CameraInfo(f"gentl:{prefix}{d.serial_number}", d.vendor, d.model, d.serial_number, _is_held(producers, d))
        for d in devices
    )


def _producers() -> tuple[str, ...]:
    folders = [Path(p) for p in os.environ.get("GENICAM_GENTL64_PATH", "").split(os.pathsep) if p]
    return tuple(sorted(str(file) for folder in folders for file in folder.glob("*.cti")))


def _harvester(producers: tuple[str, ...]) -> Harvester:
    if producers not in _HARVESTERS:
        harvester = Harvester()
        for file in producers:
            harvester.add_file(file)
        _HARVESTERS[producers] = harvester
        atexit.register(harvester.reset)
    if not any(held == producers for held, _ in _OPEN):  # looking for new cameras would cut off the open ones
        _HARVESTERS[producers].update()
    return _HARVESTERS[producers]


def _is_held(producers: tuple[str, ...], device: Any) -> bool:
    """By us, or by another program: neither unknown (0) nor readable and writable (1)."""
    return (producers, device.serial_number) in _OPEN or device.access_status not in (0, 1)


class GentlCamera(GenicamCamera):
    """A camera of a GenTL producer."""

    _refusals = (genapi.OutOfRangeException, genapi.InvalidArgumentException, genapi.AccessException, TypeError)

    def __init__(self, place: str) -> None:
        super().__init__("gentl", place)
        file, found, serial = place.rpartition("#")
        self._producers = (file,) if found else _producers()
        self._wanted = serial
        self._lost_parts = False

    def open(self) -> None:
        """See ``Camera``."""
        if missing := [p for p in self._producers if not Path(p).is_file()]:
            raise DisconnectedError(self.address, f"there is no {missing[0]}", "correct the path to the producer")
        with self._translated("open"):
            harvester = _harvester(self._producers)
        seen = [d.serial_number for d in harvester.device_info_list]
        if self._wanted not in seen:
            found = f"no producer sees it (producers: {len(self._producers)}, cameras: {', '.join(seen) or 'none'})"
            raise DisconnectedError(self.address, found, "check cable and power, and GENICAM_GENTL64_PATH")
        with self._translated("open"):
            self._camera = harvester.create({"serial_number": self._wanted})
            self._camera.num_buffers = _BUFFERS
            self._camera.add_callback(ImageAcquirer.Events.INCOMPLETE_BUFFER, self._note_lost_parts)
        self.serial = self._wanted
        _OPEN.add((self._producers, self.serial))

    def close(self) -> None:
        """See ``Camera``."""
        acquirer, self._camera = self._camera, None
        self._armed = False
        if acquirer is not None:
            _OPEN.discard((self._producers, self.serial))
            with suppress(gentl.GenericException, genapi.GenericException):
                acquirer.destroy()

    def _note_lost_parts(self) -> None:
        self._lost_parts = True

    @property
    def _nodes(self) -> Any:
        return self._camera.remote_device.node_map

    def _node(self, name: str) -> Any:
        return self._nodes.get_node(name) if self._nodes.has_node(name) else None

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``; some cameras tell their serial number to the producer alone."""
        try:
            return super().get(name)
        except UnknownFeatureError:
            if name != "DeviceSerialNumber":
                raise
            return self.serial

    def _value(self, node: Any) -> FeatureValue:
        return cast(FeatureValue, node.value)

    def _write(self, node: Any, value: FeatureValue) -> None:
        node.value = value

    def _is_locked(self, node: Any, refusal: Exception) -> bool:
        return isinstance(refusal, genapi.AccessException)

    def _takes(self, node: Any) -> str:
        limits = (node.min, node.max) if hasattr(node, "min") else None
        return values_taken(getattr(node, "symbolics", None), limits, None)

    def _require_format(self, pixel_format: str) -> None:
        if not is_mosaic_or_gray(pixel_format) or pixel_format.endswith(("p", "Packed")):
            advice = "set PixelFormat to Mono8, Mono10, Mono12 or Mono16, not packed"
            raise CameraError(self.address, f"it sends {pixel_format}", advice)

    def _receive(self) -> None:
        self._camera.start()
        self._lost_parts = False

    def _stop(self) -> None:
        if self._camera is not None and self._camera.is_acquiring():
            self._camera.stop()

    def _execute(self, command: str) -> None:
        self._nodes.get_node(command).execute()

    def _wait_until_ready(self) -> None:
        nodes = self._nodes
        if nodes.has_node("AcquisitionStatus"):
            nodes.AcquisitionStatusSelector.value = "FrameTriggerWait"
            self._wait_for(lambda: nodes.AcquisitionStatus.value)

    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``."""
        self._require_armed("fetch")
        self._lost_parts = False
        with self._translated("fetch"):
            # harvesters takes 0 for "without end"; it gives None after the time and for a buffer with missing parts
            buffer = self._camera.try_fetch(timeout=max(timeout_s, 1e-3))
            if buffer is None:
                raise self._incomplete("an image", "its number is lost") if self._lost_parts else self._late(timeout_s)
            with buffer:
                return self._frame_of(buffer)

    def _frame_of(self, buffer: Any) -> Frame:
        part = buffer.payload.components[0]
        image = gray_copy(part.data.reshape(part.height, part.width))
        return self._frame(image, int(buffer.frame_id), _time_stamp_ns(buffer), bits_of(part.data_format))

    @contextmanager
    def _translated(self, what: str) -> Iterator[None]:
        try:
            yield
        except (gentl.ResourceInUseException, gentl.AccessDeniedException) as error:
            raise InUseError(self.address, "another program holds it", "close that program") from error
        except (gentl.IoException, gentl.InvalidHandleException, gentl.ClosedException) as error:
            raise self._gone() from error
        except (gentl.GenericException, genapi.GenericException) as error:
            message = str(error).split(" : ")[0].strip()
            raise CameraError(self.address, f"{what}: {message}", "see the camera's manual") from error


def _time_stamp_ns(buffer: Any) -> int | None:
    try:
        return int(buffer.timestamp_ns)
    except gentl.GenericException:  # the device has no clock
        return None


camera = GentlCamera
