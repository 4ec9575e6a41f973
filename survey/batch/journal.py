"""The journal of a batch: a line for every folder as soon as it is finished, so that a kill loses nothing."""

import json
import os
from pathlib import Path
from types import TracebackType
from typing import Self

from adjust.model.errors import SurveyError
from survey.batch.record import Record, record_from
from survey.folder.locking import FileLock
from survey.folder.shapes import misfit
from survey.folder.text import atomic_write, read_bytes

_ENTRY = {"path": str, "fingerprint": str, "record": dict}
JOURNAL, _LOCK = "journal.jsonl", ".journal.lock"


class Journal:
    """Appends to ``FOLDER/journal.jsonl``; each line is on the disk before the next folder is reported.

    Raises BusyError while another batch writes it.
    """

    def __init__(self, folder: Path, kept: list[dict[str, object]]) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        path = folder / JOURNAL
        self._lock = FileLock(folder / _LOCK, folder, "batch")
        self._lock.acquire()
        # written anew: the last line of a killed run may be half a line
        atomic_write(path, "".join(json.dumps(entry) + "\n" for entry in kept))
        self._file = path.open("a", encoding="utf-8")

    def add(self, path: Path, inputs: str, record: Record) -> None:
        """Note a finished folder; ``inputs`` is its fingerprint."""
        self._file.write(json.dumps(entry_of(path, inputs, record)) + "\n")
        self._file.flush()
        os.fsync(self._file.fileno())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.close()
        self._lock.release()


def entry_of(path: Path, inputs: str, record: Record) -> dict[str, object]:
    """A line of the journal."""
    return {"path": str(path), "fingerprint": inputs, "record": record.plain()}


def read_journal(folder: Path) -> dict[str, tuple[str, Record]]:
    """Fingerprint and record of every finished folder, by its path; a line that was cut off is not there."""
    out: dict[str, tuple[str, Record]] = {}
    try:
        lines = read_bytes(folder / JOURNAL)[0].split(b"\n")
    except SurveyError:
        return out
    for line in lines:
        try:
            entry = json.loads(line)
            if misfit(entry, _ENTRY) is None:
                out[entry["path"]] = (entry["fingerprint"], record_from(entry["record"]))
        except (ValueError, TypeError, RecursionError):
            continue
    return out
