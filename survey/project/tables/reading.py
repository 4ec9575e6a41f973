"""Tables of observations: CSV or Parquet into columns, with the line of every row.

Text columns become codes into their different names, so that nothing later runs per row.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.model.errors import SurveyError
from adjust.model.survey import BoolArray, FloatArray, IntArray
from survey.folder.text import LARGEST_NUMBER, decode, formula_problem, id_problem, read_bytes, suggestion
from survey.project.tables.csv_chunks import Chunk, csv_chunks

LARGEST_ROWS = 50_000_000  # of one table: ten times what the largest surveys have
_LARGEST_DECODED = 8 * 2**30  # bytes of the columns of a Parquet file
FLAGS = ("group", "used")  # optional text columns of every table of observations


@dataclass(frozen=True)
class Layout:
    """The columns of a table. Required ones must be there and filled; optional ones may be absent or blank."""

    name: str
    ids: tuple[str, ...]
    numbers: tuple[str, ...]
    optional_text: tuple[str, ...] = ()
    optional_numbers: tuple[str, ...] = ()

    @property
    def required(self) -> tuple[str, ...]:
        """Columns that must be there."""
        return self.ids + self.numbers

    @property
    def columns(self) -> tuple[str, ...]:
        """All columns."""
        return self.ids + self.optional_text + self.numbers + self.optional_numbers

    def is_text(self, column: str) -> bool:
        """Whether the column holds text."""
        return column in self.ids or column in self.optional_text


@dataclass(frozen=True, eq=False)
class TextColumn:
    """``names`` are the different texts in order of appearance, ``codes`` (n,) the positions in them."""

    names: tuple[str, ...]
    codes: IntArray

    def values(self) -> list[str]:
        """The text of every row."""
        return [self.names[code] for code in self.codes.tolist()]


@dataclass(frozen=True, eq=False)
class Table:
    """A table that was read: ``lines`` (n,) where its rows stand, and its columns. Blank numbers are nan."""

    path: Path
    layout: Layout
    digest: str
    lines: IntArray
    text_columns: dict[str, TextColumn]
    number_columns: dict[str, FloatArray]

    def __len__(self) -> int:
        return len(self.lines)

    def has(self, column: str) -> bool:
        """Whether the file has the column."""
        return column in self.text_columns or column in self.number_columns

    def where(self, row: int) -> str:
        """``file:line`` of a row."""
        return f"{self.path}:{self.lines[row] if len(self.lines) else 1}"

    def error(self, row: int, problem: str) -> SurveyError:
        """An error at a row."""
        return SurveyError(f"{self.where(row)}: {problem}")

    def text(self, column: str) -> TextColumn:
        """A text column; blank where the file does not have it."""
        return self.text_columns.get(column, TextColumn(("",), np.zeros(len(self), dtype=np.int64)))

    def ids(self, column: str) -> TextColumn:
        """A text column whose every entry can be an id."""
        result = self.text(column)
        for code, name in enumerate(result.names):
            problem = id_problem(name)
            if problem and (result.codes == code).any():
                raise self.error(first_row(result.codes == code), f"{column}: {problem}")
        return result

    def unique_ids(self, column: str) -> tuple[str, ...]:
        """A text column whose entries are ids, each once."""
        result = self.ids(column)
        seen: dict[int, int] = {}
        for row, code in enumerate(result.codes.tolist()):
            if code in seen:
                name, line = result.names[code], self.lines[seen[code]]
                raise self.error(row, f"{column}: {name!r} stands already in line {line}; give each row its own id")
            seen[code] = row
        return tuple(result.values())

    def numbers(self, column: str) -> FloatArray:
        """A number column (n,); nan where blank or absent."""
        return self.number_columns.get(column, np.full(len(self), np.nan))

    def positive(self, column: str) -> FloatArray:
        """A number column (n,) whose entries, where not blank, must be positive."""
        values = self.numbers(column)
        bad = values <= 0
        if bad.any():
            row = first_row(bad)
            raise self.error(row, f"{column}: found {values[row]:g}; it must be positive")
        return values

    def flags(self, column: str) -> BoolArray:
        """A text column of true and false (1 and 0); true where blank or absent."""
        meanings = {"": True, "true": True, "1": True, "false": False, "0": False}
        result = self.text(column)
        for code, name in enumerate(result.names):
            if name.lower() not in meanings:
                raise self.error(first_row(result.codes == code), f"{column}: found {name!r}; write true or false")
        return np.array([meanings[name.lower()] for name in result.names], dtype=bool)[result.codes]


def group_names(table: Table, default: str) -> list[str]:
    """The group of every row. Raises SurveyError where a name would be taken for a formula."""
    return [name or default for name in checked_groups(table).values()]


def checked_groups(table: Table) -> TextColumn:
    """The column ``group``, blank where absent. Raises SurveyError where a name would be taken for a formula."""
    groups = table.text("group")
    for code, name in enumerate(groups.names):
        problem = formula_problem(name)
        if problem and (groups.codes == code).any():
            raise table.error(first_row(groups.codes == code), f"group: {name!r} cannot be a name; {problem}")
    return groups


def first_row(mask: npt.ArrayLike) -> int:
    """The first row that is true."""
    return int(np.argmax(mask))


def read_table(path: Path, layout: Layout) -> Table:
    """Read ``.csv`` or ``.parquet``; raises SurveyError with file and line for whatever does not fit the layout."""
    data, digest = read_bytes(path)
    if path.suffix == ".parquet":
        return _read_parquet(path, layout, data, digest)
    text = decode(path, data)
    if not text.strip():
        raise SurveyError(f"{path}:1: the file is empty; the first line names the columns: {','.join(layout.required)}")
    _check_rows(path, text.count("\n"))
    header, chunks = csv_chunks(path, text)
    check_header(path, header, layout)
    return _assemble(path, layout, digest, header, chunks)


def _check_rows(path: Path, n: int) -> None:
    if n > LARGEST_ROWS:
        raise SurveyError(f"{path}: found {n} rows, at most {LARGEST_ROWS} are read; split the survey into projects")


def _assemble(path: Path, layout: Layout, digest: str, header: Sequence[str], chunks: Iterable[Chunk]) -> Table:
    texts = {name: _TextBuilder() for name in header if layout.is_text(name)}
    numbers = {name: _NumberBuilder() for name in header if not layout.is_text(name)}
    builders: dict[str, _TextBuilder | _NumberBuilder] = {**texts, **numbers}
    all_lines = [np.zeros(0, np.int64)]
    for lines, columns in chunks:
        all_lines.append(lines)
        for name, column in zip(header, columns, strict=True):
            bad = builders[name].add(column, name in layout.required)
            if bad is not None:
                raise SurveyError(f"{path}:{lines[bad[0]]}: {name}: {bad[1]}")
    return Table(
        path,
        layout,
        digest,
        np.concatenate(all_lines),
        {name: builder.column() for name, builder in texts.items()},
        {name: builder.column() for name, builder in numbers.items()},
    )


def check_header(path: Path, header: Sequence[str], layout: Layout) -> None:
    """Raise where a column is unknown, missing or there twice."""
    if not set(header) & set(layout.columns):
        hint = "; columns are separated by commas" if any(c in "".join(header) for c in ";\t") else ""
        needed = ",".join(layout.required)
        raise SurveyError(f"{path}:1: the header is missing; the first line names the columns: {needed}{hint}")
    for i, name in enumerate(header):
        if name not in layout.columns:
            raise SurveyError(f"{path}:1: unknown column {name!r}; {suggestion(name, layout.columns)}")
        if name in header[:i]:
            raise SurveyError(f"{path}:1: the column {name!r} is there twice; remove one")
    for name in layout.required:
        if name not in header:
            raise SurveyError(f"{path}:1: the column {name!r} is missing; add it")


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


def _read_parquet(path: Path, layout: Layout, data: bytes, digest: str) -> Table:
    try:
        import pyarrow as pa
        import pyarrow.parquet as pq
    except ImportError as error:
        message = "Parquet needs pyarrow; install it with: pip install 'labsurvey[parquet]', or use CSV"
        raise SurveyError(f"{path}: {message}") from error
    try:
        file = pq.ParquetFile(pa.BufferReader(data))
        _check_rows(path, file.metadata.num_rows)
        sizes = (file.metadata.row_group(i).total_byte_size for i in range(file.metadata.num_row_groups))
        if sum(sizes) > _LARGEST_DECODED:
            raise SurveyError(f"{path}: its columns take more than {_LARGEST_DECODED >> 30} GB; split the survey")
        check_header(path, file.schema_arrow.names, layout)
        content = file.read()
        content.validate(full=True)
    except (pa.ArrowException, OSError, ValueError, MemoryError) as error:
        raise SurveyError(f"{path}:1: not a Parquet file ({error}); write it again") from error
    check_header(path, content.column_names, layout)
    texts: dict[str, TextColumn] = {}
    numbers: dict[str, FloatArray] = {}
    for name in content.column_names:
        array = content[name].combine_chunks()
        if layout.is_text(name):
            texts[name] = _parquet_text(path, name, array, name in layout.required)
        else:
            numbers[name] = _parquet_numbers(path, name, array, name in layout.required)
    return Table(path, layout, digest, np.arange(1, content.num_rows + 1), texts, numbers)


def _parquet_text(path: Path, name: str, array: Any, is_required: bool) -> TextColumn:
    import pyarrow as pa

    value_type = array.type.value_type if pa.types.is_dictionary(array.type) else array.type
    if not (pa.types.is_string(value_type) or pa.types.is_large_string(value_type)):
        raise SurveyError(f"{path}:1: {name}: the column holds {value_type}, expected text; write it as strings")
    column = array.cast(value_type).fill_null("").dictionary_encode()
    try:
        names = tuple(column.dictionary.to_pylist())
    except ValueError as error:
        raise SurveyError(f"{path}:1: {name}: a text is not UTF-8 ({error}); write it again") from error
    codes = np.asarray(column.indices.to_numpy(zero_copy_only=False), dtype=np.int64)
    if is_required and "" in names:
        raise SurveyError(f"{path}:{first_row(codes == names.index('')) + 1}: {name}: is blank; fill it in")
    return TextColumn(names, codes)


def _parquet_numbers(path: Path, name: str, array: Any, is_required: bool) -> FloatArray:
    import pyarrow as pa

    if not (pa.types.is_floating(array.type) or pa.types.is_integer(array.type)):
        raise SurveyError(f"{path}:1: {name}: the column holds {array.type}, expected numbers; write it as doubles")
    blank = np.asarray(array.is_null().to_numpy(zero_copy_only=False), dtype=bool)
    values = np.array(array.cast(pa.float64()).fill_null(0.0).to_numpy(zero_copy_only=False), dtype=float)
    bad = ~(np.abs(values) <= LARGEST_NUMBER) | (blank & is_required)
    if bad.any():
        row = first_row(bad)
        found = "is blank; fill it in" if blank[row] else f"found {values[row]}; it must be a finite number"
        raise SurveyError(f"{path}:{row + 1}: {name}: {found}")
    values[blank] = np.nan
    return values
