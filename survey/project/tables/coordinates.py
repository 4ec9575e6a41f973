"""Tables of coordinates and of coordinate differences (baselines), with covariances within sets of rows."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from adjust.model.names import natural_key
from adjust.model.observations import CoordinateDifferences, Coordinates, position_text
from adjust.model.survey import FloatArray
from survey.folder.units import from_si, to_si
from survey.project.project import Sigmas
from survey.project.tables.covariance import joint_problem, read_triples, sigmas_and_correlations
from survey.project.tables.reading import FLAGS, Columns, Layout, Table, filled, group_columns, marks
from survey.project.tables.references import Names, read_ends, timed_position

_RHO = ("rho_xy", "rho_xz", "rho_yz")
_XYZ = ("x_mm", "y_mm", "z_mm", "sigma_x_mm", "sigma_y_mm", "sigma_z_mm", *_RHO)
COORDINATES = Layout("coordinates", ("point_id",), (), ("set_id", *FLAGS), _XYZ)
COORDINATES_COVARIANCE = Layout(
    "coordinates_covariance", ("set_id", "a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)
_DIFFERENCE = ("dx_mm", "dy_mm", "dz_mm", "sigma_dx_mm", "sigma_dy_mm", "sigma_dz_mm", *_RHO)
DIFFERENCES = Layout(
    "coordinate_differences", ("difference_id", "from_id", "to_id"), (), ("set_id", *FLAGS), _DIFFERENCE
)
DIFFERENCES_COVARIANCE = Layout(
    "coordinate_differences_covariance", ("a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)
_ALONE = "\0"  # no id holds this character
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


def read_coordinates(table: Table, names: Names, sigmas: Sigmas) -> tuple[Coordinates, ...]:
    """Coordinates sorted by set and position; a row without set_id is an observation of its own."""
    texts = table.text("point_id").values()
    positions = [timed_position(text, names, table.fail(row, "point_id")) for row, text in enumerate(texts)]
    sets: dict[str, _Set] = {}
    members: dict[tuple[str, str], int] = {}
    for row, (set_id, text) in enumerate(zip(table.text("set_id").values(), texts, strict=True)):
        if (set_id, text) in members:
            line = table.lines[members[set_id, text]]
            raise table.error(row, f"point_id: {text!r} stands already in line {line}; remove one, or give set_ids")
        members[set_id, text] = row
        sets.setdefault(set_id or f"{_ALONE}{text}", _Set(set_id)).rows.append(row)
    if table.beside is not None:
        _add_coordinate_entries(table.beside, sets, members)
    own = read_triples(table, _XYZ)
    ordered = [sets[name] for name in sorted(sets, key=natural_key)]
    return tuple(
        Coordinates(tuple(positions[row] for row in j.rows), j.values, j.cov, j.group, j.used, one.name)
        for one, j in zip(ordered, _joined(table, ordered, texts, own, sigmas, "coordinates"), strict=True)
    )


def _add_coordinate_entries(extra: Table, sets: Mapping[str, _Set], members: Mapping[tuple[str, str], int]) -> None:
    """Put the covariances between different points into their sets."""
    columns = [extra.text(name).values() for name in COORDINATES_COVARIANCE.ids]
    known = dict.fromkeys(name for name in sets if not name.startswith(_ALONE))
    values = to_si(extra.numbers("covariance_mm2"), "mm2").tolist()
    for row, (set_id, a, a_axis, b, b_axis) in enumerate(zip(*columns, strict=True)):
        extra.require(row, "set_id", "set", set_id, known)
        for point in (a, b):
            if (set_id, point) not in members:
                raise extra.error(row, f"a_id, b_id: set {set_id!r} has no coordinates of {point!r} in coordinates.csv")
        ends = (a, a_axis, members[set_id, a]), (b, b_axis, members[set_id, b])
        _enter(extra, row, sets[set_id], ends, values[row], "points")


def _enter(
    extra: Table, row: int, one: _Set, ends: tuple[tuple[str, str, int], tuple[str, str, int]], value: float, what: str
) -> None:
    """Put the covariance of two coordinates into a set. ends: name, axis and row of both."""
    (a, a_axis, i), (b, b_axis, j) = ends
    if a == b or a_axis not in tuple("xyz") or b_axis not in tuple("xyz"):
        raise extra.error(row, f"expected two different {what} with axes x, y or z; correct a_id to b_axis")
    key = 3 * i + "xyz".index(a_axis), 3 * j + "xyz".index(b_axis)
    if key in one.entries or one.entries.get(key[::-1], value) != value:
        raise extra.error(row, f"the covariance of {a} {a_axis} and {b} {b_axis} is given twice; keep one")
    one.entries[key] = value


def read_differences(table: Table, names: Names, sigmas: Sigmas) -> tuple[CoordinateDifferences, ...]:
    """Differences sorted by set and id; a row without set_id is an observation of its own."""
    ids = table.unique_ids("difference_id")
    own = read_triples(table, _DIFFERENCE)
    ends = [read_ends(table, row, pair, names, "difference") for row, pair in enumerate(
        zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))]  # fmt: skip
    sets: dict[tuple[str, str], _Set] = {}
    of_row = {}
    for row, set_id in enumerate(table.text("set_id").values()):
        of_row[row] = sets.setdefault((set_id, "" if set_id else ids[row]), _Set(set_id))
        of_row[row].rows.append(row)
    if table.beside is not None:
        _add_difference_entries(table.beside, ids, of_row)
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
            extra.require(row, column, "difference", name, row_of)
        if of_row[row_of[a]] is not of_row[row_of[b]]:
            raise extra.error(row, f"{a!r} and {b!r} are not in one set; give them the same set_id")
        ends = (a, a_axis, row_of[a]), (b, b_axis, row_of[b])
        _enter(extra, row, of_row[row_of[a]], ends, values[row], "differences")


def _joined(
    table: Table, sets: Iterable[_Set], ids: Sequence[str], own: tuple[FloatArray, FloatArray], sigmas: Sigmas,
    kind: str,
) -> list[_Joint]:  # fmt: skip
    """The sets with their rows in natural order of ``ids``. own: values and covariances of all rows by themselves.

    Raises SurveyError for a set of different groups, or whose joint covariance is none.
    """
    groups, used, scale = marks(table, _GROUPS[kind], sigmas.scale)
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
        cov[np.isfinite(cov)] *= scale[rows[0]] ** 2
        out.append(_Joint(rows, own[0][rows], cov, groups[rows[0]], used[rows[0]]))
    return out


def coordinate_columns(coordinates: Sequence[Coordinates]) -> tuple[Columns, Columns]:
    """One row per position, and one row per covariance between positions of the same observation."""
    sets, alone = [], set[str]()
    for number, observation in enumerate(coordinates, 1):
        names = [position_text(position) for position in observation.positions]
        set_id = observation.set_id or (f"set{number}" if len(names) > 1 or names[0] in alone else "")
        alone.update(names if not set_id else ())
        sets.append((set_id, names, observation.cov))
    set_ids = [set_id for set_id, names, _ in sets for _ in names]
    return {
        "point_id": [name for _, names, _ in sets for name in names],
        **_triple_columns(_XYZ, coordinates),
        **({"set_id": set_ids} if any(set_ids) else {}),
        **group_columns([c for c in coordinates for _ in c.positions], "coordinates"),
    }, between_columns(sets)


def difference_columns(items: Sequence[CoordinateDifferences]) -> tuple[Columns, Columns]:
    """One row per difference, and one row per covariance between those of the same observation."""
    names: list[str] = []
    sets = []
    for item in items:
        first = len(names)
        for _ in item.at:
            own = item.set_id if len(item.at) == 1 and item.set_id not in names else ""
            names.append(own or f"d{len(names) + 1}")
        sets.append(("", names[first:], item.cov))
    set_ids = [(x.set_id or f"set{n}") if len(x.at) > 1 else "" for n, x in enumerate(items, 1) for _ in x.at]
    numbers = _triple_columns(_DIFFERENCE, items)
    between = between_columns(sets)
    del between["set_id"]
    return {
        "difference_id": names,
        "from_id": [position_text(ref) for item in items for ref in item.at],
        "to_id": [position_text(ref) for item in items for ref in item.to],
        **filled({"set_id": set_ids, **numbers}),
        **group_columns([item for item in items for _ in item.at], "coordinate_difference"),
    }, between


def _triple_columns(
    names: Sequence[str], items: Sequence[Coordinates] | Sequence[CoordinateDifferences]
) -> dict[str, FloatArray]:
    """Values, sigmas and correlations (9 columns) of three coordinates a row in mm, nan where not observed."""
    rows = [_triple(x, item.cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3])
            for item in items for i, x in enumerate(item.values)]  # fmt: skip
    return dict(zip(names, np.array(rows).reshape(-1, 9).T, strict=True))


def _triple(values: FloatArray, cov: FloatArray) -> FloatArray:
    known = np.isfinite(np.diag(cov))
    sigma, rho = sigmas_and_correlations(np.where(np.isfinite(cov), cov, 1.0)[None])
    pairs = np.triu_indices(3, 1)
    both = known[pairs[0]] & known[pairs[1]]
    row = [np.where(known, from_si(values, "mm"), np.nan), np.where(known, from_si(sigma[0], "mm"), np.nan)]
    return np.concatenate([*row, np.where(both & (rho[0] != 0.0), rho[0], np.nan)])


def between_columns(sets: Iterable[tuple[str, Sequence[str], FloatArray]]) -> dict[str, Sequence[str] | FloatArray]:
    """One row per covariance between different rows of a set; sets: id, names of its rows (n,), cov (3n, 3n) m^2."""
    rows, values = [], []
    for set_id, names, cov in sets:
        for i, j in zip(*np.nonzero(np.triu(cov)), strict=True):
            if i // 3 != j // 3:
                rows.append((set_id, names[i // 3], "xyz"[i % 3], names[j // 3], "xyz"[j % 3]))
                values.append(float(from_si(cov[i, j], "mm2")))
    ids = ("set_id", "a_id", "a_axis", "b_id", "b_axis")
    out: dict[str, Sequence[str] | FloatArray] = {name: [row[i] for row in rows] for i, name in enumerate(ids)}
    return {**out, "covariance_mm2": np.array(values)}
