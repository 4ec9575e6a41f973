"""The jobs behind ``labcapture table``: list, status, jog, home, stop."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from capture.devices.turntables.dialect import read_dialect, shipped_dialects
from capture.devices.turntables.moving import MovingTable
from capture.plan.plan import CapturePlan, read_plan
from capture.plan.table import DRIVERS, make_table
from capture.session.folder import session_lock
from capture.session.resume import last_readback
from survey.folder.text import suggestion


def driver_list() -> str:
    """Drivers and shipped dialects, one a line."""
    lines = [f"{name:<11}{what}" for name, what in DRIVERS.items()]
    dialects = [f"  {name:<16}{read_dialect(name).title}" for name in shipped_dialects()]
    return "\n".join([*lines, "dialects of ascii (or the path of a .toml file):", *dialects])


def table_job(
    path: Path, *, jog: Sequence[str] | None = None, home: bool = False, stop: bool = False
) -> dict[str, Any]:
    """Where the table of a plan is, after what was asked for. Raises SurveyError, KeyboardInterrupt after stopping."""
    plan = read_plan(path)
    if plan.table is None:
        raise SurveyError(f"{path}: the plan has no [table]")
    if stop:  # also while a session runs: whoever says stop means it
        return _with_table(plan, lambda table: table.stop())
    lock = session_lock(plan.project)
    if jog is not None or home:
        lock.acquire()
    try:
        if jog is not None:
            return _with_table(plan, lambda table: _jog(table, jog))
        return _with_table(plan, (lambda table: table.home().result()) if home else lambda table: None)
    finally:
        lock.release()


def _with_table(plan: CapturePlan, action: Any) -> dict[str, Any]:
    if plan.table is None:
        raise SurveyError(f"{plan.file}: the plan has no [table]")
    table = make_table(plan.table, last_readback(plan.project))
    table.open()
    try:
        action(table)
        return table_status(table, plan)
    except KeyboardInterrupt:
        table.emergency_stop()
        raise
    finally:
        table.close()


def _jog(table: MovingTable, words: Sequence[str]) -> None:
    table.set(jog_target(table, words)).result()


def jog_target(table: MovingTable, words: Sequence[str]) -> FloatArray:
    """(n,) rad from ``axis1=12.5`` (to), ``axis1=+0.5`` or ``axis1=-0.5r`` (by); axes that are not named stay."""
    names = [axis.name for axis in table.axes]
    target = table.position
    for word in words:
        name, equals, text = word.partition("=")
        if not equals or name not in names:
            raise SurveyError(f"{word!r}: write AXIS=DEG; {suggestion(name, names)}")
        relative = text.startswith("+") or text.endswith("r")
        try:
            angle = math.radians(float(text.removesuffix("r")))
        except ValueError as error:
            raise SurveyError(f"{word!r}: {text!r} is no angle in degrees") from error
        i = names.index(name)
        target[i] = target[i] + angle if relative else angle
    return target


def table_status(table: MovingTable, plan: CapturePlan) -> dict[str, Any]:
    """Name, address and the state of every axis, in degrees."""
    table_id = "" if plan.table is None else plan.table.table_id
    rows = []
    for axis, state in zip(table.axes, table.states(), strict=True):
        rows.append(
            {
                "name": axis.name,
                "readback_deg": round(float(np.degrees(state.angle)), 9),
                "limits_deg": [round(math.degrees(axis.lower), 9), round(math.degrees(axis.upper), 9)],
                "moving": state.moving,
                "fault": state.fault,
            }
        )
    return {"table": table_id, "address": table.address, "axes": rows}
