"""The line of a project that a cause is about: where its change would be made, else where the thing stands."""

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType

import numpy as np

from adjust.diagnosis.diagnosis import Diagnosis
from adjust.diagnosis.hypothesis import (
    ChangeColumns,
    ChangeReadings,
    Edit,
    Hypothesis,
    LeaveOut,
    Place,
    Rename,
    ScaleKey,
    SetKey,
    SetReadings,
)
from survey.folder.text import read_text
from survey.jobs.adjusting.edits import OF_IMAGE
from survey.project.declared.toml_text import key_lines
from survey.project.project import DEFINITION_FILE, OBSERVATIONS_FOLDER, Project
from survey.project.tables.files import read_table
from survey.project.tables.layouts import LAYOUTS
from survey.project.tables.reading import Table

Wanted = Mapping[str, Collection[str] | Callable[[str], bool]]
_BY_KIND = {
    "camera": (("image_points", "camera_id"), ("spots", "camera_id")), "target": (("image_points", "target_id"),),
    "epoch": (("image_points", "epoch_id"), ("table_angles", "epoch_id")), "pair": (("pairs", "pair_id"),),
    "table": (("table_angles", "table_id"),),
    "setup": (("terrestrial", "setup_id"), ("terrestrial", "from_id")),
    "point": (("terrestrial", "to_id"), ("image_points", "point_id")),
    "reading": (("terrestrial", "reading_id"), ("distances", "distance_id"), ("terrestrial", "kind"),
                ("levels", "level_id")),
    "group": (("image_points", "group"), ("pairs", "group"), ("terrestrial", "group"), ("terrestrial", "kind")),
}  # fmt: skip
"""Tables and columns that name a thing of a kind."""
_IN_TABLES = ("epoch", "to_id", "target_height_m", "value", "sigma", "u_px", "axis1_deg")
"""Keys of a place that are columns of tables; others are keys of ``survey.toml``."""
_WHOLE = {"reading": "terrestrial", "pair": "pairs", "setup": "terrestrial"}


def located(found: Diagnosis, project: Project) -> Diagnosis:
    """The diagnosis with the place in the project's files beside every candidate."""
    files = ProjectFiles(project.files or project.folder, project.origins)
    candidates = []
    for candidate in found.candidates:
        hypothesis = replace(candidate.hypothesis, edits=tuple(_of_spots(candidate.hypothesis.edits, files)))
        candidates.append(replace(candidate, hypothesis=hypothesis, where=files.of(hypothesis)))
    return replace(found, candidates=tuple(candidates))


def _of_spots(edits: Sequence[Edit], files: "ProjectFiles") -> Iterator[Edit]:
    """Changes of image points, in the table of spots too, or there alone: points of beacons may come from it."""
    for edit in edits:
        if not isinstance(edit, ChangeColumns) or (edit.table, edit.columns) != ("image_points", OF_IMAGE):
            yield edit
            continue
        where = {k: v for k, v in edit.where.items() if k != "target_id"}
        of_beacons = "" in edit.where.get("target_id", ("",))
        both = (edit, *([replace(edit, table="spots", where=where)] if of_beacons else []))
        yield from [e for e in both if files.rows(e.table, e.where)] or [edit]


class ProjectFiles:
    """The files of a project, each read when it is first asked for."""

    def __init__(self, folder: Path, origins: Mapping[str, Sequence[tuple[Path, int]]] = MappingProxyType({})) -> None:
        self.folder, self.origins = folder, origins
        self._tables: dict[str, Table | None] = {}

    @cached_property
    def text(self) -> str:
        """``survey.toml``."""
        return read_text(self.folder / DEFINITION_FILE)

    @cached_property
    def keys(self) -> dict[tuple[str | int, ...], int]:
        """Lines of its keys."""
        return key_lines(self.text)

    def table(self, name: str) -> Table | None:
        """A table, None where the project has none."""
        if name not in self._tables:
            paths = (self.folder / OBSERVATIONS_FOLDER / f"{name}.{ending}" for ending in ("csv", "parquet"))
            path = next((p for p in paths if p.is_file()), None)
            self._tables[name] = None if path is None else read_table(path, LAYOUTS[name])
        return self._tables[name]

    def of(self, hypothesis: Hypothesis) -> str:
        """``file:line`` of the first change, and how many rows it concerns; else of the thing that is wrong."""
        found = (self._edited(edit) for edit in hypothesis.edits)
        return next(filter(None, found), "") or self._of_place(hypothesis.place)

    def _edited(self, edit: Edit) -> str:
        if isinstance(edit, ScaleKey):
            from survey.project.declared.editing import LENGTHS  # here: few causes are mended by a key

            return self.key(*edit.path, LENGTHS) if edit.path[0] == "targets" else self.key(*edit.path)
        if isinstance(edit, SetKey):
            return self.key(*edit.path)
        if isinstance(edit, LeaveOut):
            return next(filter(None, (self.rows(table, wanted) for table, wanted in _left_out(edit.names))), "")
        if isinstance(edit, ChangeReadings | SetReadings):
            column = "reading_id" if edit.table == "terrestrial" else LAYOUTS[edit.table].ids[0]
            return self.rows(edit.table, {column: edit.ids}) or self._numbered(edit.ids)
        more: Wanted = {edit.column: tuple(edit.names)} if isinstance(edit, Rename) else {}
        return self.rows(edit.table, {**edit.where, **more})

    def key(self, *path: str | Collection[str]) -> str:
        """The line of a key, or of the nearest table above it; the last part of the path may be one of several."""
        if str(path[0]) not in self.text and "\\" not in self.text:
            return DEFINITION_FILE  # of thousands of stations the keys need not be told apart for that
        *above, last = path
        names = [last] if isinstance(last, str) else list(last)
        known = [p for name in names if (p := (*map(str, above), name)) in self.keys]
        place: tuple[str | int, ...] = known[0] if known else tuple(map(str, above))
        while place and place not in self.keys:
            place = place[:-1]
        return self._at(DEFINITION_FILE, self.keys[place]) if place else DEFINITION_FILE

    def _at(self, name: str, line: int) -> str:
        """``file:line``, of a merged project as its owner knows it."""
        of = self.origins.get(name, ())
        return f"{of[line - 1][0]}:{of[line - 1][1]}" if line <= len(of) else f"{name}:{line}"

    def rows(self, name: str, wanted: Wanted) -> str:
        """The first row of a table where every column has one of the values wanted, and how many there are."""
        table = self.table(name)
        if table is None or not len(table):
            return ""
        mask = np.ones(len(table), dtype=np.bool_)
        for column, values in wanted.items():
            if not table.has(column):
                return ""
            text = table.text(column)
            fits = values if callable(values) else frozenset(values).__contains__
            mask &= np.array([fits(n) for n in text.names], dtype=np.bool_)[text.codes]
        if not mask.any():
            return ""
        n, at = int(mask.sum()), self._at(f"{OBSERVATIONS_FOLDER}/{table.path.name}", int(table.lines[mask.argmax()]))
        return f"{at} and {n - 1} more rows" if n > 1 else at

    def _numbered(self, ids: Collection[str]) -> str:
        """The row of a reading that has no id of its own: r12 is that of the twelfth one."""
        table, number = self.table("terrestrial"), min(ids, key=lambda i: (len(i), i)).removeprefix("r")
        if table is None or not number.isdecimal() or not 0 < int(number) <= len(table):
            return ""
        more = f" and {len(ids) - 1} more rows" if len(ids) > 1 else ""
        return self._at(f"{OBSERVATIONS_FOLDER}/{table.path.name}", int(table.lines[int(number) - 1])) + more

    def _of_place(self, place: Place) -> str:
        in_table = place.key in _IN_TABLES or (place.key == "" and bool(place.epochs))
        rows = next(filter(None, self._rows_of(place)), "")
        section = "sigmas" if place.kind == "group" else f"{place.kind}s"
        if in_table and rows:
            return rows
        if place.kind == "group":
            return self.key(section, "scale", *place.ids[:1])
        declared = {str(path[1]) for path in self.keys if len(path) > 1 and path[0] == section}
        known = next((i for i in place.ids if i in declared), None)
        key = {"x_in_world": "x_mm", "x": "x_mm", "y": "x_mm", "z": "x_mm"}.get(place.key, place.key)
        return self.key(section, known, *([key] if key else [])) if known is not None else rows or DEFINITION_FILE

    def _rows_of(self, place: Place) -> Iterator[str]:
        """The rows that name a thing, table by table."""
        if place.kind == "station":  # a moving one is named with its epoch
            for column in ("b_id", "a_id"):
                yield self.rows("pairs", {column: lambda text: text.partition("@")[0].rpartition(":")[2] in place.ids})
        epochs = {"epoch_id": place.epochs} if place.epochs else {}
        for table, column in _BY_KIND.get(place.kind, ()):
            yield self.rows(table, {column: place.ids} | (epochs if column != "epoch_id" else {}))
        if place.kind in _WHOLE:
            yield self.rows(_WHOLE[place.kind], {})


def _left_out(names: Collection[str]) -> Iterator[tuple[str, Wanted]]:
    """Tables, and rows of them, that names of exclusions stand for; all of the kind of the first one."""
    what = next(iter(names)).partition(":")[0]
    ids = [name.partition(":")[2] for name in names if name.startswith(f"{what}:")]
    parts = [tuple(one.split("/")) for one in ids]
    columns = {"image": ("camera_id", "epoch_id"), "target": ("camera_id", "epoch_id", "target_id"),
               "image_point": ("camera_id", "epoch_id", "target_id", "point_id")}.get(what)  # fmt: skip
    if columns is not None:
        n = len(parts[0])
        used = columns[-1:] if what == "target" and n == 1 else columns[:n]
        yield "image_points", {c: {p[i] for p in parts} for i, c in enumerate(used)}
    elif what in LAYOUTS:
        yield what, {LAYOUTS[what].ids[0]: ids}
    else:
        yield from ((table, {column: ids}) for table, column in _BY_KIND.get(what, ()))
