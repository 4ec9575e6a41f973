"""Controllers that speak lines of text over RS-232, RS-422 or TCP, as their dialect says.

Addresses are pyserial's: /dev/ttyUSB0, socket://host:port, rfc2217://host:port, loop://.
"""

import contextlib
import re
import time
from collections.abc import Sequence

from capture.devices.turntable import AxisState, ControllerError, TableDisconnectedError, TurntableError
from capture.devices.turntables.dialect import Command, Dialect
from capture.devices.turntables.ports import Port, open_port

_LOOKS = 10  # at what has arrived, within the time for a reply


class AsciiController:
    """A ``Controller`` by dialect. channels, signs, zeros: of each axis; angle = sign * (controller's) + zero, rad."""

    def __init__(
        self, url: str, dialect: Dialect, channels: Sequence[str], signs: Sequence[int], zeros: Sequence[float]
    ) -> None:
        self.address, self.modulo, self._dialect = url, dialect.modulo, dialect
        self._channels, self._signs, self._zeros = tuple(channels), tuple(signs), tuple(zeros)
        self._port: Port | None = None

    def open(self) -> None:
        """Connect and send what the dialect wants first."""
        try:
            self._port = open_port(self.address, self._dialect.reply_timeout_s / _LOOKS, self._dialect.serial)
        except (OSError, ValueError) as error:  # SerialException is an OSError
            found = f"{self.address}: cannot be opened ({error})"
            raise TableDisconnectedError(f"{found}; check cable and address") from error
        for line in self._dialect.init:
            self._send(self._port, line)

    def close(self) -> None:
        """Disconnect."""
        port, self._port = self._port, None
        if port is not None:
            with contextlib.suppress(OSError):  # it may be gone already
                port.close()

    def read(self, axis: int) -> AxisState:
        """Position and state of an axis."""
        commands = self._dialect.commands
        found = self._ask(commands["position"], axis)
        moving, fault = False, None
        if "status" in commands:
            status = commands["status"]
            state = self._ask(status, axis)["state"]
            moving = status.moving is not None and status.moving.fullmatch(state) is not None
            fault = state if status.fault is not None and status.fault.fullmatch(state) else None
        return AxisState(self._angle(axis, found["value"]), moving, fault)

    def _angle(self, axis: int, text: str) -> float:
        try:
            value = float(text)
        except ValueError as error:
            raise self._error(f"{text!r} as the position of channel {self._channels[axis]} is no number") from error
        return self._signs[axis] * value * self._dialect.unit + self._zeros[axis]

    def move(self, axis: int, angle: float, delta: float) -> None:
        """Send an axis off, in the controller's units."""
        value = self._signs[axis] * (angle - self._zeros[axis]) / self._dialect.unit
        step = self._signs[axis] * delta / self._dialect.unit
        self._ask(self._dialect.commands["move"], axis, value=value, delta=step)

    def stop(self) -> None:
        """Stop all axes."""
        command = self._dialect.commands["stop"]
        for axis in range(len(self._channels)) if command.each_axis else (0,):
            self._ask(command, axis)

    def home(self, axis: int) -> None:
        """Start to look for the reference."""
        if "home" not in self._dialect.commands:
            raise TurntableError(f"{self.address}: the dialect {self._dialect.name!r} has no command 'home'; add it")
        self._ask(self._dialect.commands["home"], axis)

    def _ask(self, command: Command, axis: int, value: float = 0.0, delta: float = 0.0) -> dict[str, str]:
        """Groups of the reply; raises ControllerError where it is a refusal or unknown."""
        places = {"axis": self._channels[axis], "value": value, "delta": delta}
        sent = command.send.format(**places, counts=round(value), delta_counts=round(delta))
        reply = self._exchange(sent, command.reply is not None)
        found = self._require(sent, reply, command.reply) if command.reply is not None else {}
        errors = self._dialect.commands.get("errors")
        if errors is not None and command.name in ("move", "stop", "home"):
            self._require_none(sent, errors)
        return found

    def _require(self, sent: str, reply: str, pattern: re.Pattern[str]) -> dict[str, str]:
        refusal = self._dialect.refusal
        refused = refusal.fullmatch(reply) if refusal is not None else None
        if refused is not None:
            raise self._error(f"refused {sent!r}: {self._meaning(refused['code'])}")
        found = pattern.fullmatch(reply)
        if found is None:
            raise self._error(f"answered {sent!r} with {reply!r}, but the dialect expects {pattern.pattern!r}")
        return found.groupdict()

    def _require_none(self, sent: str, errors: Command) -> None:
        asked = errors.send.format(axis="", value=0.0, delta=0.0, counts=0, delta_counts=0)
        reply = self._exchange(asked, True)
        code = self._require(asked, reply, errors.reply)["code"] if errors.reply is not None else ""
        if errors.good is not None and not errors.good.fullmatch(code):
            raise self._error(f"refused {sent!r}: {self._meaning(code)}")

    def _meaning(self, code: str) -> str:
        text = self._dialect.texts.get(code.strip())
        return f"error {code} ({text})" if text else f"error {code}"

    def _error(self, problem: str) -> ControllerError:
        return ControllerError(f"{self.address}: the controller {problem}; see its manual or the dialect's file")

    def _send(self, port: Port, line: str) -> None:
        port.write((line + self._dialect.send_end).encode(self._dialect.encoding))

    def _exchange(self, line: str, answered: bool) -> str:
        if self._port is None:
            raise TableDisconnectedError(f"{self.address}: not connected; open it first")
        port, end = self._port, self._dialect.reply_end.encode(self._dialect.encoding)
        try:
            port.reset_input_buffer()  # a reply that came too late must not answer this question
            self._send(port, line)
            reply = _reply(port, end) if answered else b""
        except OSError as error:
            raise TableDisconnectedError(f"{self.address}: connection lost ({error}); check cable and power") from error
        if self._dialect.pause_s:
            time.sleep(self._dialect.pause_s)
        if answered and not reply.endswith(end):
            waited = f"{self._dialect.reply_timeout_s:g} s"
            raise TableDisconnectedError(f"{self.address}: no reply to {line!r} within {waited}; check cable and power")
        return str(reply[: len(reply) - len(end)].decode(self._dialect.encoding, "replace")) if answered else ""


def _reply(port: Port, end: bytes) -> bytes:
    """Up to and with ``end``, less where it does not come in time.

    The time is counted in looks: while this process is held up, as on a busy machine, a reply is not late.
    """
    reply = b""
    for _ in range(_LOOKS):
        reply += port.read_until(end)
        if reply.endswith(end):
            break
    return reply
