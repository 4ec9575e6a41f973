"""Readings in another unit, sense or from another zero than they were read: everywhere, in one set-up, of one kind.

Evidence: values as mended against those that the rest of the survey predicts at its robust start (or at the adjustment,
where there is one). What concerns every reading of its kind may have spoilt the start: then it is found anew.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import ChangeReadings, Hypothesis, Place
from adjust.diagnosis.screen import Screen, at_best, improvement, screen, screen_without
from adjust.diagnosis.units.conventions import (
    ANGLES,
    LENGTHS,
    TURNS,
    UNIT_OF_LENGTHS,
    Misreading,
    Scope,
    misreadings,
    shrinking,
    slips,
)
from adjust.model.memory import remembered
from adjust.model.observations import ReadingKind
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey

_CLEARLY = 3.0
"""By how much the misfit of the readings concerned has to fall."""
_MOST, _SINGLE = 6, 8
_FAR = 1000.0
"""Square over sigma of a single reading from which it is no matter how much larger it is."""
_FEW, _ROUGH = 0.1, 4.0
_SPOILT = 1e6
"""Variance factor of a start at which even the typical observation misses by a thousand sigmas."""
_SUSPECTS = 3
"""Set-ups without whose angles the start is looked for: the one that it begins with may turn all others over."""
LARGE_START = 2500
"""Readings up to which start values are found anew for every hypothesis that concerns all of a kind."""
_Way = tuple[Scope, Misreading]
_Found = tuple[float, Scope, Misreading]


def misread_readings(case: Case) -> Iterator[Hypothesis]:
    """The misreadings for which the rest of the survey speaks, the clearest first."""
    survey = case.survey
    if not survey.readings:
        return
    before, values = at_best(case), np.array([r.value for r in survey.readings])
    known = misreadings(case.written, "terrestrial")
    ways = [(scope, m) for scope in remembered(_every_scope, survey) for m in _possible(survey, scope, values, known)]
    looked_at = len(ways)
    gains = _evidence(survey, before, values, ways)
    if before is not None and max(gains, default=0.0) < _CLEARLY:
        gains = _without_worst(survey, before, values, ways)
    found = [(gain, *way) for gain, way in zip(gains, ways, strict=True)]
    # what explains many first: that of single readings is of each alone, which many misread ones have as well
    for some in ([f for f in found if f[0] > _CLEARLY], _slips(survey, before, values)):
        for evidence, scope, misreading in sorted(some, key=lambda f: (-f[0], -len(f[1].rows)))[:_MOST]:
            yield _hypothesis(survey, scope, misreading, evidence, looked_at)


def _slips(survey: Survey, before: Screen | None, values: FloatArray) -> list[_Found]:
    """Single readings that fit with their decimal point one or two places on: of those that miss most."""
    if before is None:
        return []
    worst = np.argsort(-before.readings)[:_SINGLE]
    ways = [(i, slip) for i in worst.tolist() for slip in slips(survey.readings[i].kind, values[i])]
    after = before.alternatives([np.array([i]) for i, _ in ways], observed=np.array([w.factor * values[i]
                                                                                      for i, w in ways]))  # fmt: skip
    out, others = [], max(1.0, float(before.missed.sum()))  # among so many that miss one alone explains the less
    for (i, slip), now in zip(ways, after, strict=True):
        evidence = min(float(before.readings[i]) / before.scale, _FAR) / (float(now[0]) / before.scale + 5.0)
        if evidence > _CLEARLY:  # of it alone: among all others one bounded misfit is soon lost
            name = survey.readings[i].reading_id
            scope = Scope(np.array([i]), f"reading {name}", Place("reading", (name,), "value"))
            out.append((evidence / others, scope, slip))
    return out


def _every_scope(survey: Survey) -> tuple[Scope, ...]:
    return tuple(_scopes(survey))


def _scopes(survey: Survey) -> Iterator[Scope]:
    """All readings of a kind; of a set-up, by kind and all its angles; single ones."""
    kinds, setups = (np.array([getattr(r, of) for r in survey.readings]) for of in ("kind", "setup_id"))

    def of(names: Sequence[str], setup_id: str = "") -> IntArray:
        return np.flatnonzero(np.isin(kinds, names) & ((setups == setup_id) | (not setup_id)))

    for kind in dict.fromkeys(kinds.tolist()):
        yield Scope(of([kind]), f"all readings of kind {kind}", Place("reading", (kind,), "value"))
    for what, names in (("angles", ANGLES), ("horizontal angles", TURNS), ("lengths", LENGTHS)):
        if len(set(kinds[rows := of(names)].tolist())) > 1:
            yield Scope(rows, f"all {what}", Place("reading", (what,), "value"))
    every = list(dict.fromkeys(s for s in setups.tolist() if s))
    for setup_id in every if len(every) > 1 else []:
        place = Place("setup", (setup_id,), "value")
        here = kinds[setups == setup_id].tolist()
        for kind in dict.fromkeys(k for k in here if here.count(k) < np.count_nonzero(kinds == k)):
            yield Scope(of([kind], setup_id), f"the readings of kind {kind} of set-up {setup_id}", place)
        if len(set(kinds[rows := of(ANGLES, setup_id)].tolist())) > 1:
            yield Scope(rows, f"the angles of set-up {setup_id}", place)


def _possible(
    survey: Survey, scope: Scope, values: FloatArray, known: Sequence[Misreading]
) -> Iterator[Misreading]:
    """A scope of several kinds is misread as a whole, in a way that all of them can be."""
    kinds = {survey.readings[i].kind for i in scope.rows}
    widest = float(np.abs(values[scope.rows]).max())
    yield from (m for m in known if kinds <= set(m.kinds) and m.may_be(widest))


def mended(survey: Survey, rows: IntArray, misreading: Misreading) -> Survey:
    """The survey with these readings as they were meant."""
    values = misreading.mend(np.array([survey.readings[i].value for i in rows]))
    new = zip(rows.tolist(), values.tolist(), strict=True)
    return with_rows(survey, "readings", {i: replace(survey.readings[i], value=v) for i, v in new})


def _mended(survey: Survey, scope: Scope, misreading: Misreading) -> Survey:
    return mended(survey, scope.rows, misreading)


def _evidence(survey: Survey, before: Screen | None, values: FloatArray, ways: Sequence[_Way]) -> list[float]:
    """How many times smaller the bounded misfit becomes by each way to read."""
    n, number = len(survey.readings), Counter(r.kind for r in survey.readings)
    whole = [
        len(scope.rows) == sum(number[k] for k in {survey.readings[i].kind for i in scope.rows}) for scope, _ in ways
    ]  # of all readings of its kinds
    anew, there = list(range(len(ways))), list[int]()
    if before is not None:
        # the lengths of one set-up may have given the start its scale, of which nothing else is left then
        whole = [w or (before.scale > _SPOILT and way[1].name == UNIT_OF_LENGTHS)
                 for w, way in zip(whole, ways, strict=True)]  # fmt: skip
        misread = [i for i, w in enumerate(whole) if w and not _fits_as_it_is(before, ways[i][0].rows)]
        anew, there = (misread, []) if n <= LARGE_START else ([], misread)
        # where all others fit, the start is not spoilt, and of a few readings it says more than a new one of all
        there += [i for i, w in enumerate(whole) if not w or (i in anew and _others_fit(before, ways[i][0].rows))]
    surveys, out = [remembered(_mended, survey, *ways[i]) for i in anew], [0.0] * len(ways)
    for i, after in zip(anew, before.afresh(surveys) if before else map(screen, surveys), strict=True):
        if after is not None:
            scale = after.scale if before is None else min(before.scale, after.scale)
            old = CAP * n if before is None else before.misfit(scale)
            out[i] = improvement(old, after.misfit(scale), n)
    for i, gain in () if before is None else _in_place(before, values, ways, there):
        out[i] = max(out[i], gain)
    return out


def _in_place(
    at: Screen, values: FloatArray, ways: Sequence[_Way], some: Sequence[int]
) -> Iterator[tuple[int, float]]:
    """How many times smaller the misfit becomes by some of the ways, where all else stays where it is."""
    sets = [ways[i][0].rows for i in some]
    read = [ways[i][1].mend(values[rows]) for i, rows in zip(some, sets, strict=True)]
    after = at.alternatives(sets, observed=np.concatenate([np.zeros(0), *read]))
    yield from ((i, at.drop(rows, squares)) for i, rows, squares in zip(some, sets, after, strict=True))


def _without_worst(survey: Survey, before: Screen, values: FloatArray, ways: Sequence[_Way]) -> list[float]:
    """The same at the start without the angles of one set-up that misses most, which may have spoilt it for all others.

    Of its horizontal angles, then of zenith angles.
    """
    gains = [0.0] * len(ways)
    for kinds in (TURNS, ("zenith",)):
        for i, gain in _without(survey, before, values, ways, kinds):
            gains[i] = max(gains[i], gain)
    return gains


def _without(
    survey: Survey, before: Screen, values: FloatArray, ways: Sequence[_Way], kinds: tuple[ReadingKind, ...]
) -> Iterator[tuple[int, float]]:
    """Of the set-ups whose angles of these kinds miss most; nothing where there is one alone, or no such start."""
    mine = [survey.readings[i].kind in kinds for i in range(len(values))]
    every = {scope.place.ids: scope for scope, _ in ways if scope.place.kind == "setup" and mine[scope.rows[0]]}
    worst = sorted(every.values(), key=lambda scope: -float(np.median(before.readings[scope.rows])))
    for scope in worst[:_SUSPECTS]:
        apart = screen_without(survey, frozenset(i for i in scope.rows.tolist() if mine[i]))
        if apart is not None:
            some = [i for i, (s, _) in enumerate(ways) if set(s.rows.tolist()) <= set(scope.rows.tolist())]
            yield from _in_place(apart, values, ways, some)


def _fits_as_it_is(before: Screen, rows: IntArray) -> bool:
    """Whether so few readings miss, of these and of all, that these cannot be misread throughout."""
    bad = before.missed
    return bool(before.scale < _ROUGH and bad.mean() < _FEW and bad[rows].mean() < 0.5)


def _others_fit(before: Screen, rows: IntArray) -> bool:
    """Whether few of the other readings miss."""
    others = np.ones(len(before.missed), dtype=np.bool_)
    others[rows] = False
    return bool(others.any() and before.scale < _ROUGH and before.missed[others].mean() < _FEW)


def _hypothesis(survey: Survey, scope: Scope, misreading: Misreading, evidence: float, looked_at: int) -> Hypothesis:
    ids = tuple(survey.readings[i].reading_id for i in scope.rows)
    changed = remembered(_mended, survey, scope, misreading)
    edit = ChangeReadings(ids, misreading.factor, misreading.offset)
    return Hypothesis(
        misreading.name, f"{scope.text}: {misreading.text('their')}", remedy(misreading), scope.place, changed, (edit,),
        evidence, 1, max(looked_at, 1), penalty=shrinking(misreading.factor, len(scope.rows)),
    )  # fmt: skip


def remedy(misreading: Misreading, table: str = "terrestrial") -> str:
    """What to do with all values of a table that were read so."""
    if misreading.offset:
        return "in terrestrial.csv give them as zenith angles"
    if misreading.factor == -1.0:
        heights = misreading.kinds == ("height_difference",)
        other = "exchange from_id and to_id" if heights else \
            "change clockwise below [bearings] in survey.toml where all count so"  # fmt: skip
        return f"in {table}.csv give them the other sign, or {other}"
    return f"in {table}.csv multiply them by {misreading.factor:.10g}, or name the column by their unit"
