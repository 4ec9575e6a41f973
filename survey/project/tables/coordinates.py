"""Tables of coordinates and of coordinate differences (baselines), with covariances within sets of rows."""

from collections.abc import Iterable, Sequence

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.names import natural_key
from adjust.model.observations import CoordinateDifferences, Coordinates, position_text
from adjust.model.survey import FloatArray
from survey.folder.units import from_si, to_si
from survey.project.project import Sigmas
from survey.project.tables.covariance import joint_problem, read_triples, sigmas_and_correlations
from survey.project.tables.layouts import COORDINATE_COLUMNS, DIFFERENCE_COLUMNS
from survey.project.tables.reading import Columns, Table, filled, group_columns, marks
from survey.project.tables.references import Names, read_ends, timed_position


@frozen(eq=False)
class _Set:
    """Rows that are one observation, in the natural order of their names. of_set: its name, blank for a single row.

    values (n, 3) m, cov (3n, 3n) m^2.
    """

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
    found = _sets(table, texts, COORDINATE_COLUMNS, "coordinates", "point", sigmas)
    found.sort(key=lambda s: (bool(s.of_set), natural_key(s.of_set)))
    return tuple(
        Coordinates(tuple(positions[row] for row in s.rows), s.values, s.cov, s.group, s.used, s.of_set) for s in found
    )


def read_differences(table: Table, names: Names, sigmas: Sigmas) -> tuple[CoordinateDifferences, ...]:
    """Differences sorted by id, sets by their first; a row without set_id is an observation of its own."""
    ids = table.unique_ids("difference_id")
    ends = [read_ends(table, row, pair, names, "difference") for row, pair in enumerate(
        zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))]  # fmt: skip
    return tuple(
        CoordinateDifferences(
            tuple(ends[row][0] for row in s.rows), tuple(ends[row][1] for row in s.rows), s.values, s.cov,
            s.group, s.used, s.of_set or ids[s.rows[0]],
        )
        for s in _sets(table, ids, DIFFERENCE_COLUMNS, "coordinate_difference", "difference", sigmas)
    )  # fmt: skip


def _sets(
    table: Table, ids: Sequence[str], columns: tuple[str, ...], kind: str, what: str, sigmas: Sigmas
) -> list[_Set]:
    """The sets in the natural order of their first rows, with what the table of covariances beside them says.

    columns: of values, sigmas and correlations; what: the rows are, for messages. Raises SurveyError for a set of
    different groups, or whose joint covariance is none.
    """
    members = _members(table, ids)
    values, own = read_triples(table, columns)
    groups, used, scale = marks(table, kind, sigmas.scale)
    sets = []
    for (of_set, _), rows in members.items():
        first = rows[0]
        for row in rows:
            if (groups[row], used[row]) != (groups[first], used[first]):
                raise table.error(row, f"set {of_set!r} has different 'group' or 'used'; make them the same")
        sets.append(_Set(of_set, rows, values[rows], _block_diagonal(own[rows]), groups[first], used[first]))
    for one in () if table.beside is None else _with_covariances(table.beside, sets, ids, what):
        if problem := joint_problem(one.cov):
            correct = f"correct {table.layout.name}_covariance"
            raise table.error(one.rows[0], f"set {one.of_set!r}: {problem}; {correct}")
    for one in sets:
        one.cov[:] *= scale[one.rows[0]] ** 2
    return sets


def _members(table: Table, ids: Sequence[str]) -> dict[tuple[str, str], list[int]]:
    """The rows of every set, by its name, or by that of its one row. Raises SurveyError for a name that is twice."""
    first: dict[tuple[str, str], int] = {}
    members: dict[tuple[str, str], list[int]] = {}
    set_ids = table.text("set_id").values()
    for row in sorted(range(len(ids)), key=lambda row: natural_key(ids[row])):
        of_set, name = set_ids[row], ids[row]
        if first.setdefault((of_set, name), row) != row:
            line = table.lines[first[of_set, name]]
            raise table.error(row, f"point_id: {name!r} stands already in line {line}; remove one, or give set_ids")
        members.setdefault((of_set, "" if of_set else name), []).append(row)
    return members


def _block_diagonal(blocks: FloatArray) -> FloatArray:
    """Of blocks (n, 3, 3) one matrix (3n, 3n)."""
    n, numbers = len(blocks), np.arange(len(blocks))
    out = np.zeros((n, 3, n, 3))
    out[numbers, :, numbers] = blocks
    return out.reshape(3 * n, 3 * n)


def _with_covariances(extra: Table, sets: Sequence[_Set], ids: Sequence[str], what: str) -> list[_Set]:
    """Put the covariances between different rows into their sets; the sets that have any."""
    named = "set_id" in extra.layout.ids
    places = {(one.of_set if named else "", ids[row]): (number, i)
              for number, one in enumerate(sets) for i, row in enumerate(one.rows)}  # fmt: skip
    names = [extra.text(name).values() for name in ("set_id", "a_id", "a_axis", "b_id", "b_axis")]
    values = to_si(extra.numbers("covariance_mm2"), "mm2").tolist()
    given: dict[tuple[int, int, int], float] = {}
    for row, (of_set, a, a_axis, b, b_axis) in enumerate(zip(*names, strict=True)):
        if named:
            extra.require(row, "set_id", "set", of_set, dict.fromkeys(known for known, _ in places if known))
        for column, name in (("a_id", a), ("b_id", b)):
            if (of_set, name) not in places:
                extra.require(row, column, what, name, [known for where, known in places if where == of_set])
        (number, i), (other, j) = places[of_set, a], places[of_set, b]
        if number != other:
            raise extra.error(row, f"{a!r} and {b!r} are not in one set; give them the same set_id")
        if a == b or a_axis not in tuple("xyz") or b_axis not in tuple("xyz"):
            raise extra.error(row, f"expected two different {what}s with axes x, y or z; correct a_id to b_axis")
        p, q = 3 * i + "xyz".index(a_axis), 3 * j + "xyz".index(b_axis)
        if (number, p, q) in given or given.get((number, q, p), values[row]) != values[row]:
            raise extra.error(row, f"the covariance of {a} {a_axis} and {b} {b_axis} is given twice; keep one")
        given[number, p, q] = sets[number].cov[p, q] = sets[number].cov[q, p] = values[row]
    return [sets[number] for number in sorted({number for number, *_ in given})]


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
        **_triple_columns(COORDINATE_COLUMNS, coordinates),
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
    numbers = _triple_columns(DIFFERENCE_COLUMNS, items)
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
