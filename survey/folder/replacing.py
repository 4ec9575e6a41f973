"""Changing a project folder: one command at a time, and all that a command writes or nothing.

A command keeps the folder (:func:`changing`) and makes what is new in ``FOLDER/.adding``. :func:`replace_parts` puts it
in place: a folder of results trades places with the old one in one step of the file system; files are renamed one by
one while readers wait (:func:`survey.folder.locking.folder_held`), the old ones kept in ``FOLDER/.before``. Whatever
goes wrong on the way, the old state comes back. A command that was killed on the way leaves ``FOLDER/.before`` with the
list of what was to be moved; the next command restores the old state (:func:`recover`).

Nothing is written through a link that lies in the project.
"""

import errno
import json
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from adjust.model.errors import SurveyError
from survey.folder.exchange import MARK, CannotTradeError, carry_over, complete_from, trade
from survey.folder.locking import (
    BEFORE,
    LIST,
    LOCK,
    OBSERVATIONS_FOLDER,
    RESULTS,
    SESSION_LOCK,
    BusyError,
    FileLock,
    folder_held,
    holder_of,
    unfinished,
)
from survey.folder.text import atomic_write, read_bytes, remove_leftovers, sync_folder
from survey.folder.whole import whole_folder

ADDING = ".adding"


@contextmanager
def changing(folder: Path, inputs: bool = False) -> Iterator[Path]:
    """Keep a folder for this command; the place for what is new in it, for :func:`replace_parts`.

    The folder is made where it is not there, and goes again where it stays empty. What a killed command left is undone
    first. inputs: observations will change, which a capture session must not do at the same time. Raises BusyError
    while another command has the folder, SurveyError, OSError where it cannot be written.
    """
    folder = Path(folder)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with FileLock(folder / LOCK, folder, "command"):
            session = holder_of(folder / SESSION_LOCK) if inputs else None
            if session is not None:
                raise BusyError(f"{folder}: a session takes images ({session}); wait for it or stop it")
            recover(folder)
            _require_no_link(folder)
            (folder / ADDING).mkdir()
            try:
                yield folder / ADDING
            finally:
                shutil.rmtree(folder / ADDING, ignore_errors=True)
    finally:
        for path in made:
            with suppress(OSError):  # there is something in it
                path.rmdir()


@contextmanager
def place_for(folder: Path, out: Path | None) -> Iterator[Path]:
    """Where a changed project is made: in the project, or beside ``out``, which it becomes when all is complete.

    Raises SurveyError where ``out`` is there already and not empty.
    """
    with changing(folder, inputs=True) if out is None else whole_folder(out) as place:
        yield place


@contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Where a project is made that appears in ``folder`` as a whole; the folder is new, or holds other things.

    Raises SurveyError where a file of the project is there already.
    """
    if not folder.exists():
        with whole_folder(folder) as place:
            yield place
        return
    with changing(folder, inputs=True) as place:
        _refuse(folder, ["survey.toml"])  # before the work
        yield place
        _refuse(folder, [name for entry in place.iterdir() for name in _files(place, entry.name)])
        replace_parts(folder)


def _refuse(folder: Path, names: Sequence[str]) -> None:
    there = next((name for name in sorted(names) if os.path.lexists(folder / name)), None)
    if there is not None:
        raise SurveyError(f"{folder / there}: there is a project already; choose another folder")


def write_set(folder: Path, texts: Mapping[str, str]) -> dict[str, Path]:
    """Write files that belong together into a folder, all or none; their paths by name."""
    with changing(folder) as place:
        for name, text in texts.items():
            atomic_write(place / name, text)
        replace_parts(folder)
    return {name: folder / name for name in texts}


def replace_parts(folder: Path, entries: Sequence[str] | None = None, gone: Sequence[str] = ()) -> None:
    """Move ``folder/.adding/<entry>`` (files or folders, None: all) to ``folder/<entry>``, all or none.

    What a folder holds besides the new files stays, but for the files ``gone``. The caller is :func:`changing` it.
    """
    adding = folder / ADDING
    wanted = sorted(path.name for path in adding.iterdir()) if entries is None else list(entries)
    files = [name for entry in wanted if entry != RESULTS for name in _files(adding, entry)]
    files += [entry for entry in gone if (folder / entry).is_file()]
    outside = next((entry for entry in files if not _is_inside(folder, entry)), None)
    if outside is not None:  # could not be undone
        raise SurveyError(f"{folder / outside}: lies behind a link; move that into the project, or use --out")
    if RESULTS in wanted and not (folder / RESULTS).exists():
        files.append(RESULTS)
    elif RESULTS in wanted:
        results = _files(adding, RESULTS)
        try:
            _replace(folder, [RESULTS], files)
            return
        except CannotTradeError:  # file systems of few talents, folders that are mounted: file by file
            files += results
    if files:
        _replace(folder, [], files)


def _files(adding: Path, entry: str) -> list[str]:
    if not (adding / entry).is_dir():
        return [entry]
    found = sorted(path for path in (adding / entry).rglob("*") if not path.is_dir())
    return [path.relative_to(adding).as_posix() for path in found]


def _replace(folder: Path, folders: list[str], files: list[str]) -> None:
    """Trade ``folders``, then move ``files``; those that were not made anew go."""
    adding, before = folder / ADDING, folder / BEFORE
    try:
        for entry in folders:
            complete_from(folder / entry, adding / entry)
            sync_folder(adding / entry)
        with folder_held(folder, shared=False):
            _keep_old(folder, folders, files)
            for entry in folders:
                trade(adding / entry, folder / entry)
            for entry in files:
                if os.path.lexists(adding / entry):
                    _put(adding / entry, folder / entry)
                else:
                    (folder / entry).unlink(missing_ok=True)
            for above in {(folder / entry).parent for entry in (*folders, *files)}:
                sync_folder(above)
            (before / LIST).unlink()  # from here on the new state holds
    except CannotTradeError:
        shutil.rmtree(before, ignore_errors=True)  # nothing was moved yet
        raise
    except BaseException:
        recover(folder)
        raise
    for entry in folders:
        carry_over(adding / entry, folder / entry)
        shutil.rmtree(adding / entry, ignore_errors=True)
    shutil.rmtree(before, ignore_errors=True)  # without its list it is a leftover


def _keep_old(folder: Path, folders: list[str], files: list[str]) -> None:
    """Fill ``.before``: what will be replaced, and the list of it last."""
    before = folder / BEFORE
    before.mkdir()
    had = {entry: os.path.lexists(folder / entry) for entry in (*folders, *files)}
    for entry in files:
        (before / entry).parent.mkdir(parents=True, exist_ok=True)
        if had[entry]:
            _link(folder / entry, before / entry)
    atomic_write(before / LIST, json.dumps(had))
    sync_folder(before)
    sync_folder(folder)


def _link(source: Path, target: Path) -> None:
    """A second name, so that the first is never missing; a copy where the file system has no second names."""
    try:
        os.link(source, target, follow_symlinks=False)
    except (OSError, NotImplementedError):
        shutil.copy2(source, target, follow_symlinks=False)


def _put(source: Path, there: Path) -> None:
    """Move a file; its content where a folder in between is mounted."""
    there.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.replace(source, there)
    except OSError as error:
        if error.errno != errno.EXDEV:
            raise
        atomic_write(there, source.read_bytes())
        source.unlink()


def recover(folder: Path) -> bool:
    """Restore the state before a replacement that was not finished; whether there was one.

    The caller keeps the folder, see :func:`recover_killed`.
    """
    adding, before = folder / ADDING, folder / BEFORE
    found = unfinished(folder)
    if found:
        entries = _entries(folder)
        with folder_held(folder, shared=False):
            for entry, was_there in entries.items():
                _restore(folder, entry, was_there)
            sync_folder(folder)
            (before / LIST).unlink()
    for place in (before, adding):
        if place.is_symlink():
            place.unlink()
        shutil.rmtree(place, ignore_errors=True)
    for place in (folder / RESULTS, folder / OBSERVATIONS_FOLDER):
        if place.is_dir() and not place.is_symlink():
            (place / MARK).unlink(missing_ok=True)
            remove_leftovers(place)
    return found


def recover_killed(folder: Path) -> bool:
    """:func:`recover`, unless a living command is at it; whether there was something to undo. Raises as changing."""
    if not unfinished(folder) or holder_of(folder / LOCK) is not None:
        return False
    try:
        with FileLock(folder / LOCK, folder, "command"):
            return recover(folder)
    except BusyError:
        return False  # another command does it


def _restore(folder: Path, entry: str, was_there: bool) -> None:
    there, old, new = folder / entry, folder / BEFORE / entry, folder / ADDING / entry
    if (there / MARK).is_file() and new.is_dir():
        trade(new, there)
    elif os.path.lexists(old):
        _put(old, there)  # the same file where it was not moved yet
    elif not was_there:
        _remove(there)


def _entries(folder: Path) -> dict[str, bool]:
    """What was to be replaced, and whether it was there. Raises SurveyError for a list that no run has written.

    The list may come with a folder from anywhere, and what it names is removed: it must lie inside the project.
    """
    path = folder / BEFORE / LIST
    try:
        had = json.loads(read_bytes(path, 2**24)[0])
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


def _require_no_link(folder: Path) -> None:
    """Before anything is computed that could not be written."""
    results = folder / RESULTS
    if results.is_symlink():
        raise SurveyError(f"{results}: is a link, and nothing is written through a link in a project; use --out DIR, "
                          "which writes DIR/results, or make it a folder")  # fmt: skip
    if results.exists() and not results.is_dir():
        raise SurveyError(f"{results}: is no folder, but results go into it; move it away")


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
