"""Two points of a network that are called by each other's names, in one set-up or in all readings.

Evidence: the readings concerned against what the rest predicts at its robust start, with the names exchanged.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, compress

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, Rename
from adjust.diagnosis.screen import Screen, at_best
from adjust.model.names import grouped
from adjust.model.observations import PositionRef, Reading
from adjust.model.rewriting import with_rows
from adjust.model.survey import IntArray, Survey

_CLEARLY = 3.0
_SUSPECTS, _MOST = 6, 4
_LARGE = 2500
_ENDS = ("to_id", "second_id")


def exchanged_points(case: Case) -> Iterator[Hypothesis]:
    """Pairs of points whose exchange makes their readings fit, the clearest first."""
    survey = case.survey
    if not survey.readings or not case.few("points exchanged", len(survey.readings), _LARGE):
        return
    before = at_best(case)
    if before is None:
        return
    setups = (None, *dict.fromkeys(r.setup_id for r in survey.readings if r.setup_id))
    pairs = [(s, a, b) for s in setups for a, b in combinations(_suspects(survey, before, s), 2)]
    sets = [_of_points(survey, s, (a, b)) for s, a, b in pairs]
    after = before.alternatives(sets, **ends_exchanged(before, sets, [(a, b) for _, a, b in pairs]))
    found = [(before.drop(rows, squares), rows, *pair) for rows, squares, pair in zip(sets, after, pairs, strict=True)]
    for evidence, rows, setup_id, a, b in sorted(found, key=lambda f: -f[0])[:_MOST]:
        if evidence > _CLEARLY:
            yield from (replace(h, looked_at=len(pairs)) for h in _hypotheses(survey, rows, setup_id, a, b, evidence))


def ends_exchanged(before: Screen, sets: Sequence[IntArray], names: Sequence[tuple[str, str]]) -> dict[str, IntArray]:
    """The targets of each set of readings, with two points under each other's names, as numbers of their positions."""
    batch = before.graph.terrestrial
    if batch is None or not sets:
        return {}
    number = {r.point_id: i for i, r in enumerate(before.graph.survey.reading_refs) if r.frame is None}
    a, b = (np.repeat([number.get(n[k], -2) for n in names], [len(rows) for rows in sets]) for k in (0, 1))
    rows, arrays = np.concatenate(sets), batch.layout.arrays
    old = np.stack([arrays.to[rows], arrays.second[rows]])
    new = np.where(old == a, b, np.where(old == b, a, old))
    new = np.where((new == arrays.at[rows]).any(axis=0), old, new)  # nobody sights the point he stands on
    return {"to": new[0], "second": new[1]}


def _suspects(survey: Survey, before: Screen, setup_id: str | None) -> list[str]:
    """Points whose sights (of one set-up, of all) miss most, worst first; only such as do miss."""
    squares = np.minimum(before.readings / before.scale, CAP).tolist()
    mine = [setup_id is None or r.setup_id == setup_id for r in survey.readings]
    sights = compress(zip(survey.readings, squares, strict=True), mine)
    misses = grouped((str(r.to.point_id), square) for r, square in sights if r.to.frame is None)
    worst = {name: float(np.mean(v)) for name, v in misses.items()}
    return [n for n in sorted(worst, key=lambda n: -worst[n])[:_SUSPECTS] if worst[n] > _CLEARLY]


def _of_points(survey: Survey, setup_id: str | None, names: tuple[str, str]) -> IntArray:
    return np.array(
        [i for i, r in enumerate(survey.readings) if (setup_id is None or r.setup_id == setup_id)
         and (r.to.point_id in names or (r.second is not None and r.second.point_id in names))],
        dtype=np.int64,
    )  # fmt: skip


def exchanged(survey: Survey, rows: IntArray, a: str, b: str, columns: Sequence[str] = _ENDS) -> Survey:
    """The survey with the targets a and b of these readings called by each other's names, in these columns."""
    other, readings = {a: b, b: a}, survey.readings

    def named(ref: PositionRef) -> PositionRef:
        known = ref.frame is None and ref.point_id in other
        return PositionRef(other[str(ref.point_id)]) if known else ref

    def renamed(r: Reading) -> Reading:
        second = r.second if r.second is None or "second_id" not in columns else named(r.second)
        return replace(r, to=named(r.to), second=second)

    new = {i: r for i in rows.tolist() if (r := renamed(readings[i])).at != r.to}  # nobody sights where he stands
    return with_rows(survey, "readings", new)


def _hypotheses(
    survey: Survey, rows: IntArray, setup_id: str | None, a: str, b: str, evidence: float
) -> Iterator[Hypothesis]:
    """In all columns where they stand, and in the first alone where the other one has them too."""
    where = "everywhere" if setup_id is None else f"in set-up {setup_id}"
    at = {} if setup_id is None else {"setup_id": (setup_id,)}
    seconds = (survey.readings[i].second for i in rows.tolist())
    both = any(r is not None and r.point_id in (a, b) for r in seconds)
    for columns in (_ENDS, _ENDS[:1]) if both else (_ENDS[:1],):
        yield Hypothesis(
            "points exchanged", f"points {a} and {b} are called by each other's names {where}",
            f"exchange them in {', '.join(columns)} of terrestrial.csv", Place("point", (a, b), "to_id"),
            exchanged(survey, rows, a, b, columns),
            tuple(Rename("terrestrial", c, {a: b, b: a}, at) for c in columns), evidence,
        )  # fmt: skip
