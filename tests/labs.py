"""Ready projects that many tests begin with: each is made once in a run, by whoever asks first, and copied."""

import csv
import fcntl
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from gtsam import Rot3

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


def with_rows(path: Path, change: Callable[[int, dict[str, str]], object]) -> None:
    """A table with its rows changed, each with its number from 0."""
    with path.open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    for number, row in enumerate(rows):
        change(number, row)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(dict.fromkeys(name for row in rows for name in row)), restval="")
        writer.writeheader()
        writer.writerows(rows)


def with_euler_angles(path: Path, factor: float = 1.0, chosen: Callable[[int], bool] = lambda _: True) -> None:
    """A table of pairs with Euler angles in place of quaternions, some of them times a factor."""

    def change(number: int, row: dict[str, str]) -> None:
        R = Rot3.Quaternion(*(float(row.pop(name)) for name in ("qw", "qx", "qy", "qz")))
        for axis, angle in zip("xyz", np.degrees(R.xyz()), strict=True):
            row[f"euler_{axis}_deg"] = f"{(factor if chosen(number) else 1.0) * angle:.12g}"

    with_rows(path, change)
