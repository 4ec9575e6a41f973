"""Two project folders as one: what is new is put behind what is there, and every line remembers where it came from."""

import re
import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import repeat
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from survey.folder.text import atomic_write, csv_rows, csv_text, read_text, suggestion
from survey.folder.whole import copy_folder
from survey.project.declared.node import read_toml
from survey.project.declared.toml_text import KeyLines, KeyPath, read_tables, toml_text
from survey.project.detected import ImageKey, file_of
from survey.project.exclusions import EXCLUSIONS_FILE, appended, read_exclusions
from survey.project.project import DEFINITION_FILE, FORMAT, IMAGES_FOLDER, OBSERVATIONS_FOLDER, Project
from survey.project.reading import leaving_out, read_all, with_exclusions
from survey.project.tables.files import read_table
from survey.project.tables.layouts import LAYOUTS

_KINDS = ("cameras", "stations", "tables", "targets", "points", "instruments", "setups", "beams", "surfaces")
Origin = tuple[Path, int]


@dataclass(eq=False)
class Merged:
    """A merged project under construction in ``place``.

    origins: of every line of a merged file, by its path in the project. entries: paths that differ from the old ones.
    new_ids: what NEW defines, by kind. rows: number of new rows by table. without_rows: tables of NEW that have none.
    """

    folder: Path
    new: Path
    place: Path
    origins: dict[str, list[Origin]] = field(default_factory=dict)
    entries: list[str] = field(default_factory=list)
    new_ids: dict[str, list[str]] = field(default_factory=dict)
    rows: dict[str, int] = field(default_factory=dict)
    without_rows: list[Path] = field(default_factory=list)

    def translated(self, error: SurveyError) -> SurveyError:
        """The error with the files and lines that the user knows instead of those of the merged project."""
        message = str(error)
        for name, lines in self.origins.items():
            where = re.escape(str(self.place / name))
            if re.search(where, message):
                message = _renumbered(r"(already in )line (\d+)", message, lines)
            message = _renumbered(rf"(){where}:(\d+)", message, lines)
        return type(error)(message.replace(str(self.place), str(self.folder)))


def _renumbered(pattern: str, message: str, lines: Sequence[Origin]) -> str:
    def found(match: re.Match[str]) -> str:
        return match[1] + _where(lines, int(match[2]))

    return re.sub(pattern, found, message)


def _where(lines: Sequence[Origin], line: int) -> str:
    path, number = lines[min(line, len(lines)) - 1]
    return f"{path}:{number}"


def merge(folder: Path, new: Path, place: Path) -> Merged:
    """Write the merged survey.toml and observations into ``place``; raises SurveyError for what cannot be added."""
    check_new(folder, new)
    merged = Merged(folder, new, place)
    old = _merge_definition(merged)
    _merge_tables(merged)
    for path in sorted((merged.folder / name for name in _point_files(old)), key=str):
        _link_into(path, merged)
    _take_images(merged)
    if merged.without_rows and not any(merged.rows.values()):  # else its stations would be blamed, which nothing places
        raise SurveyError(f"{merged.without_rows[0]}: no row below its header, so that nothing is observed; write the "
                          "rows that are to be added, or remove the file")  # fmt: skip
    if not merged.rows and not any(merged.new_ids.values()):
        raise SurveyError(f"{new}: nothing to add; put tables into {new}/{OBSERVATIONS_FOLDER}, such as pairs.csv")
    return merged


def check_new(folder: Path, new: Path) -> None:
    """Raise SurveyError where ``new`` is no folder of its own."""
    if not new.is_dir():
        raise SurveyError(f"{new}: no such folder; give a folder with observations/ and, for new stations, survey.toml")
    if new.resolve() == folder.resolve():
        raise SurveyError(f"{new}: is the project itself; give the folder that holds what is new")


def _merge_definition(merged: Merged) -> dict[str, Any]:
    """What the old survey.toml says."""
    old_path, new_path = merged.folder / DEFINITION_FILE, merged.new / DEFINITION_FILE
    text = read_text(old_path)
    old = read_tables(text)
    text += "" if text.endswith("\n") else "\n"
    origins: list[Origin] = [(old_path, i + 1) for i in range(text.count("\n"))]
    if new_path.is_file():
        added, lines = _new_sections(merged, new_path, KeyLines(text), old)
        in_braces = any(kind in old and f"[{kind}." not in text for kind in merged.new_ids)
        text, origins = text + added, origins + lines
        merged.entries.append(DEFINITION_FILE)
        try:
            if in_braces:  # or below a header of all
                read_tables(text)
        except ValueError as error:  # of tomllib
            raise SurveyError(
                f"{old_path}: nothing can be added below its tables ({error}); write them as [stations.ID], not as one "
                "line in braces"
            ) from error
    merged.origins[DEFINITION_FILE] = origins
    atomic_write(merged.place / DEFINITION_FILE, text)
    return old


def _new_sections(
    merged: Merged, path: Path, old_lines: Mapping[KeyPath, int], old: Mapping[str, Any]
) -> tuple[str, list[Origin]]:
    """What NEW's survey.toml adds, as text, with the line in NEW of every line."""
    root, _ = read_toml(path)
    out, lines = f"\n# added from {merged.new.name}\n", [(path, 1), (path, 1)]
    for key in root.values:
        if key == "format" and root.values[key] != FORMAT:
            raise root.error(f"found {root.values[key]}; this program reads format {FORMAT}", key)
        if key in ("format", "title"):
            continue
        if key not in _KINDS:
            raise root.error("cannot be added, it belongs to the project as a whole; change it there", key)
        for name, node in root.tables(key):
            if name in old.get(key, {}):
                before = f"{merged.folder / DEFINITION_FILE}:{old_lines.get((key, name), 1)}"
                raise node.error(f"stands already in {before}; give what is new a name of its own, or leave it out")
            _take_point_list(merged, node.values)
            try:
                out += toml_text([((key, name), node.values)]) + "\n"
            except (TypeError, ValueError) as error:
                raise node.error(f"holds a value that no project knows ({error})") from error
            line = root.lines.get((key, name), 1)
            lines += [(path, line), *((path, root.lines.get((key, name, k), line)) for k in node.values), (path, line)]
            merged.new_ids.setdefault(key, []).append(name)
    return out, lines


def _take_point_list(merged: Merged, entry: Mapping[str, object]) -> None:
    """The file that a target of points names."""
    name = entry.get("file")
    if not isinstance(name, str) or not (merged.new / name).is_file():
        return
    if (merged.folder / name).exists():
        raise SurveyError(f"{merged.new / name}: {merged.folder / name} is there already; give it another name")
    (merged.place / name).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy2(merged.new / name, merged.place / name)
    merged.entries.append(name)


def _merge_tables(merged: Merged) -> None:
    old, target = merged.folder / OBSERVATIONS_FOLDER, merged.place / OBSERVATIONS_FOLDER
    if old.is_dir():
        copy_folder(old, target)
    target.mkdir(exist_ok=True)
    source = merged.new / OBSERVATIONS_FOLDER
    for path in sorted(source.iterdir()) if source.is_dir() else []:
        if path.suffix not in (".csv", ".parquet") or path.name.startswith("."):
            continue
        if path.name == EXCLUSIONS_FILE:
            atomic_write(target / path.name, appended(old / path.name, read_exclusions(source)[0]))
            merged.entries.append(f"{OBSERVATIONS_FOLDER}/{path.name}")
            continue
        if path.stem not in LAYOUTS:
            raise SurveyError(f"{path}: unknown table {path.stem!r}; {suggestion(path.stem, LAYOUTS)}")
        if not len(read_table(path, LAYOUTS[path.stem])):  # its own faults are told with its own lines
            merged.without_rows.append(path)
        if path.suffix == ".parquet" or (old / f"{path.stem}.parquet").exists():
            raise SurveyError(f"{path}: Parquet tables cannot be added to; write both tables as CSV")
        _merge_table(merged, old / path.name, path, target / path.name)
        merged.entries.append(f"{OBSERVATIONS_FOLDER}/{path.name}")


def read_merged(merged: Merged, folder: Path) -> Project:
    """Read what was merged, as it will be at ``folder``. Raises SurveyError with the lines that the user knows."""
    place = merged.place
    try:
        everything, exclusions = with_exclusions(read_all(place, beside=merged.folder), place)
    except SurveyError as error:
        raise merged.translated(error) from error
    points = Counter[ImageKey]()
    for block in everything.survey.image_blocks:
        points[block.camera_id, block.epoch_id] += len(block.uv)
    new = {
        key: replace(file_of(path, path.relative_to(place).as_posix()), status="given", n_image_points=points[key])
        for key, path in everything.images.items()
        if path.is_relative_to(place)
    }
    grown = replace(everything, folder=folder, detected={**everything.detected, **new}, files=place,
                    origins=merged.origins)  # fmt: skip
    notes = tuple(note.replace(str(place), str(folder)) for note in everything.image_notes)
    return leaving_out(replace(grown, image_notes=notes), exclusions.values())


def _point_files(old: Mapping[str, Any]) -> list[str]:
    """Point lists that the old survey.toml names; the merged project is read with them."""
    targets = old.get("targets")
    tables = [t for t in targets.values() if isinstance(t, dict)] if isinstance(targets, dict) else []
    return [file for t in tables if isinstance(file := t.get("file"), str)]


def _link_into(path: Path, merged: Merged) -> None:
    copy = merged.place / path.relative_to(merged.folder)
    if path.is_file() and not copy.exists():
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy)


def _merge_table(merged: Merged, old: Path, new: Path, target: Path) -> None:
    new_header, new_rows = table_rows(new)
    text = read_text(old).replace("\r\n", "\n") if old.is_file() else ""
    _, old_header = next(csv_rows(old, text), (1, new_header))
    header = [*old_header, *(name for name in new_header if name not in old_header)]
    as_it_is = bool(text) and len(header) == len(old_header) and "\r" not in text
    parts = [(new, new_header, new_rows)]
    if as_it_is:  # what is new goes behind what is there
        text += "" if text.endswith("\n") else "\n"
        origins: list[Origin] = list(zip(repeat(old), range(1, text.count("\n") + 1)))
    else:
        parts.insert(0, (old, old_header, table_rows(old)[1] if text else []))
        origins, text = [(old if text else new, 1)], csv_text([header])
    merged_rows: list[list[str]] = []
    for path, names, rows in parts:
        place = {name: i for i, name in enumerate(names)}
        order = [place.get(name) for name in header]
        for line, row in rows:
            merged_rows.append(["" if i is None else row[i] for i in order])
            origins.append((path, line))
    merged.origins[f"{OBSERVATIONS_FOLDER}/{new.name}"] = origins
    merged.rows[new.stem] = len(new_rows)
    atomic_write(target, text + csv_text(merged_rows))


def table_rows(path: Path) -> tuple[list[str], list[tuple[int, list[str]]]]:
    """Header, and the rows with their lines; what is there was read as a table before."""
    (_, header), *rows = csv_rows(path, read_text(path))
    return header, rows


def _take_images(merged: Merged) -> None:
    source = merged.new / IMAGES_FOLDER
    paths = sorted(p for p in source.rglob("*") if p.is_file()) if source.is_dir() else []
    if paths and "image_points" not in merged.rows:
        raise SurveyError(
            f"{source}: images without {merged.new / OBSERVATIONS_FOLDER}/image_points.csv; detect their targets first"
        )
    for path in paths:
        name = path.relative_to(merged.new)
        if (merged.folder / name).exists():
            raise SurveyError(f"{path}: {merged.folder / name} is there already; give the epoch another name")
        (merged.place / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, merged.place / name)
        merged.entries.append(name.as_posix())
