"""The simulated controller as a process of its own, for tests: where it is, what it received, what is true."""

import json
import math
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TableServer:
    """A running controller."""

    port: int
    pid: int
    log: Path
    truth_file: Path

    @property
    def url(self) -> str:
        return f"socket://127.0.0.1:{self.port}"

    def received(self) -> list[tuple[int, str]]:
        """Every line that arrived, with its monotonic time in ns."""
        lines = self.log.read_text().splitlines() if self.log.exists() else []
        return [(int(line.split(" ", 1)[0]), line.split(" ", 1)[1]) for line in lines]

    def commands(self) -> list[tuple[int, str]]:
        """The lines that ask for motion or its end, in either language."""
        return [row for row in self.received() if row[1].startswith(("MA", "ST", "HM")) or row[1][1:3] in ("PA", "OR")]

    def stopped(self) -> int:
        """The monotonic time in ns of the stop that is the last command; no reply tells that it has arrived."""
        limit = time.monotonic() + 10.0
        while not (rows := self.commands()) or rows[-1][1] != "ST":
            assert time.monotonic() < limit, f"no stop came behind {rows[-1:]}"
            time.sleep(0.002)
        return rows[-1][0]

    def injected(self, words: str) -> int:
        """The monotonic time in ns at which a SIM line, the last of its kind, arrived."""
        return next(at for at, line in reversed(self.received()) if line == f"SIM {words}")

    def truth_deg(self) -> list[float]:
        """True angles of both axes, as of a moment after the call (the file is written anew every few milliseconds)."""
        asked, limit = time.monotonic_ns(), time.monotonic() + 30.0
        while (told := json.loads(self.truth_file.read_text()))["monotonic_ns"] < asked:
            assert time.monotonic() < limit, f"{self.truth_file} is written no more"
            time.sleep(0.002)
        return [math.degrees(told["axis1_rad"]), math.degrees(told["axis2_rad"])]

    def inject(self, words: str) -> int:
        """Send a SIM line on a connection of its own; the monotonic time (ns) just before."""
        with socket.create_connection(("127.0.0.1", self.port), timeout=5.0) as connection:
            connection.sendall(b"")
            before = time.monotonic_ns()
            connection.sendall(f"SIM {words}\r\n".encode())
            connection.recv(100)
        return before


@contextmanager
def table_server(folder: Path, *options: str, port: int = 0) -> Iterator[TableServer]:
    """Start it, wait for its port, and kill it at the end."""
    log, truth = folder / "controller.log", folder / "truth_angles.json"
    command = [sys.executable, "-m", "capture.simulated.controller", "--port", str(port)]
    command += ["--log", str(log), "--truth", str(truth), "--speed", "200", "--acceleration", "4000", *options]
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            yield TableServer(int(process.stdout.readline()), process.pid, log, truth)
        finally:
            process.kill()
