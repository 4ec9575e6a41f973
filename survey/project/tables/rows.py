"""Tables of image points and spots as rows of text: what stays in them stays to the letter."""

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path

from adjust.model.frozen import frozen
from survey.folder.text import csv_rows, csv_text, read_text
from survey.project.detected import ImageKey
from survey.project.tables.files import cells_of, read_table
from survey.project.tables.reading import FLAGS, Columns, Layout

_FALSE = ("false", "0")


@frozen(eq=False)
class RowTable:
    """Rows of a table. header: its columns in their order; rows: their cells by column."""

    layout: Layout
    header: tuple[str, ...]
    rows: tuple[Mapping[str, object], ...] = ()

    @cached_property
    def _keys(self) -> list[tuple[ImageKey, str]]:
        """Image and target of every row."""
        return [((camera, epoch), target) for camera, epoch, target, _ in self.points()]

    @cached_property
    def images(self) -> Counter[ImageKey]:
        """Number of rows of each image."""
        return Counter(key for key, _ in self._keys)

    @cached_property
    def _by_image(self) -> dict[ImageKey, list[Mapping[str, object]]]:
        found: dict[ImageKey, list[Mapping[str, object]]] = {}
        for row, (key, _) in zip(self.rows, self._keys, strict=True):
            found.setdefault(key, []).append(row)
        return found

    def digest(self, key: ImageKey) -> str:
        """A hash of what detection writes of an image: points and numbers, not ``group`` and ``used``; "" for none."""
        rows = self._by_image.get(key, [])
        if not rows:
            return ""
        names = [(n, not self.layout.is_text(n)) for n in self.layout.columns if n not in FLAGS]
        said = sorted(repr([_canonical(row.get(name, ""), number) for name, number in names]) for row in rows)
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
        return replace(self, header=tuple(dict.fromkeys((*self.header, *more.header))), rows=(*self.rows, *more.rows))

    def with_cells_of(self, other: "RowTable", column: str) -> "RowTable":
        """With the cells of a column that ``other`` has for the same points."""
        said = {key: cell for key, row in zip(other.points(), other.rows, strict=True) if (cell := row.get(column))}
        rows = tuple({**row, column: said.get(key, "")} for key, row in zip(self.points(), self.rows, strict=True))
        header = (*(name for name in self.header if name != column), column)
        return replace(self, header=header, rows=rows) if any(row[column] for row in rows) else self

    def points(self) -> list[tuple[str, str, str, str]]:
        """Camera, epoch, target and point of every row."""
        point = "point_id" if "point_id" in self.layout.ids else "spot_id"
        return [(str(r["camera_id"]), str(r["epoch_id"]), str(r.get("target_id", "")), str(r[point]))
                for r in self.rows]  # fmt: skip

    def marked_unused(self) -> list[tuple[str, str, str, str]]:
        """Points of the rows that are marked ``used = false``."""
        return [key for key, row in zip(self.points(), self.rows, strict=True)
                if str(row.get("used", "")).strip().lower() in _FALSE]  # fmt: skip

    def text(self) -> str:
        """The table as CSV."""
        return csv_text([self.header, *([row.get(name, "") for name in self.header] for row in self.rows)])


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
        return RowTable(layout, tuple(header), tuple(dict(zip(header, cells, strict=True)) for cells in rows))
    if parquet.is_file():
        table = read_table(parquet, layout)
        columns: Columns = {**table.text_columns, **table.number_columns}
        return rows_of(layout, {name: columns[name] for name in layout.columns if name in columns})
    return RowTable(layout, layout.columns)


def rows_of(layout: Layout, columns: Columns) -> RowTable:
    """The rows of ready columns."""
    rows = zip(*map(cells_of, columns.values()), strict=True)
    return RowTable(layout, tuple(columns), tuple(dict(zip(columns, cells, strict=True)) for cells in rows))
