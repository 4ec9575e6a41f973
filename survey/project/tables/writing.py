"""Columns as CSV or Parquet files."""

import csv
import io
import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray
from survey.folder.text import atomic_write, formula_problem

_NUMBERS = re.compile(r"[-+.\deE ]+")  # the components of an axis in one cell

Columns = Mapping[str, Sequence[str] | FloatArray]


def write_table(folder: Path, name: str, columns: Columns, parquet: bool = False) -> Path:
    """Write ``folder/name.csv`` or ``.parquet`` and remove the other of the two; nan becomes blank.

    Numbers keep all their digits: reading gives back the same doubles. Raises SurveyError for a text that a spreadsheet
    would take for a formula.
    """
    for column, values in columns.items():
        for text in () if isinstance(values, np.ndarray) else dict.fromkeys(values):
            if (problem := formula_problem(text)) and not _NUMBERS.fullmatch(text):
                raise SurveyError(f"{folder}/{name}: {column}: {text[:40]!r}: {problem}")
    path, other = folder / f"{name}.csv", folder / f"{name}.parquet"
    if parquet:
        path, other = other, path
    atomic_write(path, _parquet(path, columns) if parquet else _csv(columns))
    other.unlink(missing_ok=True)
    return path


def _csv(columns: Columns) -> str:
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*(cells_of(column) for column in columns.values()), strict=True))
    return stream.getvalue()


def cells_of(column: Sequence[str] | FloatArray) -> Sequence[object]:
    """The cells of a column as the csv module writes them; nan is blank."""
    if not isinstance(column, np.ndarray):
        return column
    values: list[object] = column.tolist()
    for row in np.flatnonzero(np.isnan(column)).tolist():
        values[row] = None
    return values


def _parquet(path: Path, columns: Columns) -> bytes:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        message = "Parquet needs pyarrow; install it with: pip install 'labsurvey[parquet]', or write CSV"
        raise SurveyError(f"{path}: {message}") from error
    arrays = {
        name: pa.array(column, from_pandas=True)
        if isinstance(column, np.ndarray)
        else pa.array(list(column), pa.string()).dictionary_encode()
        for name, column in columns.items()
    }
    stream = io.BytesIO()
    pq.write_table(pa.table(arrays), stream)
    return stream.getvalue()
