"""Rows of one set-up that were given to another: sights from where nobody stood."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.screen import Screen, at_best, screen
from adjust.diagnosis.units.readings import drop
from adjust.model.observations import Reading
from adjust.model.survey import IntArray, Survey

_CLEARLY = 2.0
_MOST, _LARGE = 2, 600
_MISSES = 25.0


def rows_of_another_setup(case: Case) -> Iterator[Hypothesis]:
    """Of every two set-ups: the sights of one that fit as sights of the other, all in one hypothesis."""
    survey = case.survey
    homes = {r.setup_id: r for r in reversed(survey.readings) if r.setup_id}
    if len(homes) < 2 or len(survey.readings) > _LARGE:
        return
    before = at_best(case)
    if before is None:
        return
    found, looked_at = [], 0
    for a in homes:
        for b in homes:
            rows = [r for r in _sights(survey, before, a) if a != b and survey.readings[r[0]].to != homes[b].at]
            looked_at += len(rows)
            good = [r for r in rows if _drop(survey, before, r, homes[b]) > 1.0 + 0.5 * (_CLEARLY - 1.0) / len(rows)]
            every = np.concatenate([np.zeros(0, dtype=np.int64), *good])
            if len(every):
                found.append((_drop(survey, before, every, homes[b]), a, b, every))
    for evidence, a, b, every in sorted(found, key=lambda f: -f[0])[:_MOST]:
        if evidence > _CLEARLY:
            yield _hypothesis(survey, a, homes[b], every, evidence, looked_at)


def _sights(survey: Survey, before: Screen, setup_id: str) -> list[IntArray]:
    """The readings of a set-up to each of its targets, every time that it was sighted, which miss."""
    by_target: dict[tuple[object, int], list[int]] = {}
    times: dict[tuple[object, str], int] = {}
    for i, r in enumerate(survey.readings):
        if r.setup_id == setup_id and r.second is None:
            times[r.to, r.kind] = times.get((r.to, r.kind), 0) + 1
            by_target.setdefault((r.to, times[r.to, r.kind]), []).append(i)
    return [np.array(rows) for rows in by_target.values() if before.readings[rows].max() > _MISSES * before.scale]


def _given(survey: Survey, rows: IntArray, home: Reading) -> Survey:
    chosen = set(rows.tolist())
    readings = tuple(
        replace(r, setup_id=home.setup_id, at=home.at, instrument_height=home.instrument_height) if i in chosen else r
        for i, r in enumerate(survey.readings)
    )
    return replace(survey, readings=readings)


def _drop(survey: Survey, before: Screen, rows: IntArray, home: Reading) -> float:
    after = screen(_given(survey, rows, home), before.start)
    return 0.0 if after is None else drop(before, rows, after.readings[rows])


def _hypothesis(survey: Survey, a: str, home: Reading, rows: IntArray, evidence: float, looked_at: int) -> Hypothesis:
    targets = list(dict.fromkeys(str(survey.readings[i].to.point_id) for i in rows.tolist()))
    return Hypothesis(
        "rows of another set-up", f"the readings of set-up {a} to {', '.join(targets)} are those of set-up "
        f"{home.setup_id}", f"give these {len(rows)} rows of terrestrial.csv to set-up {home.setup_id}, with its point "
        "and its instrument's height", Place("setup", (a, home.setup_id), "setup_id"), _given(survey, rows, home), (),
        evidence, 1, looked_at,
    )  # fmt: skip
