"""An axis that is not there: it speeds up, brakes, has backlash and a noisy encoder, and may jam.

The motor follows trapezoids of speed, piece by piece in closed form; the table lags behind it by up to half the
backlash on either side (a play operator).
"""

import math
from dataclasses import dataclass, field

import numpy as np

from adjust.model.frozen import frozen


@frozen
class AxisPhysics:
    """rad, rad/s, rad/s^2. encoder_noise: standard deviation of a reading. home_at: where the reference is."""

    speed: float = math.radians(20.0)
    acceleration: float = math.radians(40.0)
    backlash: float = 0.0
    encoder_noise: float = 0.0
    home_at: float = 0.0
    turns_lost: bool = False  # the readback starts anew after a whole turn


@frozen
class _Piece:
    """A stretch of a motion with one acceleration."""

    begin: float
    duration: float
    angle: float
    speed: float
    acceleration: float

    def at(self, time_s: float) -> tuple[float, float]:
        t = min(max(time_s - self.begin, 0.0), self.duration)
        return self.angle + self.speed * t + 0.5 * self.acceleration * t * t, self.speed + self.acceleration * t


@dataclass(eq=False)
class SimulatedAxis:
    """State of an axis at any time; ``time_s`` must not go back."""

    physics: AxisPhysics
    rng: np.random.Generator
    angle: float = 0.0
    pieces: list[_Piece] = field(default_factory=list)
    fault: str | None = None
    jammed: bool = False
    _motor: float | None = None

    def move(self, time_s: float, target: float) -> None:
        """Go to ``target`` from whatever it does now: brake first where it must."""
        angle, speed = self._motor_at(time_s)
        limits = self.physics
        self.pieces = []
        begin = time_s
        if speed:
            braking = _braking(begin, angle, speed, limits.acceleration)
            self.pieces.append(braking)
            begin += braking.duration
            angle = braking.at(begin)[0]
        self.pieces += _trapezoid(begin, angle, target, limits.speed, limits.acceleration)

    def stop(self, time_s: float) -> None:
        """Brake."""
        angle, speed = self._motor_at(time_s)
        self.pieces = [_braking(time_s, angle, speed, self.physics.acceleration)] if speed else []

    def jam(self, time_s: float) -> None:
        """Stop dead; the controller still believes in its move."""
        self.advance(time_s)
        self.jammed = True

    def unjam(self, time_s: float) -> None:
        """Move freely again, from where it stands."""
        self.jammed = False
        self._motor = self.angle
        self.pieces = []
        self.advance(time_s)

    def moving(self, time_s: float) -> bool:
        """Whether the controller believes that it moves."""
        return bool(self.pieces) and (self.jammed or time_s < self.pieces[-1].begin + self.pieces[-1].duration)

    def advance(self, time_s: float) -> float:
        """The true angle of the table at a time."""
        if self.jammed:
            return self.angle
        if self._motor is None:
            self._motor = self.angle
        for piece in self.pieces:
            if piece.begin > time_s:
                break
            motor, _ = piece.at(time_s)
            half = self.physics.backlash / 2
            self.angle = min(max(self.angle, motor - half), motor + half)
            self._motor = motor
        return self.angle

    def encoder(self, time_s: float) -> float:
        """A reading of the table's angle."""
        angle = self.advance(time_s)
        if self.physics.encoder_noise:
            angle += self.rng.normal(0.0, self.physics.encoder_noise)
        return angle % (2 * math.pi) if self.physics.turns_lost else angle

    def _motor_at(self, time_s: float) -> tuple[float, float]:
        self.advance(time_s)
        motor = self.angle if self._motor is None else self._motor
        if self.jammed:
            return motor, 0.0
        for piece in self.pieces:
            if piece.begin <= time_s < piece.begin + piece.duration:
                return piece.at(time_s)
        return motor, 0.0


def _braking(begin: float, angle: float, speed: float, rate: float) -> _Piece:
    return _Piece(begin, abs(speed) / rate, angle, speed, -math.copysign(rate, speed))


def _trapezoid(begin: float, angle: float, target: float, speed: float, rate: float) -> list[_Piece]:
    way, sign = abs(target - angle), math.copysign(1.0, target - angle)
    if way == 0.0:
        return [_Piece(begin, 0.0, angle, 0.0, 0.0)]
    top = min(speed, math.sqrt(way * rate))
    ramp, cruise = top / rate, way / top - top / rate
    first = _Piece(begin, ramp, angle, 0.0, sign * rate)
    second = _Piece(begin + ramp, cruise, first.at(begin + ramp)[0], sign * top, 0.0)
    third_begin = begin + ramp + cruise
    third = _Piece(third_begin, ramp, second.at(third_begin)[0], sign * top, -sign * rate)
    return [first, second, third, _Piece(third_begin + ramp, 0.0, target, 0.0, 0.0)]  # there, whatever rounding says
