"""Arrays into an ``.npz``, and out of one from anywhere: nothing is run, nothing unpacks to more than it may."""

import io
import math
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

_MOST_MEMBERS = 1000
_LARGEST = 4 * 2**30  # bytes of all arrays
_SMALL, _RATIO = 64 * 2**20, 100  # what numbers are packed to: no less than a hundredth, unless there are few of them
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, struct.error, TypeError,
           KeyError, IndexError, OverflowError, SyntaxError, tokenize.TokenError)  # fmt: skip


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """All arrays by name. Raises ValueError for a file that is no such archive, or too large; OSError."""
    try:
        with zipfile.ZipFile(path) as archive:
            _check_sizes(archive, path.stat().st_size)
            names = [n.removesuffix(".npy") for n in archive.namelist()]
            return {name: _array(archive, f"{name}.npy") for name in names}
    except _DAMAGE as error:
        raise ValueError(f"{path.name} is damaged: {error}") from error


def packed_arrays(**arrays: npt.NDArray[Any]) -> bytes:
    """An ``.npz`` of these: texts packed lightly; numbers as they are, for covariances are noise."""
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", compresslevel=1) as archive:
        for name, values in arrays.items():
            archive.compression = zipfile.ZIP_STORED if values.dtype.kind == "f" else zipfile.ZIP_DEFLATED
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, values, allow_pickle=False)
    return out.getvalue()


def _check_sizes(archive: zipfile.ZipFile, packed: int) -> None:
    members = archive.infolist()
    unpacked = sum(member.file_size for member in members)
    if len(members) > _MOST_MEMBERS or unpacked > min(_LARGEST, max(_SMALL, _RATIO * packed)):
        raise ValueError(f"{len(members)} arrays of {unpacked / 1e6:.0f} MB in {packed / 1e6:.3f} MB, no covariances")


def _array(archive: zipfile.ZipFile, name: str) -> npt.NDArray[Any]:
    size = archive.getinfo(name).file_size
    with archive.open(name) as stream:
        _check_head(stream, size)
    with archive.open(name) as stream:
        return np.asarray(np.lib.format.read_array(stream, allow_pickle=False))


def _check_head(stream: IO[bytes], size: int) -> None:
    """Refuse an array whose head claims more than what follows it: numpy would make room for it first."""
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError("an array of a version that this program does not write")
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype.hasobject or dtype.itemsize * math.prod(shape) > size or min(shape, default=0) < 0:
        raise ValueError("the head of an array does not fit its content")
