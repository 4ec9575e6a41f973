"""Ready projects that many tests begin with: each is made once in a run, by whoever asks first, and copied."""

import fcntl
import shutil
from pathlib import Path

from survey.examples import write_example
from survey.jobs.adjusting.job import detect_job

place: Path | None = None  # of all processes of a run; set by tests/conftest.py


def example(name: str, folder: Path, detected: bool = False) -> Path:
    """The example ``name`` in ``folder``, which is new or empty; ``detected``: with what its images show."""
    if place is None:
        return _made(name, folder, detected)
    place.mkdir(exist_ok=True)
    kept = place / f"{name}{'-detected' * detected}"
    with kept.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            _made(name, kept, detected)
    return Path(shutil.copytree(kept, folder, dirs_exist_ok=True))


def _made(name: str, folder: Path, detected: bool) -> Path:
    if not detected:
        write_example(name, folder)
    else:
        detect_job(example(name, folder), progress=False)
    return folder
