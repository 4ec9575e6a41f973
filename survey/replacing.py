"""Replacing parts of a project folder by new ones: all of them, or none.

The new parts are made in ``FOLDER/.adding``. They are moved to their places one by one, the old ones into
``FOLDER/.before``; whatever goes wrong on the way, everything is moved back. A run that was killed on the way leaves
``FOLDER/.before`` with the list of what was to be moved: :func:`recover` then restores the old state.
"""

import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path

ADDING, BEFORE, LIST = ".adding", ".before", "entries.json"


def replace_parts(folder: Path, entries: Sequence[str]) -> None:
    """Move ``folder/.adding/<entry>`` (files or folders) to ``folder/<entry>``, in this order, all or none."""
    adding, before = folder / ADDING, folder / BEFORE
    before.mkdir()
    had = {entry: (folder / entry).exists() for entry in entries}
    (before / LIST).write_text(json.dumps(had), encoding="utf-8")
    try:
        for entry in entries:
            if had[entry]:
                (before / entry).parent.mkdir(parents=True, exist_ok=True)
                os.rename(folder / entry, before / entry)
            (folder / entry).parent.mkdir(parents=True, exist_ok=True)
            os.rename(adding / entry, folder / entry)
    except BaseException:
        recover(folder)
        raise
    (before / LIST).unlink()  # from here on the new state holds
    shutil.rmtree(before)
    shutil.rmtree(adding)


def recover(folder: Path) -> bool:
    """Restore the state before a replacement that was not finished; whether there was one."""
    adding, before = folder / ADDING, folder / BEFORE
    unfinished = (before / LIST).is_file()
    if unfinished:
        had: dict[str, bool] = json.loads((before / LIST).read_text(encoding="utf-8"))
        for entry, was_there in had.items():
            if (before / entry).exists():
                _remove(folder / entry)
                os.rename(before / entry, folder / entry)
            elif not was_there:
                _remove(folder / entry)
    shutil.rmtree(before, ignore_errors=True)
    shutil.rmtree(adding, ignore_errors=True)
    return unfinished


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)
