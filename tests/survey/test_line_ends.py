"""Windows' line ends and byte order marks change nothing, in every kind of file that people write or bring along."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.acceptance.interruptions import in_a_copy, wait
from tests.fuzz.reader import Reader

pytestmark = pytest.mark.slow

MARK = b"\xef\xbb\xbf"
OURS = {
    "alignment-rounds", "batch-cache", "batch-journal", "capture-lock", "capture-status", "journal", "nexus", "quality",
    "replaced-list", "simulated-angles", "simulated-lab", "solution",
}  # fmt: skip
"""Nobody edits these: the programs write them for themselves."""
SLOW = {"planning", "definition", "kalibr", "kalibr-target", "opencv", "opencv-json", "mrcal", "nerf", "urdf", "sdf",
        "tum", "kitti", "mc-calib"}  # fmt: skip
_NOT_COMPARED = ("inputs", "digest", "path", "folder", "file", "lines")


def versions(data: bytes) -> dict[str, bytes]:
    """The same text as other editors save it."""
    unix = data.replace(b"\r\n", b"\n")
    windows = unix.replace(b"\n", b"\r\n")
    return {"\\n": unix, "\\r\\n": windows, "mark": MARK + unix, "mark and \\r\\n": MARK + windows}


def plain(value: Any) -> Any:
    """What was read, as values that can be compared, without names of files and their hashes."""
    if isinstance(value, np.ndarray):
        return value.tolist().__repr__()
    if dataclasses.is_dataclass(value):
        fields = (f.name for f in dataclasses.fields(value))
        return [(name, plain(getattr(value, name))) for name in fields if name not in _NOT_COMPARED]
    if isinstance(value, dict):
        return [(plain(key), plain(one)) for key, one in value.items()]
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(one) for one in value]
    if hasattr(value, "matrix"):
        return repr(value.matrix().tolist())
    return repr(value) if isinstance(value, str | int | float | bytes | None) else type(value).__name__


def compare(folder: Path, readers: dict[str, Reader]) -> int:
    """Read every good file in every version; the number of those that are not read, or read as something else."""
    wrong = compared = 0
    for name, reader in readers.items():
        read = reader.prepare(folder / name)
        for seed in reader.seeds():
            found = {}
            for what, data in versions(seed).items():
                try:
                    found[what] = plain(read(data))
                except Exception as error:
                    found[what] = error
            compared += 1
            for what, one in found.items():
                if isinstance(one, Exception) or one != found["\\n"]:
                    wrong += 1
                    print(f"{name}, {what}: {str(one)[:300]}")
    print(f"{compared} files of {len(readers)} kinds")
    return wrong if compared else 99


def test_windows_files_are_read_as_others(tmp_path: Path) -> None:
    """In a process of its own: some readers of the harness leave it changed."""
    from tests.fuzz.readers import READERS  # here: not in the processes that only collect

    readers = {n: r for n, r in READERS.items() if r.is_text and n not in OURS | SLOW and "colmap" not in n
               and not n.startswith(("ros", "mrcal"))}  # fmt: skip
    assert len(readers) > 30
    for name in readers:
        (tmp_path / name).mkdir()
    ended = wait(in_a_copy(lambda: min(compare(tmp_path, readers), 99), tmp_path), tmp_path)
    assert ended.code == 0, ended.said
