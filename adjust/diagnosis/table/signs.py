"""The sign of an axis: images alone cannot tell it, what is given of base, mount or cameras can.

A table whose inner axis is read with the wrong sign moves like one whose base and mount are turned by half a turn about
the outer axis: ``R1(a1) R2(-a2) = S R1(a1) R2(a2) S`` with S half a turn about axis 1.
"""

from collections.abc import Callable, Iterator

import numpy as np

from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.table.readings import column_edit, with_angles
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName, adjusted_pose
from adjust.model.survey import FloatArray, PoseParameter, Survey, Table
from adjust.spatial.rigid import inverse, rigid, rotation_exp, rotation_log
from adjust.start.network import given_pose

_WRONG_RAD = np.radians(90.0)
_RIGHT_RAD = np.radians(45.0)


@frozen
class SignVerdict:
    """Axes whose readings have the wrong sign, what showed it, and how far off (rad) it is as it stands and negated."""

    axes: tuple[str, ...]
    shown_by: str
    as_given: float
    corrected: float


Constants = tuple[dict[tuple[str, str], FloatArray], dict[str, FloatArray]]
"""``mount_from_inner`` (4, 4) by ("camera" or "target", id), and ``table_from_target`` by target id."""


def given_constants(survey: Survey, table: Table) -> Constants:
    """What is given."""
    return constants(survey, table, lambda _, parameter: given_pose(parameter))


def constants(
    survey: Survey, table: Table, pose: Callable[[ParameterName, PoseParameter], FloatArray | None]
) -> Constants:
    """As far as the poses (4, 4) on the way are known."""
    stations = {s.station_id: s for s in survey.stations if s.motion == "table" and s.table_id == table.table_id}
    inner: dict[tuple[str, str], FloatArray] = {}
    outer: dict[str, FloatArray] = {}
    base = pose(("world_from_table", table.table_id), table.world_from_table)
    cameras = [("camera", c.camera_id, c.station_id, ("station_from_camera", c.camera_id), c.station_from_camera)
               for c in survey.cameras]  # fmt: skip
    targets = [("target", t.target_id, t.station_id or "", ("carrier_from_target", t.target_id), t.carrier_from_target)
               for t in survey.targets if t.motion == "fixed"]  # fmt: skip
    for kind, name, station, parameter, given in (*cameras, *targets):
        own = pose(parameter, given)
        mounted = stations.get(station)
        mount = None if mounted is None else pose(("mount_from_station", station), mounted.mount_from_station)
        if mount is not None and own is not None:
            inner[kind, name] = mount @ own
        elif not station and base is not None and own is not None:
            outer[name] = inverse(base) @ own
    return inner, outer


def wrong_signs(survey: Survey, result: Adjustment) -> Iterator[Hypothesis]:
    """Axes whose sign contradicts poses that are given as starts: images alone do not see it, whatever fits."""

    def pose(name: ParameterName, given: PoseParameter) -> FloatArray | None:
        found = adjusted_pose(result.estimates, name, given)
        return None if found is None else found.matrix()

    for table in survey.tables:
        verdict = sign_mistake(table, constants(survey, table, pose), given_constants(survey, table))
        if verdict is not None:
            yield sign_of(survey, table, verdict)


def sign_of(survey: Survey, table: Table, verdict: SignVerdict) -> Hypothesis:
    """The survey with these axes negated."""
    axes, many = " and ".join(verdict.axes), len(verdict.axes) > 1
    signs = np.array([-1.0 if f"axis{i + 1}" in verdict.axes else 1.0 for i in range(len(table.axes))])
    readings = {r.epoch_id: signs * r.angles for r in survey.table_readings if r.table_id == table.table_id}
    return Hypothesis(
        "sign of an axis",
        f"table {table.table_id}: the sign{'s' if many else ''} of {axes} {'are' if many else 'is'} probably wrong: "
        f"{verdict.shown_by} comes out {np.degrees(verdict.as_given):.1f} deg from the pose given, with {axes} negated "
        f"{np.degrees(verdict.corrected):.1f} deg", "correct the sign in table_angles.csv, or the pose given",
        Place("table", (table.table_id,), "axis1_deg"), with_angles(survey, table.table_id, readings),
        (column_edit(table.table_id, np.diag(signs), np.zeros(len(signs))),),
        verdict.as_given / max(verdict.corrected, _WRONG_RAD / 10.0), 1, 3,
    )  # fmt: skip


def sign_mistake(table: Table, found: Constants, given: Constants) -> SignVerdict | None:
    """Compare the constants found with those given, as they stand and with axes negated."""
    (inner, outer), (known, behind) = found, given
    pairs = [(f"{k[0]} {k[1]} on the mount", inner[k], x) for k, x in known.items() if k in inner]
    pairs += [(f"target {k} against the table", outer[k], x) for k, x in behind.items() if k in outer]
    if not pairs:
        return None
    axes = ["xyz".index(a) for a in table.axes]
    as_given = [_apart(table, f, g) for _, f, g in pairs]
    turns = [(names, rigid(S, np.zeros(3))) for names, S in _half_turns(axes)]
    best, names = min((max(_apart(table, S @ f, g) for _, f, g in pairs), names) for names, S in turns)
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
