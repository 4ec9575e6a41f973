"""The job ``remove``: observations are marked as not used, and the project is adjusted again, all or nothing.

>>> outcome = remove_job(Path("lab"), ["p3", "distances:tape 1"])
>>> print(outcome.text())

Nothing is deleted: the rows get ``used = false`` and are predicted and tested from then on.
"""

import csv
import io
import shutil
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from adjust.errors import IndeterminateError, SurveyError
from survey.files import Project, read
from survey.files.project import DEFINITION_FILE, OBSERVATIONS_FOLDER
from survey.files.reading import LAYOUTS
from survey.files.tables import read_table
from survey.files.text import atomic_write, suggestion
from survey.jobs import AdjustOutcome, Clock, adjust_project, made
from survey.merging import point_files, table_rows
from survey.previous import Move, Previous, moves, read_previous
from survey.replacing import complete, copy_folder, place_for, replace_parts
from survey.results import RESULTS

_ID_COLUMNS = {
    "pairs": "pair_id", "distances": "distance_id", "coordinates": "point_id", "terrestrial": "reading_id",
    "levels": "level_id", "alignments": "alignment_id", "laser_spots": "spot_id",
    "coordinate_differences": "difference_id",
}  # fmt: skip
_WITH_SETS = ("coordinates", "coordinate_differences")
_MOST_MOVES, _MOST_SHOWN = 200, 8


@dataclass(frozen=True, eq=False)
class RemoveOutcome:
    """An adjustment without some observations. removed: their ids by table.

    before: None where there was no valid adjustment to compare with; ``why`` says why.
    """

    outcome: AdjustOutcome
    removed: dict[str, tuple[str, ...]]
    moved: tuple[Move, ...]
    before: Previous | None
    why: str
    seconds: float

    def summary(self) -> dict[str, Any]:
        """As plain values."""
        before = {} if self.before is None else self.before.summary
        after = self.outcome.solution["summary"]
        return {
            **self.outcome.summary(),
            "removed": {table: list(ids) for table, ids in self.removed.items()},
            "redundancy_before": before.get("redundancy"),
            "redundancy_after": after["redundancy"],
            "sigma0_before": before.get("sigma0"),
            "sigma0_after": after["sigma0"],
            "not_compared_because": self.why or None,
            "n_moved_over_one_sigma": sum(m.sigmas > 1.0 for m in self.moved),
            "moved": [
                {"name": m.name, "moved_mm": m.mm, "moved_arcsec": m.arcsec, "moved_sigmas": m.sigmas}
                for m in self.moved[:_MOST_MOVES]
            ],
            "seconds": self.seconds,
        }

    def text(self) -> str:
        """For people."""
        lines = ["removed: " + "; ".join(f"{table} {', '.join(ids)}" for table, ids in self.removed.items())]
        tables = " and ".join(f"{OBSERVATIONS_FOLDER}/{table}.csv" for table in self.removed)
        lines.append(f"to take them back, write used = true in {tables} and adjust again")
        after = self.outcome.solution["summary"]
        if self.before is None:
            lines.append(f"nothing to compare with: {self.why}")
        else:
            was = self.before.summary
            lines.append(
                f"redundancy {was['redundancy']} -> {after['redundancy']}, sigma0 {_sigma0(was)} -> {_sigma0(after)}"
            )
            far = [m for m in self.moved if m.sigmas > 1.0]
            lines.append(
                f"{len(far)} of {len(self.moved)} stations and points moved by more than one of their sigmas"
                + ("" if far or not self.moved else "; the most")
            )
            for m in (far or self.moved)[:_MOST_SHOWN]:
                lines.append(f"  {m.name:<20}{m.mm:>10.3f} mm{m.arcsec:>9.1f} arcsec{m.sigmas:>8.2f} sigmas")
        return "\n".join([*lines, "", self.outcome.text()])


def _sigma0(summary: Mapping[str, Any]) -> str:
    return "-" if summary["sigma0"] is None else f"{summary['sigma0']:.3f}"


def remove_job(
    folder: Path, ids: Sequence[str], out: Path | None = None, progress: bool = True
) -> RemoveOutcome:  # fmt: skip
    """Adjust a project, or a copy of it at ``out``, without some observations.

    ids: of pairs, distances, points or sets of coordinates; ``pairs:ID`` and the like where two tables share an id.
    Raises SurveyError for an id that is unknown and where the rest does not determine everything; the project is as
    before whatever goes wrong.
    """
    begin, folder = time.perf_counter(), Path(folder)
    with place_for(folder, out) as place:
        project = read(folder)
        before, why = _previous(project)
        tables = _tables(folder)
        chosen = _chosen(folder, tables, ids)
        _copy(folder, place)
        for name, rows in chosen.items():
            _write(tables[name], rows, place)
        reduced = replace(read(place), folder=out or folder, title=project.title)
        try:
            adjustment = adjust_project(reduced, progress)
        except SurveyError as error:
            said = f"{folder}: cannot do without {', '.join(dict.fromkeys(ids))}, nothing was changed: {error}"
            if isinstance(error, IndeterminateError):
                raise IndeterminateError(said, error.parameters) from error
            raise type(error)(said) from error
        outcome = made(reduced, adjustment, place, Clock({"adjust": time.perf_counter() - begin}))
        if out is None:
            replace_parts(folder, [*(f"{OBSERVATIONS_FOLDER}/{name}.csv" for name in chosen), RESULTS])
        else:
            complete(folder, place)
    outcome = outcome.at(out or folder)
    moved = () if before is None else moves(before, adjustment, project.options.sigmas)
    removed = {name: tables[name].named(rows) for name, rows in chosen.items()}
    return RemoveOutcome(outcome, removed, moved, before, why, time.perf_counter() - begin)


def _previous(project: Project) -> tuple[Previous | None, str]:
    """The last solution, or why there is none to compare with."""
    try:
        return read_previous(project), ""
    except SurveyError as error:
        return None, str(error)


@dataclass(frozen=True, eq=False)
class _Table:
    """A table as text, so that writing it back changes nothing but ``used``; used and sets by row."""

    name: str
    path: Path
    header: list[str]
    rows: list[list[str]]
    ids: tuple[str, ...]
    sets: tuple[str, ...]
    used: tuple[bool, ...]
    by_id: dict[str, list[int]] = field(default_factory=dict)

    def named(self, rows: Sequence[int]) -> tuple[str, ...]:
        """Ids of rows, sets by their own."""
        return tuple(dict.fromkeys(self.sets[row] or self.ids[row] for row in rows))


def _tables(folder: Path) -> dict[str, _Table]:
    out = {}
    for name, column in _ID_COLUMNS.items():
        path = next((p for ending in ("csv", "parquet")
                     if (p := folder / OBSERVATIONS_FOLDER / f"{name}.{ending}").is_file()), None)  # fmt: skip
        if path is None:
            continue
        table = read_table(path, LAYOUTS[name])
        # readings without an id are called by their row, as everywhere
        ids = tuple(one or f"r{row}" for row, one in enumerate(table.text(column).values(), 1))
        sets = tuple(table.text("set_id").values()) if name in _WITH_SETS else ("",) * len(ids)
        header, rows = ([], []) if path.suffix == ".parquet" else table_rows(path)
        used = tuple(bool(x) for x in table.flags("used"))
        found = _Table(name, path, header, [row for _, row in rows], ids, sets, used)
        for row, (one, group) in enumerate(zip(ids, sets, strict=True)):
            for key in {one, group} - {""}:
                found.by_id.setdefault(key, []).append(row)
        out[name] = found
    return out


def _chosen(folder: Path, tables: Mapping[str, _Table], ids: Sequence[str]) -> dict[str, list[int]]:
    """Rows to be marked, by table."""
    if not ids:
        raise SurveyError(f"{folder}: no id of an observation is given; name what is to be removed")
    out: dict[str, list[int]] = {}
    for text in dict.fromkeys(ids):
        prefix, _, name = text.partition(":")
        if prefix not in _ID_COLUMNS:  # coordinates may be those of a frame, with a colon of their own
            prefix, name = "", text
        holders = [t for t in tables.values() if name in t.by_id and prefix in ("", t.name)]
        if not holders:
            known = [key for t in tables.values() if prefix in ("", t.name) for key in t.by_id]
            raise SurveyError(
                f"{folder / OBSERVATIONS_FOLDER}: no observation of these tables has the id "
                f"{name!r}; {suggestion(name, known)}"
            )
        if len(holders) > 1:
            raise SurveyError(
                f"{name!r} stands in {' and '.join(t.name for t in holders)}; say {holders[0].name}:{name} or so"
            )
        rows = _rows_of(holders[0], name)
        out.setdefault(holders[0].name, []).extend(rows)
    return {name: sorted(set(rows)) for name, rows in out.items()}


def _rows_of(table: _Table, name: str) -> list[int]:
    """The rows of one observation. Raises where that is only a part of one, several, or not used already."""
    rows = table.by_id[name]
    if table.path.suffix == ".parquet":
        raise SurveyError(f"{table.path}: Parquet tables cannot be changed; write the table as CSV")
    of_set = {table.sets[row] for row in rows}
    if of_set not in ({""}, {name}):
        named = ", ".join(sorted(s or f"{name} by itself" for s in of_set))
        raise SurveyError(f"{table.path}: the coordinates of {name!r} belong to {named}; remove the set by its id")
    if not any(table.used[row] for row in rows):
        raise SurveyError(f"{table.path}: {name!r} is not used already; leave it out")
    return rows


def _copy(folder: Path, place: Path) -> None:
    """All that is read of a project, except images, which no adjustment reads."""
    if (folder / OBSERVATIONS_FOLDER).is_dir():
        copy_folder(folder / OBSERVATIONS_FOLDER, place / OBSERVATIONS_FOLDER)
    for name in (DEFINITION_FILE, *point_files(folder)):
        (place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(folder / name, place / name)


def _write(table: _Table, rows: Sequence[int], place: Path) -> None:
    header = table.header if "used" in table.header else [*table.header, "used"]
    column = header.index("used")
    changed = set(rows)
    stream = io.StringIO(newline="")
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow(header)
    for i, row in enumerate(table.rows):
        cells = row + [""] * (len(header) - len(row))
        if i in changed:
            cells[column] = "false"
        writer.writerow(cells)
    atomic_write(place / OBSERVATIONS_FOLDER / table.path.name, stream.getvalue())
