"""The edits of a hypothesis as texts of the project's files: everything that is not concerned stays to the letter."""

import io
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from adjust.diagnosis.hypothesis import (
    ChangeColumns,
    ChangeReadings,
    Edit,
    ExchangeColumns,
    Hypothesis,
    LeaveOut,
    Rename,
    ScaleKey,
    SetKey,
    SetReadings,
)
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.text import csv_rows, csv_text, read_text
from survey.folder.units import from_si, to_si
from survey.project.declared.editing import with_product, with_value
from survey.project.project import DEFINITION_FILE, OBSERVATIONS_FOLDER
from survey.project.tables.layouts import HEIGHTS, LAYOUTS

KEPT = "kept"
TableEdit = ChangeColumns | ExchangeColumns | ChangeReadings | SetReadings | Rename
_UNITS = ("deg", "gon", "m", "mm", "arcsec", "mgon", "cc")
_NUMBERED = "reading_id"
"""The column that rows may leave blank: their id is then that of their number."""
OF_IMAGE = ("u_px", "v_px")
"""Columns with which sigmas of image points change."""
_SIGMAS_OF_IMAGE = ("sigma_u_px", "sigma_v_px", "rho_uv")


@frozen
class Changed:
    """A file of a project, by its path in it: its text before and after, and where that is kept that was before."""

    name: str
    before: str
    after: str
    kept: str


def changed_files(folder: Path, chosen: Hypothesis) -> tuple[Changed, ...]:
    """All files that the edits of a hypothesis change; nothing is written. Raises SurveyError."""
    before: dict[str, str] = {}
    after: dict[str, str] = {}
    for edit in chosen.edits:
        if isinstance(edit, LeaveOut):
            continue
        name = file_of(edit)
        path = folder / name
        if name not in before:
            before[name] = _text(path, chosen)
        new = _edited(path, after.get(name, before[name]), edit, chosen)
        if new == after.get(name, before[name]):
            raise SurveyError(f"{path}: nothing there is concerned by this change; {chosen.change}")
        after[name] = new
    return tuple(Changed(name, before[name], after[name], kept_name(folder, name)) for name in after)


def left_out(chosen: Hypothesis) -> tuple[str, ...]:
    """All names that the edits of a hypothesis leave out."""
    return tuple(dict.fromkeys(name for edit in chosen.edits if isinstance(edit, LeaveOut) for name in edit.names))


def file_of(edit: ScaleKey | SetKey | TableEdit) -> str:
    """The file that an edit changes, by its path in the project."""
    if isinstance(edit, ScaleKey | SetKey):
        return DEFINITION_FILE
    return f"{OBSERVATIONS_FOLDER}/{edit.table}.csv"


def kept_name(folder: Path, name: str) -> str:
    """A name below ``kept/`` that nothing has yet."""
    path, number = Path(name), 1
    while (folder / KEPT / f"{path.stem}-{number}{path.suffix}").exists():
        number += 1
    return f"{KEPT}/{path.stem}-{number}{path.suffix}"


def _text(path: Path, chosen: Hypothesis) -> str:
    if path.with_suffix(".parquet").exists():
        raise SurveyError(f"{path.with_suffix('.parquet')}: only lines can be changed; write it as {path.name}, or "
                          f"{chosen.change}")  # fmt: skip
    if not path.exists():
        raise SurveyError(f"{path}: this project has no such table; {chosen.change}")
    return read_text(path)


def _edited(path: Path, text: str, edit: Edit, chosen: Hypothesis) -> str:
    if isinstance(edit, ScaleKey | SetKey):
        try:
            return with_product(text, edit.path, edit.factor) if isinstance(edit, ScaleKey) else \
                with_value(text, edit.path, edit.value)  # fmt: skip
        except SurveyError as error:
            raise SurveyError(f"{path}: {error}") from error
    if isinstance(edit, LeaveOut):
        raise TypeError("exclusions are rows of their own table")
    return _table(path, text, edit, chosen)


def _table(path: Path, text: str, edit: TableEdit, chosen: Hypothesis) -> str:
    """A table with its rows changed; the lines of those that are not concerned as they are."""
    lines, rows = io.StringIO(text, newline="").readlines(), csv_rows(path, text)
    names = [name.strip() for name in next(rows, (1, []))[1]]
    wanted, where = _columns(edit)
    if missing := [name for name in (*wanted, *where) if name not in (*names, _NUMBERED)]:
        raise SurveyError(f"{path}:1: the column {missing[0]!r} is missing; {chosen.change}")
    for number, (line, cells) in enumerate(rows, 1):
        row = dict(zip(names, cells, strict=False))
        if _NUMBERED in where:
            row[_NUMBERED] = row.get(_NUMBERED) or f"r{number}"
        if any(row[column] not in values for column, values in where.items()):
            continue
        try:
            new = row | _changed(row, edit)
        except ValueError as error:
            raise SurveyError(f"{path}:{line}: {', '.join(wanted)}: a number is missing; {chosen.change}") from error
        if new != row:
            lines[line - 1] = _row([new.get(name, "") for name in names], lines[line - 1])
    return "".join(lines)


def _columns(edit: TableEdit) -> tuple[tuple[str, ...], Mapping[str, frozenset[str]]]:
    """The columns that an edit changes, and which values choose its rows."""
    if isinstance(edit, SetReadings):
        return (edit.column,), {_NUMBERED: frozenset(edit.ids)}
    if isinstance(edit, ChangeReadings):
        return (), {LAYOUTS[edit.table].ids[0] if edit.table != "terrestrial" else _NUMBERED: frozenset(edit.ids)}
    where = {column: frozenset(values) for column, values in edit.where.items()}
    return (edit.column,) if isinstance(edit, Rename) else edit.columns, where


def _changed(row: Mapping[str, str], edit: TableEdit) -> dict[str, str]:
    if isinstance(edit, Rename):
        return {edit.column: edit.names.get(row[edit.column], row[edit.column])}
    if isinstance(edit, SetReadings):
        return {edit.column: edit.value}
    if isinstance(edit, ExchangeColumns):
        a, b = edit.columns
        return {a: row[b], b: row[a]}
    if isinstance(edit, ChangeReadings):
        there = [(f"{edit.field}_{u}", u) for u in _UNITS if f"{edit.field}_{u}" in row]
        blank = there[:1] if edit.field in HEIGHTS else []  # a height that is not given is zero
        column, unit = next(((c, u) for c, u in there if row[c]), next(iter(blank), ("", "")))
        if not column:
            raise ValueError("written as degrees-minutes-seconds, or elsewhere")
        si = edit.factor * float(to_si(float(row[column] or 0.0), unit)) + edit.offset
        return {column: f"{float(from_si(si, unit)):.12g}"}
    values = edit.matrix @ np.array([float(row[name]) for name in edit.columns]) + edit.offset
    new = {name: f"{value:.12g}" for name, value in zip(edit.columns, values, strict=True)}
    if edit.columns == OF_IMAGE and all(row.get(name) for name in _SIGMAS_OF_IMAGE[:2]):
        new |= _mapped_sigmas(row, edit.matrix)
    return new


def _mapped_sigmas(row: Mapping[str, str], by: FloatArray) -> dict[str, str]:
    """Sigmas and correlation of an image point whose coordinates are mapped."""
    s = np.array([float(row[name]) for name in _SIGMAS_OF_IMAGE[:2]])
    rho = float(row.get(_SIGMAS_OF_IMAGE[2]) or 0.0)
    cov = by @ (np.outer(s, s) * np.array([[1.0, rho], [rho, 1.0]])) @ by.T
    new = np.sqrt(np.diag(cov))
    values = (*new, cov[0, 1] / (new[0] * new[1]))
    return {name: f"{v:.12g}" for name, v in zip(_SIGMAS_OF_IMAGE, values, strict=True) if row.get(name)}


def _row(cells: Sequence[str], before: str) -> str:
    """A row as a line, with the end of the line that it had."""
    return csv_text([cells], before[len(before.rstrip("\r\n")) :])
