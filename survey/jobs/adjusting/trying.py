"""A candidate of a diagnosis carried out on the project folder, so that it can be taken back."""

import csv
import io
import re
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import numpy as np

from adjust.diagnosis.hypothesis import ChangeColumns, Edit, Hypothesis, LeaveOut, Rename, ScaleKey, SetKey
from adjust.model.errors import DiagnosedError, SurveyError
from survey.folder.replacing import changing, replace_parts
from survey.folder.text import atomic_write, decode, read_bytes
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.excluding import exclude_job
from survey.project import read
from survey.project.declared.toml_text import key_lines

DEFINITION, KEPT = "survey.toml", "kept"
FileEdit = ScaleKey | SetKey | ChangeColumns | Rename
_LENGTHS = ("square_mm", "marker_mm", "gap_mm")
_NUMBER = re.compile(r"(=\s*)([-+0-9.eE_]+)")


def try_job(folder: Path, number: int, progress: bool = False) -> str:
    """Adjust, and carry out candidate ``number`` (from 1) of the diagnosis. What was done, for people.

    Files that are changed are kept as they were below ``kept/``; what is left out becomes rows of ``exclusions.csv``.
    Raises SurveyError where there is no such candidate, or where only a person can do it.
    """
    chosen = chosen_of(folder, _candidates(folder, progress), number)
    done = [_carried_out(folder, edit, chosen) for edit in chosen.edits]
    return "\n".join([f"changed: {chosen.cause}", *(f"  {line}" for line in done)])


def chosen_of(folder: Path, candidates: Sequence[Hypothesis], number: int) -> Hypothesis:
    """Candidate ``number`` (from 1), which a program can carry out; raises SurveyError for others."""
    if not 1 <= number <= len(candidates):
        n = len(candidates)
        found = f"{n} candidate{'s' if n > 1 else ''}" if n else "no cause that it could change"
        raise SurveyError(f"{folder}: --try {number}: the diagnosis names {found}; see labsurvey adjust {folder.name}")
    chosen = candidates[number - 1]
    if not chosen.edits:
        raise SurveyError(f"{folder}: --try {number}: only you can do that: {chosen.change}")
    return chosen


def _candidates(folder: Path, progress: bool) -> list[Hypothesis]:
    try:
        diagnosis = adjust_project(read(folder), progress).diagnosis
    except DiagnosedError as error:
        diagnosis = error.diagnosis
    return [] if diagnosis is None else [c.hypothesis for c in diagnosis.candidates]


def _carried_out(folder: Path, edit: Edit, chosen: Hypothesis) -> str:
    if isinstance(edit, LeaveOut):
        exclude_job(folder, edit.names, reason_of(chosen))
        rows = f"{len(edit.names)} row{'s' if len(edit.names) > 1 else ''}"
        return f"observations/exclusions.csv: {rows} added; labsurvey include takes them back"
    name, before, text = edited(folder, edit, chosen)
    kept = kept_name(folder, name)
    with changing(folder, inputs=True) as place:
        for path, content in ((kept, before), (name, text)):
            (place / path).parent.mkdir(parents=True, exist_ok=True)
            atomic_write(place / path, content)
        replace_parts(folder)
    return f"{name}: changed; as it was: {kept}"


def reason_of(chosen: Hypothesis) -> str:
    """Why something is left out that a candidate leaves out, for ``exclusions.csv``."""
    return f"tried: {chosen.cause}"


def edited(
    folder: Path, edit: FileEdit, chosen: Hypothesis, texts: Mapping[str, str] = MappingProxyType({})
) -> tuple[str, str, str]:
    """The file that an edit changes, by its path in the folder, and its text before and after; nothing is written.

    texts: of files that are to be read instead. Raises SurveyError.
    """
    name = DEFINITION if isinstance(edit, ScaleKey | SetKey) else f"observations/{edit.table}.csv"
    path = folder / name
    if not path.exists():
        raise SurveyError(f"{path}: this project has no such table; {chosen.change}")
    before = texts[name] if name in texts else decode(path, read_bytes(path)[0])
    return name, before, _definition(path, before, edit) if isinstance(edit, ScaleKey | SetKey) else _table(
        path, before, edit, chosen)  # fmt: skip


def kept_name(folder: Path, name: str) -> str:
    """A name below ``kept/`` that nothing has yet."""
    path = Path(name)
    number = 1
    while (folder / KEPT / f"{path.stem}-{number}{path.suffix}").exists():
        number += 1
    return f"{KEPT}/{path.stem}-{number}{path.suffix}"


def _definition(path: Path, text: str, edit: ScaleKey | SetKey) -> str:
    """``survey.toml`` with the change, its comments and order kept."""
    where, lines = key_lines(text), text.splitlines(keepends=True)
    if isinstance(edit, ScaleKey):
        keys = [(*edit.path, key) for key in _LENGTHS if (*edit.path, key) in where] or [edit.path]
        for key in keys:
            if key not in where:
                raise SurveyError(f"{path}: no length of {'.'.join(edit.path)} stands there; its points are in a file: "
                                  f"multiply them by {edit.factor:.9g}")  # fmt: skip
            lines[where[key] - 1] = _scaled(lines[where[key] - 1], str(key[-1]), edit.factor)
    elif edit.path in where:
        raise SurveyError(f"{path}:{where[edit.path]}: {edit.path[-1]} is given; set it to {_toml(edit.value)}")
    else:
        # below the header of the innermost table that has one: a dotted key above it would begin that table twice
        headed = [k for k in range(2, len(edit.path)) if edit.path[:k] in where
                  and lines[where[edit.path[:k]] - 1].lstrip().startswith("[")]  # fmt: skip
        if not headed:
            raise SurveyError(f"{path}: [{'.'.join(edit.path[:-1])}] is not there; set {'.'.join(edit.path)} yourself")
        new = f"{'.'.join(edit.path[headed[-1]:])} = {_toml(edit.value)}\n"
        lines.insert(where[edit.path[: headed[-1]]], new)
    changed = "".join(lines)
    try:
        tomllib.loads(changed)
    except tomllib.TOMLDecodeError as error:  # what the key belongs to stands there as a value, { ... } in one line
        raise SurveyError(f"{path}: {'.'.join(edit.path)} has no place of its own there; set it yourself") from error
    return changed


def _scaled(line: str, key: str, factor: float) -> str:
    at = re.search(rf"\b{re.escape(key)}\b", line)
    begin = at.start() if at else 0
    return line[:begin] + _NUMBER.sub(lambda m: f"{m[1]}{float(m[2]) * factor:.9g}", line[begin:], count=1)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, tuple):
        return f"[{', '.join(_toml(v) for v in value)}]"
    return f'"{value}"' if isinstance(value, str) else repr(value)


def _table(path: Path, text: str, edit: ChangeColumns | Rename, chosen: Hypothesis) -> str:
    """A table with its rows changed; lines that are not concerned stay as they are."""
    lines = text.splitlines(keepends=True)
    begin = next((i for i, line in enumerate(lines) if line.strip() and not line.startswith("#")), len(lines))
    header = next(csv.reader([lines[begin]]), []) if begin < len(lines) else []
    names = [name.strip() for name in header]
    wanted = edit.columns if isinstance(edit, ChangeColumns) else (edit.column,)
    if missing := [name for name in wanted if name not in names]:
        raise SurveyError(f"{path}:{begin + 1}: the column {missing[0]!r} is missing; {chosen.change}")
    for i in range(begin + 1, len(lines)):
        if not lines[i].strip() or lines[i].startswith("#"):
            continue
        cells = next(csv.reader([lines[i]]))
        row = dict(zip(names, cells, strict=False))
        if all(row.get(column) in values for column, values in edit.where.items()):
            lines[i] = _row([(_changed(row, edit)).get(name, row.get(name, "")) for name in names])
    return "".join(lines)


def _changed(row: Mapping[str, str], edit: ChangeColumns | Rename) -> dict[str, str]:
    if isinstance(edit, Rename):
        return {edit.column: edit.names.get(row[edit.column], row[edit.column])}
    values = edit.matrix @ np.array([float(row[name]) for name in edit.columns]) + edit.offset
    return {name: f"{value:.12g}" for name, value in zip(edit.columns, values, strict=True)}


def _row(cells: list[str]) -> str:
    out = io.StringIO()
    csv.writer(out, lineterminator="\n").writerow(cells)
    return out.getvalue()
