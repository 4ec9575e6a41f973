"""Rows of one set-up that were given to another: sights from where nobody stood."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.screen import Screen, at_best
from adjust.model.observations import Reading
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import IntArray, Survey

_CLEARLY = 2.0
_MOST, _LARGE = 2, 600


def rows_of_another_setup(case: Case) -> Iterator[Hypothesis]:
    """Of every two set-ups: the sights of one that fit as sights of the other, all in one hypothesis."""
    survey = case.survey
    homes = {r.setup_id: r for r in reversed(survey.readings) if r.setup_id}
    if len(homes) < 2 or not case.few("rows of another set-up", len(survey.readings), _LARGE):
        return
    before = at_best(case)
    if before is None:
        return
    found, looked_at = [], 0
    for a in homes:
        sights = _sights(survey, before, a)
        for b in homes if sights else ():
            rows = [r for r in sights if a != b and survey.readings[r[0]].to != homes[b].at]
            looked_at += len(rows)
            drops = _drops(before, rows, b)
            good = [r for r, d in zip(rows, drops, strict=True) if d > 1.0 + 0.5 * (_CLEARLY - 1.0) / len(rows)]
            if good:
                every = np.concatenate(good)
                found.append((_drops(before, [every], b)[0], a, b, every))
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
    return [np.array(rows) for rows in by_target.values() if before.missed[rows].any()]


def given_to(survey: Survey, rows: IntArray, home: Reading) -> Survey:
    """The survey with these readings taken as the first one of another set-up is."""
    same: Fields = {"setup_id": home.setup_id, "at": home.at, "instrument_height": home.instrument_height}
    return with_rows(survey, "readings", {i: replace(survey.readings[i], **same) for i in rows.tolist()})


def _drops(before: Screen, sets: list[IntArray], setup_id: str) -> list[float]:
    """How much less everything misfits with each set of readings given to a set-up."""
    after = before.alternatives(sets, **as_of_setup(before, sets, setup_id)) if sets else []
    return [before.drop(rows, squares) for rows, squares in zip(sets, after, strict=True)]


def as_of_setup(before: Screen, sets: Sequence[IntArray], setup_id: str) -> dict[str, Any]:
    """The same as fields of the arrays of readings."""
    batch = before.graph.terrestrial
    if batch is None:
        return {}
    a, n = batch.layout.arrays, sum(len(rows) for rows in sets)
    home = next(i for i, r in enumerate(before.graph.survey.readings) if r.setup_id == setup_id)
    heights = a.heights[np.concatenate(sets)]
    heights[:, 0] = a.heights[home, 0]
    fields = ("at", "orientation", "centring", "instrument", "body")
    return {"heights": heights} | {name: np.full(n, getattr(a, name)[home]) for name in fields}


def _hypothesis(survey: Survey, a: str, home: Reading, rows: IntArray, evidence: float, looked_at: int) -> Hypothesis:
    targets = list(dict.fromkeys(str(survey.readings[i].to.point_id) for i in rows.tolist()))
    return Hypothesis(
        "rows of another set-up", f"the readings of set-up {a} to {', '.join(targets)} are those of set-up "
        f"{home.setup_id}", f"give these {len(rows)} rows of terrestrial.csv to set-up {home.setup_id}, with its point "
        "and its instrument's height", Place("setup", (a, home.setup_id), "setup_id"), given_to(survey, rows, home), (),
        evidence, 1, looked_at,
    )  # fmt: skip
