"""What no reader may do, caught in the act: leave its folder, start something, unpickle, hang, fill the memory."""

import os
import resource
import signal
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

_STARTS = ("pickle.find_class", "os.system", "subprocess.Popen", "os.exec", "os.posix_spawn", "os.fork",
           "socket.connect", "socket.bind", "urllib.Request", "webbrowser.open", "ctypes.dlopen")  # fmt: skip
_CHANGES = ("os.remove", "os.rename", "os.rmdir", "os.mkdir", "os.link", "os.symlink", "os.truncate", "os.chmod",
            "shutil.rmtree", "shutil.copyfile", "shutil.move")  # fmt: skip
_BESIDE = ("os.remove", "os.rmdir", "os.rename")  # these may be told a folder by its handle


_WAITING = 10.0  # times the limit by the clock on the wall


class ForbiddenError(BaseException):
    """Not an Exception: no reader can mistake it for a fault of its file."""


class HangError(BaseException):
    """The time for one input is over."""


class Watch:
    """Installed once in a process; looks only while an input is read."""

    def __init__(self, root: Path, limit_s: float) -> None:
        self._root, self._limit_s = os.path.realpath(root), limit_s
        self._code = tuple(os.path.realpath(p) for p in {sys.prefix, sys.base_prefix, str(Path(__file__).parents[2])})
        self._armed = False
        sys.addaudithook(self._event)
        for number in (signal.SIGALRM, signal.SIGPROF):
            signal.signal(number, self._late)
        warnings.simplefilter("error")  # a warning out of a reader is a fault that nobody thought of

    @contextmanager
    def reading(self) -> Iterator[None]:
        """While one input is read."""
        signal.setitimer(signal.ITIMER_PROF, self._limit_s)  # of the processor: others may be busy with it
        signal.setitimer(signal.ITIMER_REAL, _WAITING * self._limit_s)  # and whoever waits takes none
        self._armed = True
        try:
            yield
        finally:
            self._armed = False
            signal.setitimer(signal.ITIMER_PROF, 0.0)
            signal.setitimer(signal.ITIMER_REAL, 0.0)

    def _late(self, *_: Any) -> None:
        raise HangError(f"took longer than {self._limit_s} s")

    def _event(self, event: str, arguments: tuple[Any, ...]) -> None:
        if not self._armed:
            return
        if event in _STARTS:
            raise ForbiddenError(f"{event} {arguments!r}"[:300])
        if event == "open" and isinstance(arguments[0], str | bytes):
            self._look(event, os.fsdecode(arguments[0]), not _is_reading(arguments))
        elif event in _CHANGES:
            handles = [x for x in arguments if isinstance(x, int) and x >= 0]
            for name in arguments[:2]:
                if isinstance(name, str | bytes):
                    base = f"/proc/self/fd/{handles[0]}" if handles and event in _BESIDE else ""
                    self._look(event, os.path.join(base, os.fsdecode(name)), True)

    def _look(self, event: str, name: str, changes: bool) -> None:
        armed, self._armed = self._armed, False
        path = os.path.realpath(name)
        self._armed = armed
        inside = path == self._root or path.startswith(self._root + os.sep)
        known = not changes and path.startswith(self._code)
        if not inside and not known:
            raise ForbiddenError(f"{event} outside of its folder: {path}")


def _is_reading(arguments: tuple[Any, ...]) -> bool:
    mode, flags = arguments[1], arguments[2] if len(arguments) > 2 else 0
    if isinstance(mode, str):
        return not set(mode) & set("wax+")
    return not (isinstance(flags, int) and flags & (os.O_WRONLY | os.O_RDWR))


def limit_memory(more: int) -> None:
    """Let this process take so many bytes beyond what it has."""
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + more,) * 2)
