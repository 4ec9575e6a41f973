"""Given coordinates that are those of another point, or slipped, or in other axes: each change tried at its own start.

Held values and priors of points, which the readings of a network contradict; of observed ones axes and unit.
"""

from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations, compress

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.names.nearer import nearer
from adjust.diagnosis.names.throughout import in_readings
from adjust.diagnosis.screen import Fit, Screen, at_best, improvement, screen
from adjust.diagnosis.units.axes import NORTH_FIRST, other_axes, ways
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey

_CLEARLY = 2.0
_MOST, _TRIALS = 4, 80
_SLIPS = (10.0, 0.1, 100.0, 0.01, 1000.0, 0.001)
_LARGE = 2500
_EXCHANGED = "given points exchanged"
_OF_GIVEN = (NORTH_FIRST, "are millimetres, read as metres", "are metres, read as millimetres")
_SPOILT = 1e6
"""Variance factor of a start at which the typical reading misses by so much that no single one stands out."""


def wrong_given(case: Case) -> Iterator[Hypothesis]:
    """Changes of given coordinates after which the survey's own start fits its observations better."""
    survey = case.survey
    given = [p.point_id for p in survey.points if p.x_in_world.treatment != "free" and p.x_in_world.value is not None]
    n = len(survey.readings)
    if not (given or survey.coordinates) or not n or not case.few("wrong given coordinates", n, _LARGE):
        return
    before = at_best(case)
    lost = before is None or before.scale > _SPOILT
    some = [h for h in (*_exchanges(survey, given), *_slips(survey, given))
            if before is None or lost or _misses(survey, before, h.place.ids)]  # fmt: skip
    tried = [*_axes(survey, given), *some][:_TRIALS]  # the former concern all: where these are wrong all miss evenly
    observed = [*other_axes(survey)]
    looked_at = len(tried) + len(observed)
    tried, observed = nearer(survey, tried), nearer(survey, observed)
    changed, apart = ([h.survey for h in of if isinstance(h.survey, Survey)] for of in (tried, observed))
    fits = [*(map(screen, changed) if before is None else before.afresh(changed)), *map(screen, apart)]
    tried += observed
    found = [replace(h, evidence=float(f"{e:.1e}"), looked_at=looked_at) for h, fit in zip(tried, fits, strict=True)
             if (e := _evidence(before, fit)) > _CLEARLY]  # fmt: skip
    # rounded: of mirror images that fit alike the first is the likeliest mistake
    for h in sorted(found, key=lambda h: -h.evidence)[:_MOST]:
        other = in_readings(survey, (h.place.ids[0], h.place.ids[1])) if h.name == _EXCHANGED else None
        if other is not None and isinstance(other.survey, Survey):
            e = _evidence(before, screen(other.survey))
            yield from [replace(other, evidence=e, looked_at=looked_at)] if e > _CLEARLY else []
        yield h


def _misses(survey: Survey, before: Screen, ids: tuple[str, ...]) -> bool:
    """Whether readings from or to one of these points do."""
    return any({r.at.point_id, r.to.point_id} & {*ids} for r in compress(survey.readings, before.missed))


def _evidence(before: Screen | None, after: Fit | None) -> float:
    if after is None or not len(after.readings):
        return 0.0
    n = len(after.readings)
    least = after.scale if before is None else min(after.scale, before.scale)
    old = 25.0 * n if before is None else before.misfit(least)
    return improvement(old, after.misfit(least), n)


def with_given(survey: Survey, new: dict[str, FloatArray]) -> Survey:
    """The survey with other given coordinates (3,) m of these points."""
    mine = {i: p for i, p in enumerate(survey.points) if p.point_id in new}
    points = {i: replace(p, x_in_world=replace(p.x_in_world, value=new[p.point_id])) for i, p in mine.items()}
    return with_rows(survey, "points", points)


def _values(survey: Survey, given: list[str]) -> dict[str, FloatArray]:
    every = {p.point_id: p.x_in_world.value for p in survey.points}
    return {n: np.asarray(every[n], dtype=float) for n in given}


def _exchanges(survey: Survey, given: list[str]) -> Iterator[Hypothesis]:
    x = _values(survey, given)
    for a, b in combinations(given, 2):
        cause = f"the given coordinates of points {a} and {b} are each other's"
        remedy = f"exchange the coordinates of {a} and {b} in survey.toml"
        yield _changed(survey, _EXCHANGED, cause, remedy, "x_in_world", {a: x[b], b: x[a]})


def _slips(survey: Survey, given: list[str]) -> Iterator[Hypothesis]:
    for name, x in _values(survey, given).items():
        for axis, factor in ((i, f) for i in range(3) for f in _SLIPS):
            new, what = x.copy(), "xyz"[axis]
            new[axis] *= factor
            if abs(new[axis] - x[axis]) > 1e-6:
                yield _changed(
                    survey, "slipped decimal", f"point {name}: the decimal point of its given {what} has slipped: "
                    f"{x[axis]:.10g} m for {new[axis]:.10g} m",
                    f"write {new[axis]:.10g} m for {what} of point {name} in survey.toml", what, {name: new},
                )  # fmt: skip


def _axes(survey: Survey, given: list[str]) -> Iterator[Hypothesis]:
    """All given coordinates in other axes or another unit."""
    x = _values(survey, given)
    for said, remedy, M in ways() if given else ():
        if said not in _OF_GIVEN:
            continue
        yield _changed(survey, "axes or unit of given coordinates", f"the given coordinates {said}",
                       f"{remedy} in survey.toml", "x_in_world", {n: M @ v for n, v in x.items()})  # fmt: skip


def _changed(
    survey: Survey, name: str, cause: str, remedy: str, key: str, new: dict[str, FloatArray]
) -> Hypothesis:
    keys = (SetKey(("points", n, "x_mm"), tuple(float(f"{1e3 * c:.15g}") for c in x)) for n, x in new.items())
    return Hypothesis(name, cause, remedy, Place("point", tuple(new), key), with_given(survey, new), tuple(keys))
