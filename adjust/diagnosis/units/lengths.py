"""Distances and coordinates without which an adjustment leads nowhere: all in another unit, or one that is far off.

Evidence: what the rest says of them at its start, which none of them moves much.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import ChangeReadings, Hypothesis, LeaveOut, Place
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.diagnosis.units.conventions import UNIT_OF_LENGTHS, Misreading, misreadings
from adjust.diagnosis.units.readings import remedy
from adjust.model.observations import Coordinates, Distance, position_text
from adjust.model.rewriting import with_rows
from adjust.model.subsets import with_only
from adjust.model.survey import Survey

_CLEARLY = 3.0
_FAR = 1e4
"""Mean square over sigmas, in variance factors of the start, from which a single one is looked at."""


def misread_lengths(case: Case) -> Iterator[Hypothesis]:
    """Another unit of all distances, and single observations that miss most; where nothing could be adjusted."""
    survey = case.survey
    if case.result is not None or not (survey.distances or survey.coordinates):
        return
    before = at_best(case)
    if before is None:
        return
    yield from _other_units(case, before)
    yield from _alone(survey, before)


def _other_units(case: Case, before: Screen) -> Iterator[Hypothesis]:
    used = {i: d for i, d in enumerate(case.survey.distances) if d.used}
    ways = [m for m in misreadings(case.written, "distances") if m.name == UNIT_OF_LENGTHS] if len(used) > 1 else []
    changed = [replace(d, value=w.factor * d.value) for w in ways for d in used.values()]
    after = screen(with_only(case.survey, "distances", changed), before.start) if changed else None
    own = [i for i, o in enumerate(before.graph.others) if o.kind == "distance"]
    if after is None or len(after.others) != len(changed) or len(own) != len(used):
        return
    was = float(np.minimum(before.others[own] / before.scale, CAP).sum())
    for way, now in zip(ways, np.split(np.minimum(after.others / before.scale, CAP), len(ways)), strict=True):
        evidence = improvement(was, float(now.sum()), len(used))
        if evidence > _CLEARLY:
            yield all_read_by(case.survey, used, way, evidence, len(ways))


def all_read_by(
    survey: Survey, used: Mapping[int, Distance], way: Misreading, evidence: float = 1.0, looked_at: int = 1
) -> Hypothesis:
    """All distances that are used, by row, in another unit."""
    ids = tuple(d.distance_id for d in used.values())
    return Hypothesis(
        way.name, f"all distances: {way.text('their')}", remedy(way, "distances"), Place("reading", ids, "value"),
        with_rows(survey, "distances", {i: replace(d, value=way.factor * d.value) for i, d in used.items()}),
        (ChangeReadings(ids, way.factor, table="distances"),), evidence, 1, looked_at,
    )  # fmt: skip


def _alone(survey: Survey, before: Screen) -> Iterator[Hypothesis]:
    """The one without which all others fit; none where several are far off, as one."""
    squares = before.others / before.scale
    far = np.flatnonzero(squares > _FAR)
    if len(far) != 1:
        return
    k, other = int(far[0]), before.graph.others[int(far[0])]
    evidence = float(squares[k]) / (1.0 + float(np.delete(squares, k).sum()))  # not bounded: nothing else is so far off
    found = gross_error(survey, other.kind, other.ids, float(np.sqrt(before.others[k])), at_start=True)
    yield from [] if found is None else [replace(found, evidence=evidence, looked_at=len(squares))]


def gross_error(
    survey: Survey, kind: str, ids: tuple[str, ...], sigmas: float, at_start: bool = False
) -> Hypothesis | None:
    """A distance or coordinates of one position, so far off, to be left out; None of other kinds."""
    found = _observed(survey, kind, ids)
    if found is None:
        return None
    field, row, observed = found
    if isinstance(observed, Distance):
        name = observed.distance_id
        what = f"distance {name} contradicts all else by {sigmas:.3g} sigmas{' at the start' * at_start}: " \
               "its value or a name is wrong"  # fmt: skip
    else:
        name = position_text(observed.positions[0])
        what = f"the coordinates of {name} contradict all else by {sigmas:.3g} sigmas{' at the start' * at_start}: " \
               "a value is wrong"  # fmt: skip
    return Hypothesis(
        "gross error", what, f"correct it in {field}.csv, or leave it out", Place("reading", (name,), "value"),
        with_rows(survey, field, {row: replace(observed, used=False)}), (LeaveOut((f"{field}:{name}",)),),
    )  # fmt: skip


def _observed(survey: Survey, kind: str, ids: tuple[str, ...]) -> tuple[str, int, Distance | Coordinates] | None:
    if kind == "distance":
        return next((("distances", i, d) for i, d in enumerate(survey.distances) if d.distance_id == ids[0]), None)
    if kind == "coordinates":
        of = ((i, c) for i, c in enumerate(survey.coordinates) if len(c.positions) == 1)
        return next((("coordinates", i, c) for i, c in of if position_text(c.positions[0]) == ids[0]), None)
    return None
