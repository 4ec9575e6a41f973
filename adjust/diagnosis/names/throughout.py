"""Two points that are called by each other's names in every row of one table, against all other tables.

Evidence: what that table observes against what the rest predicts at its robust start, or at the adjustment that left it
out. Where one other table names the points, an exchange in either is the same to all observations: both are told.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations, product

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Edit, Hypothesis, Place, Rename
from adjust.diagnosis.screen import Screen, at_best, improvement, screen
from adjust.model.names import grouped
from adjust.model.observations import Observation, PositionRef
from adjust.model.rewriting import with_rows
from adjust.model.subsets import positions_of, with_only, with_positions
from adjust.model.survey import FloatArray, IntArray, Survey

_CLEARLY, _WORTH = 3.0, 1.5
"""Mean squares of what misses; evidence of what is tried: one rough start value may leave half of the misfit."""
_SUSPECTS, _MOST, _ALL = 6, 4, 60
_LARGE = 2500
_READINGS = "readings"
_KINDS = {"distances": "distance", "coordinates": "coordinates", "coordinate_differences": "coordinate_difference"}
_COLUMNS = {"distances": ("to_id", "from_id"), "coordinates": ("point_id",),
            "coordinate_differences": ("to_id", "from_id"),
            _READINGS: ("to_id", "from_id", "second_id")}  # fmt: skip
Names = tuple[str, str]


def exchanged_throughout(case: Case) -> Iterator[Hypothesis]:
    """Of tables other than that of readings the exchanges after which what they observe of two points fits."""
    survey = case.survey
    fields = [f for f in _KINDS if getattr(survey, f)]
    number = sum(len(getattr(survey, f)) for f in fields)
    if not fields or not case.few("points exchanged in a table", number, _LARGE):
        return
    before = at_best(case)
    if before is None:
        return
    found = [(e, f, names, len(ways)) for f in fields for ways in [_ways(survey, before, f)]
             for names, e in zip(ways, _evidence(survey, before, f, ways), strict=True) if e > _WORTH]  # fmt: skip
    for evidence, field, names, looked_at in sorted(found, key=lambda x: -x[0])[:_MOST]:
        yield in_table(survey, field, names, evidence, looked_at)


def _squares(found: Screen, field: str, scale: float) -> FloatArray:
    """(n,) mean squares over sigmas of the observations of a table, over a variance factor, bounded."""
    own = [i for i, o in enumerate(found.graph.others) if o.kind == _KINDS[field]]
    return np.minimum(found.others[own] / scale, CAP)


def _ways(survey: Survey, before: Screen, field: str) -> list[Names]:
    """Points of observations that miss, worst first, with each other; of few points with every other one."""
    observed, squares = getattr(survey, field), _squares(before, field, before.scale)
    if len(squares) != len(observed):
        return []
    each = zip(observed, squares.tolist(), strict=True)
    misses = grouped((name, square) for o, square in each for name in _names(o))
    worst = sorted(misses, key=lambda n: -float(np.mean(misses[n])))
    suspects = [n for n in worst if max(misses[n]) > _CLEARLY][:_SUSPECTS]
    ids = [p.point_id for p in survey.points]
    if len(ids) > _ALL:
        return list(combinations(suspects, 2))
    return [(a, b) for a, b in product(suspects, ids) if a != b and not (b in suspects and b < a)]


def _names(o: Observation) -> set[str]:
    """Points of the world that an observation names."""
    return {str(r.point_id) for r in positions_of(o) if r.frame is None}


def _evidence(survey: Survey, before: Screen, field: str, ways: Sequence[Names]) -> list[float]:
    """How much less those rows of a table that name one of two points miss, where all else stays where it is."""
    observed, of = getattr(survey, field), _rows_of(getattr(survey, field))
    sets = [np.array(sorted({*of.get(a, ()), *of.get(b, ())}), dtype=np.int64) for a, b in ways]
    changed = [o for rows, names in zip(sets, ways, strict=True) for o in _renamed(observed, rows, names)]
    after = screen(with_only(survey, field, changed), before.start) if changed else None
    if after is None or len(after.graph.others) != len(changed):
        return [0.0] * len(ways)
    was, now = (_squares(found, field, before.scale) for found in (before, after))
    each = np.split(now, np.cumsum([len(rows) for rows in sets])[:-1])
    return [improvement(float(was[r].sum()), float(x.sum()), len(r)) for r, x in zip(sets, each, strict=True)]


def _rows_of(observed: Sequence[Observation]) -> dict[str, list[int]]:
    """Of every point of the world the rows that name it."""
    return grouped((name, i) for i, o in enumerate(observed) for name in _names(o))


def _rows(observed: Sequence[Observation], names: Names) -> IntArray:
    return np.array([i for i, o in enumerate(observed) if _names(o) & {*names}], dtype=np.int64)


def renamed(survey: Survey, field: str, names: Names) -> Survey:
    """The survey with two points called by each other's names in all observations of a field."""
    observed = getattr(survey, field)
    rows = _rows(observed, names)
    return with_rows(survey, field, dict(zip(rows.tolist(), _renamed(observed, rows, names), strict=True)))


def _renamed(observed: Sequence[Observation], rows: IntArray, names: Names) -> list[Observation]:
    """These rows with two points called by each other's names."""
    other = dict(zip(names, reversed(names), strict=True))

    def named(ref: PositionRef) -> PositionRef:
        return replace(ref, point_id=other.get(str(ref.point_id), ref.point_id)) if ref.frame is None else ref

    return [with_positions(observed[i], named) for i in rows.tolist()]


def in_readings(survey: Survey, names: Names) -> Hypothesis | None:
    """The exchange in all readings, where other tables name the points as well: else it is that of what is given."""
    if any(len(_rows(getattr(survey, field), names)) for field in _KINDS):
        return in_table(survey, _READINGS, names, 1.0, 1)
    return None


def in_table(survey: Survey, field: str, names: Names, evidence: float, looked_at: int) -> Hypothesis:
    """The exchange in a table; told of the other one where there is one alone: that is the same to all observations."""
    (a, b), others = names, [f for f in _COLUMNS if f != field and len(_rows(getattr(survey, f), names))]
    alike = field if len(others) == 1 and not _elsewhere(survey, names) else ""
    where = others[0] if alike else field
    columns = [c for c in _COLUMNS[where] if _stands(survey, where, c, names)]
    table, same = _table(where), f" (or in all rows of {_table(alike)}.csv: what was observed cannot tell)"
    instead = f", or there in {_table(alike)}.csv"
    edits: tuple[Edit, ...] = tuple(Rename(table, c, {a: b, b: a}) for c in columns)
    if any(getattr(o, "set_id", "") for o in getattr(survey, where)):  # a table of covariances may name them as well
        edits = ()
    return Hypothesis(
        "points exchanged", f"points {a} and {b} are called by each other's names in all rows of {table}.csv"
        f"{same if alike else ''}", f"exchange them in {', '.join(columns)} of {table}.csv{instead if alike else ''}",
        Place("point", names, "to_id"), renamed(survey, field, names), edits, evidence, 1, looked_at,
    )  # fmt: skip


def _elsewhere(survey: Survey, names: Names) -> bool:
    """Whether images or given coordinates tell of the points, too."""
    some = {i for i, p in enumerate(survey.points) if p.point_id in names}
    given = any(survey.points[i].x_in_world.treatment != "free" for i in some)
    return given or any(b.target_id is None and some & {*b.point_idx.tolist()} for b in survey.image_blocks)


def _table(field: str) -> str:
    return "terrestrial" if field == _READINGS else field


def _stands(survey: Survey, field: str, column: str, names: Names) -> bool:
    """Whether one of the points stands in a column of a table."""
    ends = {"from_id": ("a", "at"), "to_id": ("b", "to"), "second_id": ("second",), "point_id": ("positions",)}[column]
    every = (getattr(o, end, None) for o in getattr(survey, field) for end in ends)
    refs = (ref for x in every for ref in (x if isinstance(x, tuple) else (x,)) if ref is not None)
    return any(ref.frame is None and ref.point_id in names for ref in refs)
