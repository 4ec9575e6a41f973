"""Standa's 8SMC controllers through the maker's libximc, one controller an axis.

Addresses are libximc's: xi-com:///dev/ttyACM0, xi-net://host/serial, xi-emu:///path (a virtual controller). Positions
go as whole steps and microsteps, because the calls in degrees carry 24 bits only.
"""

import contextlib
from collections.abc import Sequence
from typing import Any

from capture.devices.turntable import AxisState, ControllerError, TableDisconnectedError, TurntableError
from capture.devices.turntables.by_axis import ByAxis
from survey.folder.extras import library

_FAULTS = (
    ("STATE_ALARM", "alarm"),
    ("STATE_POWER_OVERHEAT", "power driver overheated"),
    ("STATE_CONTROLLER_OVERHEAT", "controller overheated"),
    ("STATE_H_BRIDGE_FAULT", "bridge fault"),
    ("STATE_ENCODER_FAULT", "encoder fault"),
    ("STATE_CTP_ERROR", "steps and encoder disagree"),
    ("STATE_ENGINE_RESPONSE_ERROR", "motor does not respond"),
)


class StandaController(ByAxis):
    """A ``Controller``: one libximc device per axis; rad_per_step: per full step."""

    def __init__(
        self, uris: Sequence[str], rad_per_step: Sequence[float], signs: Sequence[int], zeros: Sequence[float]
    ) -> None:
        super().__init__(uris, signs, zeros)
        self._steps = tuple(rad_per_step)
        self._devices: list[Any] = []
        self._micro: list[int] = []

    def open(self) -> None:
        """Open every axis; nothing moves."""
        ximc = library("libximc.highlevel", "standa", "Standa's controllers need libximc", TurntableError)
        for uri in self._addresses:
            device = ximc.Axis(uri)
            try:
                device.open_device()
            except ConnectionError as error:
                self.close()
                raise TableDisconnectedError(
                    f"{uri}: cannot be opened; check cable, power and address, and that no other program holds it"
                ) from error
            self._devices.append(device)
            # MicrostepMode n means 2**(n - 1) microsteps a step
            self._micro.append(2 ** (int(device.get_engine_settings().MicrostepMode) - 1))

    def close(self) -> None:
        """Close every axis."""
        devices, self._devices, self._micro = self._devices, [], []
        for device in devices:
            with contextlib.suppress(RuntimeError, ConnectionError):
                device.close_device()

    def read(self, axis: int) -> AxisState:
        """Position, motion and alarms."""
        from libximc.highlevel import MoveState, StateFlags

        status = self._call(axis, "get_status")
        steps = status.CurPosition + status.uCurPosition / self._micro[axis]
        flags = int(status.Flags)
        fault = [text for name, text in _FAULTS if flags & int(StateFlags[name])]
        moving = bool(int(status.MoveSts) & int(MoveState.MOVE_STATE_MOVING))
        angle = self._signs[axis] * steps * self._steps[axis] + self._zeros[axis]
        return AxisState(angle, moving, ", ".join(fault) or None)

    def move(self, axis: int, angle: float, delta: float) -> None:
        """Send an axis off."""
        micro = self._micro[axis] if self._devices else 1
        steps = self._signs[axis] * (angle - self._zeros[axis]) / self._steps[axis]
        total = round(steps * micro)
        whole = int(total / micro)  # towards zero: the microsteps carry the same sign
        self._call(axis, "command_move", whole, total - whole * micro)

    def _stop(self, axis: int) -> None:
        self._call(axis, "command_stop")

    def home(self, axis: int) -> None:
        """The controller's own search, as set up with the maker's program."""
        self._call(axis, "command_home")

    def _call(self, axis: int, name: str, *values: Any) -> Any:
        if not self._devices:
            raise TableDisconnectedError(f"{self._addresses[axis]}: not connected; open it first")
        try:
            return getattr(self._devices[axis], name)(*values)
        except ConnectionError as error:
            raise TableDisconnectedError(f"{self._addresses[axis]}: does not answer; check cable and power") from error
        except (RuntimeError, ValueError, NotImplementedError) as error:
            found = f"{self._addresses[axis]}: {name} failed ({str(error).splitlines()[0]})"
            raise ControllerError(f"{found}; see the maker's manual") from error
