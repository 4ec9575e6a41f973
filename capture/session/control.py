"""What may be asked of a running session from outside: stop at once, pause, go on."""

import threading
from collections.abc import Callable

from adjust.model.errors import SurveyError


class AbortedError(SurveyError):
    """The session was told to stop."""


class Control:
    """Flags between the session's thread and whoever watches it. ``on_stop`` is called once, in the caller's thread."""

    def __init__(self) -> None:
        self._stop = threading.Event()
        self._go = threading.Event()
        self._go.set()
        self.on_stop: Callable[[], None] = lambda: None
        self.reason = ""

    @property
    def paused(self) -> bool:
        """Whether a pause was asked for."""
        return not self._go.is_set()

    @property
    def stopping(self) -> bool:
        """Whether a stop was asked for."""
        return self._stop.is_set()

    def toggle_pause(self) -> None:
        """Pause before the next set, or go on."""
        if self._go.is_set():
            self._go.clear()
        else:
            self._go.set()

    def stop(self, reason: str) -> None:
        """Stop now; the first reason counts."""
        if self._stop.is_set():
            return
        self.reason = reason
        self._stop.set()
        self.on_stop()
        self._go.set()

    def checkpoint(self) -> None:
        """Raise AbortedError where a stop was asked for."""
        if self._stop.is_set():
            raise AbortedError(f"the session was stopped: {self.reason}")

    def wait_while_paused(self) -> None:
        """Return when the session may go on; raises AbortedError."""
        self._go.wait()
        self.checkpoint()

    def sleep(self, seconds: float) -> None:
        """Wait, but not for longer than until a stop; raises AbortedError."""
        self._stop.wait(seconds)
        self.checkpoint()
