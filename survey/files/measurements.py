"""Tables of angles, distances and coordinates."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from adjust.model import FloatArray
from adjust.observations import Coordinates, Distance, PositionRef, TableReading
from survey.files.covariance import covariance_from_sigmas, joint_problem, read_triples
from survey.files.project import Sigmas
from survey.files.references import (
    NameProblemError,
    Names,
    check_epochs,
    read_position,
)
from survey.files.tables import FLAGS, Layout, Table, first_row, group_names
from survey.files.text import natural_key, suggestion
from survey.files.units import to_si

ANGLES = Layout(
    "table_angles",
    ("epoch_id", "table_id"),
    ("axis1_deg",),
    FLAGS[:1],
    ("axis2_deg", "sigma_arcsec", "sigma_axis1_arcsec", "sigma_axis2_arcsec", "rho_12"),
)
DISTANCES = Layout("distances", ("distance_id", "from_id", "to_id"), (), FLAGS, ("value_mm", "value_m", "sigma_mm"))
XYZ_SIGMAS, XYZ_RHO = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm"), ("rho_xy", "rho_xz", "rho_yz")
XYZ = ("x_mm", "y_mm", "z_mm")
COORDINATES = Layout("coordinates", ("point_id",), (), ("set_id", *FLAGS), (*XYZ, *XYZ_SIGMAS, *XYZ_RHO))
COORDINATES_COVARIANCE = Layout(
    "coordinates_covariance", ("set_id", "a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)


def read_angles(table: Table, names: Names, sigmas: Sigmas) -> tuple[TableReading, ...]:
    """Readings sorted by table and epoch."""
    axes = {t.table_id: len(t.axes) for t in names.survey.tables}
    epochs, tables = table.ids("epoch_id").values(), table.text("table_id").values()
    angles = np.stack([table.numbers("axis1_deg"), table.numbers("axis2_deg")], axis=1)
    groups = group_names(table, "table")
    lines: dict[tuple[str, str], int] = {}
    for row, (epoch_id, table_id) in enumerate(zip(epochs, tables, strict=True)):
        if table_id not in axes:
            raise table.error(row, f"table_id: unknown table {table_id!r}; {suggestion(table_id, axes)}")
        key = (table_id, epoch_id)
        if key in lines:
            raise table.error(row, f"epoch {epoch_id!r} of table {table_id!r} stands already in line {lines[key]}")
        lines[key] = int(table.lines[row])
        k = axes[table_id]
        if int((~np.isnan(angles[row])).sum()) != k:
            advice = "fill in axis2_deg" if k == 2 else "leave axis2_deg blank"
            raise table.error(row, f"axis2_deg: table {table_id!r} has {k} axes; {advice}")
    sigma = _angle_sigmas(table, [axes[table_id] for table_id in tables], sigmas)
    rho = _angle_correlations(table)
    readings = []
    for row, (epoch_id, table_id) in enumerate(zip(epochs, tables, strict=True)):
        k = axes[table_id]
        cov = covariance_from_sigmas(sigma[None, row, :k], np.full((1, k - 1), rho[row]))[0]
        scaled = cov * sigmas.scale.get(groups[row], 1.0) ** 2
        readings.append(TableReading(table_id, epoch_id, to_si(angles[row, :k], "deg"), scaled, groups[row]))
    return tuple(sorted(readings, key=lambda r: (natural_key(r.table_id), natural_key(r.epoch_id))))


def _angle_correlations(table: Table) -> FloatArray:
    rho = np.nan_to_num(table.numbers("rho_12"))
    wrong = np.abs(rho) >= 1
    if wrong.any():
        row = first_row(wrong)
        raise table.error(row, f"rho_12: found {rho[row]:g}; a correlation lies between -1 and 1")
    return rho


def _angle_sigmas(table: Table, row_axes: list[int], sigmas: Sigmas) -> FloatArray:
    """Sigmas (n, 2) rad of the readings, from the row or else from survey.toml; nan beside a table's one axis."""
    both = table.positive("sigma_arcsec")
    each = np.stack([table.positive("sigma_axis1_arcsec"), table.positive("sigma_axis2_arcsec")], axis=1)
    twice = ~np.isnan(both) & ~np.isnan(each).all(axis=1)
    if twice.any():
        raise table.error(first_row(twice), "sigma_arcsec and sigma_axis1_arcsec are both given; keep one of the two")
    result = to_si(np.where(np.isnan(each), both[:, None], each), "arcsec")
    for row, (table_id, k) in enumerate(zip(table.text("table_id").values(), row_axes, strict=True)):
        if np.isnan(result[row]).all() and table_id in sigmas.tables:
            result[row, :k] = sigmas.tables[table_id]
        if np.isnan(result[row, :k]).any():
            raise table.error(row, f"the row has no sigma; add sigma_arcsec here or to [tables.{table_id}]")
    return result


def read_distances(table: Table, names: Names, sigmas: Sigmas) -> tuple[Distance, ...]:
    """Distances sorted by id."""
    distance_ids = table.unique_ids("distance_id")
    in_mm, in_m, sigma_mm = (table.positive(name) for name in ("value_mm", "value_m", "sigma_mm"))
    wrong = np.isnan(in_mm) == np.isnan(in_m)
    if wrong.any():
        raise table.error(first_row(wrong), "value_mm, value_m: fill in one of the two")
    if np.isnan(sigma_mm).any():
        raise table.error(first_row(np.isnan(sigma_mm)), "sigma_mm: is blank; fill it in")
    values = np.where(np.isnan(in_m), to_si(in_mm, "mm"), in_m).tolist()
    groups, used = group_names(table, "distance"), table.flags("used").tolist()
    ends = list(zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))
    distances = []
    for row, (from_text, to_text) in enumerate(ends):
        a, b = _ends(table, row, (from_text, to_text), names)
        sigma = float(to_si(sigma_mm[row], "mm")) * sigmas.scale.get(groups[row], 1.0)
        distances.append(Distance(distance_ids[row], a, b, values[row], sigma, groups[row], used[row]))
    return tuple(sorted(distances, key=lambda distance: natural_key(distance.distance_id)))


def _ends(table: Table, row: int, texts: tuple[str, str], names: Names) -> tuple[PositionRef, PositionRef]:
    try:
        a, b = (read_position(text, names) for text in texts)
        check_epochs(a.frame, b.frame, names)
    except NameProblemError as problem:
        raise table.error(row, f"from_id, to_id: {problem}") from problem
    if a == b:
        raise table.error(row, f"from_id, to_id: both are {texts[0]!r}; a distance joins two different positions")
    return a, b


@dataclass(eq=False)
class _CoordinateSet:
    """Rows that are one observation, and the covariances between them (mm^2) by (row and axis, row and axis)."""

    name: str
    rows: list[int] = field(default_factory=list)
    entries: dict[tuple[int, int], float] = field(default_factory=dict)


def read_coordinates(table: Table, extra: Table | None, names: Names, sigmas: Sigmas) -> tuple[Coordinates, ...]:
    """Coordinates sorted by set and position; a row without set_id is an observation of its own."""
    texts = table.text("point_id").values()
    positions = [_coordinate_position(table, row, text, names) for row, text in enumerate(texts)]
    sets: dict[str, _CoordinateSet] = {}
    members: dict[tuple[str, str], int] = {}
    for row, (set_id, text) in enumerate(zip(table.text("set_id").values(), texts, strict=True)):
        if (set_id, text) in members:
            line = table.lines[members[set_id, text]]
            raise table.error(row, f"point_id: {text!r} stands already in line {line}; remove one, or give set_ids")
        members[set_id, text] = row
        name = set_id or f"\0{text}"  # no id holds this character
        sets.setdefault(name, _CoordinateSet(set_id)).rows.append(row)
    if extra is not None:
        _add_entries(extra, sets, members)
    values, own = read_triples(table, XYZ, XYZ_SIGMAS, XYZ_RHO)
    groups, used = group_names(table, "coordinates"), table.flags("used").tolist()
    result = []
    for name in sorted(sets, key=natural_key):
        rows = sorted(sets[name].rows, key=lambda row: natural_key(texts[row]))
        for row in rows:
            if (groups[row], used[row]) != (groups[rows[0]], used[rows[0]]):
                raise table.error(row, f"set {sets[name].name!r} has different 'group' or 'used'; make them the same")
        cov = _joint_covariance(table, rows, own, sets[name])
        cov[np.isfinite(cov)] *= sigmas.scale.get(groups[rows[0]], 1.0) ** 2
        refs = tuple(positions[row] for row in rows)
        result.append(Coordinates(refs, values[rows], cov, groups[rows[0]], used[rows[0]], sets[name].name))
    return tuple(result)


def _coordinate_position(table: Table, row: int, text: str, names: Names) -> PositionRef:
    try:
        position = read_position(text, names)
        check_epochs(position.frame, None, names)
    except NameProblemError as problem:
        raise table.error(row, f"point_id: {problem}") from problem
    return position


def _add_entries(extra: Table, sets: Mapping[str, _CoordinateSet], members: Mapping[tuple[str, str], int]) -> None:
    """Put the covariances between different points into their sets."""
    columns = [extra.text(name).values() for name in COORDINATES_COVARIANCE.ids]
    values = extra.numbers("covariance_mm2").tolist()
    for row, (set_id, a, a_axis, b, b_axis) in enumerate(zip(*columns, strict=True)):
        if set_id not in sets:
            raise extra.error(row, f"set_id: unknown set {set_id!r}; {suggestion(set_id, _visible(sets))}")
        for point in (a, b):
            if (set_id, point) not in members:
                raise extra.error(row, f"a_id, b_id: set {set_id!r} has no coordinates of {point!r} in coordinates.csv")
        if a == b or a_axis not in tuple("xyz") or b_axis not in tuple("xyz"):
            raise extra.error(row, "expected two different points with axes x, y or z; correct a_id to b_axis")
        key = (3 * members[set_id, a] + "xyz".index(a_axis), 3 * members[set_id, b] + "xyz".index(b_axis))
        known = sets[set_id].entries.get(key[::-1], values[row])
        if key in sets[set_id].entries or known != values[row]:
            raise extra.error(row, f"the covariance of {a} {a_axis} and {b} {b_axis} is given twice; keep one")
        sets[set_id].entries[key] = values[row]


def _visible(names: Iterable[str]) -> list[str]:
    return [name for name in names if not name.startswith("\0")]


def _joint_covariance(table: Table, rows: list[int], own: FloatArray, members: _CoordinateSet) -> FloatArray:
    cov = np.zeros((3 * len(rows), 3 * len(rows)))
    for i, row in enumerate(rows):
        cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = own[row]
    at = {3 * row + axis: 3 * i + axis for i, row in enumerate(rows) for axis in range(3)}
    for (a, b), value in members.entries.items():
        cov[at[a], at[b]] = cov[at[b], at[a]] = to_si(value, "mm2")
    problem = joint_problem(cov) if members.entries else None
    if problem:
        raise table.error(rows[0], f"set {members.name!r}: {problem}; correct coordinates_covariance")
    return cov
