"""The session: what it writes, what it survives, how it stops."""

import errno
import json
import os
import signal
import subprocess
import sys
import time
from itertools import count

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from capture.devices.turntable import LimitError
from capture.plan.plan import read_plan
from capture.session.folder import session_lock
from capture.session.journal import read_journal
from capture.session.progress import Progress
from capture.session.run import run_plan
from capture.session.taking import SessionStoppedError
from survey.folder.locking import SESSION_LOCK, holder_of
from tests.capture.session_runs import processes, require_complete, run_to_end, write_plan
from tests.capture.table_server import table_server

FAST = ("--speed", "2000", "--acceleration", "100000")


def run(plan):
    return run_plan(read_plan(plan), shown=False)


def events(plan, what):
    records, _, _ = read_journal(plan.parent / "lab" / "capture" / "journal.jsonl")
    return [r["message"] for r in records if r["kind"] == "event" and r["what"] == what]


@pytest.mark.slow
def test_a_run_writes_what_was_planned(tmp_path):
    plan = write_plan(tmp_path, options="repeats = 2")
    outcome = run(plan)
    assert (outcome.planned, outcome.before, outcome.taken, dict(outcome.retries)) == (12, 0, 12, {})
    require_complete(plan, 12)
    rows = (tmp_path / "lab" / "observations" / "table_angles.csv").read_text().splitlines()
    assert rows[0] == "epoch_id,table_id,axis1_deg,axis2_deg,sigma_axis1_arcsec,sigma_axis2_arcsec"
    for row, epoch_id in zip(rows[1:3], ("t01-1", "t01-2"), strict=True):
        assert row.split(",")[:2] == [epoch_id, "turntable"]
        assert float(row.split(",")[2]) == pytest.approx(-12.0, abs=1e-6)
    assert json.loads((tmp_path / "lab" / "capture" / "status.json").read_text())["state"] == "finished"


@pytest.mark.slow
def test_a_second_run_takes_nothing(tmp_path):
    plan = write_plan(tmp_path)
    run(plan)
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "lab" / "images").rglob("*.png")}
    outcome = run(plan)
    assert (outcome.before, outcome.taken) == (6, 0)
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "lab" / "images").rglob("*.png")}


def test_cameras_without_a_table(tmp_path):
    plan = write_plan(tmp_path, table=False)
    assert run(plan).taken == 6
    require_complete(plan, 6)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "kind"),
    [
        ("timeout", "FetchTimeout"),
        ("incomplete", "IncompleteFrame"),
        ("disconnect", "Disconnected"),
        ("wrong_id", "FrameOrder"),
        ("duplicate", "FrameOrder"),
        ("extra", "FrameOrder"),
        ("lost", "FetchTimeout"),
    ],
)
def test_fault_of_a_camera_is_retried(tmp_path, fault, kind):
    """At the third image of one of two cameras: both images of that try are discarded, the epoch is taken once."""
    plan = write_plan(tmp_path, faults={"Y": f"{fault}@3"})
    outcome = run(plan)
    assert outcome.taken == 6
    assert kind in outcome.retries
    require_complete(plan, 6)


@pytest.mark.slow
def test_images_in_the_wrong_order_never_meet_another_pose(tmp_path):
    """The camera holds one image back: its number then says that it belongs to the trigger before."""
    plan = write_plan(tmp_path, faults={"X": "swap@2", "Y": "swap@4"})
    assert run(plan).taken == 6
    require_complete(plan, 6)
    records, _, _ = read_journal(tmp_path / "lab" / "capture" / "journal.jsonl")
    for record in records:
        if record["kind"] == "set":  # exposed after the table had settled there, and before it left
            for image in record["images"].values():
                assert record["before"]["monotonic_ns"] < image["host_monotonic_ns"] < record["after"]["monotonic_ns"]


@pytest.mark.slow
def test_lost_camera_stops_clearly_and_the_rest_follows(tmp_path):
    plan = write_plan(tmp_path, faults={"Y": "timeout@3,timeout@4,timeout@5"})
    with pytest.raises(SessionStoppedError) as caught:
        run(plan)
    message = str(caught.value)
    assert "simulated:Y: no image within 0.1 s" in message
    assert "the table is stopped" in message
    assert f"labcapture run {plan}" in message
    assert run(write_plan(tmp_path)).before == 2
    require_complete(plan, 6)


@pytest.mark.slow
def test_connection_of_the_table_cut_at_work(tmp_path):
    with table_server(tmp_path, *FAST) as server:
        plan = write_plan(tmp_path, server.url, n=(3, 3), options="wait_s = 0.1")
        context = processes()
        process = context.Process(target=run_plan_quietly, args=(str(plan),))
        process.start()
        n = 0
        while process.is_alive() and n < 3:
            done = len(list((tmp_path / "lab" / "images").rglob("X/t*.png")))
            if done > 2 * n:
                server.inject("DROP")
                n += 1
            time.sleep(0.005)
        process.join(120)
        assert process.exitcode == 0
        assert n == 3
        require_complete(plan, 9)
        assert any("connection lost" in line for line in events(plan, "retry"))


def run_plan_quietly(plan):
    from tests.capture.session_runs import run_quietly

    run_quietly(plan)


def pause_after_two(plan):
    """A run that is asked to pause when its second set is there, by itself: nobody else would be in time for sure."""
    taken, seen = Progress.taken, count(1)

    def and_pause(*given):
        taken(*given)
        if next(seen) == 2:
            os.kill(os.getpid(), signal.SIGUSR1)

    Progress.taken = and_pause
    run_plan_quietly(plan)


def pause_as_on_macos(plan):
    del signal.sigtimedwait
    pause_after_two(plan)


@pytest.mark.slow
def test_stalled_table_stops_the_session(tmp_path):
    with table_server(tmp_path, *FAST) as server:
        server.inject("JAM 2")
        plan = write_plan(tmp_path, server.url, settle="window_s = 0.01, stall_s = 0.1, poll_s = 0.003")
        with pytest.raises(SessionStoppedError, match="'axis2' stands still while it should move"):
            run(plan)
        assert len(events(plan, "retry")) == 2
        assert server.stopped()
        server.inject("UNJAM 2")
        assert run(plan).taken == 6
        require_complete(plan, 6)


def test_pose_outside_the_limits_never_reaches_the_controller(tmp_path):
    with table_server(tmp_path) as server:
        plan = write_plan(tmp_path, server.url)
        plan.write_text(plan.read_text() + '[poses.u]\nkind = "list"\nangles_deg = [[0, 0], [0, 60.5]]\n')
        with pytest.raises(LimitError, match=r"pose 'u02'.*'axis2': 60\.5000 deg is outside its limits"):
            run(plan)
        assert server.received() == []
        assert not (tmp_path / "lab" / "images").exists()


@pytest.mark.slow
def test_interrupt_stops_the_table_within_50_ms(tmp_path):
    """From the signal to the stop that the controller receives, while the table turns slowly.

    The least of three, because other work on the machine may hold up both processes.
    """
    delays = []
    with table_server(tmp_path, "--speed", "2") as server:
        plan = write_plan(tmp_path, server.url)
        for _ in range(3):
            process = processes().Process(target=run_plan_quietly, args=(str(plan),))
            n = len(server.commands())
            process.start()
            while len(server.commands()) < n + 2:
                time.sleep(0.005)
            time.sleep(0.05)
            begin = time.monotonic_ns()
            os.kill(process.pid, signal.SIGINT)
            process.join(120)
            assert process.exitcode == 130
            delays.append((server.stopped() - begin) / 1e6)
    assert 0.0 < min(delays) < 50.0, delays


@pytest.mark.slow
@pytest.mark.parametrize("run_it", [pause_after_two, pause_as_on_macos])
def test_pause_and_go_on(tmp_path, run_it):
    plan = write_plan(tmp_path, options="wait_s = 0.1")
    process = processes().Process(target=run_it, args=(str(plan),))
    process.start()
    images, journal = tmp_path / "lab" / "images", tmp_path / "lab" / "capture" / "journal.jsonl"
    while not (journal.exists() and events(plan, "paused")):
        assert process.is_alive()
        time.sleep(0.005)
    n = len(list(images.rglob("Y/t*.png")))
    time.sleep(0.3)
    assert len(list(images.rglob("Y/t*.png"))) == n < 6
    os.kill(process.pid, signal.SIGUSR1)
    process.join(120)
    assert process.exitcode == 0
    require_complete(plan, 6)
    assert len(events(plan, "paused")) == len(events(plan, "resumed")) == 1


@pytest.mark.slow
def test_a_run_that_was_suspended_goes_on(tmp_path):
    """As by Ctrl-Z and fg: that is no signal to a session."""
    plan = write_plan(tmp_path, options="wait_s = 0.1")
    process = processes().Process(target=run_plan_quietly, args=(str(plan),))
    process.start()
    while not list((tmp_path / "lab" / "images").rglob("Y/t*.png")):
        assert process.is_alive()
        time.sleep(0.005)
    for _ in range(5):
        os.kill(process.pid, signal.SIGSTOP)
        time.sleep(0.06)
        os.kill(process.pid, signal.SIGCONT)
        time.sleep(0.01)
    process.join(120)
    assert process.exitcode == 0
    require_complete(plan, 6)
    assert events(plan, "paused") == []


@pytest.mark.slow
def test_two_sessions_on_one_folder_are_refused(tmp_path):
    plan = write_plan(tmp_path)
    holder = "import sys,time,pathlib; from capture.session.folder import session_lock as L\n"
    holder += f"lock = L(pathlib.Path({str(tmp_path / 'lab')!r})); lock.acquire()\n"
    holder += "print('held', flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", holder], stdout=subprocess.PIPE, text=True) as other:
        try:
            assert other.stdout.readline() == "held\n"
            with pytest.raises(SurveyError, match=f"another session works on this folder .process {other.pid} on"):
                run(plan)
            assert holder_of(tmp_path / "lab" / SESSION_LOCK).startswith(f"process {other.pid}")
        finally:
            other.kill()
        other.wait()
    # the lock file is still there and names a process that is dead: nobody holds it
    assert str(other.pid) in (tmp_path / "lab" / "capture" / "lock").read_text()
    assert holder_of(tmp_path / "lab" / SESSION_LOCK) is None
    assert run(plan).taken == 6


def test_lock_is_given_back(tmp_path):
    first = session_lock(tmp_path)
    first.acquire()
    with pytest.raises(SurveyError, match="another session"):
        session_lock(tmp_path).acquire()
    first.release()
    second = session_lock(tmp_path)
    second.acquire()
    second.release()


@pytest.mark.slow
def test_disk_full(tmp_path):
    """A file system with room for some images only: a clear stop, and with more room the rest."""
    small = tmp_path / "small"
    small.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=96k", "tmpfs", str(small)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        pytest.skip(f"no small file system can be mounted here: {mounted.stderr.strip()}")
    try:
        plan = write_plan(small, n=(3, 4), options="repeats = 2")
        assert run_to_end(processes(), plan) == 1
        text = (small / "lab" / "capture" / "journal.jsonl").read_bytes()
        assert text.endswith(b"\n")
        n = sum(b'"kind": "set"' in line for line in text.splitlines())
        assert 0 < n < 24
        assert not list(small.rglob("*.tmp"))
        subprocess.run(["mount", "-o", "remount,size=4m", str(small)], check=True)
        assert run_to_end(processes(), plan) == 0
        require_complete(plan, 24)
    finally:
        subprocess.run(["umount", str(small)], check=True)


@pytest.mark.slow
@pytest.mark.parametrize("step", ["write", "fsync"])
def test_disk_full_is_said(tmp_path, monkeypatch, step):
    """The same by an error that is injected where an image, or a journal line, is written through."""
    plan, real, n = write_plan(tmp_path), os.fsync, [0]

    def full(handle):
        n[0] += 1
        if n[0] == (12 if step == "write" else 15):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(SessionStoppedError, match="the disk is full; make room\n  the table is stopped"):
        run(plan)
    monkeypatch.undo()
    assert not list((tmp_path / "lab").rglob("*.tmp"))
    run(plan)
    require_complete(plan, 6)


@pytest.mark.slow
def test_clock_that_jumps_is_harmless(tmp_path, monkeypatch):
    """UTC jumps by an hour at every look, back and forth; order and times of waiting do not care."""
    real, n = time.time_ns, [0]

    def jumping():
        n[0] += 1
        return real() + (-1) ** n[0] * 3600 * 10**9

    monkeypatch.setattr(time, "time_ns", jumping)
    monkeypatch.setattr(time, "time", lambda: jumping() / 1e9)
    plan = write_plan(tmp_path)
    assert run(plan).seconds < 10.0
    require_complete(plan, 6)
    records, _, _ = read_journal(tmp_path / "lab" / "capture" / "journal.jsonl")
    times = [record["monotonic_ns"] for record in records]
    assert times == sorted(times)
    assert sorted(r["time_ns"] for r in records) != [r["time_ns"] for r in records]  # it did jump


@pytest.mark.slow
def test_damaged_image_is_taken_again(tmp_path):
    plan = write_plan(tmp_path)
    run(plan)
    path = tmp_path / "lab" / "images" / "X" / "t03.png"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    (tmp_path / "lab" / "images" / "Y" / "t05.png").unlink()
    outcome = run(plan)
    assert (outcome.before, outcome.taken) == (4, 2)
    require_complete(plan, 6)


@pytest.mark.slow
def test_torn_last_line_is_cut_and_what_it_said_is_done_again(tmp_path):
    plan = write_plan(tmp_path)
    run(plan)
    journal = tmp_path / "lab" / "capture" / "journal.jsonl"
    lines = journal.read_bytes().splitlines(keepends=True)
    last = max(i for i, line in enumerate(lines) if b'"kind": "set"' in line)
    journal.write_bytes(b"".join(lines[:last]) + lines[last][:-40])
    assert run(plan).taken == 1
    require_complete(plan, 6)


@pytest.mark.slow
def test_half_an_image_is_removed_and_foreign_ones_stay(tmp_path):
    plan = write_plan(tmp_path)
    images = tmp_path / "lab" / "images" / "X"
    images.mkdir(parents=True)
    (images / ".t01.png.k3_x9abc.tmp").write_bytes(b"half")
    (images / "t02.png").write_bytes(b"an image that no journal knows")
    (images / "byhand01.png").write_bytes(b"of the user")
    run(plan)
    assert (images / "byhand01.png").read_bytes() == b"of the user"
    (images / "byhand01.png").unlink()
    require_complete(plan, 6)


@pytest.mark.slow
def test_changed_plan_is_refused(tmp_path):
    plan = write_plan(tmp_path)
    run(plan)
    plan.write_text(plan.read_text().replace("from = -12", "from = -11"))
    with pytest.raises(SurveyError, match=r"t01 is at \[-11.*holds it at \[-12"):
        run(plan)


def test_table_that_drifts_is_not_trusted(tmp_path, monkeypatch):
    from capture.session.cameras import PlannedCameras

    plan = write_plan(tmp_path)
    real, n = PlannedCameras.take, [0]

    def take(self, timeout_s):
        n[0] += 1
        frames = real(self, timeout_s)
        if n[0] == 2:
            tables[0].simulated[0].angle += np.radians(0.1)
            tables[0].simulated[0]._motor = None
            tables[0].simulated[0].pieces = []
        return frames

    from capture.devices.turntables.simulated import SimulatedController

    tables = []
    opened = SimulatedController.open
    monkeypatch.setattr(SimulatedController, "open", lambda self: (tables.append(self), opened(self))[1])
    monkeypatch.setattr(PlannedCameras, "take", take)
    outcome = run(plan)
    assert dict(outcome.retries) == {"Drift": 1}
    require_complete(plan, 6)


def test_images_of_another_size_than_the_survey_says(tmp_path):
    """Said at the first image, and not tried again."""
    (tmp_path / "survey.toml").write_text(
        'format = 1\n[cameras.X]\nimage_size_px = [96, 64]\n[cameras.Y]\nimage_size_px = [640, 512]\n'
        '[tables.turntable]\naxes = ["x", "z"]\n'
    )
    plan = write_plan(tmp_path)
    plan.write_text(plan.read_text().replace("format = 1", 'format = 1\nsurvey = "survey.toml"'))
    with pytest.raises(SessionStoppedError, match=r"camera 'Y' sends 96 x 64 px, but .*survey\.toml says 640 x 512"):
        run(plan)
    assert not list((tmp_path / "lab").rglob("*.png"))
