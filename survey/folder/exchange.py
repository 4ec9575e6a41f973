"""Two folders that trade places in one step: whoever opens the name finds the old one complete or the new one."""

import ctypes
import errno
import os
import shutil
from pathlib import Path

from survey.folder.locking import holder_of

MARK = ".placed"
_HERE, _EXCHANGE = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of <linux/fs.h>; RENAME_SWAP of macOS is 2, too


class CannotTradeError(Exception):
    """The file system cannot do it; nothing was changed."""


def trade(new: Path, there: Path) -> None:
    """Let two folders trade places. ``new`` holds MARK, by which its later place is known. Raises CannotTradeError."""
    code = _renameat2(new, there)
    if code:
        raise CannotTradeError(os.strerror(code))


def _renameat2(new: Path, there: Path) -> int:
    """The number of the error, 0 where they have traded places: by Linux' call of this name, or by macOS' own."""
    names = os.fsencode(new), os.fsencode(there)
    try:
        system = ctypes.CDLL(None, use_errno=True)
        if hasattr(system, "renameat2"):
            failed = system.renameat2(_HERE, names[0], _HERE, names[1], _EXCHANGE)
        else:
            failed = system.renamex_np(*names, _EXCHANGE)
    except (AttributeError, OSError, TypeError):
        return errno.ENOSYS
    return ctypes.get_errno() if failed else 0


def complete_from(old: Path, new: Path) -> None:
    """Give ``new`` what ``old`` holds besides, by second names, and MARK. Raises CannotTradeError."""
    (old / MARK).unlink(missing_ok=True)
    try:
        _take(old, new)
    except (OSError, NotImplementedError) as error:  # second names are not everywhere, and not of everybody's files
        raise CannotTradeError(str(error)) from error
    (new / MARK).touch()


def _take(old: Path, new: Path) -> None:
    with os.scandir(old) as entries:
        found = [e for e in entries if not os.path.lexists(new / e.name) and not _is_leftover(e)]
    for entry in found:
        if entry.is_dir(follow_symlinks=False):
            (new / entry.name).mkdir()
            _take(Path(entry.path), new / entry.name)
        else:
            os.link(entry.path, new / entry.name, follow_symlinks=False)
    _take_rights(old, new)


def _take_rights(old: Path, new: Path) -> None:
    status = old.stat()
    if (status.st_uid, status.st_gid) != (new.stat().st_uid, new.stat().st_gid):
        os.chown(new, status.st_uid, status.st_gid)
    shutil.copymode(old, new)


def _is_leftover(entry: "os.DirEntry[str]") -> bool:
    """A temporary file that nobody writes any more."""
    is_temporary = entry.name.startswith(".") and entry.name.endswith(".tmp") and entry.is_file(follow_symlinks=False)
    return is_temporary and holder_of(Path(entry.path)) is None


def carry_over(old: Path, new: Path) -> None:
    """What somebody put into ``old`` at the last moment; then ``new`` is an ordinary folder."""
    with os.scandir(old) as entries:
        late = [e.name for e in entries if not os.path.lexists(new / e.name) and not _is_leftover(e)]
    for name in late:
        os.rename(old / name, new / name)
    (new / MARK).unlink(missing_ok=True)
