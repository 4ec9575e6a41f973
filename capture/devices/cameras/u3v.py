"""USB3 Vision cameras without a maker's SDK: ``u3v:SERIAL``."""

from typing import Any

import viva_genicam as vg

from capture.devices.camera import CameraInfo
from capture.devices.cameras.genicam_client import GenicamClientCamera, held_by_another, not_found


def discover() -> tuple[CameraInfo, ...]:
    """All cameras on the machine's USB."""
    return tuple(
        CameraInfo(f"u3v:{d.serial}", d.manufacturer or "", d.model or "", d.serial or "") for d in _devices()
    )


def _devices() -> list[Any]:
    try:
        return list(vg.discover_u3v())
    except vg.TransportError:  # a machine without USB
        return []


class U3vCamera(GenicamClientCamera):
    """A USB3 Vision camera; block ids have 64 bits, time stamps are in ns.

    connect: gives the client's camera, in place of a look on USB.
    """

    def __init__(self, place: str, connect: Any = None) -> None:
        super().__init__("u3v", place)
        self._connect_to = connect

    def _connect(self) -> Any:
        if self._connect_to is not None:
            return self._connect_to()
        place = self.address.partition(":")[2]
        devices = _devices()
        device = next((d for d in devices if d.serial == place), None)
        if device is None:
            raise not_found(self.address, [str(d.serial) for d in devices])
        try:
            return vg.connect_u3v(device)
        except vg.GenicamError as error:
            raise held_by_another(self.address) from error

    def _answers(self) -> bool:
        if self._camera is None:
            return False
        try:
            self._camera.invalidate("PixelFormat")
            self._camera.get("PixelFormat")
        except vg.GenicamError:
            return False
        return True


camera = U3vCamera
