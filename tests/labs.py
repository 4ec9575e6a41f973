"""Ready projects that many tests begin with: each is made once in a run, by whoever asks first, and copied."""

import fcntl
import shutil
from pathlib import Path

from survey.examples import write_example

place: Path | None = None  # of all processes of a run; set by tests/conftest.py


def example(name: str, folder: Path) -> Path:
    """The example ``name`` in ``folder``, which is new or empty."""
    if place is None:
        write_example(name, folder)
        return folder
    place.mkdir(exist_ok=True)
    with (place / f"{name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (place / name).exists():
            write_example(name, place / name)
    return Path(shutil.copytree(place / name, folder, dirs_exist_ok=True))
