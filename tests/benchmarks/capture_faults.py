"""Faults injected into capture sessions, counted in a table.

    python tests/benchmarks/capture_faults.py [--kills 50] [--seed 1]

Every row is a number of runs with that fault; a run has survived when in the end exactly the planned images are there,
each with the hash of its one journal line, and no file besides them. Times are from the fault to the stop that the
controller's process receives.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))

from tests.capture.session_runs import (
    kill_runs,
    processes,
    require_complete,
    run_quietly,
    run_to_end,
    run_until_fsync,
    write_plan,
)
from tests.capture.table_server import TableServer, table_server

FAST = ("--speed", "2000", "--acceleration", "100000")
TABLE_FAULTS = {"DROP": "connection cut", "JAM 1": "stall", "FAULT 1 hot": "fault", "MUTE": "mute"}
CAMERA_FAULTS = ("timeout", "incomplete", "disconnect", "wrong_id", "duplicate", "swap", "extra", "lost")


def is_complete(plan: Path, n_epochs: int) -> bool:
    """Whether all is as it should be; what is not goes to stderr."""
    try:
        require_complete(plan, n_epochs)
    except AssertionError as error:
        print(f"{plan}: {error}", file=sys.stderr)
        return False
    return True


def camera_faults(home: Path, kind: str, n_runs: int, rng: np.random.Generator) -> int:
    """Runs with one or two such faults at random images of random cameras; how many survived."""
    survived = 0
    for k in range(n_runs):
        folder = home / f"{kind}{k}"
        folder.mkdir()
        faults = {name: f"{kind}@{rng.integers(2, 6)}" for name in rng.choice(["X", "Y"], rng.integers(1, 3), False)}
        plan = write_plan(folder, faults=faults)
        survived += run_to_end(processes(), plan) == 0 and is_complete(plan, 6)
    return survived


def at_work(home: Path, server: TableServer, fault: str, n_runs: int, rng: np.random.Generator) -> int:
    """Runs whose controller gets a fault at a random instant; where they stop, the fault is cleared and they go on."""
    survived = 0
    for k in range(n_runs):
        folder = home / f"{fault.split()[0]}{k}"
        folder.mkdir()
        plan = write_plan(folder, server.url, n=(3, 4))
        process = processes().Process(target=run_quietly, args=(str(plan),))
        process.start()
        while process.is_alive() and not list(folder.rglob("X/t*.png")):
            time.sleep(0.002)
        time.sleep(rng.uniform(0.0, 0.4))
        server.inject(fault)
        time.sleep(0.2)
        for line in ("UNJAM 1", "CLEAR", "SPEAK"):
            server.inject(line)
        process.join(60)
        survived += run_to_end(processes(), plan) == 0 and is_complete(plan, 12)
    return survived


def fsync_points(home: Path) -> int:
    """Killed before every fsync of a run in turn; number of moments."""
    number = 0
    while True:
        number += 1
        folder = home / f"fsync{number}"
        folder.mkdir()
        plan = write_plan(folder, table=False, n=(1, 2))
        process = processes().Process(target=run_until_fsync, args=(str(plan), number))
        process.start()
        process.join(60)
        if process.exitcode == 0:
            return number - 1
        if run_to_end(processes(), plan):
            raise RuntimeError(f"no resume after fsync {number}")
        require_complete(plan, 2)


def full_disk(home: Path, kilobytes: int) -> bool | None:
    """A file system that fills up; None where none can be mounted."""
    small = home / f"small{kilobytes}"
    small.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={kilobytes}k", "tmpfs", str(small)]
    if subprocess.run(command, capture_output=True, check=False).returncode:
        return None
    try:
        plan = write_plan(small, n=(3, 4), options="repeats = 2")
        stopped = run_to_end(processes(), plan) == 1
        subprocess.run(["mount", "-o", "remount,size=4m", str(small)], check=True)
        done = run_to_end(processes(), plan) == 0
        return stopped and done and is_complete(plan, 24)
    finally:
        subprocess.run(["umount", str(small)], check=True)


def interrupt_delays(home: Path, n_runs: int) -> list[float]:
    """Milliseconds from SIGINT, while the table turns, to the stop at the controller."""
    delays = []
    with table_server(home, "--speed", "2") as server:
        plan = write_plan(home, server.url)
        for _ in range(n_runs):
            n = len(server.commands())
            process = processes().Process(target=run_quietly, args=(str(plan),))
            process.start()
            while len(server.commands()) < n + 2:
                time.sleep(0.002)
            time.sleep(0.05)
            begin = time.monotonic_ns()
            os.kill(process.pid or 0, signal.SIGINT)
            process.join(30)
            stops = [when for when, line in server.commands() if line == "ST" and when > begin]
            delays.append((stops[0] - begin) / 1e6)
    return delays


def main() -> None:
    """All faults; rows go out as they are done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--only", choices=("kills", "cameras", "table", "disk", "interrupt"), action="append")
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    rng = np.random.default_rng(given.seed)
    print(f"{'fault':<44}{'runs':>6}{'survived':>10}")
    with tempfile.TemporaryDirectory() as name:
        home = Path(name)
        (home / "server").mkdir()
        wanted = given.only or ["kills", "cameras", "table", "disk", "interrupt"]
        with table_server(home / "server", *FAST) as server:
            if "kills" in wanted:
                kills(home, server, given.kills, given.seed)
            for kind in CAMERA_FAULTS if "cameras" in wanted else ():
                row(f"camera: {kind}", given.runs, camera_faults(home, kind, given.runs, rng))
            for fault, text in TABLE_FAULTS.items() if "table" in wanted else ():
                row(f"table: {text}", given.runs, at_work(home, server, fault, given.runs, rng))
        if "disk" in wanted:
            full = [full_disk(home, size) for size in (64, 80, 96, 128)]
            row("disk full", sum(f is not None for f in full), sum(f is True for f in full))
        if "interrupt" in wanted:
            delays = interrupt_delays(home, given.runs)
            median, largest = np.median(delays), max(delays)
            print(f"Ctrl-C to the stop at the controller: median {median:.1f} ms, largest {largest:.1f} ms")


def kills(home: Path, server: TableServer, n: int, seed: int) -> None:
    """Both rows of kills."""
    (home / "kills").mkdir()
    counts = kill_runs(home / "kills", server.url, n, seed)
    row("SIGKILL at random instants", counts["kills"], counts["kills"])
    print(f"  {counts}")
    points = fsync_points(home)
    row("SIGKILL before every fsync of a run", points, points)


def row(fault: str, n_runs: int, survived: int) -> None:
    """A line of the table."""
    print(f"{fault:<44}{n_runs:>6}{survived:>10}", flush=True)


if __name__ == "__main__":
    main()
