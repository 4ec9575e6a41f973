"""A folder that appears complete or not at all."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from adjust.errors import SurveyError


@contextmanager
def whole_folder(folder: Path) -> Iterator[Path]:
    """A temporary place beside ``folder`` that takes its name in the end; SurveyError where something is there."""
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SurveyError(f"{folder}: is there already and not empty; give the name of a new folder")
    place = folder.absolute().with_name(f".{folder.absolute().name}.partial")
    shutil.rmtree(place, ignore_errors=True)  # left by a run that was killed
    place.mkdir(parents=True)
    try:
        yield place
        if folder.exists():
            folder.rmdir()
        place.rename(folder)
    finally:
        shutil.rmtree(place, ignore_errors=True)
