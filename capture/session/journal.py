"""The journal of a capture: one JSON line per fact, on disk before it counts; what is in it has happened.

Kinds of records: ``session`` (a start), ``set`` (the images of one epoch, all of them already on disk), ``lost`` (an
epoch whose images were damaged since, to be taken again), ``event`` (faults, retries, pauses). ``n`` counts the lines.
"""

import json
import os
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from adjust.model.errors import SurveyError
from survey.folder.text import sync_folder

Record = Mapping[str, Any]


class Journal:
    """Appends records; opening cuts a last line that a crash has torn."""

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        is_new = not path.exists()
        self.records, size, self.torn = read_journal(path)
        self._stream = path.open("ab", buffering=0)
        if self.torn:
            self._stream.truncate(size)
            os.fsync(self._stream.fileno())
        self._size = size
        if is_new:
            sync_folder(path.parent)

    def append(self, kind: str, **values: object) -> Record:
        """Add a record; on return it is on disk. Where that fails, nothing of it stays. Raises OSError."""
        record = {"n": len(self.records), "kind": kind, **values}
        line = json.dumps(record, allow_nan=False, ensure_ascii=False).encode() + b"\n"
        try:
            self._write(line)
            os.fsync(self._stream.fileno())
        except OSError:
            # a full disk may have taken half a line; the next one must not be glued to it
            self._stream.truncate(self._size)
            raise
        self._size += len(line)
        self.records.append(record)
        return record

    def _write(self, line: bytes) -> None:
        while line:
            line = line[self._stream.write(line) :]

    def close(self) -> None:
        """Close the file."""
        self._stream.close()

    def taken(self) -> dict[str, Record]:
        """The last valid set of every epoch."""
        return taken_sets(self.records)


def read_journal(path: Path) -> tuple[list[Record], int, bool]:
    """Records, the bytes that they fill, and whether a torn line follows. Raises SurveyError for damage elsewhere."""
    if not path.exists():
        return [], 0, False
    data = path.read_bytes()
    records: list[Record] = []
    size = 0
    lines = data.split(b"\n")
    for i, line in enumerate(lines[:-1]):
        record = _parsed(line)
        if record is None or record.get("n") != i:
            if i == len(lines) - 2 and not lines[-1]:
                return records, size, True  # whole but for its content: blocks that never reached the disk
            raise SurveyError(
                f"{path}:{i + 1}: not a line of a journal; a crash damages the last line only, so restore the file "
                "from a copy, or cut this line and all after it to take those epochs again"
            )
        records.append(record)
        size += len(line) + 1
    return records, size, bool(lines[-1])


def _parsed(line: bytes) -> dict[str, Any] | None:
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    if not isinstance(record, dict) or not isinstance(record.get("kind"), str):
        return None
    named = record["kind"] not in ("set", "lost") or isinstance(record.get("epoch_id"), str)
    return record if named else None


def taken_sets(records: list[Record]) -> dict[str, Record]:
    """The last valid set of every epoch, in the order in which they were taken."""
    taken: dict[str, Record] = {}
    for record in records:
        if record["kind"] == "set":
            taken.pop(record["epoch_id"], None)
            taken[record["epoch_id"]] = record
        elif record["kind"] == "lost":
            taken.pop(record["epoch_id"], None)
    return taken


def clocks() -> dict[str, int]:
    """When it is now, for a record: differences are taken of the monotonic clock; the other, UTC, may jump."""
    return {"monotonic_ns": time.monotonic_ns(), "time_ns": time.time_ns()}
