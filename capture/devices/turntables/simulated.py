"""A simulated controller in this process, with faults that tests and drills can inject."""

import time
from collections.abc import Sequence

import numpy as np

from capture.devices.turntable import AxisState, ControllerError, TableDisconnectedError
from capture.devices.turntables.simulated_axis import AxisPhysics, SimulatedAxis


class SimulatedController:
    """A ``Controller`` without hardware. ``received`` lists the commands that arrived, with their monotonic time."""

    def __init__(self, physics: Sequence[AxisPhysics], seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        self.simulated = [SimulatedAxis(p, rng) for p in physics]
        self.received: list[tuple[float, str]] = []
        self.cut = False  # a pulled cable: nothing is answered until it is False again
        self._connected = False
        self.address = "simulated"
        self.modulo: float | None = 2 * np.pi if physics[0].turns_lost else None

    def open(self) -> None:
        """Connect."""
        if self.cut:
            raise TableDisconnectedError("simulated: the cable is pulled; plug it in")
        self._connected = True

    def close(self) -> None:
        """Disconnect."""
        self._connected = False

    def _require_connection(self) -> None:
        if self.cut or not self._connected:
            self._connected = False
            raise TableDisconnectedError("simulated: no connection; plug the cable in")

    def read(self, axis: int) -> AxisState:
        """Where an axis is now."""
        self._require_connection()
        now = time.monotonic()
        simulated = self.simulated[axis]
        return AxisState(simulated.encoder(now), simulated.moving(now), simulated.fault)

    def move(self, axis: int, angle: float, delta: float) -> None:
        """Send an axis off."""
        self._require_connection()
        simulated = self.simulated[axis]
        if simulated.fault:
            raise ControllerError(f"simulated: axis {axis + 1} has a fault: {simulated.fault}; clear it")
        now = time.monotonic()
        self.received.append((now, f"move {axis} {angle!r}"))
        simulated.move(now, angle)

    def stop(self) -> None:
        """Stop all axes."""
        self._require_connection()
        now = time.monotonic()
        self.received.append((now, "stop"))
        for simulated in self.simulated:
            simulated.stop(now)

    def home(self, axis: int) -> None:
        """Go to the reference and call it zero."""
        self._require_connection()
        now = time.monotonic()
        self.received.append((now, f"home {axis}"))
        self.simulated[axis].move(now, self.simulated[axis].physics.home_at)
