"""The sign of an axis: images alone cannot tell it, what is given of base, mount or cameras can.

A table whose inner axis is read with the wrong sign moves like one whose base and mount are turned by half a turn about
the outer axis: ``R1(a1) R2(-a2) = S R1(a1) R2(a2) S`` with S half a turn about axis 1.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from adjust.model.survey import FloatArray, PoseParameter, Survey, Table
from adjust.spatial.rigid import inverse, rotation_exp, rotation_log
from adjust.start.network import given_pose

_WRONG_RAD = np.radians(90.0)
_RIGHT_RAD = np.radians(45.0)


@dataclass(frozen=True)
class SignVerdict:
    """Axes whose readings have the wrong sign, what showed it, and how far off (rad) it is as it stands and negated."""

    axes: tuple[str, ...]
    shown_by: str
    as_given: float
    corrected: float


def given_constants(survey: Survey, table: Table) -> tuple[dict[tuple[str, str], FloatArray], dict[str, FloatArray]]:
    """What is given: ``mount_from_inner`` by ("camera" or "target", id), ``table_from_target`` by target id."""
    stations = {s.station_id: s for s in survey.stations if s.motion == "table" and s.table_id == table.table_id}
    inner: dict[tuple[str, str], FloatArray] = {}
    things: list[tuple[str, str, str | None, PoseParameter]] = [
        ("camera", c.camera_id, c.station_id, c.station_from_camera) for c in survey.cameras
    ]
    things += [("target", t.target_id, t.station_id, t.carrier_from_target) for t in survey.targets]
    for kind, name, station_id, parameter in things:
        mount = given_pose(stations[station_id].mount_from_station) if station_id in stations else None
        own = given_pose(parameter)
        if mount is not None and own is not None:
            inner[kind, name] = mount @ own
    outer: dict[str, FloatArray] = {}
    base = given_pose(table.world_from_table)
    if base is not None:
        for t in survey.targets:
            own = given_pose(t.carrier_from_target)
            if t.station_id is None and t.motion == "fixed" and own is not None:
                outer[t.target_id] = inverse(base) @ own
    return inner, outer


def sign_mistake(
    table: Table,
    found_inner: Mapping[tuple[str, str], FloatArray],
    found_outer: Mapping[str, FloatArray],
    given_inner: Mapping[tuple[str, str], FloatArray],
    given_outer: Mapping[str, FloatArray],
) -> SignVerdict | None:
    """Compare the constants (4, 4) found with those given, as they stand and with axes negated."""
    pairs = [(f"{k[0]} {k[1]} on the mount", found_inner[k], given_inner[k]) for k in given_inner if k in found_inner]
    pairs += [
        (f"target {k} against the table", found_outer[k], given_outer[k]) for k in given_outer if k in found_outer
    ]
    if not pairs:
        return None
    axes = ["xyz".index(a) for a in table.axes]
    as_given = [_apart(table, f, g) for _, f, g in pairs]
    trials = _half_turns(axes)
    results = []
    for names, S in trials:
        turned = np.eye(4)
        turned[:3, :3] = S
        results.append((max(_apart(table, turned @ f, g) for _, f, g in pairs), names))
    best, names = min(results)
    worst = int(np.argmax(as_given))
    if as_given[worst] < _WRONG_RAD or best > _RIGHT_RAD:
        return None
    return SignVerdict(names, pairs[worst][0], as_given[worst], best)


def _half_turns(axes: list[int]) -> list[tuple[tuple[str, ...], FloatArray]]:
    turn = [rotation_exp(np.pi * np.eye(3)[i]) for i in range(3)]
    if len(axes) == 1:
        return [(("axis1",), turn[(axes[0] + 1) % 3])]
    p, q = axes
    return [(("axis1",), turn[q]), (("axis2",), turn[p]), (("axis1", "axis2"), turn[3 - p - q])]


def _apart(table: Table, found: FloatArray, given: FloatArray) -> float:
    """Angle (rad) between two constants; of a table of one axis that between the directions of its axis."""
    if len(table.axes) == 1:
        i = "xyz".index(table.axes[0])
        return float(np.arccos(np.clip(found[i, :3] @ given[i, :3], -1.0, 1.0)))
    return float(np.linalg.norm(rotation_log(found[:3, :3].T @ given[:3, :3])))
