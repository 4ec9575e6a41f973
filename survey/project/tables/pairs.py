"""The table of measured pairs: relative rotations and poses, with sigmas or covariances."""

from collections.abc import Iterator, Sequence

import numpy as np
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.names import natural_key
from adjust.model.observations import FrameRef, Pair, frame_text
from adjust.model.survey import BoolArray, FloatArray
from adjust.observations.pair_arrays import pair_arrays
from adjust.spatial.rotation_forms import euler_from_matrix, tangent_cov_from_euler
from survey.folder.units import from_si, to_si, unit_in
from survey.project.declared.poses import is_unit, quaternion_wxyz, rotation_from_euler
from survey.project.project import Sigmas
from survey.project.tables.covariance import covariance_from_sigmas, covariance_problem
from survey.project.tables.layouts import (
    COVARIANCE_COLUMNS,
    EULER,
    EULER_SIGMAS,
    QUATERNION,
    SIGMA_COLUMNS,
    TRANSLATION,
    covariance_column,
)
from survey.project.tables.reading import Columns, Table, first_row, group_columns, marks, one_of
from survey.project.tables.references import Names, check_epochs, read_frame


def read_pairs(table: Table, names: Names, sigmas: Sigmas) -> tuple[Pair, ...]:
    """Measured pairs sorted by id: poses where there is a translation, else rotations."""
    pair_ids = table.unique_ids("pair_id")
    is_pose = _all_or_none(table, TRANSLATION)
    rotations = _pair_rotations(table)
    cov = _pair_covariances(table, is_pose, rotations)
    groups, used, scale = marks(table, "pair", sigmas.scale)
    translation = to_si(np.stack([table.numbers(name) for name in TRANSLATION], axis=1), "mm")
    scaled = cov * scale[:, None, None] ** 2
    rows = zip(pair_ids, read_ends(table, names), rotations, translation, scaled, is_pose.tolist(), groups, used,
               strict=True)  # fmt: skip
    pairs = [Pair(i, a, b, Pose3(R, t) if pose else R, C if pose else C[:3, :3], group, use)
             for i, (a, b), R, t, C, pose, group, use in rows]  # fmt: skip
    return tuple(sorted(pairs, key=lambda pair: natural_key(pair.pair_id)))


def read_ends(table: Table, names: Names) -> Iterator[tuple[FrameRef, FrameRef]]:
    """The two frames of every row. Raises SurveyError for what cannot be a pair."""
    something_moves, known = any(names.bodies.values()), names.frames
    for row, (a_text, b_text) in enumerate(zip(table.text("a_id").values(), table.text("b_id").values(), strict=True)):
        if not something_moves and a_text in known and b_text in known and known[a_text].text != known[b_text].text:
            yield known[a_text], known[b_text]
            continue
        fail = table.fail(row, "a_id, b_id")
        a, b = read_frame(a_text, names, fail), read_frame(b_text, names, fail)
        if something_moves:
            check_epochs(a, b, names, fail)
        if a.text == b.text:
            raise fail(f"both are {a_text!r}; a pair joins two different frames")
        yield a, b


def _pair_rotations(table: Table) -> list[Rot3]:
    by_quaternion, by_euler = _all_or_none(table, QUATERNION), _all_or_none(table, EULER)
    wrong = by_quaternion == by_euler
    if wrong.any():
        row = first_row(wrong)
        found = "twice; keep one" if by_euler[row] else "nowhere; fill in"
        raise table.error(row, f"the rotation is given {found} of {','.join(QUATERNION)} and {','.join(EULER)}")
    wxyz = np.stack([table.numbers(name) for name in QUATERNION], axis=1)
    euler = to_si(np.stack([table.numbers(name) for name in EULER], axis=1), "deg")
    with np.errstate(invalid="ignore", over="ignore"):
        length = np.linalg.norm(wxyz, axis=1)
        bad = by_quaternion & ~is_unit(length)
        unit = (wxyz / length[:, None]).tolist()
    if bad.any():
        row = first_row(bad)
        raise table.error(row, f"the quaternion qw,qx,qy,qz has length {length[row]:g}, not 1; correct it")
    return [Rot3.Quaternion(*q) if known else rotation_from_euler(angles)
            for q, known, angles in zip(unit, by_quaternion.tolist(), euler, strict=True)]  # fmt: skip


def _pair_covariances(table: Table, is_pose: BoolArray, rotations: list[Rot3]) -> FloatArray:
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
                missing = f"the pair has no sigma of the {name}; fill in {SIGMA_COLUMNS[name][1][0]} or the like"
                raise table.error(row, surplus if np.isinf(part[row]).any() else missing)
        cov[~given] = covariance_from_sigmas(sigma[~given])
        _turn_euler_covariances(table, rotations, cov)
    cov[~is_pose, 3:, :] = 0.0
    cov[~is_pose, :, 3:] = 0.0
    for mask, k in ((is_pose, 6), (~is_pose, 3)):
        problem = covariance_problem(cov[mask][:, :k, :k])
        if problem:
            raise table.error(int(np.flatnonzero(mask)[problem[0]]), f"{problem[1]}; correct the cov columns")
    return cov


def _turn_euler_covariances(table: Table, rotations: list[Rot3], cov: FloatArray) -> None:
    """Where the sigmas are those of Euler angles (R = Rz Ry Rx), turn their covariance into the tangent, in place."""
    sigmas = np.stack([table.numbers(name) for columns in EULER_SIGMAS for name in columns], axis=1)
    for row in np.flatnonzero((~np.isnan(sigmas)).any(axis=1)):
        try:
            angles = euler_from_matrix(rotations[row].matrix())
        except SurveyError as error:
            raise table.error(int(row), f"sigma_euler: {error}; give sigma_rx_arcsec and the like instead") from error
        cov[row, :3, :3] = tangent_cov_from_euler(angles, cov[row, :3, :3])


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
    given = {columns[0]: to_si(np.stack([table.positive(name) for name in columns], axis=1), unit_in(columns[0]))
             for columns in SIGMA_COLUMNS[part]}  # fmt: skip
    return one_of(table, given, f"sigma of the {part}")


def _all_or_none(table: Table, columns: tuple[str, ...]) -> BoolArray:
    """Rows (n,) in which all ``columns`` are filled; raises where only some are."""
    filled = np.stack([~np.isnan(table.numbers(name)) for name in columns], axis=1)
    some = filled.any(axis=1) & ~filled.all(axis=1)
    if some.any():
        raise table.error(first_row(some), f"{','.join(columns)}: only some are filled in; give all or none")
    return np.asarray(filled.all(axis=1))


def pair_columns(pairs: Sequence[Pair]) -> Columns:
    """One row per pair: quaternion, translation of poses, sigmas where they are independent, else the covariance."""
    sigma_names = (*SIGMA_COLUMNS["rotation"][3], *SIGMA_COLUMNS["translation"][1])
    names = (*QUATERNION, *TRANSLATION, *sigma_names, *COVARIANCE_COLUMNS)
    measured, rows = pair_arrays(tuple(pairs)), np.full((len(pairs), len(names)), np.nan)
    rotations = (p.b_from_a.rotation() if isinstance(p.b_from_a, Pose3) else p.b_from_a for p in pairs)
    rows[:, :4] = np.array([quaternion_wxyz(rotation) for rotation in rotations]).reshape(-1, 4)
    rows[:, 4:7] = from_si(measured.translations, "mm")
    alone = np.count_nonzero(measured.cov, axis=(1, 2)) == 6  # infinite where no translation was measured
    cov = np.where(np.isinf(measured.cov), np.nan, measured.cov)
    cov[~measured.is_pose, :, 3:] = np.nan
    sigma = np.sqrt(np.diagonal(cov[alone], axis1=1, axis2=2))
    rows[alone, 7:13] = np.concatenate([from_si(sigma[:, :3], "arcsec"), from_si(sigma[:, 3:], "mm")], axis=1)
    rows[~alone, 13:] = np.where(np.triu(np.ones((6, 6), dtype=np.bool_)), cov[~alone], np.nan).reshape(-1, 36)
    columns = {name: column for name, column in zip(names, rows.T, strict=True) if not np.isnan(column).all()}
    return {
        "pair_id": [pair.pair_id for pair in pairs],
        "a_id": [frame_text(pair.a) for pair in pairs],
        "b_id": [frame_text(pair.b) for pair in pairs],
        **columns,
        **group_columns(pairs, "pair"),
    }
