"""Standa's 8SMC controllers through the maker's libximc, one controller an axis.

Addresses are libximc's: xi-com:///dev/ttyACM0, xi-net://host/serial, xi-emu:///path (a virtual controller). Positions
go as whole steps and microsteps, because the calls in degrees carry 24 bits only.
"""

import contextlib
from collections.abc import Sequence
from typing import Any

from capture.devices.turntable import AxisState, ControllerError, TableDisconnectedError, TurntableError

_FAULTS = (
    ("STATE_ALARM", "alarm"),
    ("STATE_POWER_OVERHEAT", "power driver overheated"),
    ("STATE_CONTROLLER_OVERHEAT", "controller overheated"),
    ("STATE_H_BRIDGE_FAULT", "bridge fault"),
    ("STATE_ENCODER_FAULT", "encoder fault"),
    ("STATE_CTP_ERROR", "steps and encoder disagree"),
    ("STATE_ENGINE_RESPONSE_ERROR", "motor does not respond"),
)


class StandaController:
    """A ``Controller``: one libximc device per axis; rad_per_step: per full step."""

    def __init__(
        self, uris: Sequence[str], rad_per_step: Sequence[float], signs: Sequence[int], zeros: Sequence[float]
    ) -> None:
        self._uris, self._steps = tuple(uris), tuple(rad_per_step)
        self._signs, self._zeros = tuple(signs), tuple(zeros)
        self._devices: list[Any] = []
        self._micro: list[int] = []

    @property
    def address(self) -> str:
        """The URIs."""
        return " ".join(self._uris)

    @property
    def modulo(self) -> float | None:
        """It counts steps, and so turns."""
        return None

    def open(self) -> None:
        """Open every axis; nothing moves."""
        ximc = _highlevel()
        for uri in self._uris:
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

    def stop(self) -> None:
        """Stop every axis, the others too where one does not answer."""
        problem: TurntableError | None = None
        for axis in range(len(self._uris)):
            try:
                self._call(axis, "command_stop")
            except TurntableError as error:
                problem = error
        if problem is not None:
            raise problem

    def home(self, axis: int) -> None:
        """The controller's own search, as set up with the maker's program."""
        self._call(axis, "command_home")

    def _call(self, axis: int, name: str, *values: Any) -> Any:
        if not self._devices:
            raise TableDisconnectedError(f"{self._uris[axis]}: not connected; open it first")
        try:
            return getattr(self._devices[axis], name)(*values)
        except ConnectionError as error:
            raise TableDisconnectedError(f"{self._uris[axis]}: does not answer; check cable and power") from error
        except (RuntimeError, ValueError, NotImplementedError) as error:
            found = str(error).splitlines()[0]
            raise ControllerError(f"{self._uris[axis]}: {name} failed ({found}); see the maker's manual") from error


def _highlevel() -> Any:
    try:
        import libximc.highlevel as ximc
    except ImportError as error:
        advice = "pip install 'labsurvey[standa]'"
        raise TurntableError(f"Standa's controllers need libximc, which is not installed; {advice}") from error
    return ximc
