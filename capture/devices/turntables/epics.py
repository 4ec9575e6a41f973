"""EPICS motor records through ophyd: one record an axis, by its prefix (lab:table:m1).

ophyd's EpicsMotor gives the record its fields; the moves are watched by ``MovingTable`` as for every other driver, so
that limits, settling and stops are the same.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from capture.devices.turntable import AxisState, ControllerError, TableDisconnectedError, TurntableError
from capture.devices.turntables.by_axis import ByAxis
from survey.folder.extras import library

_CONNECT_S = 5.0
_UNITS = {"deg": np.pi / 180, "degree": np.pi / 180, "degrees": np.pi / 180, "rad": 1.0, "mrad": 1e-3, "": np.pi / 180}


class EpicsController(ByAxis):
    """A ``Controller``: a motor record per axis. units: as EGU writes them; None: as the record's EGU says."""

    def __init__(
        self, prefixes: Sequence[str], signs: Sequence[int], zeros: Sequence[float], units: str | None = None
    ) -> None:
        super().__init__(prefixes, signs, zeros)
        self._given = units
        self._units: list[float] = []
        self._motors: list[Any] = []

    def open(self) -> None:
        """Connect to the records; nothing moves."""
        motor_class = library("ophyd", "epics", "EPICS motors need ophyd", TurntableError).EpicsMotor
        motors = [motor_class(prefix, name=f"axis{i + 1}") for i, prefix in enumerate(self._addresses)]
        self._motors = motors
        for prefix, motor in zip(self._addresses, motors, strict=True):
            try:
                motor.wait_for_connection(timeout=_CONNECT_S)
            except TimeoutError as error:
                self.close()
                advice = "check that the IOC runs and EPICS_CA_ADDR_LIST reaches it"
                raise TableDisconnectedError(f"{prefix}: no motor record within {_CONNECT_S:g} s; {advice}") from error
        self._units = [self._unit(i) for i in range(len(motors))]

    def _unit(self, axis: int) -> float:
        unit = self._given if self._given is not None else str(self._call(axis, lambda m: m.motor_egu.get()))
        if unit.strip().lower() not in _UNITS:
            raise TurntableError(f"{self._addresses[axis]}: its unit is {unit!r}; set EGU to deg, or units in the plan")
        return float(_UNITS[unit.strip().lower()])

    def close(self) -> None:
        """Let go of the records."""
        motors, self._motors = self._motors, []
        for motor in motors:
            motor.destroy()

    def read(self, axis: int) -> AxisState:
        """Readback, motion and limit switches, asked for anew."""
        value = self._call(axis, lambda m: m.user_readback.get(use_monitor=False))
        done = self._call(axis, lambda m: m.motor_done_move.get(use_monitor=False))
        high = self._call(axis, lambda m: m.high_limit_switch.get(use_monitor=False))
        low = self._call(axis, lambda m: m.low_limit_switch.get(use_monitor=False))
        fault = "upper limit switch" if high else "lower limit switch" if low else None
        angle = self._signs[axis] * float(value) * self._units[axis] + self._zeros[axis]
        return AxisState(angle, not done, fault)

    def move(self, axis: int, angle: float, delta: float) -> None:
        """Write VAL."""
        value = self._signs[axis] * (angle - self._zeros[axis]) / self._units[axis]
        low = self._call(axis, lambda m: m.low_limit_travel.get())
        high = self._call(axis, lambda m: m.high_limit_travel.get())
        if low < high and not low <= value <= high:  # equal limits mean none, by the record's own rule
            raise ControllerError(
                f"{self._addresses[axis]}: {value:.6g} is outside the record's own limits {low:g} to {high:g}; "
                "nothing was sent to this axis"
            )
        self._call(axis, lambda m: m.user_setpoint.put(value, wait=False))

    def _stop(self, axis: int) -> None:
        self._call(axis, lambda m: m.motor_stop.put(1, wait=False))

    def home(self, axis: int) -> None:
        """Write HOMF."""
        self._call(axis, lambda m: m.home_forward.put(1, wait=False))

    def _call(self, axis: int, action: Any) -> Any:
        if not self._motors:
            raise TableDisconnectedError(f"{self._addresses[axis]}: not connected; open it first")
        from ophyd.utils import DisconnectedError

        try:
            return action(self._motors[axis])
        except (DisconnectedError, TimeoutError) as error:
            raise TableDisconnectedError(f"{self._addresses[axis]}: does not answer; check the IOC") from error
