"""What all commands share: exit codes, flags, output, and the check of a project folder."""

import argparse
import errno
import gc
import importlib.util
import io
import json
import os
import re
import sys
import unicodedata
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any, NoReturn, TextIO, cast

from adjust.model.errors import SurveyError

DONE, FAILED, USAGE, TEST_FAILED, INTERRUPTED = 0, 1, 2, 3, 130
_OBJECTS = 100_000  # new ones before Python looks for cycles: loading modules makes many and no cycles
_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)  # writing does not say which file


def message(error: SurveyError | OSError) -> str:
    """An error as its reader should see it."""
    if isinstance(error, OSError):
        where = "" if error.filename is None else f"{error.filename}: "
        text = f"{where}{error.strerror}; check the name, the permissions and the free space"
    else:
        text = str(error)
    return shown(text)


def shown(text: str) -> str:
    """A text with escapes for what is no letter: names and titles out of a file must not drive a terminal."""
    if text.isprintable():
        return text
    return "".join(c if _is_harmless(c) else c.encode("unicode_escape").decode() for c in text)


def _is_harmless(sign: str) -> bool:
    return sign.isprintable() or sign in "\n\t" or unicodedata.category(sign) == "Zs"  # narrow spaces


class _Shown:
    """An output that shows what is written to it."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def write(self, text: str) -> int:
        """As that of a file."""
        return self._out.write(shown(text))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._out, name)


def run_command(program: str, build_parser: Callable[[], argparse.ArgumentParser], argv: Sequence[str] | None) -> int:
    """Parse and run a command line of ``program``; its exit code. What its owner can mend is one line on stderr."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a name that the terminal cannot show is no reason to stop
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        try:
            arguments = build_parser().parse_args(argv)
            with redirect_stdout(cast(TextIO, _Shown(sys.stdout))):
                return int(arguments.run(arguments))
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        # whoever read our output has left; a second complaint at exit would be noise
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return FAILED
    except (SurveyError, OSError) as error:
        if isinstance(error, OSError) and error.filename is None and error.errno not in _OF_THE_DISK:
            raise  # not about a file of the user
        print(f"{program}: error: {message(error)}", file=sys.stderr)
        return INTERRUPTED if getattr(error, "interrupted", False) else FAILED
    except KeyboardInterrupt:
        print(f"\n{program}: interrupted", file=sys.stderr)
        return INTERRUPTED


def run_as_program(main: Callable[[], int]) -> NoReturn:
    """``main()`` as a program of its own, with little done for a memory that goes away with it."""
    gc.set_threshold(_OBJECTS)
    code = main()
    gc.freeze()  # at its end Python looks for cycles once more, in all that was ever loaded
    sys.exit(code)


def postpone(names: Sequence[str] = ("numpy.f2py", "numpy.testing")) -> None:
    """Modules that load when their contents are first looked at: SciPy imports all of NumPy and needs little of it."""
    for name in names:
        spec = None if name in sys.modules else importlib.util.find_spec(name)
        if spec is not None and spec.loader is not None:
            spec.loader = importlib.util.LazyLoader(spec.loader)
            module = importlib.util.module_from_spec(spec)
            sys.modules[name] = module
            spec.loader.exec_module(module)
            parent, _, child = name.rpartition(".")
            setattr(sys.modules[parent], child, module)


class Version(argparse.Action):
    """Prints the version and which vector instructions run, looked up only when it is asked for."""

    def __call__(self, parser: argparse.ArgumentParser, *_: Any) -> None:
        """Print it and stop."""
        from importlib.metadata import PackageNotFoundError, version

        from adjust.model.errors import SurveyError
        from adjust.native import instruction_set

        try:
            core = f"(native core: {instruction_set()})"
        except SurveyError as error:
            parser.exit(1, f"{parser.prog}: {error}\n")
        try:
            print(f"{parser.prog} {version('labsurvey')} {core}")
        except PackageNotFoundError:
            print(f"{parser.prog}, run from its source folder without being installed {core}")
        parser.exit()


def positive(text: str) -> int:
    """A count from the command line, 1 or more."""
    return _at_least(1, text)


def not_negative(text: str) -> int:
    """A number from the command line, 0 or more."""
    return _at_least(0, text)


def _at_least(least: int, text: str) -> int:
    value = int(text) if re.fullmatch(r"\s*[+-]?\d{1,18}\s*", text, re.ASCII) else None
    if value is None or value < least:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a whole number, {least} or more")
    return value


def is_set(arguments: argparse.Namespace, flag: str) -> bool:
    """Whether a flag that may stand before or after the command is set."""
    return bool(getattr(arguments, flag, False))


def say(arguments: argparse.Namespace, *lines: str) -> None:
    """Messages beside the results."""
    if not is_set(arguments, "quiet"):
        for line in lines:
            print(line, file=sys.stderr)


def print_json(value: Mapping[str, Any]) -> None:
    """The summary as one JSON object on stdout."""
    print(json.dumps(value, indent=1, allow_nan=False))


def require_project(folder: Path, out: Path | None = None) -> None:
    """Raises SurveyError where a folder is no project; there and in ``out`` undoes what was killed half way."""
    for place in (folder, *([out] if out is not None else [])):
        undo_killed(place)
    if folder.is_file():
        raise SurveyError(f"{folder}: is a file; give the folder that holds survey.toml, here {_holder(folder)}")
    if not folder.is_dir():
        meant = _nearest(folder)
        raise SurveyError(f"{folder}: no such folder; {meant}'labsurvey example full-lab lab' writes a ready one")
    if not (folder / "survey.toml").is_file():
        inside = _projects(folder)
        hint = f", as {inside[0]} does" if inside else ""
        raise SurveyError(f"{folder}: there is no survey.toml in it; give the folder that holds one{hint}")


def _holder(file: Path) -> str:
    """The nearest folder above a file that is a project, or where to look."""
    return next((str(p) for p in file.parents if (p / "survey.toml").is_file()), "none above it does")


def _nearest(folder: Path) -> str:
    """The project beside a folder that is not there whose name is the most like its own."""
    from survey.folder.text import suggestion

    by_name = {p.name: str(p) for p in _projects(folder.parent)}
    near = suggestion(folder.name, by_name)
    found = next((by_name[name] for name in by_name if near == f"did you mean {name!r}?"), None)
    return "" if found is None else f"did you mean {found!r}? "


def _projects(place: Path) -> list[Path]:
    """The folders in ``place`` that hold a survey.toml."""
    try:
        return sorted(p.parent for p in place.glob("*/survey.toml"))
    except OSError:
        return []


def undo_killed(folder: Path) -> None:
    """A mixture of old and new must not be taken for a project."""
    if (folder / ".before").is_dir():
        from survey.folder.replacing import recover_killed

        if recover_killed(folder):
            print(f"labsurvey: {folder}: a command that was killed while it replaced files has been undone",
                  file=sys.stderr)  # fmt: skip


def tested(summary: Mapping[str, Any]) -> int:
    """Exit code by what the summary of a solution says: cautious sigmas mislead nobody, and are no failure."""
    from survey.solution.verdict import misfits

    return TEST_FAILED if misfits(summary) else DONE
