"""Bytes of files that are read beside other work. Nothing here needs NumPy: tables are read while that is loaded."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

from adjust.native.parallel import Beside
from survey.folder.locking import OBSERVATIONS_FOLDER
from survey.folder.text import content, with_digest

LARGE = 2**20  # bytes of CSV; below, loading Arrow (30 ms) costs more than it saves
Version = tuple[int, ...]


class Content(NamedTuple):
    """What gives the bytes of a file, and their sha256."""

    data: Callable[[], bytes]
    digest: Callable[[], str]


class Ahead(NamedTuple):
    """Files that are being read, as they were then, and the steps that these are."""

    steps: Beside
    files: dict[Path, tuple[Version, Content]]


@contextmanager
def reading_ahead(folder: Path) -> Iterator[Ahead]:
    """The large tables of a project, which are read while what comes next is loaded; none where there is one thread.

    Nothing of it goes on when this ends. What is wrong with a file is told to who asks for it.
    """
    with Beside() as steps:
        paths = [] if steps.alone else sorted((folder / OBSERVATIONS_FOLDER).glob("*.csv"))
        large = [path for path in paths if path.is_file() and path.stat().st_size >= LARGE]
        yield Ahead(steps, {path: (version(path), begun(partial(content, path), steps)) for path in large})


def version(path: Path) -> Version:
    """Another one where a file was replaced or written to: inode, size and time."""
    status = path.stat()
    return status.st_ino, status.st_size, status.st_mtime_ns


def begun(read: Callable[[], bytes], steps: Beside) -> Content:
    """Bytes that are being read and hashed."""
    data = steps.of(read)
    return Content(data, steps.of(lambda: with_digest(data())[1]))
