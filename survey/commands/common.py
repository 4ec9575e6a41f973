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
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import redirect_stdout
from pathlib import Path
from typing import NoReturn, Protocol, TextIO, cast

from adjust.model.errors import SurveyError
from survey.folder.kept import require_project as require_project
from survey.folder.messages import message, shown

DONE, FAILED, USAGE, TEST_FAILED, INTERRUPTED = 0, 1, 2, 3, 130
_OBJECTS = 400_000  # new ones before Python looks for cycles: loading modules makes 150,000 and no cycles
_TURN = 0.0005  # s that a thread which comes back from a kernel waits for one that runs Python
_MALLOC = {-3: 2**30, -1: 2**30, -2: 2**26, -8: 1}  # M_MMAP_THRESHOLD, _TRIM_THRESHOLD, _TOP_PAD (bytes), _ARENA_MAX
_OF_THE_DISK = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO)  # writing does not say which file


class _Shown:
    """An output that shows what is written to it."""

    def __init__(self, out: TextIO) -> None:
        self._out = out

    def write(self, text: str) -> int:
        """As that of a file."""
        return self._out.write(shown(text))

    def __getattr__(self, name: str) -> object:
        return getattr(self._out, name)


def run_command(program: str, build_parser: Callable[[], argparse.ArgumentParser], argv: Sequence[str] | None) -> int:
    """Parse and run a command line of ``program``; its exit code. What its owner can mend is one line on stderr."""
    if isinstance(sys.stdout, io.TextIOWrapper):  # a name that the terminal cannot show is no reason to stop
        sys.stdout.reconfigure(errors="backslashreplace")
    arguments = argparse.Namespace()
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
        say(arguments, *map(shown, getattr(error, "__notes__", ())))
        return INTERRUPTED if getattr(error, "interrupted", False) else FAILED
    except KeyboardInterrupt:
        print(f"\n{program}: interrupted", file=sys.stderr)
        return INTERRUPTED


def run_as_program(main: Callable[[], int]) -> NoReturn:
    """``main()`` as a program of its own, with little done for a memory that goes away with it.

    All cores work on parts of a survey already: threads of NumPy's and SciPy's OpenBLAS beside them mostly wait for
    each other, and would make the last digits depend on the number of cores.
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    gc.set_threshold(_OBJECTS)
    sys.setswitchinterval(_TURN)
    code = main()
    gc.freeze()  # at its end Python looks for cycles once more, in all that was ever loaded
    sys.exit(code)


def begin_adjusting() -> None:
    """Before a command that adjusts and ends: less to load, and memory that was freed is used again."""
    use_memory_again()
    load_late()


def use_memory_again() -> None:
    """Before the first thread and the first array.

    Large arrays come and go by the hundred; given back every time, the system clears as many pages as the command has
    points.
    """
    import ctypes  # here: --help starts without it

    os.environ.setdefault("NUMPY_MADVISE_HUGEPAGE", "0")  # pages of 2 MB are sought, and cleared whole, at every array
    os.environ.setdefault("ARROW_DEFAULT_MEMORY_POOL", "system")  # one place for memory, not one more of Arrow's own
    if sys.platform == "linux" and (mallopt := getattr(ctypes.CDLL(None), "mallopt", None)) is not None:  # of glibc
        for option, value in _MALLOC.items():
            mallopt(option, value)


def load_late() -> None:
    """Modules that load when their contents are first looked at: SciPy imports all of NumPy and needs little of it."""
    for name in ("numpy.f2py", "numpy.testing"):  # not numpy.ma: two threads that are first to use a lazy module fail
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

    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        """Print it and stop."""
        from importlib.metadata import PackageNotFoundError, version

        from adjust.model.errors import SurveyError
        from adjust.native.library import instruction_set

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


def print_json(value: Mapping[str, object]) -> None:
    """The summary as one JSON object on stdout."""
    print(json.dumps(value, indent=1, allow_nan=False))


class Outcome(Protocol):
    """What a job gives back."""

    def summary(self) -> dict[str, object]:
        """As plain values."""

    def text(self) -> str:
        """For people."""


def tell(arguments: argparse.Namespace, found: Mapping[str, object], text: str, written: Iterable[Path] = ()) -> None:
    """What was found as JSON where that is asked for, else the text; and what was written."""
    if is_set(arguments, "json"):
        print_json(found)
    else:
        print(text)
        say(arguments, *(f"written: {path}" for path in written))


def show(arguments: argparse.Namespace, outcome: Outcome, written: Iterable[Path] = (), then: str = "") -> None:
    """The outcome as JSON where that is asked for, else in words, ``then`` behind them, and what was written."""
    is_json = is_set(arguments, "json")
    tell(arguments, outcome.summary() if is_json else {}, "" if is_json else outcome.text() + then, written)


def tested(summary: Mapping[str, object]) -> int:
    """Exit code by what the summary of a solution says: cautious sigmas mislead nobody, and are no failure."""
    from survey.solution.verdict import misfits

    return TEST_FAILED if misfits(summary) else DONE
