"""Tables out of CSV or Parquet files, with file and line of whatever is wrong in them, and columns as such files."""

import csv
import io
import itertools
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from adjust.model.arrays import FloatArray, IntArray
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.native.parallel import Beside
from survey.folder.ahead import LARGE, Ahead, Content, Version, begun, version
from survey.folder.text import (
    LARGEST_NUMBER,
    atomic_write,
    content,
    csv_rows,
    csv_text,
    decode,
    formula_problem,
    utf8,
)
from survey.project.tables.arrow import csv_bytes, csv_columns, parquet_bytes, parquet_columns
from survey.project.tables.layouts import LAYOUTS
from survey.project.tables.reading import Columns, Layout, Table, TextColumn, check_header, check_rows, first_row

CHUNK = 65536
_NUMBERS = re.compile(r"[-+.\deE ]+")  # the components of an axis in one cell
Chunk = tuple[IntArray, Sequence[Sequence[str]]]


@frozen(eq=False)
class Begun:
    """A table that is being read: the file as it was then, and what gives the table."""

    file: Version
    table: Callable[[], Table]


def begin_tables(ahead: Ahead) -> dict[Path, Begun]:
    """Go on with files that are being read: to the tables that they hold."""
    begun_tables = {}
    if ahead.files:
        import_module("pyarrow.csv")  # before GTSAM, which is loaded with Python's lock held
    while ahead.files:
        path, (file, found) = ahead.files.popitem()
        if path.stem in LAYOUTS:
            begun_tables[path] = Begun(file, ahead.steps.of(partial(_read, path, LAYOUTS[path.stem], found)))
    return begun_tables


def read_table(path: Path, layout: Layout, instead: str | None = None, ahead: Begun | None = None) -> Table:
    """Read ``.csv`` or ``.parquet``; raises SurveyError with file and line for whatever does not fit the layout.

    instead: what is to stand in it, not yet written. ahead: where it was read ahead, taken if the file is as it was.
    """
    if ahead is not None and instead is None and ahead.file == version(path):
        return ahead.table()
    with Beside() as steps:
        return _read(path, layout, begun(lambda: content(path) if instead is None else instead.encode(), steps))


def _read(path: Path, layout: Layout, found: Content) -> Table:
    if path.suffix == ".parquet":
        columns = parquet_columns(path, found.data(), layout)
        lines = np.arange(1, len(next(iter(columns.values()))) + 1)
        return _table(path, layout, found.digest(), lines, columns)
    plain = csv_columns(found.data(), layout)
    if plain is not None:
        return _table(path, layout, found.digest(), np.arange(2, len(next(iter(plain.values()))) + 2), plain)
    text = decode(path, found.data())
    if not text.strip():
        raise SurveyError(f"{path}:1: the file is empty; the first line names the columns: {','.join(layout.required)}")
    check_rows(path, text.count("\n"))
    header, chunks = csv_chunks(path, text)
    check_header(path, header, layout)
    return _assemble(path, layout, found.digest(), header, chunks)


def _assemble(path: Path, layout: Layout, digest: str, header: Sequence[str], chunks: Iterable[Chunk]) -> Table:
    builders = {name: _TextBuilder() if layout.is_text(name) else _NumberBuilder() for name in header}
    all_lines = [np.zeros(0, np.int64)]
    for lines, columns in chunks:
        all_lines.append(lines)
        for name, column in zip(header, columns, strict=True):
            bad = builders[name].add(column, name in layout.required)
            if bad is not None:
                raise SurveyError(f"{path}:{lines[bad[0]]}: {name}: {bad[1]}")
    return _table(path, layout, digest, np.concatenate(all_lines), {n: b.column() for n, b in builders.items()})


def _table(
    path: Path, layout: Layout, digest: str, lines: IntArray, columns: Mapping[str, TextColumn | FloatArray]
) -> Table:
    texts = {name: column for name, column in columns.items() if isinstance(column, TextColumn)}
    numbers = {name: column for name, column in columns.items() if not isinstance(column, TextColumn)}
    return Table(path, layout, digest, lines, texts, numbers)


class _TextBuilder:
    """Turns texts into codes, chunk by chunk."""

    def __init__(self) -> None:
        self.parts: list[IntArray] = []
        self.index: dict[str, int] = {}

    def add(self, column: Sequence[str], is_required: bool) -> tuple[int, str] | None:
        for name in dict.fromkeys(column):
            self.index.setdefault(name, len(self.index))
        self.parts.append(np.fromiter(map(self.index.__getitem__, column), np.int64, len(column)))
        if is_required and "" in self.index:
            return column.index(""), "is blank; fill it in"
        return None

    def column(self) -> TextColumn:
        return TextColumn(tuple(self.index), np.concatenate([np.zeros(0, np.int64), *self.parts]))


class _NumberBuilder:
    """Turns texts into numbers, chunk by chunk."""

    def __init__(self) -> None:
        self.parts: list[FloatArray] = []

    def add(self, column: Sequence[str], is_required: bool) -> tuple[int, str] | None:
        try:
            values = np.fromiter(map(float, column), np.float64, len(column))
        except ValueError:
            values = None
        if values is None or "_" in "".join(column):  # Python takes 1_000 for a number, people do not
            values = np.empty(len(column))
            for row, text in enumerate(column):
                if text == "" and not is_required:
                    values[row] = 0.0
                    continue
                try:
                    values[row] = float(text.replace("_", "?"))
                except ValueError:
                    return row, "is blank; fill it in" if text == "" else f"found {text!r}, expected a number"
        bad = ~(np.abs(values) <= LARGEST_NUMBER)
        if bad.any():
            row = first_row(bad)
            problem = "too large to be meant; correct it" if np.isfinite(values[row]) else "it must be a finite number"
            return row, f"found {column[row][:40]!r}; {problem}"
        if not is_required and "" in column:
            values[np.fromiter((text == "" for text in column), bool, len(column))] = np.nan
        self.parts.append(values)
        return None

    def column(self) -> FloatArray:
        return np.concatenate([np.zeros(0), *self.parts])


def csv_chunks(path: Path, text: str) -> tuple[list[str], Iterator[Chunk]]:
    """The header, and the rows after it: the line of each row, and the columns. Raises SurveyError for broken rows."""
    reader = csv.reader(io.StringIO(text, newline=""), strict=True)
    header = _next_rows(path, text, reader, 1)[0]
    return header, _columns(path, text, reader, len(header))


def _columns(path: Path, text: str, reader: Any, n: int) -> Iterator[Chunk]:
    """Chunk by chunk through the csv module; raises where a row has a wrong length."""
    line = reader.line_num + 1
    while rows := _next_rows(path, text, reader, CHUNK):
        lines = np.arange(line, line + len(rows))
        _check_lengths(path, rows, lines, n, reader.line_num)
        line += len(rows)
        filled = np.fromiter(map(bool, rows), bool, len(rows))
        if filled.any():
            yield lines[filled], list(zip(*filter(None, rows), strict=True))


def _next_rows(path: Path, text: str, reader: Iterator[list[str]], n: int) -> list[list[str]]:
    try:
        return list(itertools.islice(reader, n))
    except csv.Error:
        deque(csv_rows(path, text), maxlen=0)  # raises it with the line
        raise


def _check_lengths(path: Path, rows: list[list[str]], lines: IntArray, n: int, last_line: int) -> None:
    if not set(map(len, rows)) <= {0, n}:
        i = next(i for i, row in enumerate(rows) if len(row) not in (0, n))
        hint = "; numbers have a decimal point, not a comma" if len(rows[i]) > n else ""
        raise SurveyError(f"{path}:{lines[i]}: found {len(rows[i])} fields, expected {n} as in the first line{hint}")
    if last_line != lines[-1]:
        i = next(i for i, row in enumerate(rows) if any("\n" in field or "\r" in field for field in row))
        raise SurveyError(f"{path}:{lines[i]}: a quoted field runs over the end of the line; close its quotes")


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
    header = csv_text([columns])
    doubles = all(c.dtype == np.float64 for c in columns.values() if isinstance(c, np.ndarray))
    if doubles and 10 * len(columns) * max(map(len, columns.values()), default=0) > LARGE:
        return utf8(header) + csv_bytes(columns)
    return utf8(header + csv_text(zip(*(cells_of(column) for column in columns.values()), strict=True)))


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
