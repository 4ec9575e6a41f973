"""Columns as CSV or Parquet files."""

import csv
import io
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from survey.folder.text import atomic_write, formula_problem, utf8
from survey.project.tables.arrow import LARGE, csv_rows, parquet_bytes
from survey.project.tables.reading import Columns, TextColumn

_NUMBERS = re.compile(r"[-+.\deE ]+")  # the components of an axis in one cell


def write_table(folder: Path, name: str, columns: Columns, parquet: bool = False) -> Path:
    """Write ``folder/name.csv`` or ``.parquet`` and remove the other of the two; nan becomes blank.

    Numbers keep all their digits: reading gives back the same doubles. Raises SurveyError for a text that a spreadsheet
    would take for a formula.
    """
    for column, values in columns.items():
        for text in _names(values):
            if (problem := formula_problem(text)) and not _NUMBERS.fullmatch(text):
                raise SurveyError(f"{folder}/{name}: {column}: {text[:40]!r}: {problem}")
    path, other = folder / f"{name}.csv", folder / f"{name}.parquet"
    if parquet:
        path, other = other, path
    atomic_write(path, parquet_bytes(columns) if parquet else _csv(columns))
    other.unlink(missing_ok=True)
    return path


def _names(column: Sequence[str] | TextColumn | FloatArray) -> Sequence[str]:
    """The different texts of a column; none of numbers."""
    if isinstance(column, TextColumn):
        return column.names
    return () if isinstance(column, np.ndarray) else tuple(dict.fromkeys(column))


def _csv(columns: Columns) -> bytes:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    doubles = all(c.dtype == np.float64 for c in columns.values() if isinstance(c, np.ndarray))
    if doubles and 10 * len(columns) * max(map(len, columns.values()), default=0) > LARGE:
        return utf8(stream.getvalue()) + csv_rows(columns)
    writer.writerows(zip(*(cells_of(column) for column in columns.values()), strict=True))
    return utf8(stream.getvalue())


def cells_of(column: Sequence[str] | TextColumn | FloatArray) -> Sequence[object]:
    """The cells of a column as the csv module writes them; nan is blank."""
    if isinstance(column, TextColumn):
        return column.values()
    if not isinstance(column, np.ndarray):
        return column
    values: list[object] = column.tolist()
    for row in np.flatnonzero(np.isnan(column)).tolist():
        values[row] = None
    return values
