"""A folder that appears complete or not at all."""

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adjust.errors import SurveyError
from survey.files.locking import FileLock
from survey.files.text import sync_folder


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary place beside ``folder`` that takes its name in the end; SurveyError where something is there.

    The place is kept by a lock beside it: what a killed command has left there goes, what a living one makes does not.
    """
    target = Path(os.path.realpath(folder))  # a link to an empty folder stays a link
    _require_empty(folder, target)
    target.parent.mkdir(parents=True, exist_ok=True)
    place = target.with_name(f".{target.name}.partial")
    with FileLock(target.with_name(f".{target.name}.lock"), folder, "command"):
        _require_empty(folder, target)  # another may have made it before the lock was free
        shutil.rmtree(place, ignore_errors=True)
        place.mkdir()
        try:
            yield place
            place.rename(target)  # takes the place of an empty folder, too
            sync_folder(target.parent)
        finally:
            shutil.rmtree(place, ignore_errors=True)


def _require_empty(folder: Path, target: Path) -> None:
    if target.exists() and (not target.is_dir() or any(target.iterdir())):
        raise SurveyError(f"{folder}: is there already and not empty; give the name of a new folder")
