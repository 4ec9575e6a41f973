"""Tables of observations out of CSV or Parquet files, with file and line of whatever is wrong in them."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from adjust.errors import SurveyError
from adjust.model import FloatArray, IntArray
from survey.files.arrow_columns import csv_columns, parquet_columns
from survey.files.csv_chunks import Chunk, csv_chunks
from survey.files.tables import Layout, Table, TextColumn, check_header, check_rows, first_row
from survey.files.text import LARGEST_NUMBER, decode, read_bytes


def read_table(path: Path, layout: Layout) -> Table:
    """Read ``.csv`` or ``.parquet``; raises SurveyError with file and line for whatever does not fit the layout."""
    data, digest = read_bytes(path)
    if path.suffix == ".parquet":
        columns = parquet_columns(path, data, layout)
        return _table(path, layout, digest, np.arange(1, len(next(iter(columns.values()))) + 1), columns)
    plain = csv_columns(data, layout)
    if plain is not None:
        return _table(path, layout, digest, np.arange(2, len(next(iter(plain.values()))) + 2), plain)
    text = decode(path, data)
    if not text.strip():
        raise SurveyError(f"{path}:1: the file is empty; the first line names the columns: {','.join(layout.required)}")
    check_rows(path, text.count("\n"))
    header, chunks = csv_chunks(path, text)
    check_header(path, header, layout)
    return _assemble(path, layout, digest, header, chunks)


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
