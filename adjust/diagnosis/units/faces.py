"""Readings of another kind than they are called: directions of the second face, or of a circle that was turned.

Slope distances for horizontal.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import ChangeReadings, Hypothesis, Place, Rename, new_setup, split_setup
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.diagnosis.units.readings import LARGE_START
from adjust.model.errors import listed
from adjust.model.names import grouped
from adjust.model.observations import ReadingKind
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.spatial.averaging import circular_median, wrapped

_CLEARLY = 3.0
_LEAST, _CUTS = 2, 40
"""Directions on either side of a turn, and places for it that are compared."""
_OTHER: dict[ReadingKind, ReadingKind] = {
    "horizontal_distance": "slope_distance", "slope_distance": "horizontal_distance"}  # fmt: skip


def second_faces(case: Case) -> Iterator[Hypothesis]:
    """By set-up: directions that are half a turn from where the others have them."""
    survey, before = case.survey, at_best(case) if case.survey.readings else None
    if before is None or before.graph.terrestrial is None:
        return
    kinds, setups = (np.array([getattr(r, of) for r in survey.readings]) for of in ("kind", "setup_id"))
    names = [s for s in dict.fromkeys(setups.tolist()) if s]
    for setup_id in names:
        mine = np.flatnonzero((kinds == "direction") & (setups == setup_id))
        rows = _turned_over(before, mine)
        if not len(rows):
            continue
        new = {int(i): replace(survey.readings[i], value=survey.readings[i].value + np.pi) for i in rows}
        changed = with_rows(survey, "readings", new)
        (after,) = before.alternatives([mine], observed=np.array([changed.readings[i].value for i in mine]))
        evidence = before.drop(mine, after)
        if evidence > _CLEARLY:
            ids = tuple(survey.readings[i].reading_id for i in rows)
            yield Hypothesis(
                "directions of the second face", f"set-up {setup_id}: directions {listed(ids, 6)} are half a turn from "
                "where the others have them: read in the second face", "in terrestrial.csv turn them by 200 gon, 180 "
                "deg", Place("setup", (setup_id,), "value"), changed, (ChangeReadings(ids, 1.0, np.pi),), evidence, 1,
                len(names),
            )  # fmt: skip


def _turned_over(before: Screen, mine: IntArray) -> IntArray:
    """Of the directions of a set-up the fewer ones, where some are half a turn from the others."""
    batch = before.graph.terrestrial
    if batch is None or not len(mine):
        return mine[:0]
    miss = batch.residual[mine]
    off = np.abs(wrapped(miss - 0.5 * circular_median(2.0 * miss)))
    far = off > 0.5 * np.pi
    return np.asarray(mine[far if 2 * far.sum() <= len(far) else ~far])


def turned_circles(case: Case) -> Iterator[Hypothesis]:
    """By set-up: directions that from one of them on count from another zero."""
    survey, before = case.survey, at_best(case) if case.survey.readings else None
    if before is None or before.graph.terrestrial is None:
        return
    residual, sigma = before.graph.terrestrial.residual, before.graph.terrestrial.sigma
    of = grouped((r.setup_id, i) for i, r in enumerate(survey.readings) if r.kind == "direction")
    for setup_id, rows in of.items():
        mine = np.array(rows)
        if not before.missed[mine].any() or not np.isfinite(residual[mine]).all():
            continue
        cuts = range(_LEAST, len(mine) - _LEAST + 1)[:: max(1, len(mine) // _CUTS)]
        parts = [(_of_part(residual[mine[:k]], sigma[mine[:k]]), _of_part(residual[mine[k:]], sigma[mine[k:]]))
                 for k in cuts]  # fmt: skip
        if not parts:
            continue
        left = [float(np.minimum(np.concatenate(x) / before.scale, CAP).sum()) for x in parts]
        best = int(np.argmin(left))
        evidence = before.drop(mine, np.concatenate(parts[best]))
        if evidence > _CLEARLY:
            yield _turned(survey, setup_id, mine[cuts[best] :], evidence, len(cuts) * len(of))


def _of_part(miss: FloatArray, sigma: FloatArray) -> FloatArray:
    """Squares over sigmas of directions that share a turn of their own."""
    return np.asarray((wrapped(miss - circular_median(miss)) / sigma) ** 2)


def _turned(survey: Survey, setup_id: str, late: IntArray, evidence: float, looked_at: int) -> Hypothesis:
    name, ids = new_setup(survey, setup_id), tuple(survey.readings[i].reading_id for i in late.tolist())
    own = with_rows(survey, "readings", {i: replace(survey.readings[i], setup_id=name) for i in late.tolist()})
    given = [replace(s, setup_id=name) for s in survey.setups if s.setup_id == setup_id]
    return Hypothesis(
        "set-up turned", f"the circle of set-up {setup_id} was turned, or its instrument, before reading {ids[0]}: its "
        "directions count from another zero from there on",
        f"give the directions from {ids[0]} on a set-up of their own, {name} with the same instrument",
        Place("setup", (setup_id,), "value"), replace(own, setups=(*survey.setups, *given)),
        split_setup(survey, setup_id, ids), evidence, 2, looked_at,
    )  # fmt: skip


def other_kinds(case: Case) -> Iterator[Hypothesis]:
    """All distances of a kind, where they fit the survey's own start as those of the other kind."""
    survey, n = case.survey, len(case.survey.readings)
    if survey.image_blocks or not case.few("distances of another kind", n, LARGE_START):
        return
    before = at_best(case) if n else None
    if before is None:
        return
    for kind, other in _OTHER.items():
        rows = [i for i, r in enumerate(survey.readings) if r.kind == kind]
        if not rows:
            continue
        changed = _as_kind(survey, rows, other)
        after = screen(changed)
        scale = 1.0 if after is None else min(before.scale, after.scale)
        evidence = 0.0 if after is None else improvement(before.misfit(scale), after.misfit(scale), n)
        if evidence > _CLEARLY:
            what, meant = kind.replace("_", " "), other.replace("_", " ")
            yield Hypothesis(
                "kind of distances", f"the {what}s are {meant}s", f"in terrestrial.csv call them {other}",
                Place("reading", (kind,), "value"), changed, (Rename("terrestrial", "kind", {kind: other}),), evidence,
                1, len(_OTHER),
            )  # fmt: skip


def _as_kind(survey: Survey, rows: list[int], kind: ReadingKind) -> Survey:
    every = survey.readings
    new = {i: replace(every[i], kind=kind, group=kind if every[i].group == every[i].kind else every[i].group)
           for i in rows}  # fmt: skip
    return with_rows(survey, "readings", new)
