"""Tables of observations: which columns they have, and columns with the line of every row.

Text columns become codes into their different names, so that nothing later runs per row. A quantity may stand in one
of several columns, each with its unit; angles also as text.
"""

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.model.arrays import BoolArray, FloatArray, IntArray
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.text import formula_problem, id_problem, suggestion
from survey.folder.units import to_si

LARGEST_ROWS = 50_000_000  # of one table: ten times what the largest surveys have
FLAGS = ("group", "used")  # optional text columns of every table of observations
ANGLE_UNITS = ("deg", "gon", "arcsec", "mgon", "cc")
_DMS = re.compile(r"([+-]?)(\d+)-(\d+)-(\d+(?:\.\d*)?)")


@frozen
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


@frozen(eq=False)
class TextColumn:
    """``names`` are the different texts in order of appearance, ``codes`` (n,) the positions in them."""

    names: tuple[str, ...]
    codes: IntArray

    def values(self) -> list[str]:
        """The text of every row."""
        return [self.names[code] for code in self.codes.tolist()]

    def __len__(self) -> int:
        return len(self.codes)


Columns = Mapping[str, Sequence[str] | TextColumn | FloatArray]


@frozen(eq=False)
class Table:
    """A table that was read: ``lines`` (n,) where its rows stand, and its columns. Blank numbers are nan.

    beside: the table of the covariances between its rows.
    """

    path: Path
    layout: Layout
    digest: str
    lines: IntArray
    text_columns: dict[str, TextColumn]
    number_columns: dict[str, FloatArray]
    beside: "Table | None" = None

    def __len__(self) -> int:
        return len(self.lines)

    def part(self, rows: slice) -> "Table":
        """These of its rows, nothing copied."""
        texts = {name: TextColumn(c.names, c.codes[rows]) for name, c in self.text_columns.items()}
        numbers = {name: c[rows] for name, c in self.number_columns.items()}
        return Table(self.path, self.layout, self.digest, self.lines[rows], texts, numbers, self.beside)

    def has(self, column: str) -> bool:
        """Whether the file has the column."""
        return column in self.text_columns or column in self.number_columns

    def where(self, row: int) -> str:
        """``file:line`` of a row."""
        return f"{self.path}:{self.lines[row] if len(self.lines) else 1}"

    def error(self, row: int, problem: str) -> SurveyError:
        """An error at a row."""
        return SurveyError(f"{self.where(row)}: {problem}")

    def fail(self, row: int, column: str) -> Callable[[str], SurveyError]:
        """What makes an error of a problem with a column of a row."""
        return lambda problem: self.error(row, f"{column}: {problem}")

    def require(self, row: int, column: str, what: str, name: str, known: Collection[str]) -> None:
        """Raise where a name in a column is none of those that are known."""
        if name not in known:
            raise self.error(row, f"{column}: unknown {what} {name!r}; {suggestion(name, known)}")

    def text(self, column: str) -> TextColumn:
        """A text column; blank where the file does not have it."""
        found = self.text_columns.get(column)
        return TextColumn(("",), np.zeros(len(self), dtype=np.int64)) if found is None else found

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
        found = self.number_columns.get(column)
        return np.full(len(self), np.nan) if found is None else found

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


def marks(table: Table, kind: str, scale: Mapping[str, float]) -> tuple[list[str], list[bool], FloatArray]:
    """Of every row the group, by default its kind, whether it is used, and the factor (n,) of its group's sigmas."""
    groups = [name or kind for name in checked_groups(table).values()]
    return groups, table.flags("used").tolist(), np.array([scale.get(group, 1.0) for group in groups], dtype=float)


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


def check_rows(path: Path, n: int) -> None:
    """Raise where a table has more rows than are read."""
    if n > LARGEST_ROWS:
        raise SurveyError(f"{path}: found {n} rows, at most {LARGEST_ROWS} are read; split the survey into projects")


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


def quantity(table: Table, name: str, units: Sequence[str], positive: bool = False) -> FloatArray:
    """Values (n,) in SI from whichever column ``name_unit`` gives them, nan where none does; raises where two do."""
    read = table.positive if positive else table.numbers
    return one_of(table, {f"{name}_{unit}": to_si(read(f"{name}_{unit}"), unit) for unit in units}, name)


def both_or_each(table: Table, both: str, each: Sequence[str]) -> FloatArray:
    """Positive numbers (n, k) from the columns ``each`` or, for all of them, from ``both``; raises where two say it."""
    own = np.stack([table.positive(name) for name in each], axis=1)
    return one_of(table, {both: np.broadcast_to(table.positive(both)[:, None], own.shape), each[0]: own}, "sigma")


def dms_angles(table: Table, column: str) -> FloatArray:
    """Angles (n,) rad written as degrees-minutes-seconds, ``12-34-56.7``; nan where blank."""
    text = table.text(column)
    values = np.full(len(text.names), np.nan)
    for code, name in enumerate(text.names):
        if not name:
            continue
        found = _DMS.fullmatch(name)
        rows = text.codes == code
        if found is None:
            example = "write degrees-minutes-seconds, as 12-34-56.7"
            raise table.error(first_row(rows), f"{column}: found {name!r}; {example}")
        sign, degrees, minutes, seconds = found.groups()
        if int(minutes) > 60 or float(seconds) > 60:  # 60 is what rounding makes of 59.99
            raise table.error(first_row(rows), f"{column}: found {name!r}; minutes and seconds go up to 60")
        arcseconds = int(degrees) * 3600 + int(minutes) * 60 + float(seconds)
        values[code] = to_si(-arcseconds if sign == "-" else arcseconds, "arcsec")
    return np.asarray(values[text.codes])


def one_of(table: Table, parts: Mapping[str, FloatArray], what: str = "value") -> FloatArray:
    """What of each row the one of ``parts`` says, (n,) or (n, k), that has anything; raises where two have."""
    out = np.full(next(iter(parts.values())).shape, np.nan)
    for name, values in parts.items():
        given, before = (~np.isnan(x).all(axis=tuple(range(1, x.ndim))) for x in (values, out))
        if (given & before).any():
            problem = f"{name}: the {what} is given twice; keep one of {', '.join(parts)}"
            raise table.error(first_row(given & before), problem)
        out = np.where(np.isnan(values), out, values)
    return out


def needed(table: Table, values: FloatArray, rows: BoolArray, advice: str) -> None:
    """Raise at the first of ``rows`` without a value."""
    missing = rows & np.isnan(values)
    if missing.any():
        raise table.error(first_row(missing), advice)


def group_columns(items: Sequence[Any], usual: str = "", used: bool = True) -> dict[str, list[str]]:
    """``group`` and ``used`` of one item a row where they are not as usual: readings have groups by their kind.

    used: whether the table tells it.
    """
    columns = {}
    if any(x.group != (usual or x.kind) for x in items):
        columns["group"] = [x.group for x in items]
    if used and not all(x.used for x in items):
        columns["used"] = ["true" if x.used else "false" for x in items]
    return columns


def filled(columns: Mapping[str, Sequence[str] | FloatArray]) -> dict[str, Sequence[str] | FloatArray]:
    """Without the columns that are blank throughout."""
    return {
        name: column
        for name, column in columns.items()
        if not (np.isnan(column).all() if isinstance(column, np.ndarray) else not any(column))
    }
