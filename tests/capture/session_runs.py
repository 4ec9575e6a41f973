"""Short capture sessions for tests: plans, runs in processes that can be killed, and what must hold afterwards."""

import hashlib
import json
import multiprocessing
import os
import signal
import sys
import time
from pathlib import Path

import cv2
import numpy as np

AXES = "{ limits_deg = [-60, 60], speed_deg_s = 200, acceleration_deg_s2 = 4000 }"


def write_plan(
    folder: Path, url: str = "", *, cameras=("X", "Y"), faults=None, options="", n=(2, 3), table=True, settle=""
) -> Path:
    """A plan of n[0] x n[1] poses for simulated cameras; with a TCP table where ``url`` is given."""
    faults = faults or {}
    lines = ["format = 1", 'project = "lab"']
    if table:
        driver = f'driver = "ascii"\naddress = "{url}"' if url else 'driver = "simulated"'
        lines += [f'[table]\nid = "turntable"\n{driver}\nsigma_arcsec = 8.0']
        lines += [f"axes.axis1 = {AXES}", f"axes.axis2 = {AXES}"]
        lines += [f"settle = {{ {settle or 'window_s = 0.01, stall_s = 0.3, poll_s = 0.003'} }}"]
    for name in cameras:
        query = f"?faults={faults[name]}" if name in faults else ""
        lines += [f'[cameras.{name}]\naddress = "simulated:{name}{query}"']
        lines += ["settings = { Width = 96, Height = 64, ExposureTime = 500.0 }"]
    lines += [f"[capture]\nfetch_timeout_s = 0.1\nretry_pause_s = 0.02\nquality = false\n{options}"]
    if table:
        lines += ['[poses.t]\nkind = "grid"']
        lines += [f"axis{i + 1}_deg = {{ from = -12, to = 12, count = {count} }}" for i, count in enumerate(n)]
    else:
        lines += [f'[poses.t]\nkind = "still"\ncount = {n[0] * n[1]}']
    path = folder / "plan.toml"
    path.write_text("\n".join(lines) + "\n")
    return path


def run_quietly(plan: str) -> None:
    """For a process of its own: ``labcapture run`` with nothing printed."""
    from capture.cli import main

    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)
    code = main(["run", plan, "--quiet"])
    sys.exit(code)


def processes():
    """Processes that start in milliseconds, because what they import is imported once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["capture.cli", "capture.session.run", "capture.plan.plan"])
    return context


def run_and_kill(context, plan: Path, after_s: float) -> bool:
    """Start a run and kill it after some time; whether it was still at work."""
    process = context.Process(target=run_quietly, args=(str(plan),))
    process.start()
    lock = plan.parent / "lab" / "capture" / "lock"
    while process.is_alive() and not (lock.exists() and f'"pid": {process.pid}' in lock.read_text()):
        time.sleep(0.001)
    process.join(after_s)
    is_hit = process.is_alive()
    process.kill()
    process.join()
    return is_hit


def run_until_fsync(plan: str, number: int) -> None:
    """For a process of its own: a run that is killed just before its ``number``-th fsync."""
    real, seen = os.fsync, [0]

    def counted(handle: int) -> None:
        seen[0] += 1
        if seen[0] == number:
            os.kill(os.getpid(), signal.SIGKILL)
        real(handle)

    os.fsync = counted
    run_quietly(plan)


def run_to_end(context, plan: Path) -> int:
    """Exit code of a run that is left alone."""
    process = context.Process(target=run_quietly, args=(str(plan),))
    process.start()
    process.join(60)
    assert not process.is_alive()
    return process.exitcode


def require_complete(plan: Path, n_epochs: int, cameras=("X", "Y"), angles=None) -> None:
    """Exactly the planned images, each with the hash of its one valid journal line, and nothing else in the folder."""
    lab = plan.parent / "lab"
    lines = (lab / "capture" / "journal.jsonl").read_text().splitlines()
    records = [json.loads(line) for line in lines]
    assert [record["n"] for record in records] == list(range(len(records)))
    sets = {}
    for record in records:
        if record["kind"] == "set":
            assert record["epoch_id"] not in sets, "an epoch was taken twice"
            sets[record["epoch_id"]] = record
        if record["kind"] == "lost":
            del sets[record["epoch_id"]]
    assert len(sets) == n_epochs
    files = {path.relative_to(lab).as_posix() for path in (lab / "images").rglob("*") if path.is_file()}
    assert files == {f"images/{camera}/{epoch}.png" for camera in cameras for epoch in sets}
    for record in sets.values():
        for image in record["images"].values():
            data = (lab / image["path"]).read_bytes()
            assert hashlib.sha256(data).hexdigest() == image["sha256"]
            assert cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED).shape == (64, 96)
        for side in ("before", "after"):
            if record["planned_deg"]:
                assert np.allclose(record[side]["readback_deg"], record["planned_deg"], atol=0.05)
                assert np.allclose(record[side]["setpoint_deg"], record["planned_deg"], atol=1e-9)
    table = lab / "observations" / "table_angles.csv"
    rows = table.read_text().splitlines() if table.exists() else []
    assert len(rows) == (n_epochs + 1 if records[0]["table"] else 0)


def kill_runs(folder: Path, url: str, n_kills: int, seed: int) -> dict[str, int]:
    """Kill runs at random instants until ``n_kills`` have hit one at work; every project is finished and checked."""
    rng = np.random.default_rng(seed)
    context = processes()
    counts = {"kills": 0, "projects": 0, "epochs": 0, "images": 0, "torn lines": 0, "removed images": 0}
    while counts["kills"] < n_kills:
        home = folder / f"p{counts['projects']:03d}"
        home.mkdir()
        plan = write_plan(home, url)
        for _ in range(4):
            counts["kills"] += run_and_kill(context, plan, rng.uniform(0.0, 0.3))
            if counts["kills"] == n_kills:
                break
        assert run_to_end(context, plan) == 0
        require_complete(plan, 6)
        counts["projects"] += 1
        counts["epochs"] += 6
        counts["images"] += 12
        for line in (home / "lab" / "capture" / "journal.jsonl").read_text().splitlines():
            record = json.loads(line)
            counts["torn lines"] += bool(record.get("torn"))
            counts["removed images"] += len(record.get("removed", ()))
    return counts
