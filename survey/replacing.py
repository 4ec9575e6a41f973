"""Replacing parts of a project folder by new ones: all of them, or none.

The new parts are made in ``FOLDER/.adding``. They are moved to their places one by one; the old ones are kept in
``FOLDER/.before`` (files copied, so that they are never missing, folders moved). Whatever goes wrong on the way, the
old ones come back. A run that was killed on the way leaves ``FOLDER/.before`` with the list of what was to be moved:
:func:`recover` then restores the old state.
"""

import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from adjust.errors import SurveyError
from survey.files.project import OBSERVATIONS_FOLDER
from survey.files.text import atomic_write, read_bytes
from survey.results import RESULTS
from survey.whole_folder import whole_folder

ADDING, BEFORE, LIST = ".adding", ".before", "entries.json"


def replace_parts(folder: Path, entries: Sequence[str]) -> None:
    """Move ``folder/.adding/<entry>`` (files or folders) to ``folder/<entry>``, in this order, all or none."""
    adding, before = folder / ADDING, folder / BEFORE
    outside = next((entry for entry in entries if not _is_inside(folder, entry)), None)
    if outside is not None:  # could not be undone
        raise SurveyError(f"{folder / outside}: lies behind a link; move that into the project, or use --out")
    before.mkdir()
    had = {entry: (folder / entry).exists() for entry in entries}
    for entry in entries:
        (before / entry).parent.mkdir(parents=True, exist_ok=True)
        if (folder / entry).is_file():
            shutil.copy2(folder / entry, before / entry)
    atomic_write(before / LIST, json.dumps(had))
    try:
        for entry in entries:
            if (folder / entry).is_dir():
                os.rename(folder / entry, before / entry)
            (folder / entry).parent.mkdir(parents=True, exist_ok=True)
            os.rename(adding / entry, folder / entry)
    except BaseException:
        recover(folder)
        raise
    (before / LIST).unlink()  # from here on the new state holds
    shutil.rmtree(before)
    shutil.rmtree(adding)


def unfinished(folder: Path) -> bool:
    """Whether a replacement was begun and neither finished nor undone."""
    return (folder / BEFORE / LIST).is_file()


def recover(folder: Path) -> bool:
    """Restore the state before a replacement that was not finished; whether there was one."""
    adding, before = folder / ADDING, folder / BEFORE
    found = unfinished(folder)
    if found:
        for entry, was_there in _entries(folder).items():
            if (before / entry).is_file():
                os.replace(before / entry, folder / entry)
            elif (before / entry).exists():
                _remove(folder / entry)
                os.rename(before / entry, folder / entry)
            elif not was_there:
                _remove(folder / entry)
    shutil.rmtree(before, ignore_errors=True)
    shutil.rmtree(adding, ignore_errors=True)
    return found


def _entries(folder: Path) -> dict[str, bool]:
    """What was to be replaced, and whether it was there. Raises SurveyError for a list that no run has written.

    The list may come with a folder from anywhere, and what it names is removed: it must lie inside the project.
    """
    path = folder / BEFORE / LIST
    try:
        had = json.loads(read_bytes(path, 2**20)[0])
    except (ValueError, RecursionError):
        had = None
    known = isinstance(had, dict) and all(isinstance(flag, bool) for flag in had.values())
    if not known or not all(_is_inside(folder, entry) for entry in had):
        raise SurveyError(f"{path}: is no list that labsurvey has written; look into {folder / BEFORE} for what was "
                          "replaced, copy back what is missing, then remove that folder")  # fmt: skip
    return dict(had)


def _is_inside(folder: Path, entry: str) -> bool:
    """Whether an entry names something in the project itself, by no detour and through no link."""
    parts = entry.split("/")
    if not entry.isprintable() or any(part in ("", ".", "..") or "\\" in part or ":" in part for part in parts):
        return False
    if parts[0] in (ADDING, BEFORE) or max(len(part.encode()) for part in parts) > 200 or len(parts) > 20:
        return False
    above = [folder.joinpath(*parts[:k]) for k in range(1, len(parts))]
    return not any(path.is_symlink() for path in (*above, folder / BEFORE, folder / ADDING))


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@contextmanager
def place_for(folder: Path, out: Path | None) -> Iterator[Path]:
    """Where the new state is made: inside the project, or beside ``out``, which it becomes when all is complete.

    Raises SurveyError where ``out`` is there already and not empty.
    """
    if out is None:
        place = folder / ADDING
        place.mkdir()
        try:
            yield place
        finally:
            shutil.rmtree(place, ignore_errors=True)
        return
    with whole_folder(out) as place:
        yield place


def complete(folder: Path, place: Path) -> None:
    """Put everything of the project that is not new into ``place``."""
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if name.parts[0] in (RESULTS, OBSERVATIONS_FOLDER) or name.parts[0].startswith(".") or (place / name).exists():
            continue
        if path.is_dir():
            (place / name).mkdir()
        else:
            shutil.copy2(path, place / name)
