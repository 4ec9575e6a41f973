"""Names that a project folder can hold, for points and setups of other programs that are freer with them."""

from dataclasses import replace
from typing import Any

from adjust.model.errors import listed
from adjust.model.observations import PositionRef
from adjust.model.subsets import with_positions
from adjust.model.survey import Survey
from survey.folder.text import FORBIDDEN_IN_IDS, formula_problem, id_problem


def safe_ids(names: list[str], taken: set[str] | None = None) -> dict[str, str]:
    """For every name that cannot be an id one that can: what is forbidden becomes "_"; all stay different."""
    used = {name for name in names if id_problem(name) is None} | (taken or set())
    out = {}
    for name in names:
        if id_problem(name) is None and name not in (taken or set()):
            continue
        plain = "".join("_" if c in FORBIDDEN_IN_IDS or not c.isprintable() else c for c in name)
        plain = plain.strip().lstrip(".") or "_"
        plain = f"_{plain[1:]}" if formula_problem(plain) else plain
        new, count = plain, 2
        while new in used:
            new, count = f"{plain}_{count}", count + 1
        used.add(new)
        out[name] = new
    return out


def with_safe_ids(survey: Survey) -> tuple[Survey, tuple[str, ...]]:
    """The survey with names that a project can hold, and what was renamed, for people."""
    points = safe_ids([p.point_id for p in survey.points], {"world"})
    setups = safe_ids([s.setup_id for s in survey.setups])
    readings = safe_ids([r.reading_id for r in survey.readings])
    if not (points or setups or readings):
        return survey, ()

    def ref(position: PositionRef) -> PositionRef:
        return PositionRef(points[position.point_id]) if position.point_id in points else position

    changed: dict[str, Any] = {
        "points": tuple(replace(p, point_id=points.get(p.point_id, p.point_id)) for p in survey.points),
        "setups": tuple(replace(s, setup_id=setups.get(s.setup_id, s.setup_id)) for s in survey.setups),
        "readings": tuple(
            replace(with_positions(r, ref), reading_id=readings.get(r.reading_id, r.reading_id),
                    setup_id=setups.get(r.setup_id, r.setup_id)) for r in survey.readings
        ),
        "reading_covariances": tuple(
            replace(c, reading_ids=tuple(readings.get(i, i) for i in c.reading_ids)) for c in survey.reading_covariances
        ),
        **{kind: tuple(with_positions(x, ref) for x in getattr(survey, kind))
           for kind in ("coordinate_differences", "coordinates", "distances")},
        "datum": replace(survey.datum, points=tuple(points.get(p, p) for p in survey.datum.points)),
    }  # fmt: skip
    shown = [f"{old} -> {new}" for old, new in points.items()]
    said = "renamed, because ids have none of / \\ : @ , ; and no = + - in front"
    note = f"{said}: {listed(shown, 6)}" if shown else ""
    return replace(survey, **changed), (note,) if note else ()
