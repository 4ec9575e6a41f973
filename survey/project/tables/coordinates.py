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


@dataclass(eq=False)
class _Set:
    """Rows that are one observation, in the natural order of their names. of_set: its name, blank for a single row.

    entries: the covariances between them (m^2) by (row and axis, row and axis).
    """

    of_set: str
    rows: list[int] = field(default_factory=list)
    entries: dict[tuple[int, int], float] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Joint:
    """A set as an observation: rows (n,), values (n, 3) m, cov (3n, 3n) m^2."""

    of_set: str
    rows: list[int]
    values: FloatArray
    cov: FloatArray
    group: str
    used: bool


def read_coordinates(table: Table, names: Names, sigmas: Sigmas) -> tuple[Coordinates, ...]:
    """Coordinates sorted by set and position; a row without set_id is an observation of its own."""
    texts = table.text("point_id").values()
    positions = [timed_position(text, names, table.fail(row, "point_id")) for row, text in enumerate(texts)]
    found = _joined(table, texts, _XYZ, "coordinates", "point", sigmas)
    found.sort(key=lambda j: (bool(j.of_set), natural_key(j.of_set)))
    return tuple(
        Coordinates(tuple(positions[row] for row in j.rows), j.values, j.cov, j.group, j.used, j.of_set) for j in found
    )


def read_differences(table: Table, names: Names, sigmas: Sigmas) -> tuple[CoordinateDifferences, ...]:
    """Differences sorted by id, sets by their first; a row without set_id is an observation of its own."""
    ids = table.unique_ids("difference_id")
    ends = [read_ends(table, row, pair, names, "difference") for row, pair in enumerate(
        zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))]  # fmt: skip
    return tuple(
        CoordinateDifferences(
            tuple(ends[row][0] for row in j.rows), tuple(ends[row][1] for row in j.rows), j.values, j.cov,
            j.group, j.used, j.of_set or ids[j.rows[0]],
        )
        for j in _joined(table, ids, _DIFFERENCE, "coordinate_difference", "difference", sigmas)
    )  # fmt: skip


def _sets(table: Table, ids: Sequence[str], what: str) -> list[_Set]:
    """The sets in the natural order of their first rows, with what stands in the table of covariances beside them."""
    sets: dict[tuple[str, str], _Set] = {}
    members: dict[tuple[str, str], tuple[_Set, int]] = {}
    named = table.beside is None or "set_id" in table.beside.layout.ids
    set_ids = table.text("set_id").values()
    for row in sorted(range(len(ids)), key=lambda row: natural_key(ids[row])):
        of_set, name = set_ids[row], ids[row]
        one = sets.setdefault((of_set, "" if of_set else name), _Set(of_set))
        first = members.setdefault((of_set if named else "", name), (one, row))[1]
        if first != row:
            line = table.lines[first]
            raise table.error(row, f"point_id: {name!r} stands already in line {line}; remove one, or give set_ids")
        one.rows.append(row)
    if table.beside is not None:
        _add_entries(table.beside, members, what, named)
    return list(sets.values())


def _add_entries(
    extra: Table, members: Mapping[tuple[str, str], tuple[_Set, int]], what: str, named: bool
) -> None:
    """Put the covariances between different rows into their sets. named: whether the table says of which set."""
    columns = [extra.text(name).values() for name in ("set_id", "a_id", "a_axis", "b_id", "b_axis")]
    values = to_si(extra.numbers("covariance_mm2"), "mm2").tolist()
    for row, (of_set, a, a_axis, b, b_axis) in enumerate(zip(*columns, strict=True)):
        if named:
            extra.require(row, "set_id", "set", of_set, dict.fromkeys(known for known, _ in members if known))
        for column, name in (("a_id", a), ("b_id", b)):
            if (of_set, name) not in members:
                extra.require(row, column, what, name, [known for where, known in members if where == of_set])
        (one, i), (other, j) = members[of_set, a], members[of_set, b]
        if one is not other:
            raise extra.error(row, f"{a!r} and {b!r} are not in one set; give them the same set_id")
        if a == b or a_axis not in tuple("xyz") or b_axis not in tuple("xyz"):
            raise extra.error(row, f"expected two different {what}s with axes x, y or z; correct a_id to b_axis")
        key = 3 * i + "xyz".index(a_axis), 3 * j + "xyz".index(b_axis)
        if key in one.entries or one.entries.get(key[::-1], values[row]) != values[row]:
            raise extra.error(row, f"the covariance of {a} {a_axis} and {b} {b_axis} is given twice; keep one")
        one.entries[key] = values[row]


def _joined(
    table: Table, ids: Sequence[str], columns: tuple[str, ...], kind: str, what: str, sigmas: Sigmas
) -> list[_Joint]:
    """The sets as observations. columns: of values, sigmas and correlations; what: the rows are, for messages.

    Raises SurveyError for a set of different groups, or whose joint covariance is none.
    """
    sets, (values, own) = _sets(table, ids, what), read_triples(table, columns)
    groups, used, scale = marks(table, kind, sigmas.scale)
    out = []
    for one in sets:
        first, rows = one.rows[0], one.rows
        for row in rows:
            if (groups[row], used[row]) != (groups[first], used[first]):
                raise table.error(row, f"set {one.of_set!r} has different 'group' or 'used'; make them the same")
        n, numbers = len(rows), np.arange(len(rows))
        blocks = np.zeros((n, 3, n, 3))
        blocks[numbers, :, numbers] = own[rows]
        cov = blocks.reshape(3 * n, 3 * n)
        at = {3 * row + axis: 3 * i + axis for i, row in enumerate(rows) for axis in range(3)}
        for (a, b), value in one.entries.items():
            cov[at[a], at[b]] = cov[at[b], at[a]] = value
        problem = joint_problem(cov) if one.entries else None
        if problem:
            raise table.error(first, f"set {one.of_set!r}: {problem}; correct {table.layout.name}_covariance")
        cov[np.isfinite(cov)] *= scale[first] ** 2
        out.append(_Joint(one.of_set, rows, values[rows], cov, groups[first], used[first]))
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
