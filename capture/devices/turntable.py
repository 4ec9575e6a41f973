"""What turntables are made of: axes with their limits, moves, controllers, and the ways in which they fail.

Angles are radians, one per axis, outermost first; they count whole turns, because a cable does. Drivers are in
``capture.devices.turntables``, over which ``MovingTable`` is the turntable of a session.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray

TURN = 2 * math.pi
_HAIR = 1e-9  # rad; a limit written in degrees is not missed for its last digit


class TurntableError(SurveyError):
    """Something is wrong with a turntable; the message says which axis, what was found and what to do."""


class LimitError(TurntableError):
    """A position outside the limits was asked for; nothing has been sent."""


class TableDisconnectedError(TurntableError):
    """The controller does not answer any more, or was never reached."""


class ControllerError(TurntableError):
    """The controller refused a command or reports a fault."""


class StalledError(TurntableError):
    """An axis should move and does not, or stands still away from where it was sent."""


class NotSettledError(TurntableError):
    """The readback did not come to rest within the time."""


class StoppedError(TurntableError):
    """The move was ended by ``stop``."""


@frozen
class Axis:
    """An axis and how far it may turn, rad; the limits count whole turns and so guard the cable too.

    wraps: an angle may be reached with any number of whole turns; the nearest that the limits allow is taken.
    speed, acceleration: rad/s and rad/s^2, for estimates of time only.
    """

    name: str
    lower: float
    upper: float
    wraps: bool = False
    speed: float = math.radians(20.0)
    acceleration: float = math.radians(40.0)

    def target(self, angle: float, current: float) -> float:
        """Where to go for ``angle`` when at ``current``; raises LimitError. Both and the result count turns."""
        if not math.isfinite(angle):
            raise LimitError(f"axis {self.name!r}: {angle} is not an angle; nothing was sent")
        if not self.wraps:
            self.check(angle)
            return angle
        first = math.ceil((self.lower - _HAIR - angle) / TURN)
        last = math.floor((self.upper + _HAIR - angle) / TURN)
        if first > last:
            self.check(angle, " plus any number of whole turns")
        nearest = round((current - angle) / TURN)
        return angle + TURN * min(max(nearest, first), last)

    def check(self, angle: float, more: str = "") -> None:
        """Raise LimitError where the angle is outside the limits."""
        if not self.lower - _HAIR <= angle <= self.upper + _HAIR:
            low, high = math.degrees(self.lower), math.degrees(self.upper)
            raise LimitError(
                f"axis {self.name!r}: {math.degrees(angle):.4f} deg{more} is outside its limits {low:.4f} to "
                f"{high:.4f} deg; nothing was sent; correct the pose, or limits_deg in the plan if the table allows it"
            )

    def duration(self, angle: float) -> float:
        """Seconds for a turn by ``angle`` from rest to rest, with a trapezoid of speed."""
        way = abs(angle)
        if way < self.speed**2 / self.acceleration:
            return 2 * math.sqrt(way / self.acceleration)
        return way / self.speed + self.speed / self.acceleration


@frozen(eq=False)
class Location:
    """Where a table was sent and where it says it is, (n,) rad each, and when; ``setpoint`` is nan before any move."""

    setpoint: FloatArray
    readback: FloatArray
    monotonic_ns: int
    time_ns: int


@frozen
class Settle:
    """How the readback tells that an axis has come to rest; angles in rad.

    tolerance: farthest from the setpoint. still: largest spread of the readback over ``window_s``. stall_s: an axis
    that has turned less than ``still`` in this time and is not there has stalled. poll_s: time between two looks.
    """

    tolerance: float = math.radians(0.05)
    still: float = math.radians(0.01)
    window_s: float = 0.3
    stall_s: float = 1.0
    timeout_s: float = 120.0
    poll_s: float = 0.01


@frozen
class AxisState:
    """What a controller says of an axis: angle (rad, in the controller's count of turns), and a fault in its words."""

    angle: float
    moving: bool
    fault: str | None = None


class Controller(Protocol):
    """What a driver gives: plain exchanges with a controller, called by one thread at a time; angles in rad.

    All raise TableDisconnectedError, and ControllerError where the controller refuses.
    """

    address: str
    """For messages."""
    modulo: float | None
    """After what angle its readback starts anew (rad); None where it counts turns."""

    def open(self) -> None:
        """Connect."""
        ...

    def close(self) -> None:
        """Disconnect; never raises."""
        ...

    def read(self, axis: int) -> AxisState:
        """Ask where an axis is."""
        ...

    def move(self, axis: int, angle: float, delta: float) -> None:
        """Send an axis to ``angle``, which is ``delta`` from where it is."""
        ...

    def stop(self) -> None:
        """Stop all axes."""
        ...

    def home(self, axis: int) -> None:
        """Start to look for the reference."""
        ...


def degrees_text(axes: Sequence[Axis], angles: Sequence[float] | FloatArray) -> str:
    """``axis1 12.0000 deg, axis2 -3.5000 deg``."""
    pairs = zip(axes, angles, strict=True)
    return ", ".join(f"{axis.name} {math.degrees(angle):.4f} deg" for axis, angle in pairs)


def location_dict(location: Location) -> Mapping[str, object]:
    """For journals: degrees, and both clocks."""
    setpoint = [None if math.isnan(a) else a for a in np.degrees(location.setpoint).tolist()]
    return {
        "setpoint_deg": setpoint,
        "readback_deg": np.degrees(location.readback).tolist(),
        "monotonic_ns": location.monotonic_ns,
        "time_ns": location.time_ns,
    }
