"""The table of coordinate differences (baselines), with covariances between them."""

from dataclasses import dataclass, field

import numpy as np

from adjust.observations import CoordinateDifferences, PositionRef
from survey.files.covariance import joint_problem, read_triples
from survey.files.project import Sigmas
from survey.files.references import NameProblemError, Names, check_epochs, read_position
from survey.files.tables import FLAGS, Layout, Table, group_names
from survey.files.text import natural_key, suggestion
from survey.files.units import to_si

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


@dataclass(eq=False)
class _Set:
    """Rows that are one observation."""

    rows: list[int] = field(default_factory=list)
    entries: dict[tuple[int, int], float] = field(default_factory=dict)


def read_differences(
    table: Table, extra: Table | None, names: Names, sigmas: Sigmas
) -> tuple[CoordinateDifferences, ...]:
    """Differences sorted by set and id; a row without set_id is an observation of its own."""
    ids = table.unique_ids("difference_id")
    values, own = read_triples(table, DIFFERENCE, DIFFERENCE_SIGMAS, DIFFERENCE_RHO)
    ends = [_ends(table, row, pair, names) for row, pair in enumerate(
        zip(table.text("from_id").values(), table.text("to_id").values(), strict=True))]  # fmt: skip
    sets: dict[tuple[str, str], _Set] = {}
    of_row = {}
    for row, set_id in enumerate(table.text("set_id").values()):
        of_row[row] = sets.setdefault((set_id, "" if set_id else ids[row]), _Set())
        of_row[row].rows.append(row)
    if extra is not None:
        _add_entries(extra, ids, of_row)
    groups, used = group_names(table, "coordinate_difference"), table.flags("used").tolist()
    result = []
    for (set_id, _), members in sets.items():
        rows = sorted(members.rows, key=lambda row: natural_key(ids[row]))
        for row in rows:
            if (groups[row], used[row]) != (groups[rows[0]], used[rows[0]]):
                raise table.error(row, f"set {set_id!r} has different 'group' or 'used'; make them the same")
        at = {3 * row + axis: 3 * i + axis for i, row in enumerate(rows) for axis in range(3)}
        cov = np.zeros((3 * len(rows), 3 * len(rows)))
        for i, row in enumerate(rows):
            cov[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = own[row]
        for (a, b), value in members.entries.items():
            cov[at[a], at[b]] = cov[at[b], at[a]] = value
        problem = joint_problem(cov)
        if problem:
            raise table.error(rows[0], f"set {set_id!r}: {problem}; correct coordinate_differences_covariance")
        cov[np.isfinite(cov)] *= sigmas.scale.get(groups[rows[0]], 1.0) ** 2
        item = CoordinateDifferences(
            tuple(ends[row][0] for row in rows), tuple(ends[row][1] for row in rows), values[rows], cov,
            groups[rows[0]], used[rows[0]], set_id or ids[rows[0]],
        )  # fmt: skip
        result.append((natural_key(ids[rows[0]]), item))
    return tuple(item for _, item in sorted(result, key=lambda pair: pair[0]))


def _ends(table: Table, row: int, texts: tuple[str, str], names: Names) -> tuple[PositionRef, PositionRef]:
    try:
        a, b = (read_position(text, names) for text in texts)
        check_epochs(a.frame, b.frame, names)
    except NameProblemError as problem:
        raise table.error(row, f"from_id, to_id: {problem}") from problem
    if a == b:
        raise table.error(row, f"from_id, to_id: both are {texts[0]!r}; a difference joins two different positions")
    return a, b


def _add_entries(extra: Table, ids: tuple[str, ...], of_row: dict[int, _Set]) -> None:
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
