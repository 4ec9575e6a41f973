"""Tables of image points and spots as rows of text: what stays in them stays to the letter."""

import hashlib
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from survey.folder.text import csv_rows, csv_text, read_text
from survey.project.detected import ImageKey
from survey.project.tables.files import cells_of, read_table
from survey.project.tables.reading import Columns, Layout

_FALSE = ("false", "0")


@dataclass(frozen=True, eq=False)
class RowTable:
    """Rows of a table. header: its columns in their order; rows: their cells."""

    layout: Layout
    header: tuple[str, ...]
    rows: tuple[Sequence[object], ...] = ()

    def _column(self, name: str) -> list[str]:
        i = self.header.index(name) if name in self.header else -1
        return [str(row[i]) for row in self.rows] if i >= 0 else [""] * len(self.rows)

    @cached_property
    def _keys(self) -> list[tuple[ImageKey, str]]:
        """Image and target of every row."""
        columns = (self._column(name) for name in ("camera_id", "epoch_id", "target_id"))
        return [((camera, epoch), target) for camera, epoch, target in zip(*columns, strict=True)]

    @cached_property
    def images(self) -> Counter[ImageKey]:
        """Number of rows of each image."""
        return Counter(key for key, _ in self._keys)

    @cached_property
    def _by_image(self) -> dict[ImageKey, list[int]]:
        found: dict[ImageKey, list[int]] = {}
        for row, (key, _) in enumerate(self._keys):
            found.setdefault(key, []).append(row)
        return found

    def digest(self, key: ImageKey) -> str:
        """A hash of what detection writes of an image: points and numbers, not ``group`` and ``used``; "" for none."""
        rows = self._by_image.get(key, [])
        if not rows:
            return ""
        places = [self.header.index(name) if name in self.header else -1 for name in self.layout.columns
                  if name not in ("group", "used")]  # fmt: skip
        numbers = [not self.layout.is_text(n) for n in self.layout.columns if n not in ("group", "used")]
        said = sorted(
            repr([_canonical("" if i < 0 else self.rows[row][i], number)
                  for i, number in zip(places, numbers, strict=True)]) for row in rows
        )  # fmt: skip
        return hashlib.sha256("\n".join(said).encode()).hexdigest()

    def taken(self, wanted: Callable[[ImageKey, str], bool]) -> "RowTable":
        """The rows of some images and targets."""
        return replace(self, rows=tuple(r for r, (k, t) in zip(self.rows, self._keys, strict=True) if wanted(k, t)))

    def without(self, gone: "RowTable") -> "RowTable":
        """The rows that are not among those of ``gone``, which come from this table."""
        ids = {id(row) for row in gone.rows}
        return replace(self, rows=tuple(row for row in self.rows if id(row) not in ids))

    def with_rows(self, more: "RowTable") -> "RowTable":
        """With the rows of another table behind its own; that one's header where this one has no rows."""
        if not self.rows:
            return more
        header = (*self.header, *(name for name in more.header if name not in self.header))
        return replace(self, header=header, rows=(*_in_order(self, header), *_in_order(more, header)))

    def with_cells_of(self, other: "RowTable", column: str) -> "RowTable":
        """With the cells of a column that ``other`` has for the same points."""
        said = {key: cell for key, cell in zip(other.points(), other._column(column), strict=True) if cell}
        cells = [said.get(key, "") for key in self.points()]
        if not any(cells):
            return self
        old = [name for name in self.header if name != column]
        rows = _in_order(self, old)
        return replace(self, header=(*old, column), rows=tuple((*r, c) for r, c in zip(rows, cells, strict=True)))

    def points(self) -> list[tuple[str, ...]]:
        """Camera, epoch, target and point of every row."""
        point = "point_id" if "point_id" in self.layout.ids else "spot_id"
        return list(zip(*(self._column(n) for n in ("camera_id", "epoch_id", "target_id", point)), strict=True))

    def marked_unused(self) -> list[tuple[str, ...]]:
        """Points of the rows that are marked ``used = false``."""
        marks = self._column("used")
        return [key for key, used in zip(self.points(), marks, strict=True) if used.strip().lower() in _FALSE]

    def text(self) -> str:
        """The table as CSV."""
        return csv_text([self.header, *self.rows])


def _in_order(table: RowTable, header: Sequence[str]) -> list[Sequence[object]]:
    if tuple(header) == table.header:
        return list(table.rows)
    at = {name: i for i, name in enumerate(table.header)}
    order = [at.get(name) for name in header]
    return [["" if i is None else row[i] for i in order] for row in table.rows]


def _canonical(cell: object, number: bool) -> str:
    """A cell in one form, however a program writes its numbers."""
    text = "" if cell is None else str(cell).strip()
    if not number or not text:
        return text
    try:
        return repr(float(text))
    except ValueError:
        return text


def read_rows(folder: Path, layout: Layout) -> RowTable:
    """The rows of a table in a folder, none where it is not there. Raises SurveyError."""
    csv_path, parquet = (folder / f"{layout.name}.{ending}" for ending in ("csv", "parquet"))
    if csv_path.is_file():
        read_table(csv_path, layout)  # its faults, with their lines
        header, *rows = (cells for _, cells in csv_rows(csv_path, read_text(csv_path)))
        return RowTable(layout, tuple(header), tuple(rows))
    if parquet.is_file():
        table = read_table(parquet, layout)
        columns: Columns = {**table.text_columns, **table.number_columns}
        return rows_of(layout, {name: columns[name] for name in layout.columns if name in columns})
    return RowTable(layout, layout.columns)


def rows_of(layout: Layout, columns: Columns) -> RowTable:
    """The rows of ready columns."""
    return RowTable(layout, tuple(columns), tuple(zip(*map(cells_of, columns.values()), strict=True)))
