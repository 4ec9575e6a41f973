"""A turntable from any controller: limits, chosen path, settling, stalls and stops are the same for all of them."""

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future

import numpy as np

from adjust.model.survey import FloatArray
from capture.devices.turntable import (
    Axis,
    AxisState,
    Controller,
    ControllerError,
    Location,
    NotSettledError,
    Settle,
    StalledError,
    StoppedError,
    TableDisconnectedError,
    TurntableError,
    degrees_text,
)

_LEAST = 3  # readings that tell rest from motion


class MovingTable:
    """The turntable of a session, over a ``Controller``; usable from several threads, one more watches each move.

    The shape is bluesky's (name, position, set -> status, stop, locate), without the dependency; a status is a future
    whose ``result`` waits for the end and raises what went wrong.
    axes: outermost first. near: (n,) rad, where the table was last, for controllers whose readback loses turns.
    """

    def __init__(
        self, name: str, axes: Sequence[Axis], controller: Controller, settle: Settle, near: FloatArray | None = None
    ) -> None:
        self.name, self.axes = name, tuple(axes)
        self._controller, self._settle = controller, settle
        self._io = threading.Lock()
        self._stopped = threading.Event()
        self._locked_out = self._closed = False
        self._status: Future[None] | None = None
        self._setpoint = np.full(len(self.axes), np.nan)
        self._last = None if near is None else np.array(near, float)
        self.stop_sent_ns: int | None = None  # monotonic; when the last stop had been acknowledged

    @property
    def address(self) -> str:
        """How the controller is reached."""
        return self._controller.address

    @property
    def position(self) -> FloatArray:
        """The readback, (n,) rad."""
        return np.array([state.angle for state in self.states()])

    def open(self) -> None:
        """Connect; nothing moves."""
        with self._io:
            self._closed = False
            self._controller.open()
        try:
            self.states()
        except BaseException:
            self._controller.close()
            raise

    def reopen(self) -> None:
        """Connect anew, after a cable was pulled; the count of turns goes on."""
        with self._io:
            self._controller.close()
            self._closed = False
            self._controller.open()
        self.states()

    def close(self) -> None:
        """Stop what still turns, and disconnect; never raises."""
        try:
            if self._status is not None and not self._status.done():
                self.stop()
        except TurntableError:
            pass  # whoever closes has no use for a table that cannot be reached
        with self._io:
            self._closed = True
            self._controller.close()

    def states(self) -> tuple[AxisState, ...]:
        """What the controller says of all axes, turns counted."""
        with self._io:
            found = [self._controller.read(i) for i in range(len(self.axes))]
            angles = self._unwrapped(np.array([state.angle for state in found]))
        return tuple(
            AxisState(float(angle), state.moving, state.fault) for angle, state in zip(angles, found, strict=True)
        )

    def _unwrapped(self, angles: FloatArray) -> FloatArray:
        modulo = self._controller.modulo
        if modulo is not None:
            near = np.zeros(len(angles)) if self._last is None else self._last
            angles = angles + modulo * np.round((near - angles) / modulo)
        self._last = angles
        return angles

    def check(self, angles: Sequence[float] | FloatArray) -> None:
        """Raise LimitError where a position cannot be reached from here or from anywhere; sends nothing."""
        self._targets(angles, np.zeros(len(self.axes)) if self._last is None else self._last)

    def _targets(self, angles: Sequence[float] | FloatArray, current: FloatArray) -> FloatArray:
        if len(angles) != len(self.axes):
            raise TurntableError(f"{self.name}: {len(angles)} angles for {len(self.axes)} axes; give one each")
        rows = zip(self.axes, angles, current, strict=True)
        return np.array([axis.target(float(angle), float(now)) for axis, angle, now in rows])

    def set(self, angles: Sequence[float] | FloatArray) -> Future[None]:
        """Start to turn to angles (n,) rad. Raises LimitError before the first axis is told anything."""
        self.check(angles)
        self._begin()
        current = self.position
        self._setpoint = targets = self._targets(angles, current)
        return self._sent(
            lambda i: self._controller.move(i, float(targets[i]), float(targets[i] - current[i])), targets
        )

    def home(self) -> Future[None]:
        """Look for the references; the readback afterwards is the setpoint."""
        self._begin()
        return self._sent(self._controller.home, None)

    def _sent(self, send: Callable[[int], None], targets: FloatArray | None) -> Future[None]:
        """All axes sent off, and a thread that watches them; where one is not, all are stopped."""
        self._status = status = Future[None]()
        try:
            for i in range(len(self.axes)):
                with self._io:
                    self._require_released()
                    send(i)
        except BaseException as error:
            self._fail(status, error)
            raise
        threading.Thread(target=self._watch, args=(status, targets), name=f"{self.name} moves", daemon=True).start()
        return status

    def _begin(self) -> None:
        if self._locked_out:
            raise StoppedError(f"{self.name}: stopped in an emergency; it moves again after release")
        if self._status is not None and not self._status.done():
            raise TurntableError(f"{self.name}: it is still moving; wait for the move before, or stop it")
        self._stopped.clear()

    def _require_released(self) -> None:
        if self._locked_out or self._stopped.is_set():
            raise StoppedError(f"{self.name}: stopped before all axes were sent off")

    def stop(self) -> None:
        """Stop all axes, a move under way ends with StoppedError; over a cut connection once more with a new one."""
        self._stopped.set()
        with self._io:
            try:
                self._controller.stop()
            except TableDisconnectedError:
                if self._closed:  # by whoever let go of the table: a move that notices it late takes no new connection
                    raise
                self._controller.close()
                self._controller.open()
                self._controller.stop()
        self.stop_sent_ns = time.monotonic_ns()

    def emergency_stop(self) -> None:
        """Stop, and refuse to move until ``release``."""
        self._locked_out = True
        self.stop()

    def release(self) -> None:
        """Allow moves again."""
        self._locked_out = False

    def locate(self) -> Location:
        """Setpoint and readback."""
        return Location(self._setpoint.copy(), self.position, time.monotonic_ns(), time.time_ns())

    def _fail(self, status: Future[None], error: BaseException) -> None:
        """Stop first, tell afterwards; a stop that fails too is part of the news."""
        try:
            self.stop()
        except TurntableError as second:
            error.add_note(f"the stop after it failed too: {second}")
        status.set_exception(error)

    def _watch(self, status: Future[None], targets: FloatArray | None) -> None:
        try:
            self._until_settled(targets)
        except BaseException as error:  # told to whoever waits
            self._fail(status, error)
        else:
            status.set_result(None)

    def _until_settled(self, targets: FloatArray | None) -> None:
        settle, begin = self._settle, time.monotonic()
        seen: deque[tuple[float, FloatArray]] = deque()
        while True:
            states, now = self.states(), time.monotonic()
            if self._stopped.is_set():
                raise StoppedError(f"{self.name}: the move was stopped at {self._where(states)}")
            self._require_no_fault(states)
            angles = np.array([state.angle for state in states])
            seen.append((now, angles))
            # one sample older than the window stays, so that the window is always spanned
            while len(seen) > _LEAST and now - seen[1][0] >= max(settle.window_s, settle.stall_s):
                seen.popleft()
            moving = any(state.moving for state in states)
            arrived = targets is None or bool(np.all(np.abs(angles - targets) <= settle.tolerance))
            if not moving and arrived and self._still(seen, now, settle.window_s):
                if targets is None:
                    self._setpoint = self._at_turn_zero(angles)
                return
            self._require_progress(seen, now, states, targets, moving)
            if now - begin > settle.timeout_s:
                where = self._where(states)
                raise NotSettledError(
                    f"{self.name}: not at rest after {settle.timeout_s:g} s, at {where}; look for vibration, or give "
                    "settle a larger tolerance_deg, still_deg or timeout_s"
                )
            time.sleep(settle.poll_s)

    def _at_turn_zero(self, angles: FloatArray) -> FloatArray:
        """A reference is found at turn zero, whichever way the search went."""
        modulo = self._controller.modulo
        with self._io:
            self._last = angles if modulo is None else angles - modulo * np.round(angles / modulo)
            return self._last

    def _still(self, seen: deque[tuple[float, FloatArray]], now: float, span_s: float) -> bool:
        return bool(np.all(self._spread(seen, now, span_s) <= self._settle.still))

    def _spread(self, seen: deque[tuple[float, FloatArray]], now: float, span_s: float) -> FloatArray:
        """Spread (n,) of the readback over the last ``span_s``; infinite until they have passed.

        Where a slow line or a busy machine leaves few readings in them, older ones count too: one alone has no spread.
        """
        if now - seen[0][0] < span_s or len(seen) < _LEAST:
            return np.full(len(self.axes), np.inf)
        n = max(_LEAST, sum(now - at <= span_s for at, _ in seen))
        return np.asarray(np.ptp(np.array([angles for _, angles in list(seen)[-n:]]), axis=0))

    def _require_no_fault(self, states: Sequence[AxisState]) -> None:
        for axis, state in zip(self.axes, states, strict=True):
            if state.fault:
                raise ControllerError(
                    f"{self.name}: the controller reports {state.fault!r} of axis {axis.name!r} at "
                    f"{np.degrees(state.angle):.4f} deg; clear it there, then go on"
                )

    def _require_progress(
        self,
        seen: deque[tuple[float, FloatArray]],
        now: float,
        states: Sequence[AxisState],
        targets: FloatArray | None,
        moving: bool,
    ) -> None:
        """Raise StalledError where an axis stands still although it should move, or has ended elsewhere."""
        settle = self._settle
        spread = self._spread(seen, now, settle.stall_s)
        if targets is None:
            return  # a reference search may wait at its switch; its end is the time-out
        for i, axis in enumerate(self.axes):
            away = abs(states[i].angle - targets[i])
            if away > settle.tolerance and spread[i] <= settle.still:
                what = "stands still while it should move" if moving else "has ended"
                raise StalledError(
                    f"{self.name}: axis {axis.name!r} {what} at {np.degrees(states[i].angle):.4f} deg, "
                    f"{np.degrees(away):.4f} deg from its setpoint {np.degrees(targets[i]):.4f} deg, for "
                    f"{settle.stall_s:g} s; the table was stopped; look for what blocks it"
                )

    def _where(self, states: Sequence[AxisState]) -> str:
        return degrees_text(self.axes, [state.angle for state in states])
