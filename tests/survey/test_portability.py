"""What not every system has: taken away, and the work goes on."""

import ctypes
import errno
import fcntl
import os
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

import survey.folder.exchange
from adjust.model.errors import SurveyError
from adjust.native.parallel import cores
from capture.session.run import _heard, _signals_blocked
from survey.cli import main
from survey.examples import write_example
from survey.folder import locking
from survey.folder.exchange import CannotTradeError, trade
from survey.folder.locking import FileLock, holder_of
from survey.folder.replacing import changing, replace_parts


@pytest.fixture
def elsewhere(monkeypatch: pytest.MonkeyPatch) -> None:
    """A system that has nothing beyond what Python promises on all kinds of Unix."""
    monkeypatch.delattr(os, "sched_getaffinity")
    monkeypatch.delattr(os, "O_NOFOLLOW")
    monkeypatch.delattr(os, "O_NONBLOCK")
    monkeypatch.delattr(signal, "sigtimedwait")
    own, real = ctypes.CDLL, os.link  # the native core is loaded by name, the system without one
    monkeypatch.setattr(ctypes, "CDLL", lambda name, **more: own(name, **more) if name else SimpleNamespace())

    def link(source: str, target: str, follow_symlinks: bool = True) -> None:
        if not follow_symlinks:
            raise NotImplementedError("link: follow_symlinks unavailable on this platform")
        real(source, target)

    monkeypatch.setattr(os, "link", link)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    write_example("total-station", tmp_path / "lab")
    return tmp_path / "lab"


@pytest.mark.slow
@pytest.mark.parametrize("lacking", ["nothing", "module", "call"])
def test_a_project_is_adjusted_twice(
    lab: Path, elsewhere: None, lacking: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """With locks, where the module for them is missing, and where it is there without the call that locks."""
    if lacking == "module":
        monkeypatch.setattr(locking, "fcntl", None)
    elif lacking == "call":
        monkeypatch.delattr(fcntl, "flock")
    assert main(["adjust", str(lab), "--quiet"]) == 0
    before = (lab / "results" / "residuals_other.csv").read_bytes()
    (lab / "results" / "mine.txt").write_text("the only copy")
    assert main(["adjust", str(lab), "--quiet"]) == 0
    assert (lab / "results" / "residuals_other.csv").read_bytes() == before
    assert (lab / "results" / "mine.txt").read_text() == "the only copy"
    assert [p.name for p in lab.iterdir() if p.name.startswith(".")] == []


def test_cores_are_counted(elsewhere: None) -> None:
    assert cores() == os.cpu_count()


def test_no_lock_is_taken_through_a_link(elsewhere: None, tmp_path: Path) -> None:
    (tmp_path / "lock").symlink_to(tmp_path / "other")
    with pytest.raises(SurveyError, match="is no lock of labsurvey"), FileLock(tmp_path / "lock", tmp_path, "command"):
        pass
    assert not (tmp_path / "other").exists()
    assert holder_of(tmp_path / "lock") is None
    (tmp_path / "lock").unlink()
    with FileLock(tmp_path / "lock", tmp_path, "command"):
        assert f"process {os.getpid()}" in str(holder_of(tmp_path / "lock"))


def test_signals_are_fetched(elsewhere: None) -> None:
    before = [signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGTERM)]
    with _signals_blocked(SimpleNamespace()):
        assert _heard(0.0) is None
        os.kill(os.getpid(), signal.SIGUSR1)
        assert _heard(0.01) == signal.SIGUSR1
        os.kill(os.getpid(), signal.SIGTERM)  # else it would end this process
        time.sleep(0.01)
    assert before == [signal.getsignal(number) for number in (signal.SIGUSR1, signal.SIGTERM)]


def test_folders_trade_places_as_macos_does_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its call has two names and a flag; what it does here is done by three moves."""
    asked = []

    def renamex_np(one: bytes, other: bytes, flags: int) -> int:
        asked.append(flags)
        os.rename(one, one + b".away")
        os.rename(other, one)
        os.rename(one + b".away", other)
        return 0

    monkeypatch.setattr(ctypes, "CDLL", lambda *_, **__: SimpleNamespace(renamex_np=renamex_np))
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "old.txt").write_text("old")
    with changing(tmp_path) as place:
        (place / "results").mkdir()
        (place / "results" / "new.txt").write_text("new")
        replace_parts(tmp_path)
    assert asked == [2]  # RENAME_SWAP of <sys/stdio.h>
    assert sorted(p.name for p in (tmp_path / "results").iterdir()) == ["new.txt", "old.txt"]


def test_a_system_that_cannot_trade_says_so(elsewhere: None, tmp_path: Path) -> None:
    with pytest.raises(CannotTradeError, match=os.strerror(errno.ENOSYS)):
        trade(tmp_path / "a", tmp_path / "b")
    assert survey.folder.exchange._renameat2(tmp_path / "a", tmp_path / "b") == errno.ENOSYS
