"""Runs of epochs, within which it is known how things moved, and what late clocks saw at their ends."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TypeVar

import numpy as np

from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.model.clocks import EpochTimes, clock_text, clocks_of, epoch_times
from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock, Pair, TableReading
from adjust.model.result import ParameterName
from adjust.model.survey import Clock, Survey

_GAP = 3.0
"""Steps between epochs, in typical ones, from which another run begins."""
MOVING = ("world_from_station", "carrier_from_target", "table_motion")
"""Kinds of slots that epochs have of their own."""
T = TypeVar("T", ImageBlock, TableReading, Pair)


def runs(times: Sequence[float], body: ParameterName) -> list[range]:
    """Runs of epochs at ascending times. Raises SurveyError where two of a body's are the same."""
    steps = np.diff(times)
    if not (steps > 0.0).all():
        raise SurveyError(f"{' '.join(body)}: two of its epochs have the same time; correct times_s")
    ends: list[int] = (np.flatnonzero(steps > _GAP * np.median(steps)) + 1).tolist() if len(steps) else []
    borders = [0, *ends, len(times)]
    return [range(a, b) for a, b in pairwise(borders)]


def within_motion(survey: Survey) -> Survey:
    """The survey less what late clocks saw at the ends of runs, of which it is not known how things moved there.

    It is predicted where others tell where things were at the epoch, else left out. Raises SurveyError where no clock
    is the time, or nothing of a late one is left.
    """
    clocks = dict(clocks_of(survey))
    late = {name for name, clock in clocks.items() if _is_late(clock)}
    if not late:
        return survey
    items, given = _observers(survey)
    _check_reference(clocks, items)
    left, out = set(range(len(items))), set[int]()
    while True:
        ends = _ends(set().union(given, *(items[i][1] for i in left)), epoch_times(survey))
        out = {i for i in left if items[i][0] in late and items[i][1] & ends}
        told = set().union(given, *(items[i][1] for i in left - out))
        lost = {i for i in out if not items[i][1] <= told}
        if not lost:
            break
        left -= lost
    used = {clock for i, (clock, places) in enumerate(items) if i in left - out or not places}
    if lost_clocks := [c for c in sorted(late) if c not in used and any(items[i][0] == c for i in range(len(items)))]:
        raise SurveyError(
            f"clock of {clock_text(lost_clocks[0])}: at no epoch is it known how what it sees moves, for "
            "that takes an epoch before and one after; take the clock out, or measure while things move"
        )
    n_blocks, n_readings = len(survey.image_blocks), len(survey.table_readings)

    def kept(every: Sequence[T], first: int) -> tuple[T, ...]:
        return tuple(_unused(x) if i in out else x for i, x in enumerate(every, first) if i in left)

    return replace(survey, image_blocks=kept(survey.image_blocks, 0),
                   table_readings=kept(survey.table_readings, n_blocks),
                   pairs=kept(survey.pairs, n_blocks + n_readings))  # fmt: skip


_Place = tuple[ParameterName, str]
"""A body or table, and an epoch."""


def _observers(survey: Survey) -> tuple[list[tuple[ParameterName, set[_Place]]], set[_Place]]:
    """Of every image block, table reading and pair its clock and what it sees moving; what is known without them."""
    u, moving = Unknowns(), dict[int, _Place]()
    tree = FrameTree(survey, u)
    slots = [{link.slot for link in tree.of_image(b)} for b in survey.image_blocks]
    for name, slot in u.slot_of.items():
        if name[0] in MOVING and len(name) == 3:
            moving[slot] = name[:2], name[2]
    items: list[tuple[ParameterName, set[_Place]]] = [
        (("camera_clock", b.camera_id), {moving[s] for s in of if s in moving})
        for b, of in zip(survey.image_blocks, slots, strict=True)
    ]
    for r in survey.table_readings:
        items.append((("table_clock", r.table_id), {(("table_motion", r.table_id), r.epoch_id)}))
    for pair in survey.pairs:
        ends = [(f.frame_id, str(f.epoch_id)) for f in (pair.a, pair.b) if f.kind == "station" and f.epoch_id]
        clock = ("pose_clock", ends[0][0] if ends else "")
        items.append((clock, {(("world_from_station", station), epoch) for station, epoch in ends}))
    return items, {(n[:2], n[2]) for n, p in u.parameters.items() if len(n) == 3 and p.treatment != "free"}


def _check_reference(clocks: Mapping[ParameterName, Clock], items: Iterable[tuple[ParameterName, set[_Place]]]) -> None:
    """Raises SurveyError where all that see the same motion have free offsets, or drifts: no clock is the time."""
    seen: dict[ParameterName, set[ParameterName]] = {}
    for clock, places in items:
        seen.setdefault(clock, set()).update(body for body, _ in places)
    groups: list[tuple[set[ParameterName], set[ParameterName]]] = []
    for clock, bodies in seen.items():
        mine = ({clock}, bodies)
        for other in [g for g in groups if g[1] & bodies]:
            groups.remove(other)
            mine = mine[0] | other[0], mine[1] | other[1]
        groups += [mine] if bodies else []
    for component in ("offset", "drift"):
        free = {name for name, c in clocks.items() if component in c.parameters.free and not (
            c.parameters.prior is not None and component in c.parameters.prior.names)}  # fmt: skip
        for together, _ in groups:
            if together <= free:
                said = ", ".join(clock_text(c) for c in sorted(together))
                raise SurveyError(
                    f"clocks of {said}: the {component} of every clock that sees the same motion is "
                    "unknown, so none of them is the time; take one out of free, or give it a sigma"
                )


def _unused(observed: T) -> T:
    """An image block, reading or pair that is predicted only."""
    if isinstance(observed, ImageBlock):
        return replace(observed, used=np.zeros(len(observed.uv), dtype=np.bool_))
    return replace(observed, used=False)


def _is_late(clock: Clock) -> bool:
    given = zip(clock.parameters.names, clock.parameters.values.tolist(), strict=True)
    return clock.jitter > 0.0 or any(n != "line_time" and (n in clock.parameters.free or v != 0.0) for n, v in given)


def _ends(places: Iterable[_Place], times: EpochTimes) -> set[_Place]:
    """The first and the last epoch of every run of every body."""
    bodies: dict[ParameterName, list[tuple[float, str]]] = {}
    for body, epoch in places:
        if epoch in times.of:
            bodies.setdefault(body, []).append((times.of[epoch], epoch))
    out = set()
    for body, found in bodies.items():
        found.sort()
        for run in runs([t for t, _ in found], body):
            out |= {(body, found[i][1]) for i in (run.start, run.stop - 1)}
    return out
