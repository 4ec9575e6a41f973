"""Tables of the observations that are not image points: table angles, pairs, distances, coordinates."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model import BoolArray, FloatArray
from adjust.observations import Coordinates, Distance, Pair, PositionRef, TableReading
from survey.files.covariance import covariance_from_sigmas, covariance_problem
from survey.files.poses import rotation_from_euler, rotation_from_quaternion
from survey.files.project import Sigmas
from survey.files.references import (
    NameProblemError,
    Names,
    check_epochs,
    read_frame,
    read_position,
)
from survey.files.tables import Layout, Table, first_row
from survey.files.text import natural_key, suggestion
from survey.files.units import to_si

_FLAGS = ("group", "used")
QUATERNION = ("qw", "qx", "qy", "qz")
EULER = ("euler_x_deg", "euler_y_deg", "euler_z_deg")
TRANSLATION = ("tx_mm", "ty_mm", "tz_mm")
_TANGENT = ("rx", "ry", "rz", "tx", "ty", "tz")


def covariance_column(i: int, j: int) -> str:
    """Column of one element of a pair's covariance, in rad and m."""
    unit = {0: "rad2", 1: "rad_m", 2: "m2"}[(i >= 3) + (j >= 3)]
    return f"cov_{_TANGENT[i]}_{_TANGENT[j]}_{unit}"


SIGMA_COLUMNS = {
    "rotation": [("sigma_rotation_deg",) * 3, ("sigma_rotation_arcsec",) * 3]
    + [tuple(f"sigma_{a}_{unit}" for a in _TANGENT[:3]) for unit in ("deg", "arcsec")],
    "translation": [("sigma_translation_mm",) * 3, tuple(f"sigma_{a}_mm" for a in _TANGENT[3:])],
}
COVARIANCE_COLUMNS = tuple(covariance_column(i, j) for i in range(6) for j in range(6))
ANGLES = Layout(
    "table_angles",
    ("epoch_id", "table_id"),
    ("axis1_deg",),
    _FLAGS[:1],
    ("axis2_deg", "sigma_arcsec", "sigma_axis1_arcsec", "sigma_axis2_arcsec", "rho_12"),
)
PAIRS = Layout(
    "pairs",
    ("pair_id", "a_id", "b_id"),
    (),
    _FLAGS,
    QUATERNION
    + EULER
    + TRANSLATION
    + tuple(dict.fromkeys(name for columns in SIGMA_COLUMNS.values() for names in columns for name in names))
    + COVARIANCE_COLUMNS,
)
DISTANCES = Layout("distances", ("distance_id", "from_id", "to_id"), (), _FLAGS, ("value_mm", "value_m", "sigma_mm"))
XYZ_SIGMAS, XYZ_RHO = ("sigma_x_mm", "sigma_y_mm", "sigma_z_mm"), ("rho_xy", "rho_xz", "rho_yz")
COORDINATES = Layout("coordinates", ("point_id",), ("x_mm", "y_mm", "z_mm", *XYZ_SIGMAS), ("set_id", *_FLAGS), XYZ_RHO)
COORDINATES_COVARIANCE = Layout(
    "coordinates_covariance", ("set_id", "a_id", "a_axis", "b_id", "b_axis"), ("covariance_mm2",)
)


def read_angles(table: Table, names: Names, sigmas: Sigmas) -> tuple[TableReading, ...]:
    """Readings sorted by table and epoch."""
    axes = {t.table_id: len(t.axes) for t in names.survey.tables}
    epochs, tables = table.ids("epoch_id").values(), table.text("table_id").values()
    angles = np.stack([table.numbers("axis1_deg"), table.numbers("axis2_deg")], axis=1)
    groups = _groups(table, "table")
    readings: dict[tuple[str, str], TableReading] = {}
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
        cov = _angle_cov(table, row, table_id, k, sigmas) * sigmas.scale.get(groups[row], 1.0) ** 2
        readings[key] = TableReading(table_id, epoch_id, to_si(angles[row, :k], "deg"), cov, groups[row])
    order = sorted(readings, key=lambda key: (natural_key(key[0]), natural_key(key[1])))
    return tuple(readings[key] for key in order)


def _angle_cov(table: Table, row: int, table_id: str, k: int, sigmas: Sigmas) -> FloatArray:
    both = table.positive("sigma_arcsec")[row]
    each = np.array([table.positive(f"sigma_axis{i + 1}_arcsec")[row] for i in range(k)])
    rho = np.nan_to_num(table.numbers("rho_12")[row])
    if not np.isnan(both) and not np.isnan(each).all():
        raise table.error(row, "sigma_arcsec and sigma_axis1_arcsec are both given; keep one of the two")
    sigma = to_si(np.full(k, both) if not np.isnan(both) else each, "arcsec")
    if np.isnan(sigma).all() and table_id in sigmas.tables:
        sigma = sigmas.tables[table_id]
    if np.isnan(sigma).any():
        raise table.error(row, f"the row has no sigma; add sigma_arcsec here or to [tables.{table_id}]")
    if abs(rho) >= 1:
        raise table.error(row, f"rho_12: found {rho:g}; a correlation lies between -1 and 1")
    return np.asarray(covariance_from_sigmas(sigma[None], np.full((1, k * (k - 1) // 2), rho))[0])


def read_pairs(table: Table, names: Names, sigmas: Sigmas) -> tuple[Pair, ...]:
    """Measured pairs sorted by id: poses where there is a translation, else rotations."""
    pair_ids = table.unique_ids("pair_id")
    is_pose = _all_or_none(table, TRANSLATION)
    cov = _pair_covariances(table, is_pose)
    groups, used = _groups(table, "pair"), table.flags("used").tolist()
    rotations = _pair_rotations(table)
    translation = to_si(np.stack([table.numbers(name) for name in TRANSLATION], axis=1), "mm")
    ends = list(zip(table.text("a_id").values(), table.text("b_id").values(), strict=True))
    pairs = []
    for row, (a_text, b_text) in enumerate(ends):
        try:
            a, b = read_frame(a_text, names), read_frame(b_text, names)
            check_epochs(a, b, names)
        except NameProblemError as problem:
            raise table.error(row, f"a_id, b_id: {problem}") from problem
        if a == b:
            raise table.error(row, f"a_id, b_id: both are {a_text!r}; a pair joins two different frames")
        k = 6 if is_pose[row] else 3
        b_from_a = Pose3(rotations[row], translation[row]) if is_pose[row] else rotations[row]
        scaled = cov[row, :k, :k] * sigmas.scale.get(groups[row], 1.0) ** 2
        pairs.append(Pair(pair_ids[row], a, b, b_from_a, scaled, groups[row], used[row]))
    return tuple(sorted(pairs, key=lambda pair: natural_key(pair.pair_id)))


def _pair_rotations(table: Table) -> list[Rot3]:
    by_quaternion, by_euler = _all_or_none(table, QUATERNION), _all_or_none(table, EULER)
    wrong = by_quaternion == by_euler
    if wrong.any():
        row = first_row(wrong)
        found = "twice; keep one" if by_euler[row] else "nowhere; fill in"
        raise table.error(row, f"the rotation is given {found} of {','.join(QUATERNION)} and {','.join(EULER)}")
    wxyz = np.stack([table.numbers(name) for name in QUATERNION], axis=1)
    euler = to_si(np.stack([table.numbers(name) for name in EULER], axis=1), "deg")
    rotations = []
    for row in range(len(table)):
        rotation = rotation_from_quaternion(wxyz[row]) if by_quaternion[row] else rotation_from_euler(euler[row])
        if rotation is None:
            length = np.linalg.norm(wxyz[row])
            raise table.error(row, f"the quaternion qw,qx,qy,qz has length {length:g}, not 1; correct it")
        rotations.append(rotation)
    return rotations


def _pair_covariances(table: Table, is_pose: BoolArray) -> FloatArray:
    """Covariances (n, 6, 6) in rad and m, of rotations only in the upper left (3, 3)."""
    cov = np.zeros((len(table), 6, 6))
    full = np.stack([table.numbers(name) for name in COVARIANCE_COLUMNS], axis=1)
    given: BoolArray = np.asarray((~np.isnan(full)).any(axis=1))
    if given.any():
        cov[given] = _full_covariances(table, given, is_pose)
    if not given.all():
        sigma = np.concatenate([_sigmas(table, "rotation"), _sigmas(table, "translation")], axis=1)
        sigma[~is_pose, 3:] = np.where(np.isnan(sigma[~is_pose, 3:]), 1.0, np.inf)
        for name, part in (("rotation", sigma[:, :3]), ("translation", sigma[:, 3:])):
            bad = ~given & (~np.isfinite(part)).any(axis=1)
            if bad.any():
                row = first_row(bad)
                surplus = "the pair has a sigma of the translation but no translation; remove it"
                missing = f"the pair has no sigma of the {name}; fill in {SIGMA_COLUMNS[name][-1][0]} or the like"
                raise table.error(row, surplus if np.isinf(part[row]).any() else missing)
        cov[~given] = covariance_from_sigmas(sigma[~given])
    cov[~is_pose, 3:, :] = 0.0
    cov[~is_pose, :, 3:] = 0.0
    for mask, k in ((is_pose, 6), (~is_pose, 3)):
        problem = covariance_problem(cov[mask][:, :k, :k])
        if problem:
            raise table.error(int(np.flatnonzero(mask)[problem[0]]), f"{problem[1]}; correct the cov columns")
    return cov


def _full_covariances(table: Table, given: BoolArray, is_pose: BoolArray) -> FloatArray:
    """Matrices (n, 6, 6) of the rows ``given``: the upper triangle is needed, the lower one filled in where blank."""
    full = np.stack([table.numbers(name) for name in COVARIANCE_COLUMNS], axis=1).reshape(-1, 6, 6)
    upper = np.triu(np.ones((6, 6), dtype=bool))
    needed = upper & ~(~is_pose[:, None, None] & (np.arange(6) >= 3))
    missing = given[:, None, None] & needed & np.isnan(full)
    if missing.any():
        row, i, j = (int(x[0]) for x in np.nonzero(missing))
        raise table.error(row, f"{covariance_column(i, j)}: is blank; fill in the whole upper triangle")
    doubled = given & ~np.isnan(np.concatenate([_sigmas(table, "rotation"), _sigmas(table, "translation")], 1)).all(1)
    if doubled.any():
        raise table.error(first_row(doubled), "the covariance and sigmas are both given; keep one of the two")
    full = np.nan_to_num(np.where(np.isnan(full), full.transpose(0, 2, 1), full))
    return np.asarray(full[given])


def _sigmas(table: Table, part: str) -> FloatArray:
    """Sigmas (n, 3) rad or m from whichever columns give them; nan where none does."""
    result = np.full((len(table), 3), np.nan)
    for columns in SIGMA_COLUMNS[part]:
        values = to_si(np.stack([table.positive(name) for name in columns], axis=1), columns[0].rpartition("_")[2])
        twice = ~np.isnan(values).all(axis=1) & ~np.isnan(result).all(axis=1)
        if twice.any():
            raise table.error(first_row(twice), f"{columns[0]}: the sigma of the {part} is given twice; keep one")
        result = np.where(np.isnan(values), result, values)
    return result


def _all_or_none(table: Table, columns: tuple[str, ...]) -> BoolArray:
    """Rows (n,) in which all ``columns`` are filled; raises where only some are."""
    filled = np.stack([~np.isnan(table.numbers(name)) for name in columns], axis=1)
    some = filled.any(axis=1) & ~filled.all(axis=1)
    if some.any():
        raise table.error(first_row(some), f"{','.join(columns)}: only some are filled in; give all or none")
    return np.asarray(filled.all(axis=1))


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
    groups, used = _groups(table, "distance"), table.flags("used").tolist()
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
    values = to_si(np.stack([table.numbers(name) for name in ("x_mm", "y_mm", "z_mm")], axis=1), "mm")
    own = _own_covariances(table)
    groups, used = _groups(table, "coordinates"), table.flags("used").tolist()
    result = []
    for name in sorted(sets, key=natural_key):
        rows = sorted(sets[name].rows, key=lambda row: natural_key(texts[row]))
        for row in rows:
            if (groups[row], used[row]) != (groups[rows[0]], used[rows[0]]):
                raise table.error(row, f"set {sets[name].name!r} has different 'group' or 'used'; make them the same")
        cov = _joint_covariance(table, rows, own, sets[name]) * sigmas.scale.get(groups[rows[0]], 1.0) ** 2
        refs = tuple(positions[row] for row in rows)
        result.append(Coordinates(refs, values[rows], cov, groups[rows[0]], used[rows[0]]))
    return tuple(result)


def _coordinate_position(table: Table, row: int, text: str, names: Names) -> PositionRef:
    try:
        position = read_position(text, names)
        check_epochs(position.frame, None, names)
    except NameProblemError as problem:
        raise table.error(row, f"point_id: {problem}") from problem
    return position


def _own_covariances(table: Table) -> FloatArray:
    """Covariances (n, 3, 3) m^2 of the rows, from sigmas and correlations."""
    sigma = to_si(np.stack([table.positive(name) for name in XYZ_SIGMAS], axis=1), "mm")
    rho = np.nan_to_num(np.stack([table.numbers(name) for name in XYZ_RHO], axis=1))
    wrong = (np.abs(rho) >= 1).any(axis=1)
    if wrong.any():
        raise table.error(first_row(wrong), f"{','.join(XYZ_RHO)}: a correlation lies between -1 and 1")
    cov = covariance_from_sigmas(sigma, rho)
    problem = covariance_problem(cov)
    if problem:
        raise table.error(problem[0], f"{problem[1]}; correct {','.join(XYZ_RHO)}")
    return cov


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
    problem = covariance_problem(cov[None]) if members.entries else None
    if problem:
        raise table.error(rows[0], f"set {members.name!r}: {problem[1]}; correct coordinates_covariance")
    return cov


def _groups(table: Table, default: str) -> list[str]:
    return [name or default for name in table.text("group").values()]
