"""A folder that appears complete or not at all, and what it is filled with of another one."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from adjust.model.errors import SurveyError
from survey.folder.locking import LOCK, OBSERVATIONS_FOLDER, FileLock
from survey.folder.text import sync_folder


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary place beside ``folder`` that takes its name in the end; SurveyError where something is there.

    The place is kept by a lock in it: what a killed command has left there goes, what a living one makes does not.
    """
    target = Path(os.path.realpath(folder))  # a link to an empty folder stays a link
    _require_empty(folder, target)
    target.parent.mkdir(parents=True, exist_ok=True)
    place = target.with_name(f".{target.name}.partial")
    lock = _locked(place, folder)
    try:
        _empty(place)
        _require_empty(folder, target)  # another may have made it before the lock was free
        yield place
        place.rename(target)  # takes the place of an empty folder, too
        lock.path = target / LOCK
        with suppress(OSError):  # it is complete; only a cut of the power could still undo it
            sync_folder(target.parent)
    finally:
        _empty(place)
        lock.release()
        with suppress(OSError):  # is gone, or another command has it already
            place.rmdir()


def _locked(place: Path, folder: Path) -> FileLock:
    lock = FileLock(place / LOCK, folder, "command")
    while True:
        try:
            place.mkdir(exist_ok=True)
            lock.acquire()
            return lock
        except FileNotFoundError:  # the last holder has just removed it
            continue
        except BaseException:
            with suppress(OSError):
                place.rmdir()
            raise


def _empty(place: Path) -> None:
    """Remove everything but the lock, which goes last: until then nobody else may work there."""
    for path in place.iterdir() if place.is_dir() else ():
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        elif path.name != LOCK:
            path.unlink(missing_ok=True)


def _require_empty(folder: Path, target: Path) -> None:
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise SurveyError(f"{folder}: is there already and not empty; give the name of a new folder")


def copy_folder(source: Path, target: Path) -> None:
    """Copy all files; as ``shutil.copytree``, but its errors do not say which file."""
    target.mkdir(parents=True, exist_ok=True)
    for path in source.iterdir():
        if path.is_dir():
            copy_folder(path, target / path.name)
        else:
            shutil.copy2(path, target / path.name)


def complete(folder: Path, place: Path) -> None:
    """Put everything of the project that is not new into ``place``."""
    for path in sorted(folder.rglob("*")):
        name = path.relative_to(folder)
        if name.parts[0] == OBSERVATIONS_FOLDER or name.parts[0].startswith(".") or (place / name).exists():
            continue
        if path.is_dir():
            (place / name).mkdir(exist_ok=True)
        else:
            shutil.copy2(path, place / name)
