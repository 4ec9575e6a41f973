"""GigE Vision cameras without a maker's SDK: ``gige:IP`` or ``gige:SERIAL``."""

import time
from contextlib import suppress
from typing import Any

import viva_genicam as vg

from capture.devices.camera import CameraInfo
from capture.devices.cameras.features import OLDER_NAMES
from capture.devices.cameras.genicam_client import GenicamClientCamera, held_by_another, not_found

_DISCOVERY_MS = 300
# a camera lets go of a program that has died when it has heard nothing for 3 s, not even a question
_LEASE_S = 4.0
# registers of the GigE Vision bootstrap block, the same in every camera
_CONTROL_PRIVILEGE, _TICK_FREQUENCY = 0x0A00, 0x093C


def discover() -> tuple[CameraInfo, ...]:
    """All cameras that answer on the machine's networks, loopback included."""
    return tuple(_info(device) for device in vg.discover(timeout_ms=_DISCOVERY_MS, all=True))


def _info(device: Any) -> CameraInfo:
    serial, in_use = _look_at(device)
    return CameraInfo(f"gige:{device.ip}", device.manufacturer or "", device.model or "", serial, in_use)


def _look_at(device: Any) -> tuple[str, bool]:
    """Serial number, and whether a program controls it; by reading alone, which disturbs nobody."""
    with suppress(vg.GenicamError), vg.connect_gige(device, monitor=True) as watcher:
        in_use = any(watcher.read_register(_CONTROL_PRIVILEGE, 4))
        for name in ("DeviceSerialNumber", OLDER_NAMES["DeviceSerialNumber"]):
            if watcher.node_info(name) is not None:
                return watcher.get(name), in_use
        return "", in_use
    return "", False


class GigeCamera(GenicamClientCamera):
    """A GigE Vision camera, by its IP address, MAC address or serial number."""

    def __init__(self, place: str) -> None:
        super().__init__("gige", place)

    @property
    def last_block_id(self) -> int | None:
        """65535; a camera with extended ids counts on from there, which ``TriggerSet`` accepts as well."""
        return 65535

    def _connect(self) -> Any:
        place = self.address.partition(":")[2]
        devices = vg.discover(timeout_ms=_DISCOVERY_MS, all=True)
        device = next((d for d in devices if place in (d.ip, d.mac)), None)
        if device is None:
            device = next((d for d in devices if _look_at(d)[0] == place), None)
        if device is None:
            raise not_found(self.address, [d.ip for d in devices])
        if _look_at(device)[1]:
            time.sleep(_LEASE_S)
            if _look_at(device)[1]:
                raise held_by_another(self.address)
        try:
            connected = vg.connect_gige(device)
        except vg.GenicamError as error:
            raise not_found(self.address, [d.ip for d in devices]) from error
        self._ns_per_tick = _ns_per_tick(connected)
        return connected

    def _answers(self) -> bool:
        if self._camera is None or self._camera.control_state == vg.ControlState.LOST:
            return False
        try:
            # ours only while we hold it: after a restart of the camera it answers, but no more to us
            return any(self._camera.read_register(_CONTROL_PRIVILEGE, 4))
        except vg.GenicamError:
            return False


def _ns_per_tick(connected: Any) -> float:
    """From the register that says how many ticks a second has; 0 there: the camera has no clock to speak of."""
    with suppress(vg.GenicamError):
        frequency = int.from_bytes(connected.read_register(_TICK_FREQUENCY, 8), "big")
        return 1e9 / frequency if frequency else 1.0
    return 1.0


camera = GigeCamera
