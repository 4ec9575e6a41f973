"""No command leaves a broken folder: killed, on a full disk or a read-only one, two at a time, under odd names.

Every step of every command is tried by ``python -m tests.acceptance.kill_adjust``; here some of them.
"""

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from capture.session.folder import session_lock
from survey.batch.record import MAY_PASS, cause_of
from survey.cli import FAILED, main
from survey.folder.locking import LOCK, BusyError, FileLock, holder_of
from survey.folder.replacing import changing, recover_killed, replace_parts, unfinished, write_set
from survey.folder.text import atomic_write
from survey.folder.whole import whole_folder
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.removing import remove_job
from survey.project import read, write_project
from survey.solution.earlier.previous import read_previous
from tests.acceptance.interruptions import (
    CASES,
    Ground,
    adjusted_ring,
    content,
    full_at_step,
    in_a_copy,
    kill_before,
    killed_at_instant,
    killed_at_step,
    leftovers,
    prepare,
    results,
    ring,
    run,
    start,
    steps_of,
    wait,
)

_KILLS, _FULL = 4, 2


@pytest.fixture(scope="module")
def grounds(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Ground]:
    """Every case, prepared when it is first asked for."""
    folder = tmp_path_factory.mktemp("interrupted")

    class Prepared(dict[str, Ground]):
        def __missing__(self, name: str) -> Ground:
            self[name] = prepare(CASES[name], folder / name)
            return self[name]

    return Prepared()


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    return adjusted_ring(tmp_path)


def decisive(ground: Ground) -> list[int]:
    """Steps that put something in place, and the first and the last."""
    moves = ("renameat2", "os.rename")
    at = [n for n, step in enumerate(ground.steps, 1) if step.startswith(moves) and ".tmp" not in step]
    return [1, *at, *(n for n, step in enumerate(ground.steps, 1) if "entries.json" in step), len(ground.steps)]


def some(numbers: list[int], n: int) -> list[int]:
    return [numbers[i] for i in np.unique(np.linspace(0, len(numbers) - 1, n).round().astype(int))]


# killed


@pytest.mark.parametrize("name", CASES)
def test_killed_before_any_step(grounds: dict[str, Ground], name: str) -> None:
    """The old state or the new one, and nothing left over once the next command has come."""
    ground = grounds[name]
    for number in some(decisive(ground), _KILLS + 2 * (name == "add")):
        assert killed_at_step(ground, number) == [], ground.steps[number - 1]


@pytest.mark.parametrize("name", ["adjust", "remove"])
def test_killed_at_any_instant(grounds: dict[str, Ground], name: str) -> None:
    """The machine may have been busier when the command's time was taken: where it had ended, it is killed earlier."""
    seconds = grounds[name].seconds
    for share in (0.3, 0.6, 0.85):
        was_at_work = False
        while not was_at_work:
            was_at_work, faults = killed_at_instant(grounds[name], share * seconds)
            assert faults == []
            seconds *= 1.0 if was_at_work else 0.5


def test_what_was_half_replaced_is_undone_with_a_line(
    grounds: dict[str, Ground], capsys: pytest.CaptureFixture[str]
) -> None:
    ground = grounds["add"]
    ground.afresh()
    last = max(n for n, step in enumerate(ground.steps, 1) if "pairs.csv" in step and step.startswith("os.rename"))
    assert run(ground.argv, ground.home, kill_before(last)).code == -signal.SIGKILL
    assert unfinished(ground.target)
    with pytest.raises(SurveyError, match="replaced half by a command that was killed"):
        read(ground.target)
    assert main(["plan", str(ground.target), "--quiet"]) == 0
    assert "a command that was killed while it replaced files has been undone" in capsys.readouterr().err
    assert content(ground.target) == ground.before
    assert leftovers(ground.home) == []


def test_a_mixture_on_a_living_hand_is_not_undone(grounds: dict[str, Ground]) -> None:
    """Another process that is in the middle of it will finish; only what a dead one left is undone."""
    ground = grounds["add"]
    ground.afresh()
    run(ground.argv, ground.home, kill_before(len(ground.steps) - 20))
    (ground.target / ".before").mkdir(exist_ok=True)
    (ground.target / ".before" / "entries.json").write_text("{}")
    with FileLock(ground.target / LOCK, ground.target, "command"):
        assert not recover_killed(ground.target)
        assert unfinished(ground.target)
    assert recover_killed(ground.target)


def test_leftovers_go_unless_somebody_holds_them(lab: Path) -> None:
    dead, alive = lab / "results/.solution.json.abcdefgh.tmp", lab / "results/.report.html.abcdefgh.tmp"
    for path in (dead, alive):
        path.write_text("half")
    code = f"import fcntl,time; f=open({str(alive)!r}); fcntl.flock(f, 2); print(flush=True); time.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE) as other:
        assert other.stdout is not None
        other.stdout.readline()
        adjust_job(lab, progress=False)
        assert not dead.exists()
        assert alive.exists()
        other.kill()
    adjust_job(lab, progress=False)
    assert leftovers(lab) == []


def test_files_of_a_killed_writer_go_with_the_next(tmp_path: Path) -> None:
    (tmp_path / ".out.txt.abcdefgh.tmp").write_text("half")
    (tmp_path / ".out.txt.bak.tmp").write_text("of somebody else")
    atomic_write(tmp_path / "out.txt", "whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".out.txt.bak.tmp", "out.txt"]


# a full disk, a disk that is read only


@pytest.mark.parametrize("name", CASES)
def test_full_disk_at_any_step(grounds: dict[str, Ground], name: str) -> None:
    ground = grounds[name]
    at = [n for n, step in enumerate(ground.steps, 1) if step.startswith(("open", "os.mkdir", "os.link", "fsync"))]
    for number in some(at[1:], _FULL):
        assert full_at_step(ground, number) == [], ground.steps[number - 1]


def mounted(folder: Path, *options: str) -> None:
    folder.mkdir()
    done = subprocess.run(["mount", *options, str(folder)], capture_output=True, text=True, check=False)
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")


def test_a_disk_that_is_really_full(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    small = tmp_path / "small"
    mounted(small, "-t", "tmpfs", "-o", "size=512k", "tmpfs")
    try:
        lab = adjusted_ring(small)
        capsys.readouterr()
        before = content(lab)
        for left in (60_000, 0):
            room = os.statvfs(small).f_bavail * os.statvfs(small).f_bsize
            (small / f"ballast{left}").write_bytes(b"\0" * (room - left))
            _refused_for_space(lab, before, capsys)
        for path in small.glob("ballast*"):
            path.unlink()
        assert main(["adjust", str(lab), "--quiet"]) == 0
    finally:
        subprocess.run(["umount", str(small)], check=True)


def _refused_for_space(lab: Path, before: dict[str, bytes], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["adjust", str(lab), "--quiet"]) == FAILED
    assert "No space left on device; check the name, the permissions and the free space" in capsys.readouterr().err
    assert content(lab) == before
    assert leftovers(lab.parent) == []


def test_read_only_media(tmp_path: Path, lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """What writes nothing works; what writes says so at once; ``--out`` writes elsewhere."""
    still = tmp_path / "still"
    mounted(still, "--bind", str(lab))
    try:
        if subprocess.run(["mount", "-o", "remount,ro,bind", str(still)], capture_output=True, check=False).returncode:
            pytest.skip("nothing can be mounted read only here")
        assert main(["compare", str(still), str(lab), "--quiet"]) == 0
        assert main(["plan", str(still), "--quiet"]) == 0
        assert read_previous(read(still)).summary["redundancy"] == 12
        capsys.readouterr()
        for argv in (["adjust"], ["report"], ["remove", "p0-2"], ["detect"]):
            assert main([argv[0], str(still), *argv[1:], "--quiet"]) == FAILED
            assert f"{still}: Read-only file system; check" in capsys.readouterr().err
        assert main(["adjust", str(still), "--out", str(tmp_path / "out"), "--quiet"]) == 0
        assert (tmp_path / "out" / "results" / "solution.json").is_file()
    finally:
        subprocess.run(["umount", str(still)], check=True)
    assert leftovers(tmp_path) == []


def test_no_locks_on_this_file_system(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As on network drives without a lock manager: reading works, writing is refused with a message."""
    import fcntl

    def unable(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    before = content(lab)
    monkeypatch.setattr(fcntl, "flock", unable)
    assert main(["plan", str(lab), "--quiet"]) == 0
    assert main(["adjust", str(lab), "--quiet"]) == FAILED
    assert "its file system has no locks (No locks available)" in capsys.readouterr().err
    assert content(lab) == before
    assert leftovers(lab) == []


@pytest.mark.parametrize("code", [errno.EINVAL, errno.ENOSYS, errno.EBUSY])
def test_file_systems_that_cannot_trade_folders(lab: Path, code: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Network drives, folders that are mounted: files are replaced one by one instead."""
    monkeypatch.setattr("survey.folder.exchange._renameat2", lambda *_: code)
    before = content(lab)
    inode = (lab / "results").stat().st_ino
    assert main(["remove", str(lab), "p0-2", "--quiet"]) == 0
    after = content(lab)
    assert results(after).keys() == results(before).keys()
    assert all(after[f"results/{name}"] != before[f"results/{name}"] for name in ("solution.json", "report.html"))
    assert (lab / "results").stat().st_ino == inode
    assert read_previous(read(lab)).summary["redundancy"] == 6
    assert leftovers(lab) == []


def test_results_that_are_mounted(lab: Path, tmp_path: Path) -> None:
    """A folder that is mounted cannot be moved; it is filled."""
    inside = tmp_path / "inside"
    shutil.move(lab / "results", inside)
    mounted(lab / "results", "--bind", str(inside))
    try:
        assert main(["remove", str(lab), "p0-2", "--quiet"]) == 0
        assert read_previous(read(lab)).summary["redundancy"] == 6
        assert leftovers(tmp_path) == []
    finally:
        subprocess.run(["umount", str(lab / "results")], check=True)
    assert (inside / "notes" / "mine.txt").read_text() == "the only copy"


# what others have put there


def test_files_of_others_stay(lab: Path) -> None:
    """Also one that comes at the last moment; rights of the folder, too."""
    (lab / "results").chmod(0o750)
    (lab / "results" / "link").symlink_to("notes/mine.txt")
    with changing(lab) as place:
        (place / "results").mkdir()
        (place / "results" / "solution.json").write_text("new")
        old = (lab / "results").stat().st_ino
        replace_parts(lab)
    assert (lab / "results" / "solution.json").read_text() == "new"
    assert (lab / "results" / "report.html").is_file()
    assert (lab / "results" / "link").readlink() == Path("notes/mine.txt")
    assert (lab / "results" / "notes" / "mine.txt").read_text() == "the only copy"
    assert (lab / "results").stat().st_mode & 0o777 == 0o750
    assert (lab / "results").stat().st_ino != old


def test_what_comes_at_the_last_moment_stays(lab: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import survey.folder.exchange

    real = survey.folder.exchange._renameat2

    def late(new: Path, there: Path) -> int:
        (there / "late.txt").write_text("written by somebody else")
        return real(new, there)

    monkeypatch.setattr(survey.folder.exchange, "_renameat2", late)
    adjust_job(lab, progress=False)
    assert (lab / "results" / "late.txt").read_text() == "written by somebody else"


# two at a time


def test_a_second_command_is_refused(grounds: dict[str, Ground], capsys: pytest.CaptureFixture[str]) -> None:
    """Every command that writes, while an adjustment works on the folder; readers see the old set."""
    ground = grounds["adjust"]
    ground.afresh()
    go = ground.home / "go"

    def pause(count: int, _: str) -> None:
        while count == 20 and not go.exists():
            time.sleep(0.005)

    pid = start(ground.argv, ground.home, pause)
    try:
        while holder_of(ground.target / LOCK) is None:
            time.sleep(0.005)
        for argv in (["adjust"], ["report"], ["remove", "p0-1"], ["add", str(ground.home)], ["align"], ["detect"]):
            assert main([argv[0], str(ground.target), *argv[1:], "--quiet"]) == FAILED
            said = capsys.readouterr().err
            assert f"{ground.target}: another command works on this folder (process {pid} on " in said
        assert content(ground.target) == ground.before
        assert main(["plan", str(ground.target), "--quiet"]) == 0
        assert main(["adjust", str(ground.target), "--out", str(ground.home / "out"), "--quiet"]) == 0
    finally:
        go.touch()
        assert wait(pid, ground.home).code == 0
    assert content(ground.target) == ground.after
    assert leftovers(ground.home) == []


def test_many_at_the_same_time(grounds: dict[str, Ground]) -> None:
    ground = grounds["adjust"]
    ground.afresh()
    pids = [start(ground.argv, ground.home) for _ in range(4)]
    codes = [os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids]
    assert set(codes) <= {0, FAILED}
    assert 0 in codes
    assert content(ground.target) == ground.after
    assert leftovers(ground.home) == []


def test_readers_see_the_old_set_or_the_new_one(lab: Path) -> None:
    """A reader that knows nothing of locks opens the folder once and reads; all files are of one set."""

    def write() -> int:
        for k in range(60):
            with changing(lab) as place:
                (place / "results").mkdir()
                for name in "abcd":
                    (place / "results" / name).write_text(str(k))
                replace_parts(lab)
        return 0

    sets: set[str] = set()
    pid = in_a_copy(write, lab.parent)
    while os.waitpid(pid, os.WNOHANG)[0] == 0:
        handle = os.open(lab / "results", os.O_RDONLY)
        try:
            found = {_text(handle, name) for name in "abcd"}
        except FileNotFoundError:  # the old folder is being cleared away, or nothing was written yet
            continue
        finally:
            os.close(handle)
        assert len(found) == 1
        sets |= found
    assert (lab / "results" / "a").read_text() == "59"
    assert len(sets) > 5


def _text(folder: int, name: str) -> str:
    handle = os.open(name, os.O_RDONLY, dir_fd=folder)
    try:
        return os.read(handle, 99).decode()
    finally:
        os.close(handle)


def test_a_busy_folder_is_a_cause_that_passes() -> None:
    assert cause_of(BusyError("x")) in MAY_PASS


def test_two_makers_of_one_folder(tmp_path: Path) -> None:
    with whole_folder(tmp_path / "new") as place:
        (place / "a").write_text("1")
        again = whole_folder(tmp_path / "new")
        with pytest.raises(BusyError, match=rf"works on this folder .process {os.getpid()} on "), again:
            pass
        assert (place / "a").is_file()
    assert [p.name for p in (tmp_path / "new").iterdir()] == ["a"]
    assert leftovers(tmp_path) == []


def test_a_lock_that_is_no_lock(lab: Path, tmp_path: Path) -> None:
    """A folder from a stranger may hold a link in its place: what it leads to is not emptied."""
    (tmp_path / "thesis").write_text("the only copy")
    (lab / LOCK).symlink_to(tmp_path / "thesis")
    with pytest.raises(SurveyError, match="is no lock of labsurvey; remove it"):
        adjust_job(lab, progress=False)
    (lab / LOCK).unlink()
    os.mkfifo(lab / LOCK)
    with pytest.raises(SurveyError, match="is no lock of labsurvey; remove it"):
        adjust_job(lab, progress=False)
    assert (tmp_path / "thesis").read_text() == "the only copy"


def test_observations_do_not_change_under_a_capture_session(lab: Path) -> None:
    with session_lock(lab), pytest.raises(BusyError, match="a session takes images"):
        remove_job(lab, ["p0-2"], progress=False)


def test_files_that_belong_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The overview of a batch, for one: all of its files or none."""
    write_set(tmp_path / "report", {"a": "1", "b": "1"})
    real, calls = os.replace, []

    def failing(source: Path, target: Path) -> None:
        calls.extend([target] if Path(target).parent == tmp_path / "report" else [])
        if len(calls) == 2 and calls[-1] == target:
            raise OSError(errno.ENOSPC, "No space left on device", str(target))
        real(source, target)

    monkeypatch.setattr(os, "replace", failing)
    with pytest.raises(OSError, match="No space left"):
        write_set(tmp_path / "report", {"a": "2", "b": "2"})
    assert {p.name: p.read_text() for p in (tmp_path / "report").iterdir()} == {"a": "1", "b": "1"}


def test_a_folder_made_for_results_goes_again(tmp_path: Path) -> None:
    write_project(tmp_path / "lab", ring())
    (tmp_path / "lab" / "observations" / "pairs.csv").unlink()
    assert main(["adjust", str(tmp_path / "lab"), "--out", str(tmp_path / "deep" / "out"), "--quiet"]) == FAILED
    assert not (tmp_path / "deep").exists()


# links


def test_a_project_behind_a_link(lab: Path, tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(lab)
    (tmp_path / "link" / "results" / "solution.json").unlink()
    assert main(["adjust", str(tmp_path / "link"), "--quiet"]) == 0
    assert (lab / "results" / "solution.json").is_file()
    assert (tmp_path / "link").is_symlink()
    assert not (lab / "results").is_symlink()
    with changing(lab), pytest.raises(BusyError), changing(tmp_path / "link"):
        pass


def test_inputs_behind_links_are_read(lab: Path, tmp_path: Path) -> None:
    before = json.loads((lab / "results/solution.json").read_text())["points"]
    for name in ("survey.toml", "observations"):
        (lab / name).rename(tmp_path / name)
        (lab / name).symlink_to(tmp_path / name)
    assert main(["adjust", str(lab), "--quiet"]) == 0
    assert json.loads((lab / "results/solution.json").read_text())["points"] == before


def test_nothing_is_written_through_a_link(lab: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name in ("results", "observations"):
        (lab / name).rename(tmp_path / name)
        (lab / name).symlink_to(tmp_path / name)
        before = content(tmp_path)
        assert main(["remove", str(lab), "p0-2", "--quiet"]) == FAILED
        assert "link" in capsys.readouterr().err
        with pytest.raises(SurveyError, match=r"is a link|lies behind a link"):
            _changed(lab, f"{name}/deep/image_points.csv")
        assert content(tmp_path) == before
        (lab / name).unlink()
        (tmp_path / name).rename(lab / name)


def _changed(lab: Path, name: str) -> None:
    with changing(lab) as place:
        atomic_write(place / name, "new")
        replace_parts(lab)


def test_a_table_behind_a_link_is_replaced_not_written_to(lab: Path, tmp_path: Path) -> None:
    table = lab / "observations" / "exclusions.csv"
    shared = tmp_path / "shared.csv"
    shared.write_text("what,id\n")
    before = shared.read_bytes()
    table.symlink_to(shared)
    assert main(["remove", str(lab), "p0-2", "--quiet"]) == 0
    assert shared.read_bytes() == before
    assert not table.is_symlink()
    assert "pairs:p0-2" in table.read_text()


def test_a_new_folder_behind_a_link(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert main(["example", "total-station", str(tmp_path / "link"), "--quiet"]) == 0
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "real" / "survey.toml").is_file()


# odd locales


def test_names_of_bytes(tmp_path: Path) -> None:
    """As the C locale gives them: UTF-8 comes out as what it is, anything else as unknown."""
    atomic_write(tmp_path / "a", os.fsencode("Süd").decode("ascii", "surrogateescape") + " ä")
    atomic_write(tmp_path / "b", b"S\xfcd".decode("ascii", "surrogateescape"))
    assert (tmp_path / "a").read_text("utf-8") == "Süd ä"
    assert (tmp_path / "b").read_text("utf-8") == "S\ufffdd"


_COMMANDS = """
import sys
from survey.cli import main
lab = sys.argv[1]
for argv in (["remove", lab, "p0-2"], ["adjust", lab, "--json"], ["report", lab, "--language", "de"], ["plan", lab],
             ["convert", lab, lab + ".g2o"], ["convert", lab + ".g2o", lab + " back"], ["detect", lab]):
    code = main(argv)
    sys.stderr.flush()
    if code != (argv[0] == "detect"):
        sys.exit(f"{argv[0]}: {code}")
"""


def test_a_terminal_that_knows_few_letters(tmp_path: Path) -> None:
    """The C locale, output in Latin-1: names of another alphabet, all commands after one another."""
    folder = adjusted_ring(tmp_path).rename(tmp_path / "実験室 Süd's")
    text = (folder / "survey.toml").read_text("utf-8")
    (folder / "survey.toml").write_text(text.replace('title = ""', 'title = "лаборатория"'), encoding="utf-8")
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0",
                   "PYTHONIOENCODING": "latin-1"}  # fmt: skip
    command = [sys.executable, "-c", _COMMANDS, os.fsencode(folder)]
    root = Path(__file__).parents[2]
    done = subprocess.run(command, env=environment, capture_output=True, cwd=root, check=False)
    assert b"Traceback" not in done.stderr
    assert done.returncode == 0, done.stderr
    assert "лаборатория" in (folder / "results" / "report.html").read_text("utf-8")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([folder.name + end for end in ("", ".g2o", " back")])


def test_steps_are_counted(grounds: dict[str, Ground]) -> None:
    """The harness sees what it is to interrupt."""
    ground = grounds["remove"]
    ground.afresh()
    steps = steps_of(ground.argv, ground.home)
    assert sum(step.startswith("renameat2") for step in steps) == 1
    assert any(step.startswith("os.rename") and step.endswith(".adding/observations/exclusions.csv") for step in steps)
    assert steps.count("fsync") >= 8
