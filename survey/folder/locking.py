"""Locks: one command or session at a time may write a folder, and nobody reads it in the middle of a change.

The system frees them when their process ends, however it ends; what is left then is a file that nobody holds. The
package ``filelock`` would lock the files, but has no shared locks, none of folders, and does not say who holds one.
"""

import errno
import json
import os
import socket
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adjust.model.errors import SurveyError

try:
    import fcntl
except ImportError:  # no such locks on this system
    fcntl = None  # type: ignore[assignment]  # a module, or none

OBSERVATIONS_FOLDER, RESULTS = "observations", "results"
"""In a project folder: what is given, what is found."""
LOCK, SESSION_LOCK = ".labsurvey.lock", "capture/lock"
"""In a project folder: held by the command that writes it, by the session that takes its images."""
BEFORE, LIST = ".before", "entries.json"
"""In a project folder: what is being replaced; in there the list of it, while that is neither done nor undone."""
_HELD = (errno.EWOULDBLOCK, errno.EAGAIN, errno.EACCES)
_NO_FILE = (errno.ELOOP, errno.EMLINK, errno.EISDIR, errno.ENXIO)  # a link, a folder, a pipe
_LOOK_S, _PATIENCE_S, _TRIES = 0.01, 60.0, 5


class BusyError(SurveyError):
    """Somebody else works on the folder; later it may be free."""


class FileLock:
    """Keeps a folder for one process, by a file in it that names the process.

    path: the file; it goes when the lock is given back. folder, user: for messages, what is kept and by what kind of
    thing ("command", "session").
    """

    def __init__(self, path: Path, folder: Path, user: str) -> None:
        self.path, self._folder, self._user = path, folder, user
        self._handle: int | None = None

    def acquire(self) -> None:
        """Take the lock; raises BusyError naming who has it, SurveyError where there can be none, OSError."""
        while _has_locks() and self._handle is None:
            handle = self._opened()
            try:
                self._lock(handle)
                if _is_at(handle, self.path):  # else the last holder has just removed the file: make a new one
                    self._sign(handle)
                    self._handle, handle = handle, -1
            finally:
                if handle >= 0:
                    os.close(handle)

    def _opened(self) -> int:
        try:
            handle = _opened(self.path, os.O_RDWR | os.O_CREAT)
        except OSError as error:
            if error.errno in _NO_FILE:
                raise SurveyError(f"{self.path}: is no lock of labsurvey; remove it") from error
            raise OSError(error.errno, error.strerror, str(self._folder)) from error
        if not stat.S_ISREG(os.fstat(handle).st_mode):
            os.close(handle)
            raise SurveyError(f"{self.path}: is no lock of labsurvey; remove it")
        return handle

    def _sign(self, handle: int) -> None:
        try:
            os.ftruncate(handle, 0)
            os.write(handle, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
        except OSError as error:  # a full disk
            self.path.unlink(missing_ok=True)
            raise OSError(error.errno, error.strerror, str(self._folder)) from error

    def _lock(self, handle: int) -> None:
        try:
            for _ in range(_TRIES):  # somebody may just be asking who has it
                if _flocked(handle, shared=False):
                    return
                time.sleep(_LOOK_S)
            raise BusyError(f"{self._folder}: another {self._user} works on this folder ({_holder(handle)}); wait for "
                            "it or stop it")  # fmt: skip
        except OSError as error:
            self.path.unlink(missing_ok=True)
            raise SurveyError(
                f"{self._folder}: its file system has no locks ({error.strerror}), so that two could write it at once; "
                "work on a copy on a local disk"
            ) from error

    def release(self) -> None:
        """Give it back."""
        handle, self._handle = self._handle, None
        if handle is not None:
            self.path.unlink(missing_ok=True)  # before it is freed: whoever opens it then sees that it is not at hand
            os.close(handle)

    def __enter__(self) -> None:
        self.acquire()

    def __exit__(self, *_: object) -> None:
        self.release()


def holder_of(path: Path) -> str | None:
    """Who holds a lock; None where nobody does, whatever a dead process has left behind."""
    try:
        handle = _opened(path, os.O_RDONLY)
    except OSError:
        return None
    try:
        return None if _flocked(handle, shared=True) else _holder(handle)
    except OSError:
        return None
    finally:
        os.close(handle)


def hold(handle: int, path: Path) -> bool:
    """Say that a file just made is being written; False where :func:`remove_unheld` was faster and it is gone."""
    try:
        return _flocked(handle, shared=False) and _is_at(handle, path)
    except OSError:
        return True


def remove_unheld(path: Path) -> None:
    """Remove a file that no process holds."""
    try:
        handle = _opened(path, os.O_RDONLY)
    except OSError:
        return
    try:
        if _flocked(handle, shared=False):
            path.unlink(missing_ok=True)
    except OSError:
        pass  # no locks: nobody knows, it stays
    finally:
        os.close(handle)


@contextmanager
def folder_held(folder: Path, shared: bool) -> Iterator[None]:
    """Readers share a folder while they read it; who changes more than one file of it has it alone for that moment.

    The folder itself is locked, which takes no file and is possible on media that cannot be written. Where it is not
    possible at all, or somebody sits on it, this goes on without.
    """
    try:
        handle = os.open(folder, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    except OSError:
        yield  # the reader that follows says what is wrong
        return
    try:
        _wait_for(handle, shared)
        yield
    finally:
        os.close(handle)


def unfinished(folder: Path) -> bool:
    """Whether a replacement was begun and neither finished nor undone."""
    return (folder / BEFORE / LIST).is_file()


@contextmanager
def settled(folder: Path) -> Iterator[None]:
    """Nothing in the folder is replaced while it is read. Raises SurveyError where a killed command left a mixture."""
    end = time.monotonic() + _PATIENCE_S
    while True:
        with folder_held(folder, shared=True):
            if not unfinished(folder):
                yield
                return
        said = holder_of(folder / LOCK)
        if said is None or time.monotonic() > end:
            by = f"by {said}" if said else "by a command that was killed"
            raise SurveyError(f"{folder}: its files have been replaced half {by}; any command of labsurvey puts that "
                              "right where it can write the folder")  # fmt: skip
        time.sleep(_LOOK_S)


def _wait_for(handle: int, shared: bool) -> None:
    end = time.monotonic() + _PATIENCE_S
    try:
        while not _flocked(handle, shared) and time.monotonic() < end:
            time.sleep(_LOOK_S)
    except OSError:
        pass


def _has_locks() -> bool:
    return hasattr(fcntl, "flock")


def _flocked(handle: int, shared: bool) -> bool:
    """Try to lock; False where another has it. Raises OSError where the file system has no locks."""
    if not _has_locks():
        return True
    try:
        fcntl.flock(handle, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in _HELD:
            return False
        raise
    return True


def _opened(path: Path, flags: int) -> int:
    """Open a file that may be anything: no link is followed, no pipe waited for. Raises OSError."""
    follow_no = getattr(os, "O_NOFOLLOW", 0)
    if not follow_no and path.is_symlink():
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    return os.open(path, flags | follow_no | getattr(os, "O_NONBLOCK", 0), 0o666)


def _is_at(handle: int, path: Path) -> bool:
    try:
        return os.path.samestat(os.fstat(handle), os.lstat(path))
    except OSError:
        return False


def _holder(handle: int) -> str:
    try:
        who = json.loads(os.pread(handle, 1000, 0))
        return f"process {int(who['pid'])} on {who['host']!s}"
    except (ValueError, OverflowError, KeyError, TypeError, RecursionError, OSError):
        return "it has not said who it is"
