"""The table of readings of total stations, theodolites and levels, and that of their correlations."""

from collections.abc import Sequence

import numpy as np

from adjust.model.names import natural_key
from adjust.model.observations import PositionRef, Reading, ReadingCovariance, ReadingKind, position_text
from adjust.model.survey import FloatArray
from survey.folder.text import choice_hint
from survey.folder.units import from_si, to_si
from survey.project.declared.instruments import setup_problem
from survey.project.project import Accuracy, Sigmas
from survey.project.tables.covariance import covariance_problem
from survey.project.tables.layouts import HEIGHTS
from survey.project.tables.reading import (
    ANGLE_UNITS,
    Columns,
    Table,
    dms_angles,
    filled,
    first_row,
    group_columns,
    one_of,
    quantity,
)
from survey.project.tables.references import Names, check_epochs, read_position

READING_KINDS: tuple[ReadingKind, ...] = (
    "direction", "angle", "zenith", "azimuth", "slope_distance", "horizontal_distance", "height_difference",
)  # fmt: skip
ANGLES = READING_KINDS[:4]


def read_readings(table: Table, names: Names, sigmas: Sigmas) -> tuple[Reading, ...]:
    """Readings sorted by id; a reading without one gets r1, r2 ... by its row."""
    kinds, reading_ids = _kinds(table), _reading_ids(table)
    values = _values(table, kinds)
    heights = [np.nan_to_num(quantity(table, name, ("mm", "m"))) for name in HEIGHTS]
    setup_ids, groups = table.text("setup_id").values(), table.text("group").values()
    ends = zip(table.text("from_id").values(), table.text("to_id").values(), strict=True)
    seconds, used = table.text("second_id").values(), table.flags("used").tolist()
    own = _own_sigmas(table, kinds)
    centring = to_si(table.numbers("sigma_target_centring_mm"), "mm")
    lengths = table.positive("length_m")
    setups = {setup.setup_id: setup for setup in names.survey.setups}
    readings = []
    for row, (from_text, to_text) in enumerate(ends):
        kind, setup_id = kinds[row], setup_ids[row]
        if setup_id not in setups:
            _check_setup(table, row, kind, setup_id, names)
        at, to, second = _positions(table, row, (from_text, to_text, seconds[row]), kind, names)
        instrument_id = setups[setup_id].instrument_id if setup_id else None
        accuracy = sigmas.instruments.get(instrument_id or "", Accuracy())
        sigma = own[row]
        if np.isnan(sigma):
            usual = accuracy.sigma(kind, (lengths if kind == "height_difference" else values)[row])
            if usual is None:
                what = kind if kind in ANGLES or kind == "height_difference" else "distance"
                key = f"sigma_{what}_{'arcsec' if kind in ANGLES else 'mm'}"
                where = f"[instruments.{instrument_id}]" if instrument_id else "the instrument of its setup"
                raise table.error(row, f"the {kind} has no sigma; add it to the row, or {key} to {where}")
            sigma = usual
        group = groups[row] or kind
        plumbing = centring[row] if not np.isnan(centring[row]) else accuracy.target_centring
        if plumbing < 0:
            raise table.error(row, "sigma_target_centring_mm: it is negative; write 0 for none")
        readings.append(
            Reading(reading_ids[row], kind, at, to, float(values[row]), float(sigma) * sigmas.scale.get(group, 1.0),
                    setup_id, second, float(heights[0][row]), float(heights[1][row]), float(heights[2][row]),
                    float(plumbing), group, used[row])
        )  # fmt: skip
    _check_places(table, readings)
    return tuple(sorted(readings, key=lambda reading: natural_key(reading.reading_id)))


def _check_places(table: Table, readings: Sequence[Reading]) -> None:
    """Directions of one set-up share an orientation, so they are from one place: with ends swapped they look sound."""
    first: dict[str, int] = {}
    for row, reading in enumerate(readings):
        if reading.kind != "direction":
            continue
        other = first.setdefault(reading.setup_id, row)
        if reading.at != readings[other].at:
            here, there = position_text(reading.at), position_text(readings[other].at)
            raise table.error(row, f"from_id: {here!r}, but set-up {reading.setup_id!r} stands on {there!r} in line "
                              f"{table.lines[other]}; an instrument is set up on one point: correct from_id and to_id, "
                              "or give it a set-up of its own")  # fmt: skip


def _kinds(table: Table) -> list[ReadingKind]:
    column = table.text("kind")
    for code, name in enumerate(column.names):
        if name not in READING_KINDS and (column.codes == code).any():
            found = f"kind: found {name!r}; {choice_hint(name, READING_KINDS)}"
            raise table.error(first_row(column.codes == code), found)
    known = {name: name for name in READING_KINDS}
    return [known[name] for name in column.values()]  # type: ignore[index]  # all are known, see above


def _reading_ids(table: Table) -> list[str]:
    given = table.text("reading_id").values()
    seen: dict[str, int] = {}
    for row, name in enumerate(given):
        if name and name in seen:
            raise table.error(row, f"reading_id: {name!r} stands already in line {table.lines[seen[name]]}")
        seen[name] = row
    ids = [name or f"r{row + 1}" for row, name in enumerate(given)]
    for row, name in enumerate(given):
        if not name and ids[row] in seen:
            raise table.error(row, f"reading_id: {ids[row]!r}, which this row would get, is another one's; give it one")
    return ids


def _values(table: Table, kinds: Sequence[ReadingKind]) -> FloatArray:
    angle = np.array([kind in ANGLES for kind in kinds], dtype=bool)
    parts = {f"value_{unit}": quantity(table, "value", (unit,)) for unit in ("deg", "gon")}
    angles = one_of(table, parts | {"value_dms": dms_angles(table, "value_dms")})
    length = quantity(table, "value", ("m", "mm"))
    for mask, good, bad, needs in (
        (angle, angles, length, "an angle: value_deg, value_gon or value_dms"),
        (~angle, length, angles, "a length: value_m or value_mm"),
    ):
        wrong = mask & (np.isnan(good) | ~np.isnan(bad))
        if wrong.any():
            row = first_row(wrong)
            found = "has a value of the wrong kind" if not np.isnan(bad[row]) else "has no value"
            raise table.error(row, f"value: the {kinds[row]} {found}; give it {needs}")
    values = np.where(angle, angles, length)
    for row, kind in enumerate(kinds):
        if kind == "zenith" and not 0.0 < values[row] < np.pi:
            found = f"found {np.degrees(values[row]):.6g} deg"
            raise table.error(row, f"value: {found}; a zenith angle lies between 0 and 180 deg (reduce it to face I)")
        if kind in ("slope_distance", "horizontal_distance") and values[row] <= 0:
            raise table.error(row, f"value: found {values[row]:g} m; a distance is positive")
    return values


def _own_sigmas(table: Table, kinds: Sequence[ReadingKind]) -> FloatArray:
    """Sigmas (n,) that the rows give, nan where they give none."""
    angle = np.array([kind in ANGLES for kind in kinds], dtype=bool)
    angles, lengths = quantity(table, "sigma", ANGLE_UNITS, True), quantity(table, "sigma", ("mm",), True)
    wrong = (angle & ~np.isnan(lengths)) | (~angle & ~np.isnan(angles))
    if wrong.any():
        row = first_row(wrong)
        unit = "sigma_arcsec, sigma_cc or sigma_mgon" if angle[row] else "sigma_mm"
        raise table.error(row, f"sigma: that of a reading of kind {kinds[row]} stands in {unit}; move it there")
    return np.where(angle, angles, lengths)


def _check_setup(table: Table, row: int, kind: ReadingKind, setup_id: str, names: Names) -> None:
    if not setup_id:
        if kind == "direction":
            raise table.error(row, "setup_id: is blank; directions of one set-up share an orientation: name it")
        return
    problem = setup_problem(setup_id, names.survey.setups)
    if problem:
        raise table.error(row, f"setup_id: {problem}")


def _positions(
    table: Table, row: int, texts: tuple[str, str, str], kind: ReadingKind, names: Names
) -> tuple[PositionRef, PositionRef, PositionRef | None]:
    columns = ("from_id", "to_id", "second_id")
    if (kind == "angle") != bool(texts[2]):
        if kind == "angle":
            raise table.error(row, "second_id: an angle needs its right-hand target; fill it in")
        raise table.error(row, f"second_id: readings of kind {kind} have no second target; remove it")
    refs: list[PositionRef] = []
    for column, text in zip(columns, texts, strict=True):
        if not text:
            continue
        fail = table.fail(row, column)
        refs.append(read_position(text, names, fail))
        check_epochs(refs[0].frame, refs[-1].frame, names, fail)
        if refs[-1] in refs[:-1]:
            raise fail(f"{text!r} stands in this row twice; its positions must differ")
    return refs[0], refs[1], refs[2] if len(refs) > 2 else None


def read_reading_covariances(extra: Table, readings: Sequence[Reading]) -> tuple[ReadingCovariance, ...]:
    """Correlated readings, one covariance for those that hang together."""
    by_id = {reading.reading_id: reading for reading in readings}
    rho: dict[tuple[str, str], float] = {}
    lines: dict[str, int] = {}
    pairs = zip(extra.text("a_id").values(), extra.text("b_id").values(), extra.numbers("rho").tolist(), strict=True)
    for row, (a, b, value) in enumerate(pairs):
        for column, name in (("a_id", a), ("b_id", b)):
            extra.require(row, column, "reading", name, by_id)
            lines.setdefault(name, row)
        if a == b or not -1.0 < value < 1.0:
            found = f"rho: found {value:g}; a correlation lies between -1 and 1"
            raise extra.error(row, found if a != b else "a_id, b_id: a correlation joins two different readings")
        if rho.get((b, a), rho.get((a, b), value)) != value or (a, b) in rho:
            raise extra.error(row, f"the correlation of {a!r} and {b!r} is given twice; keep one")
        rho[a, b] = value
    result = []
    for members in _components(list(lines), list(rho)):
        ordered = tuple(sorted(members, key=natural_key))
        cov = np.diag([by_id[name].sigma ** 2 for name in ordered])
        for (a, b), value in rho.items():
            if a in members:
                i, j = ordered.index(a), ordered.index(b)
                cov[i, j] = cov[j, i] = value * by_id[a].sigma * by_id[b].sigma
        row = min(lines[name] for name in ordered)
        problem = covariance_problem(cov[None])
        if problem:
            raise extra.error(row, f"the correlations of {', '.join(ordered[:6])}: {problem[1]}; correct them")
        if len({by_id[name].used for name in ordered}) > 1:
            raise extra.error(row, f"{', '.join(ordered[:6])} are correlated: use all of them or none")
        result.append(ReadingCovariance(ordered, cov))
    return tuple(sorted(result, key=lambda c: natural_key(c.reading_ids[0])))


def _components(names: list[str], edges: list[tuple[str, str]]) -> list[set[str]]:
    of = {name: {name} for name in names}
    for a, b in edges:
        if of[a] is not of[b]:
            of[a] |= of[b]
            for name in of[b]:
                of[name] = of[a]
    return list({id(members): members for members in of.values()}.values())


def reading_columns(readings: Sequence[Reading]) -> Columns:
    """One row per reading: angles in degrees, lengths in metres, sigmas in arcseconds and millimetres."""
    angle = np.array([r.kind in ANGLES for r in readings], dtype=bool)
    value, sigma = (np.array([getattr(r, name) for r in readings], dtype=float) for name in ("value", "sigma"))
    heights = {name: np.array([getattr(r, name) for r in readings]) for name in HEIGHTS}
    centring = np.array([r.target_centring_sigma for r in readings], dtype=float)
    columns: dict[str, Sequence[str] | FloatArray] = {
        "setup_id": [r.setup_id for r in readings],
        "second_id": [position_text(r.second) if r.second else "" for r in readings],
        "value_deg": np.where(angle, from_si(value, "deg"), np.nan),
        "value_m": np.where(angle, np.nan, value),
        "sigma_arcsec": np.where(angle, from_si(sigma, "arcsec"), np.nan),
        "sigma_mm": np.where(angle, np.nan, from_si(sigma, "mm")),
        **{f"{name}_mm": np.where(h != 0.0, from_si(h, "mm"), np.nan) for name, h in heights.items()},
        # written even where it is zero, if any is not: a blank means the instrument's own
        "sigma_target_centring_mm": from_si(centring, "mm"),
    }
    return {
        "kind": [r.kind for r in readings],
        "from_id": [position_text(r.at) for r in readings],
        "to_id": [position_text(r.to) for r in readings],
        "reading_id": [r.reading_id for r in readings],
        **filled(columns),
        **group_columns(readings),
    }


def correlation_columns(covariances: Sequence[ReadingCovariance]) -> Columns:
    """One row per correlation of two readings."""
    rows = []
    for item in covariances:
        sigma = np.sqrt(np.diagonal(item.cov))
        for i, j in zip(*np.nonzero(np.triu(item.cov, 1)), strict=True):
            rows.append((item.reading_ids[i], item.reading_ids[j], float(item.cov[i, j] / (sigma[i] * sigma[j]))))
    return {
        "a_id": [a for a, _, _ in rows],
        "b_id": [b for _, b, _ in rows],
        "rho": np.array([rho for _, _, rho in rows], dtype=float),
    }
