"""A turntable's controller that is not there, as a program of its own: lines of text over TCP, motion in real time.

    python -m capture.simulated.controller --port 5020 --truth truth.json --log commands.log

It speaks the shipped dialects ``two-axis`` and ``newport-esp301``, writes every line that it receives to the log with
its monotonic time, and keeps the true angles in a JSON file that is always whole, for whoever renders what the cameras
would see. Lines that begin with ``SIM`` inject faults (``SIM JAM 1``, ``SIM UNJAM 1``, ``SIM FAULT 1 overheated``,
``SIM CLEAR``, ``SIM MUTE``, ``SIM SPEAK``); ``SIM DROP`` closes all other connections.
"""

import argparse
import json
import math
import os
import socketserver
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from capture.devices.turntables.simulated_axis import AxisPhysics, SimulatedAxis
from survey.commands.common import not_negative, positive, run_command
from survey.commands.parser import Parser, port
from survey.workbench.guard import port_error

_PROGRAM = "python -m capture.simulated.controller"
_TRUTH_S = 0.005


class SimulatedTable:
    """The axes behind all connections; every method takes the lock itself."""

    def __init__(self, physics: Sequence[AxisPhysics], seed: int, log: Path | None, hard_limit: float) -> None:
        rng = np.random.default_rng(seed)
        self.axes = [SimulatedAxis(p, rng) for p in physics]
        self.lock = threading.RLock()
        self.mute = False
        self.hard_limit = hard_limit
        self.error = 0
        self._log: TextIO | None = log.open("a", buffering=1, encoding="utf-8") if log is not None else None

    def note(self, line: str) -> None:
        """Log a line as received."""
        if self._log is not None:
            self._log.write(f"{time.monotonic_ns()} {line}\n")

    def truth(self) -> dict[str, object]:
        """True angles now, by the names that ``capture.simulated.angles`` reads."""
        with self.lock:
            now = time.monotonic()
            angles = {f"axis{i + 1}_rad": axis.advance(now) for i, axis in enumerate(self.axes)}
            moving = any(axis.moving(now) for axis in self.axes)
        return {**angles, "moving": moving, "monotonic_ns": round(now * 1e9), "pid": os.getpid()}

    def inject(self, words: Sequence[str]) -> str:
        """A fault, by a line that begins with SIM."""
        now = time.monotonic()
        with self.lock:
            if words[0] in ("JAM", "UNJAM"):
                axis = self.axes[int(words[1]) - 1]
                (axis.jam if words[0] == "JAM" else axis.unjam)(now)
            elif words[0] == "FAULT":
                self.axes[int(words[1]) - 1].fault = " ".join(words[2:]) or "fault"
            elif words[0] == "CLEAR":
                for axis in self.axes:
                    axis.fault = None
            elif words[0] in ("MUTE", "SPEAK"):
                self.mute = words[0] == "MUTE"
            else:
                return "ERR 1"
        return "OK"

    def go(self, number: int, angle: float) -> int:
        """Move an axis; 0, or the number of the error: 2 no such axis, 3 beyond the hard limit, 4 fault."""
        with self.lock:
            if not 1 <= number <= len(self.axes):
                return 2
            if abs(angle) > self.hard_limit:
                return 3
            if self.axes[number - 1].fault:
                return 4
            self.axes[number - 1].move(time.monotonic(), angle)
            return 0

    def stop(self) -> None:
        """Brake all axes."""
        with self.lock:
            now = time.monotonic()
            for axis in self.axes:
                axis.stop(now)


def answer_two_axis(table: SimulatedTable, line: str) -> str | None:
    """The reply of the language ``two-axis``."""
    words = line.split()
    name = words[0] if words else ""
    if name == "ST":
        table.stop()
        return "OK"
    if name not in ("MA", "TP", "TS", "HM") or len(words) != (3 if name == "MA" else 2):
        return "ERR 1"
    number = int(words[1]) if words[1].isdigit() else 0
    if not 1 <= number <= len(table.axes):
        return "ERR 2"
    axis, now = table.axes[number - 1], time.monotonic()
    if name in ("MA", "HM"):
        error = table.go(number, math.radians(float(words[2])) if name == "MA" else axis.physics.home_at)
        return f"ERR {error}" if error else "OK"
    with table.lock:
        if name == "TP":
            return f"{math.degrees(axis.encoder(now)):.6f}"
        return f"FAULT {axis.fault}" if axis.fault else "MOVING" if axis.moving(now) else "READY"


def answer_esp301(table: SimulatedTable, line: str) -> str | None:
    """The reply of the language ``newport-esp301``: None where a command is not answered."""
    if line == "TE?":
        error, table.error = table.error, 0
        return str(error)
    number, name, value = int(line[0]) if line[:1].isdigit() else 0, line[1:3], line[3:]
    if not 1 <= number <= len(table.axes):
        table.error = 6
        return None
    axis, now = table.axes[number - 1], time.monotonic()
    with table.lock:
        if name == "TP":
            return f" {math.degrees(axis.encoder(now)):.6f}"
        if name == "MD":
            return "0" if axis.moving(now) else "1"
        if name == "ST":
            axis.stop(now)
        elif name in ("PA", "OR"):
            angle = math.radians(float(value)) if name == "PA" else axis.physics.home_at
            table.error = {0: 0, 2: 6, 3: 100 * number + 4, 4: 100 * number + 8}[table.go(number, angle)]
        else:
            table.error = 6
    return None


_LANGUAGES = {"two-axis": (answer_two_axis, b"\r\n"), "newport-esp301": (answer_esp301, b"\r")}


class _Server(socketserver.ThreadingTCPServer):
    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, port: int, table: SimulatedTable, language: str) -> None:
        self.table, self.language = table, language
        self.connections: set[Any] = set()
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except OSError as error:
            raise port_error(port, error) from error


class _Handler(socketserver.StreamRequestHandler):
    disable_nagle_algorithm = True
    server: _Server

    def handle(self) -> None:
        self.server.connections.add(self.request)
        try:
            self._talk()
        except OSError:
            pass  # the client has gone
        finally:
            self.server.connections.discard(self.request)

    def _talk(self) -> None:
        table = self.server.table
        answer, end = _LANGUAGES[self.server.language]
        buffer = b""
        while chunk := self.request.recv(4096):
            *lines, buffer = (buffer + chunk).split(end)
            for raw in lines:
                line = raw.decode("ascii", "replace").strip()
                table.note(line)
                reply = self._inject(line[4:].split()) if line.startswith("SIM ") else answer(table, line)
                if reply is not None and (not table.mute or line.startswith("SIM ")):
                    self.request.sendall(reply.encode("ascii") + b"\r\n")

    def _inject(self, words: Sequence[str]) -> str:
        if words != ["DROP"]:
            return self.server.table.inject(words)
        for other in list(self.server.connections):
            if other is not self.request:
                other.shutdown(2)
        return "OK"


def _publish(table: SimulatedTable, path: Path) -> None:
    while True:
        _write_truth(table, path)
        time.sleep(_TRUTH_S)


def _write_truth(table: SimulatedTable, path: Path) -> None:
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(json.dumps(table.truth()), encoding="utf-8")
    temporary.replace(path)


def build_parser() -> argparse.ArgumentParser:
    """Its flags."""
    parser = Parser(prog=_PROGRAM, description=__doc__)
    parser.add_argument("--port", type=port, default=0, help="on loopback; 0 takes a free one")
    parser.add_argument("--language", choices=tuple(_LANGUAGES), default="two-axis")
    parser.add_argument("--truth", type=Path, help="JSON file of the true angles, replaced every few milliseconds")
    parser.add_argument("--log", type=Path, help="every line received, with its monotonic time in ns")
    parser.add_argument("--axes", type=positive, default=2)
    parser.add_argument("--speed", type=float, default=20.0, help="deg/s")
    parser.add_argument("--acceleration", type=float, default=40.0, help="deg/s^2")
    parser.add_argument("--backlash", type=float, default=0.0, help="arcsec")
    parser.add_argument("--noise", type=float, default=0.0, help="of the encoder, arcsec")
    parser.add_argument("--hard-limit", type=float, default=370.0, help="deg, where the controller itself refuses")
    parser.add_argument("--turns-lost", action="store_true", help="the readback starts anew after 360 deg")
    parser.add_argument("--seed", type=not_negative, default=1)
    parser.set_defaults(run=_serve)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """Serve until killed; the first line on stdout is the port."""
    return run_command(_PROGRAM, build_parser, argv)


def _serve(given: argparse.Namespace) -> int:
    arcsec = math.radians(1 / 3600)
    physics = AxisPhysics(
        math.radians(given.speed),
        math.radians(given.acceleration),
        given.backlash * arcsec,
        given.noise * arcsec,
        turns_lost=given.turns_lost,
    )
    table = SimulatedTable([physics] * given.axes, given.seed, given.log, math.radians(given.hard_limit))
    server = _Server(given.port, table, given.language)
    if given.truth is not None:
        _write_truth(table, given.truth)  # where it cannot be written, that is said now
        threading.Thread(target=_publish, args=(table, given.truth), daemon=True).start()
    sys.stdout.write(f"{server.server_address[1]}\n")
    sys.stdout.flush()
    server.serve_forever()
    return 0


if __name__ == "__main__":
    sys.exit(main())
