"""The commands ``exclude`` and ``include``."""

import argparse

from survey.commands.common import DONE, Outcome, require_project, show
from survey.commands.parser import Commands, project_folder

NAMES = """\
Names: image:X/h05  epoch:h05  camera:X  target:board  target:X/h05/board  point:board/r7c2  point:B07
  image_point:X/h05/board/r7c2  spot:X/n01/s2  distances:B01-B02  table_angles:turntable/t09
A name alone will do where only one thing has it; an epoch goes before its readings, a reading before its point.
"""


def declare_exclude(commands: Commands) -> None:
    """Add ``exclude`` to the commands."""
    parser = commands.add(
        "exclude",
        _exclude,
        help="leave observations out from now on, with the reason",
        usage='labsurvey exclude lab X/h05 --reason "motion blur"   (labsurvey exclude FOLDER NAME [NAME ...] '
        "--reason TEXT)",
        description="Adds rows to FOLDER/observations/exclusions.csv, which every command obeys; nothing is "
        "adjusted.\n\n" + NAMES,
        epilog="Next: labsurvey adjust FOLDER",
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder")
    parser.add_argument("names", nargs="+", metavar="NAME", help="what is to be left out")
    parser.add_argument("--reason", required=True, metavar="TEXT", help="why; stands in the report")
    parser.add_argument("--author", default="", metavar="TEXT", help="who; default: $LABSURVEY_AUTHOR, or the user")


def declare_include(commands: Commands) -> None:
    """Add ``include`` to the commands."""
    parser = commands.add(
        "include",
        _include,
        help="take back what was excluded",
        usage="labsurvey include lab X/h05   (labsurvey include FOLDER NAME [NAME ...] [--reason TEXT])",
        description="Adds rows to FOLDER/observations/exclusions.csv that take others back; nothing is adjusted.\n\n"
        + NAMES,
        epilog="Next: labsurvey adjust FOLDER",
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder")
    parser.add_argument("names", nargs="+", metavar="NAME", help="what was left out, by its name in the file")
    parser.add_argument("--reason", default="", metavar="TEXT", help="why")
    parser.add_argument("--author", default="", metavar="TEXT", help="who; default: $LABSURVEY_AUTHOR, or the user")


def _exclude(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    from survey.jobs.excluding import exclude_job

    return _say(arguments, exclude_job(arguments.folder, arguments.names, arguments.reason, arguments.author))


def _include(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    from survey.jobs.excluding import include_job

    return _say(arguments, include_job(arguments.folder, arguments.names, arguments.reason, arguments.author))


def _say(arguments: argparse.Namespace, outcome: Outcome) -> int:
    show(arguments, outcome, then=f"\nNext: labsurvey adjust {arguments.folder}")
    return DONE
