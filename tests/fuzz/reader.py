"""What a reader is to the harness: good files to start from, and a folder in which one file is read."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

Read = Callable[[bytes], object]


@dataclass(frozen=True)
class Reader:
    """prepare: makes the folder around the file, gives a function that writes the file and reads it."""

    seeds: Callable[[], Sequence[bytes]]
    prepare: Callable[[Path], Read]
    is_text: bool = True
    dictionary: Sequence[bytes] = ()


def in_file(name: str, read: Callable[[Path], object]) -> Callable[[Path], Read]:
    """Reads one file; its folder may hold others."""

    def prepare(folder: Path) -> Read:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)

        def run(data: bytes) -> object:
            path.write_bytes(data)
            return read(path)

        return run

    return prepare
