"""The table as a session uses it: every pose approached once, at rest while images are taken, stopped when in doubt."""

from collections.abc import Callable, Mapping
from contextlib import suppress

import numpy as np

from adjust.model.errors import SurveyError
from capture.devices.turntable import Location, TurntableError, degrees_text
from capture.devices.turntables.moving import MovingTable
from capture.plan.plan import CapturePlan, Shot
from capture.plan.table import TablePlan
from capture.session.control import Control
from capture.session.journal import clocks


class DriftError(SurveyError):
    """The table moved while the images were taken."""


class Placing:
    """The table of a plan. Where there is none, nothing moves and every location is that of no axes."""

    def __init__(self, plan: CapturePlan, table: MovingTable | None, control: Control) -> None:
        self._options, self._control = plan.options, control
        self._table: tuple[MovingTable, TablePlan] | None = None
        if table is not None and plan.table is not None:
            self._table = table, plan.table
        self._pose_id: str | None = None

    def description(self) -> Mapping[str, object] | None:
        """For the journal."""
        if self._table is None:
            return None
        plan = self._table[1]
        return {"table_id": plan.table_id, "driver": plan.driver, "axes": [axis.axis.name for axis in plan.axes]}

    def home(self, note: Callable[[str], None]) -> None:
        """Look for the references, where the plan wants it."""
        if self._table is not None and self._table[1].home:
            note(f"{self._table[0].name}: looking for its references")
            self._table[0].home().result()

    def go_to(self, shot: Shot) -> None:
        """Be at a pose, and wait there; where the table is there already, at once."""
        if self._table is not None and self._pose_id != shot.pose_id:
            self._table[0].set(shot.angles).result()
            self._control.sleep(self._options.wait_s)
        self._pose_id = shot.pose_id

    def locate(self) -> Location:
        """Where it is now."""
        none = np.zeros(0)
        return Location(none, none, **clocks()) if self._table is None else self._table[0].locate()

    def require_rest(self, before: Location, after: Location) -> None:
        """Raise DriftError where it has moved between two locations."""
        moved = np.abs(after.readback - before.readback)
        if self._table is not None and (moved > self._options.drift).any():
            table = self._table[0]
            raise DriftError(
                f"{table.name}: it moved while the images were taken, from {degrees_text(table.axes, before.readback)} "
                f"to {degrees_text(table.axes, after.readback)}; brake it, or give drift_deg a larger value"
            )

    def reopen(self) -> None:
        """Connect anew. Raises TurntableError."""
        if self._table is not None:
            self._table[0].reopen()

    def give_up_pose(self) -> None:
        """Stop after a fault; whatever happened, the pose is approached anew."""
        self._pose_id = None
        if self._table is not None:
            with suppress(TurntableError):  # a cut connection: the next try connects anew, or says so
                self._table[0].stop()

    def stop_at_once(self) -> None:
        """In the thread that asks for it; whatever moves ends with StoppedError."""
        if self._table is not None:
            with suppress(TurntableError):
                self._table[0].emergency_stop()

    def stopped_text(self) -> str:
        """Stop for good, and say so."""
        if self._table is None:
            return ""
        try:
            self._table[0].stop()
        except TurntableError as error:
            return f"THE TABLE COULD NOT BE STOPPED ({error}), "
        return "the table is stopped, "
