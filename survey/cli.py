"""The command ``labsurvey``: arguments in, exit code out. The commands are in ``survey.commands``.

Exit codes: 0 done, 1 something its owner can mend, 2 wrong usage, 3 solved but the global test failed (residuals larger
than the sigmas say), 130 interrupted.
Results go to stdout, progress and messages to stderr. Heavy imports happen inside the commands.
"""

from collections.abc import Sequence
from functools import cache, partial
from typing import NoReturn

from survey.commands.adjusting import adjust, report
from survey.commands.common import DONE, FAILED, INTERRUPTED, TEST_FAILED, USAGE, run_as_program, run_command
from survey.commands.comparing import compare, cross_validate
from survey.commands.completion import declare_completion
from survey.commands.converting import convert
from survey.commands.excluding import exclude, include
from survey.commands.navigating import align, navigate
from survey.commands.networks import add, pairs, remove, trackers
from survey.commands.opening import open_project, runs
from survey.commands.parser import Parser, program_parser
from survey.commands.planning import check, plan
from survey.commands.starting import detect, example, init, schema

__all__ = ["DONE", "FAILED", "INTERRUPTED", "TEST_FAILED", "USAGE", "build_parser", "main"]

_OPENING = "labsurvey adjust lab"
_DESCRIPTION = """\
Adjusts a whole laboratory at once: cameras, turntable, beacons, relay stations and tape readings.

  labsurvey example full-lab lab      write a ready project into the folder lab
  labsurvey adjust lab                detect targets in its images, adjust everything, write lab/results
"""
_EPILOG = """\
Next: labsurvey example full-lab lab
Help for one command: labsurvey adjust --help
Exit codes: 0 done, 1 error in the project, 2 wrong usage, 3 solved, but something does not fit.
"""
_COMMANDS = (
    adjust,
    init,
    open_project,
    detect,
    report,
    check,
    plan,
    add,
    remove,
    exclude,
    include,
    runs,
    convert,
    pairs,
    trackers,
    navigate,
    align,
    compare,
    cross_validate,
    example,
    schema,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line; the exit code."""
    return run_command("labsurvey", build_parser, argv)


def program() -> NoReturn:
    """The installed command."""
    run_as_program(main)


@cache
def build_parser() -> Parser:
    """All commands and flags."""
    flags = {
        "--json": "print the summary as one JSON object", "-v --verbose": "say more on stderr",
        "--quiet": "no progress bars and no messages on stderr",
    }  # fmt: skip
    completion = partial(declare_completion, "labsurvey", build_parser)
    return program_parser("labsurvey", _OPENING, _DESCRIPTION, _EPILOG, flags, (*_COMMANDS, completion))


if __name__ == "__main__":
    program()
