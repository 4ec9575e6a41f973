"""Files as text: reading with clear errors, writing that never leaves half a file, names for messages."""

import csv
import difflib
import errno
import functools
import hashlib
import io
import json
import os
import re
import stat
import tempfile
import threading
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from pathlib import Path

from adjust.model.errors import SurveyError
from survey.folder.locking import hold, remove_unheld

LARGEST_FILE = 4 * 2**30  # bytes; longer observations go into several projects
Piece = bytes | memoryview
"""Of a file."""
LARGEST_NUMBER = 1e15  # its square and what is made of it stay finite
FORBIDDEN_IN_IDS = set('/\\:@,;"|<>*?')
NOT_OURS = (ValueError, KeyError, TypeError, AttributeError, IndexError, OverflowError, RecursionError, OSError)
"""What a file raises that is taken for one of this program and is none, or was damaged."""
_FORMULA = ("=", "+", "-", "@", "\t", "\r")  # what spreadsheets take for the beginning of a formula
_ASKING = threading.Lock()
_PLAIN_ID = re.compile(r"(?:[0-9][A-Za-z0-9_-]{0,99}|[A-Za-z_][A-Za-z0-9_-]{4,99})", re.ASCII).fullmatch
"""Nearly all of thousands; a shorter word may be that of a device."""
_LONGEST_ID = 120  # bytes: an id with a prefix and an ending is still the name of a file
_DEVICES = {"CON", "PRN", "AUX", "NUL", *(f"{port}{i}" for port in ("COM", "LPT") for i in range(1, 10))}


def atomic_write(path: Path, content: bytes | str | Iterable[Piece], lasting: bool = False) -> None:
    """Write ``content`` (text as UTF-8) under a temporary name beside ``path``, then rename: all of it or nothing.

    What killed runs left of the same file goes. lasting: on return even a cut of the power leaves the new file.
    """
    whole = utf8(content) if isinstance(content, str) else content
    made = not path.parent.is_dir()
    path.parent.mkdir(parents=True, exist_ok=True)
    remove_leftovers(path.parent, path.name)
    handle, temporary = _temporary(path)
    try:
        with os.fdopen(handle, "wb") as stream:
            stream.writelines([whole] if isinstance(whole, bytes) else whole)
            stream.flush()
            os.fsync(handle)
        os.chmod(temporary, 0o666 & ~_umask())  # mkstemp makes files that only their owner can read
        os.replace(temporary, path)
        for folder in (path.parent, *([path.parent.parent] if made else [])) if lasting else ():
            sync_folder(folder)
    except BaseException as error:
        Path(temporary).unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename is None:  # writing does not say which file
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


def utf8(text: str) -> bytes:
    """Where the system knows no UTF-8, names of files in a text stand for their bytes."""
    try:
        return text.encode("utf-8")
    except UnicodeEncodeError:
        return text.encode("utf-8", "surrogateescape").decode("utf-8", "replace").encode("utf-8")


def _temporary(path: Path) -> tuple[int, str]:
    while True:
        handle, temporary = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
        if hold(handle, Path(temporary)):
            return handle, temporary
        os.close(handle)


def remove_leftovers(folder: Path, name: str = "") -> None:
    """Remove temporary files of ``atomic_write``, of one name or all, that no living process writes."""
    pattern = re.compile(rf"\.{re.escape(name) or '.+'}\.[a-z0-9_]{{8}}\.tmp")
    with os.scandir(folder) as entries:
        found = [entry.path for entry in entries if pattern.fullmatch(entry.name)]
    for path in found:
        remove_unheld(Path(path))


def sync_folder(folder: Path) -> None:
    """Make names in a folder last: what was renamed or created there is on disk on return."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # some file systems cannot, and need not
            raise
    finally:
        os.close(handle)


def _umask() -> int:
    with _ASKING:  # of the whole process, and only told by what changes it
        mask = os.umask(0)
        os.umask(mask)
    return mask


def read_bytes(path: Path, largest: int = LARGEST_FILE) -> tuple[bytes, str]:
    """:func:`content` of a file and its sha256."""
    return with_digest(content(path, largest))


def content(path: Path, largest: int = LARGEST_FILE) -> bytes:
    """Bytes of a file; raises SurveyError where it cannot be read, is no file, or over ``largest``."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) and not stat.S_ISDIR(status.st_mode):  # a pipe would never end
            raise SurveyError(f"{path}: is a device, a pipe or a socket; put a file in its place")
        if status.st_size > largest:
            found = f"{status.st_size / 1e6:.0f} MB, more than the {largest / 1e6:.0f} MB that are read"
            raise SurveyError(f"{path}: the file has {found}; check whether it is the right one, or split it")
        return path.read_bytes()
    except OSError as error:
        raise SurveyError(f"{path}: cannot be read ({error.strerror}); check the name and the permissions") from error


def with_digest(data: bytes) -> tuple[bytes, str]:
    """Bytes and their sha256."""
    return data, hashlib.sha256(data).hexdigest()


def decode(path: Path, data: bytes) -> str:
    """Text of a UTF-8 file, with or without byte order mark; raises SurveyError with the line of the first bad byte."""
    if data[:2] in (b"\xff\xfe", b"\xfe\xff"):
        raise SurveyError(f"{path}:1: the file is UTF-16, not UTF-8; save it as UTF-8")
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = data.count(b"\n", 0, error.start) + 1
        found = f"byte 0x{data[error.start]:02x}"
        raise SurveyError(f"{path}:{line}: {found} is not UTF-8; save the file with the encoding UTF-8") from error


def read_text(path: Path) -> str:
    """All of a UTF-8 file. Raises as :func:`read_bytes` and :func:`decode`."""
    return decode(path, read_bytes(path)[0])


def csv_rows(path: Path, text: str) -> Iterator[tuple[int, list[str]]]:
    """The rows of CSV that have cells, each with the line on which it begins. Raises SurveyError for broken ones."""
    reader, begin = csv.reader(io.StringIO(text, newline=""), strict=True), 1
    try:
        for cells in reader:
            line, begin = begin, reader.line_num + 1
            if cells:
                yield line, cells
    except csv.Error as error:
        raise SurveyError(f"{path}:{begin}: not a CSV line ({error}); correct the quotes") from error


def csv_text(rows: Iterable[Iterable[object]], ending: str = "\n") -> str:
    """Rows as CSV, each with its end of line."""
    out = io.StringIO(newline="")
    csv.writer(out, lineterminator=ending).writerows(rows)
    return out.getvalue()


def json_text(value: object) -> str:
    """A document that people read too. Raises ValueError for a number that JSON does not know."""
    return json.dumps(value, indent=1, ensure_ascii=False, allow_nan=False) + "\n"


def time_text() -> str:
    """Now, in UTC, as files say it."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@functools.lru_cache(1 << 16)
def id_problem(name: str) -> str | None:
    """Why ``name`` cannot be an id, or None. Ids become names of files and parts of references, so both stay safe."""
    if _PLAIN_ID(name):
        return None
    if not name:
        return "an id is empty; give it a name"
    if name in (".", "..") or name.startswith(".") or set(name) & FORBIDDEN_IN_IDS or not name.isprintable():
        allowed = "use letters, digits, '_', '-' and '.' (not in front), none of / \\ : @ , ; and not '..'"
        return f"{name!r} cannot be an id; {allowed}"
    if name != name.strip():
        return f"{name!r} cannot be an id; remove the blanks around it"
    if problem := formula_problem(name):
        return f"{name!r} cannot be an id; {problem}"
    if len(name.encode()) > _LONGEST_ID:
        return f"{name[:40]!r}... cannot be an id; use at most {_LONGEST_ID} bytes"
    if name.endswith(".") or name.partition(".")[0].upper() in _DEVICES:
        return f"{name!r} cannot be an id; Windows has no files of that name, choose another"
    return None


def formula_problem(text: str) -> str | None:
    """Why a spreadsheet that opens a table would compute ``text`` instead of showing it, or None."""
    if not text.startswith(_FORMULA):
        return None
    return f"spreadsheets take what begins with {text[0]!r} for a formula; put a letter before it"


def cell_text(text: str) -> str:
    """Text for a table that no program reads again: no spreadsheet takes it for a formula.

    An apostrophe in front, as people write it there; ids need none, because none begins like a formula.
    """
    return f"'{text}" if formula_problem(text) else text


def choice_hint(name: str, options: Iterable[str]) -> str:
    """What to do where one of few words is wanted: the nearest one, and all of them, once."""
    options = tuple(options)
    near, listed = suggestion(name, options), f"one of: {', '.join(options)}"
    return f"{near} ({listed})" if near.startswith("did you mean") else listed


def suggestion(name: str, known: Iterable[str]) -> str:
    """What to do about an unknown name: the nearest known one, else the known ones."""
    names, name = list(dict.fromkeys(known)), name[:80]  # the time to compare grows with the square of the length
    with_unit = [candidate for candidate in names if candidate.startswith(f"{name}_")]
    near = with_unit[:1] or difflib.get_close_matches(name, names, n=1, cutoff=0.6)
    if near:
        return f"did you mean {near[0]!r}?"
    if not names:
        return "none is known here"
    shown = ", ".join(names[:12]) + (", ..." if len(names) > 12 else "")
    return f"known: {shown}"
