"""A plan from start to end: lock, table, cameras, and the session in a thread of its own.

The session has a thread of its own so that a Ctrl-C is heard at once, whatever the cameras' libraries are doing: the
signals are blocked everywhere and waited for here, and the stop goes to the table from here.
"""

import os
import signal
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager

from capture.devices.turntables.moving import MovingTable
from capture.plan.plan import CapturePlan, check_plan_limits
from capture.session.cameras import PlannedCameras
from capture.session.control import Control
from capture.session.folder import session_lock
from capture.session.progress import Progress
from capture.session.quality_thread import QualityWatch
from capture.session.table_jobs import opened_table
from capture.session.taking import Outcome, Session, Taken

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1)
_LOOK_S = 0.05
_noted: deque[int] = deque()


def run_plan(plan: CapturePlan, *, shown: bool = True) -> Outcome:
    """Take all images of a plan that are not there yet; ``shown``: progress on stderr.

    Raises SurveyError; SessionStoppedError after a fault that stayed, or a Ctrl-C.
    """
    check_plan_limits(plan)
    with ExitStack() as stack:
        stack.enter_context(session_lock(plan.project))
        progress = Progress(plan.project, len(plan.shots), shown)
        stack.callback(progress.close)
        control = stack.enter_context(_signals_blocked(Control()))
        table = stack.enter_context(opened_table(plan.table, plan.project)) if plan.table is not None else None
        cameras = stack.enter_context(PlannedCameras(plan.cameras, plan.options.trigger))
        watch = stack.enter_context(QualityWatch(plan)) if plan.options.quality else None
        return run_session(plan, table, cameras, control, progress, watch)


def run_session(
    plan: CapturePlan,
    table: MovingTable | None,
    cameras: PlannedCameras,
    control: Control,
    progress: Progress,
    watch: QualityWatch | None,
) -> Outcome:
    """The session in a thread, signals and keys here."""
    found: list[Outcome | BaseException] = []

    def listener(taken: Taken) -> None:
        progress.taken(taken, watch(taken.record["epoch_id"], taken.frames) if watch is not None else {})

    session = Session(plan, table, cameras, control, listener, progress.note)

    def work() -> None:
        try:
            found.append(session.run())
        except BaseException as error:  # raised again by the caller
            found.append(error)

    worker = threading.Thread(target=work, name="capture session")
    progress.state("running")
    worker.start()
    with _keys() as pressed:
        while worker.is_alive():
            _look(control, progress, pressed)
    worker.join()
    result = found[0]
    if isinstance(result, BaseException):
        progress.state("stopped", str(result))
        raise result
    if watch is not None:
        progress.quality(watch.finish())
    progress.state("finished")
    return result


def _look(control: Control, progress: Progress, pressed: Callable[[], str]) -> None:
    """Wait for a signal for a moment, then for a key."""
    heard = _heard(_LOOK_S)
    if heard is not None and heard != signal.SIGUSR1:
        control.stop(f"{signal.Signals(heard).name} received")
        return
    if heard is not None or pressed() in ("p", " "):
        control.toggle_pause()
        progress.state("paused" if control.paused else "running")
        progress.note("pausing before the next set; p goes on" if control.paused else "going on")


def _heard(seconds: float) -> int | None:
    """The next signal, waited for."""
    if hasattr(signal, "sigtimedwait"):
        heard = signal.sigtimedwait(_SIGNALS, seconds)
        # where the process was suspended meanwhile, Python tells of a signal that there was not, of any number
        return None if heard is None or heard.si_signo not in _SIGNALS else heard.si_signo
    time.sleep(seconds)
    return _noted.popleft() if _noted else None


@contextmanager
def _signals_blocked(control: Control) -> Iterator[Control]:
    """Signals wait to be fetched, in this thread and in all that are started from now on.

    Without ``sigtimedwait`` (macOS) a handler notes them: only a thread that waits for a signal is sure to get it.
    """
    if not hasattr(signal, "sigtimedwait"):
        handlers = {number: signal.signal(number, lambda heard, _: _noted.append(heard)) for number in _SIGNALS}
        try:
            yield control
        finally:
            _noted.clear()
            for number, handler in handlers.items():
                signal.signal(number, handler)
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _SIGNALS)
    try:
        yield control
    finally:
        while _heard(0) is not None:
            pass  # a second Ctrl-C while everything is being closed has done its work
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _keys() -> Iterator[Callable[[], str]]:
    """Keys as they are pressed, where stdin is a terminal that listens to this process."""
    if not sys.stdin or not sys.stdin.isatty() or os.getpgrp() != os.tcgetpgrp(sys.stdin.fileno()):
        yield lambda: ""
        return
    import select
    import termios
    import tty

    handle = sys.stdin.fileno()
    before = termios.tcgetattr(handle)
    tty.setcbreak(handle)

    def pressed() -> str:
        return os.read(handle, 1).decode("ascii", "replace") if select.select([handle], [], [], 0)[0] else ""

    try:
        yield pressed
    finally:
        termios.tcsetattr(handle, termios.TCSADRAIN, before)
