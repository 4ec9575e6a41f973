"""Basler cameras through pypylon, its emulator (``PYLON_CAMEMU=3``) included."""

import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, cast

from capture.devices.camera import (
    CameraError,
    CameraInfo,
    DisconnectedError,
    FeatureValue,
    Frame,
    InUseError,
)
from capture.devices.cameras.features import bits_of, is_mosaic_or_gray
from capture.devices.cameras.genicam_camera import READY_S, GenicamCamera, values_taken

with warnings.catch_warnings():
    # SWIG's types have no __module__; where warnings are errors, that one ends the interpreter
    warnings.filterwarnings("ignore", "builtin type .* has no __module__ attribute", DeprecationWarning)
    from pypylon import genicam, pylon


def discover() -> tuple[CameraInfo, ...]:
    """All cameras that pylon's transport layers find."""
    factory = pylon.TlFactory.GetInstance()
    return tuple(_info(factory, device) for device in factory.EnumerateDevices())


def _info(factory: Any, device: Any) -> CameraInfo:
    serial = device.GetSerialNumber()
    in_use = not factory.IsDeviceAccessible(device)
    return CameraInfo(f"pylon:{serial}", device.GetVendorName(), device.GetModelName(), serial, in_use)


class PylonCamera(GenicamCamera):
    """A camera of pylon, by its serial number, user-defined name or IP address."""

    _refusals = (genicam.OutOfRangeException, genicam.InvalidArgumentException, genicam.AccessException, TypeError)

    def __init__(self, place: str) -> None:
        super().__init__("pylon", place)
        self._place = place
        self._class = ""
        self._bits, self._mono = 8, True

    def open(self) -> None:
        """See ``Camera``."""
        factory = pylon.TlFactory.GetInstance()
        device = self._find(factory)
        if not factory.IsDeviceAccessible(device):
            raise InUseError(self.address, "another program holds it", "close that program")
        with self._translated("open"):
            self._camera = pylon.InstantCamera(factory.CreateDevice(device))
            self._camera.Open()
        self.serial, self._class = device.GetSerialNumber(), device.GetDeviceClass()

    def _find(self, factory: Any) -> Any:
        devices = list(factory.EnumerateDevices())
        for device in devices:
            address = device.GetIpAddress() if device.IsIpAddressAvailable() else ""
            if self._place in (device.GetSerialNumber(), device.GetUserDefinedName(), address):
                return device
        seen = ", ".join(d.GetSerialNumber() for d in devices) or "none"
        found = f"pylon does not see it (serial numbers seen: {seen})"
        raise DisconnectedError(self.address, found, "check the cable, its power and the address")

    def close(self) -> None:
        """See ``Camera``."""
        if self._camera is not None:
            with suppress(genicam.GenericException):  # where it is gone already nothing is left to let go of
                self._camera.DestroyDevice()
        self._camera, self._armed = None, False

    @property
    def last_block_id(self) -> int | None:
        """65535 on GigE Vision without extended ids."""
        if self._class != "BaslerGigE":
            return None
        node = self._camera.GetNodeMap().GetNode("GevGVSPExtendedIDMode")
        return None if _readable(node) and node.Value == "On" else 65535

    def get(self, name: str) -> FeatureValue:
        """See ``Camera``."""
        return self.serial if name == "DeviceSerialNumber" else super().get(name)

    def _node(self, name: str) -> Any:
        node = self._camera.GetNodeMap().GetNode(name)
        return node if node is not None and genicam.IsImplemented(node) else None

    def _value(self, node: Any) -> FeatureValue:
        if not _readable(node):
            raise self._unknown(node.GetNode().GetName())
        return cast(FeatureValue, node.Value)

    def _write(self, node: Any, value: FeatureValue) -> None:
        node.Value = value

    def _is_locked(self, node: Any, refusal: Exception) -> bool:
        return isinstance(refusal, genicam.AccessException)

    def _takes(self, node: Any) -> str:
        limits = (node.Min, node.Max) if hasattr(node, "Min") else None
        return values_taken(getattr(node, "Symbolics", None), limits, getattr(node, "Inc", None))

    def _require_format(self, pixel_format: str) -> None:
        self._bits, self._mono = bits_of(pixel_format), is_mosaic_or_gray(pixel_format)

    def _receive(self) -> None:
        self._camera.StartGrabbing(pylon.GrabStrategy_OneByOne, pylon.GrabLoop_ProvidedByUser)

    def _stop(self) -> None:
        if self._camera is not None and self._camera.IsGrabbing():
            self._camera.StopGrabbing()

    def _execute(self, command: str) -> None:
        self._camera.GetNodeMap().GetNode(command).Execute()

    def _answers(self) -> bool:
        return not self._camera.IsCameraDeviceRemoved()  # the question takes 2 ms

    def _wait_until_ready(self) -> None:
        if self._source_armed == "Software" and self._camera.CanWaitForFrameTriggerReady():
            wait_ms = int(1e3 * READY_S)
            self._wait_for(lambda: self._camera.WaitForFrameTriggerReady(wait_ms, pylon.TimeoutHandling_Return))

    def fetch(self, timeout_s: float) -> Frame:
        """See ``Camera``."""
        self._require_armed("fetch")
        with self._translated("fetch"):
            result = self._camera.RetrieveResult(round(1e3 * timeout_s), pylon.TimeoutHandling_Return)
            if not result.IsValid():
                raise self._no_image(timeout_s)
            try:
                return self._frame_of(result)
            finally:
                result.Release()

    def _frame_of(self, result: Any) -> Frame:
        complete = bool(result.GrabSucceeded())  # an incomplete buffer may well have error code 0
        if complete and not self._mono:
            found = f"it sends colour ({self.get('PixelFormat')})"
            raise CameraError(self.address, found, "set PixelFormat to Mono8, Mono12 or Mono16")
        # Array is a copy already
        frame = self._frame(result.Array, int(result.BlockID), int(result.TimeStamp), self._bits, complete)
        if complete:
            return frame
        raise self._incomplete(f"image {frame.block_id}", result.ErrorDescription or "no reason given", frame)

    @contextmanager
    def _translated(self, what: str) -> Iterator[None]:
        try:
            yield
        except genicam.GenericException as error:
            if self._camera is not None and self._camera.IsCameraDeviceRemoved():
                raise self._gone() from error
            message = str(error).split(" : ")[0].strip()
            if "controlled by another application" in message or "already opened" in message:
                raise InUseError(self.address, "another program holds it", "close that program") from error
            raise CameraError(self.address, f"{what}: {message}", "see the camera's manual") from error


def _readable(node: Any) -> bool:
    return node is not None and bool(genicam.IsReadable(node))


camera = PylonCamera
