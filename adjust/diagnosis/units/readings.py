"""Readings in another unit, sense or from another zero than they were read: everywhere, in one set-up, of one kind.

Evidence: values as mended against those that the rest of the survey predicts at its robust start (or at the adjustment,
where there is one). What concerns every reading of its kind may have spoilt the start: then it is found anew.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import ChangeReadings, Hypothesis, Place
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.diagnosis.units.conventions import ANGLES, LENGTHS, MISREADINGS, SLIPS, TURNS, Misreading, Scope
from adjust.model.observations import Reading
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.observations.terrestrial.batch import circular_median
from adjust.observations.terrestrial.equations import DIRECTION, wrapped

_CLEARLY = 3.0
"""By how much the misfit of the readings concerned has to fall."""
_MOST, _SINGLE = 6, 8
_FAR = 1000.0
"""Square over sigma of a single reading from which it is no matter how much larger it is."""
_BAD, _FEW, _ROUGH = 25.0, 0.1, 4.0
_LARGE_START = 2500
"""Readings up to which start values are found anew for every hypothesis that concerns all of a kind."""


def misread_readings(case: Case) -> Iterator[Hypothesis]:
    """The misreadings for which the rest of the survey speaks, the clearest first."""
    survey = case.survey
    if not survey.readings:
        return
    before = at_best(case)
    looked_at, found = 0, list[tuple[float, Scope, Misreading]]()
    for scope in scopes(survey):
        for misreading in _possible(survey, scope):
            looked_at += 1
            found.append((_evidence(survey, before, scope, misreading), scope, misreading))
    # what explains many first: that of single readings is of each alone, which many misread ones have as well
    for some in ([f for f in found if f[0] > _CLEARLY], _slips(survey, before)):
        for evidence, scope, misreading in sorted(some, key=lambda f: (-f[0], -len(f[1].rows)))[:_MOST]:
            yield _hypothesis(survey, scope, misreading, evidence, looked_at)


def _slips(survey: Survey, before: Screen | None) -> list[tuple[float, Scope, Misreading]]:
    """Single readings that fit with their decimal point one or two places on: of those that miss most."""
    if before is None:
        return []
    out = []
    for i in np.argsort(-before.readings)[:_SINGLE].tolist():
        r = survey.readings[i]
        scope = Scope(np.array([i]), f"reading {r.reading_id}", Place("reading", (r.reading_id,), "value"))
        for factor in SLIPS:
            slip = Misreading("slipped decimal", f"has slipped: {r.value:.9g} for {factor * r.value:.9g} (SI)", factor,
                              0.0, (r.kind,))  # fmt: skip
            was, now = (float(x[0]) / before.scale for x in (before.readings[[i]], _mended_squares(
                before, scope.rows, slip)))  # fmt: skip
            evidence = min(was, _FAR) / (now + 5.0)  # of it alone: among all others one bounded misfit is soon lost
            if evidence > _CLEARLY:
                out.append((evidence, scope, slip))
    return out


def scopes(survey: Survey) -> Iterator[Scope]:
    """All readings of a kind; of a set-up, by kind and all its angles; single ones."""
    readings = survey.readings
    kinds = list(dict.fromkeys(r.kind for r in readings))
    for kind in kinds:
        rows = _rows(readings, (kind,))
        yield Scope(rows, f"all readings of kind {kind}", Place("reading", (kind,), "value"))
    for names in (ANGLES, TURNS):
        rows = _rows(readings, names)
        if len({readings[i].kind for i in rows}) > 1:
            what = "angles" if names is ANGLES else "horizontal angles"
            yield Scope(rows, f"all {what}", Place("reading", (what,), "value"))
    lengths = _rows(readings, LENGTHS)
    if len({readings[i].kind for i in lengths}) > 1:
        yield Scope(lengths, "all lengths", Place("reading", ("lengths",), "value"))
    setups = list(dict.fromkeys(r.setup_id for r in readings if r.setup_id))
    for setup_id in setups if len(setups) > 1 else []:
        mine = np.array([i for i, r in enumerate(readings) if r.setup_id == setup_id], dtype=np.int64)
        place = Place("setup", (setup_id,), "value")
        for kind in dict.fromkeys(readings[i].kind for i in mine):
            rows = np.array([i for i in mine if readings[i].kind == kind], dtype=np.int64)
            yield Scope(rows, f"the readings of kind {kind} of set-up {setup_id}", place)
        angles = np.array([i for i in mine if readings[i].kind in ANGLES], dtype=np.int64)
        if len({readings[i].kind for i in angles}) > 1:
            yield Scope(angles, f"the angles of set-up {setup_id}", place)


def _rows(readings: Sequence[Reading], kinds: Sequence[str]) -> IntArray:
    return np.array([i for i, r in enumerate(readings) if r.kind in kinds], dtype=np.int64)


def _possible(survey: Survey, scope: Scope) -> Iterator[Misreading]:
    """A scope of several kinds is misread as a whole, in a way that all of them can be."""
    kinds = {survey.readings[i].kind for i in scope.rows}
    yield from (m for m in MISREADINGS if kinds <= set(m.kinds))


def mended(survey: Survey, rows: IntArray, misreading: Misreading) -> Survey:
    """The survey with these readings as they were meant."""
    values = misreading.mend(np.array([survey.readings[i].value for i in rows]))
    new = dict(zip(rows.tolist(), values.tolist(), strict=True))
    readings = tuple(replace(r, value=new[i]) if i in new else r for i, r in enumerate(survey.readings))
    return replace(survey, readings=readings)


def _evidence(survey: Survey, before: Screen | None, scope: Scope, misreading: Misreading) -> float:
    """How many times smaller the bounded misfit becomes."""
    n, whole = len(survey.readings), _concerns_all(survey, scope)
    if whole and before is not None and _fits_as_it_is(before, scope.rows):
        return 0.0
    if before is not None and not (whole and n <= _LARGE_START):
        return drop(before, scope.rows, _mended_squares(before, scope.rows, misreading))
    after = screen(mended(survey, scope.rows, misreading))
    if after is None:
        return 0.0
    if before is None:
        return improvement(CAP * n, after.misfit(after.scale), n)
    scale = min(before.scale, after.scale)
    return improvement(before.misfit(scale), after.misfit(scale), n)


def _fits_as_it_is(before: Screen, rows: IntArray) -> bool:
    """Whether so few readings miss, of these and of all, that these cannot be misread throughout."""
    bad = before.readings > _BAD * before.scale
    return bool(before.scale < _ROUGH and bad.mean() < _FEW and bad[rows].mean() < 0.5)


def drop(before: Screen, rows: IntArray, after: FloatArray) -> float:
    """How much less everything misfits when these readings do as in ``after`` (n,), squares over sigmas."""
    every, now = (np.minimum(s / before.scale, CAP) for s in (before.readings, after))
    total = float(every.sum())
    return improvement(total, total - float(every[rows].sum()) + float(now.sum()), len(every))


def _mended_squares(before: Screen, rows: IntArray, misreading: Misreading) -> FloatArray:
    """(n,) squares over sigmas of mended readings where everything else is; directions of a set-up share a turn."""
    batch = before.graph.terrestrial
    if batch is None:
        return np.zeros(len(rows))
    a = batch.layout.arrays
    observed = np.array(a.observed)
    observed[rows] = misreading.mend(observed[rows])
    miss = wrapped(a.kind, before.predicted, observed)
    for orientation in np.unique(a.orientation[rows][a.kind[rows] == DIRECTION]):
        of = (a.kind == DIRECTION) & (a.orientation == orientation)
        turn = circular_median(miss[of & np.isfinite(miss)])
        miss[of] = wrapped(a.kind[of], miss[of], np.full(int(of.sum()), turn))
    squares = (miss[rows] / batch.sigma[rows]) ** 2
    return np.where(np.isfinite(squares), squares, np.inf)


def _concerns_all(survey: Survey, scope: Scope) -> bool:
    kinds = {survey.readings[i].kind for i in scope.rows}
    return len(scope.rows) == sum(r.kind in kinds for r in survey.readings)


def _hypothesis(survey: Survey, scope: Scope, misreading: Misreading, evidence: float, looked_at: int) -> Hypothesis:
    ids = tuple(survey.readings[i].reading_id for i in scope.rows)
    return Hypothesis(
        misreading.name, _cause(scope, misreading), _remedy(misreading), scope.place,
        mended(survey, scope.rows, misreading), (ChangeReadings(ids, misreading.factor, misreading.offset),), evidence,
        1, max(looked_at, 1),
    )  # fmt: skip


def _cause(scope: Scope, misreading: Misreading) -> str:
    what = "its decimal point" if misreading.name == "slipped decimal" else "their values"
    return f"{scope.text}: {what} {misreading.said}"


def _remedy(misreading: Misreading) -> str:
    if misreading.offset:
        return "in terrestrial.csv give them as zenith angles"
    return f"in terrestrial.csv multiply them by {misreading.factor:.10g}, or name the column by their unit"
