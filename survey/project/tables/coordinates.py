"""Tables of coordinates and of coordinate differences (baselines), with covariances within sets of rows."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adjust.model.names import natural_key
from adjust.model.observations import CoordinateDifferences, Coordinates
from adjust.model.survey import FloatArray
from survey.folder.text import suggestion
from survey.folder.units import to_si
from survey.project.project import Sigmas
from survey.project.tables.covariance import joint_problem, read_triples
from survey.project.tables.reading import FLAGS, Layout, Table, group_names
from survey.project.tables.references import Names, position_at, read_ends

XYZ_SIGMAS, XYZ_RHO = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm"), ("rho_xy", "rho_xz", "rho_yz")
XYZ = ("x_mm", "y_mm", "z_mm")
COORDINATES = Layout("coordinates", ("point_id",), (), ("set_id", *FLAGS), (*XYZ, *XYZ_SIGMAS, *XYZ_RHO))
COORDINATES_COVARIANCE = Layout(
    "coordinates_covariance", ("set_id", "a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)
DIFFERENCE = ("dx_mm", "dy_mm", "dz_mm")
DIFFERENCE_SIGMAS, DIFFERENCE_RHO = ("sigma_dx_mm", "sigma_dy_mm", "sigma_dz_mm"), ("rho_xy", "rho_xz", "rho_yz")
DIFFERENCES = Layout(
    "coordinate_differences",
    ("difference_id", "from_id", "to_id"),
    (),
    ("set_id", *FLAGS),
    (*DIFFERENCE, *DIFFERENCE_SIGMAS, *DIFFERENCE_RHO),
)
DIFFERENCES_COVARIANCE = Layout(
    "coordinate_differences_covariance", ("a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)
_GROUPS = {"coordinates": "coordinates", "coordinate_differences": "coordinate_difference"}


@dataclass(eq=False)
class _Set:
    """Rows that are one observation, and the covariances between them (m^2) by (row and axis, row and axis)."""

    name: str
    rows: list[int] = field(default_factory=list)
    entries: dict[tuple[int, int], float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Joint:
    """A set as an observation: rows (n,) in their order, values (n, 3) m, cov (3n, 3n) m^2."""

    rows: list[int]
    values: FloatArray
    cov: FloatArray
    group: str
    used: bool


def read_coordinates(table: Table, extra: Table | None, names: Names, sigmas: Sigmas) -> tuple[Coordinates, ...]:
    """Coordinates sorted by set and position; a row without set_id is an observation of its own."""
    texts = table.text("point_id").values()
    positions = [position_at(table, row, text, names) for row, text in enumerate(texts)]
    sets: dict[str, _Set] = {}
    members: dict[tuple[str, str], int] = {}
    for row, (set_id, text) in enumerate(zip(table.text("set_id").values(), texts, strict=True)):
        if (set_id, text) in members:
            line = table.lines[members[set_id, text]]
            raise table.error(row, f"point_id: {text!r} stands already in line {line}; remove one, or give set_ids")
        members[set_id, text] = row
        name = set_id or f"\0{text}"  # no id holds this character
        sets.setdefault(name, _Set(set_id)).rows.append(row)
    if extra is not None:
        _add_coordinate_entries(extra, sets, members)
    own = read_triples(table, XYZ, XYZ_SIGMAS, XYZ_RHO)
    ordered = [sets[name] for name in sorted(sets, key=natural_key)]
    return tuple(
        Coordinates(tuple(positions[row] for row in j.rows), j.values, j.cov, j.group, j.used, one.name)
        for one, j in zip(ordered, _joined(table, ordered, texts, own, sigmas, "coordinates"), strict=True)
    )


def _add_coordinate_entries(extra: Table, sets: Mapping[str, _Set], members: Mapping[tuple[str, str], int]) -> None:
    """Put the covariances between different points into their sets."""
    columns = [extra.text(name).values() for name in COORDINATES_COVARIANCE.ids]
    values = to_si(extra.numbers("covariance_mm2"), "mm2").tolist()
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


def read_differences(
    table: Table, extra: Table | None, names: Names, sigmas: Sigmas
) -> tuple[CoordinateDifferences, ...]:
    """Differences sorted by set and id; a row without set_id is an observation of its own."""
    ids = table.unique_ids("difference_id")
    own = read_triples(table, DIFFERENCE, DIFFERENCE_SIGMAS, DIFFERENCE_RHO)
    ends = [read_ends(table, row, pair, names, "difference") for row, pair in enumerate(
        zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))]  # fmt: skip
    sets: dict[tuple[str, str], _Set] = {}
    of_row = {}
    for row, set_id in enumerate(table.text("set_id").values()):
        of_row[row] = sets.setdefault((set_id, "" if set_id else ids[row]), _Set(set_id))
        of_row[row].rows.append(row)
    if extra is not None:
        _add_difference_entries(extra, ids, of_row)
    ordered = list(sets.values())
    result = [
        CoordinateDifferences(
            tuple(ends[row][0] for row in j.rows), tuple(ends[row][1] for row in j.rows), j.values, j.cov,
            j.group, j.used, one.name or ids[j.rows[0]],
        )
        for one, j in zip(ordered, _joined(table, ordered, ids, own, sigmas, "coordinate_differences"), strict=True)
    ]  # fmt: skip
    first = [min(natural_key(ids[row]) for row in one.rows) for one in ordered]
    return tuple(result[k] for k in sorted(range(len(result)), key=first.__getitem__))


def _add_difference_entries(extra: Table, ids: tuple[str, ...], of_row: dict[int, _Set]) -> None:
    """Put the covariances between different rows into their sets."""
    row_of = {name: row for row, name in enumerate(ids)}
    columns = [extra.text(name).values() for name in DIFFERENCES_COVARIANCE.ids]
    values = to_si(extra.numbers("covariance_mm2"), "mm2").tolist()
    for row, (a, a_axis, b, b_axis) in enumerate(zip(*columns, strict=True)):
        for column, name in (("a_id", a), ("b_id", b)):
            if name not in row_of:
                raise extra.error(row, f"{column}: unknown difference {name!r}; {suggestion(name, row_of)}")
        if a == b or a_axis not in tuple("xyz") or b_axis not in tuple("xyz"):
            raise extra.error(row, "expected two different differences with axes x, y or z; correct a_id to b_axis")
        if of_row[row_of[a]] is not of_row[row_of[b]]:
            raise extra.error(row, f"{a!r} and {b!r} are not in one set; give them the same set_id")
        key = (3 * row_of[a] + "xyz".index(a_axis), 3 * row_of[b] + "xyz".index(b_axis))
        entries = of_row[row_of[a]].entries
        if key in entries or key[::-1] in entries:
            raise extra.error(row, f"the covariance of {a} {a_axis} and {b} {b_axis} is given twice; keep one")
        entries[key] = values[row]


def _joined(
    table: Table, sets: Iterable[_Set], ids: Sequence[str], own: tuple[FloatArray, FloatArray], sigmas: Sigmas,
    kind: str,
) -> list[_Joint]:  # fmt: skip
    """The sets with their rows in natural order of ``ids``. own: values and covariances of all rows by themselves.

    Raises SurveyError for a set of different groups, or whose joint covariance is none.
    """
    groups, used = group_names(table, _GROUPS[kind]), table.flags("used").tolist()
    out = []
    for one in sets:
        rows = sorted(one.rows, key=lambda row: natural_key(ids[row]))
        for row in rows:
            if (groups[row], used[row]) != (groups[rows[0]], used[rows[0]]):
                raise table.error(row, f"set {one.name!r} has different 'group' or 'used'; make them the same")
        cov = np.zeros((3 * len(rows), 3 * len(rows)))
        for i, row in enumerate(rows):
            cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = own[1][row]
        at = {3 * row + axis: 3 * i + axis for i, row in enumerate(rows) for axis in range(3)}
        for (a, b), value in one.entries.items():
            cov[at[a], at[b]] = cov[at[b], at[a]] = value
        problem = joint_problem(cov) if one.entries else None
        if problem:
            raise table.error(rows[0], f"set {one.name!r}: {problem}; correct {kind}_covariance")
        cov[np.isfinite(cov)] *= sigmas.scale.get(groups[rows[0]], 1.0) ** 2
        out.append(_Joint(rows, own[0][rows], cov, groups[rows[0]], used[rows[0]]))
    return out
