"""The commands ``exclude`` and ``include``."""

import argparse
from functools import partial

from survey.commands.common import DONE, require_project, show
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
        partial(_change, True),
        help="leave observations out from now on, with the reason",
        usage='labsurvey exclude lab X/h05 --reason "motion blur"   (labsurvey exclude FOLDER NAME [NAME ...] '
        "--reason TEXT)",
        description="Adds rows to FOLDER/observations/exclusions.csv, which every command obeys; nothing is "
        "adjusted.\n\n" + NAMES,
        epilog="Next: labsurvey adjust FOLDER",
    )
    add_names(parser, "project folder", "what is to be left out", "why; stands in the report", required=True)


def declare_include(commands: Commands) -> None:
    """Add ``include`` to the commands."""
    parser = commands.add(
        "include",
        partial(_change, False),
        help="take back what was excluded",
        usage="labsurvey include lab X/h05   (labsurvey include FOLDER NAME [NAME ...] [--reason TEXT])",
        description="Adds rows to FOLDER/observations/exclusions.csv that take others back; nothing is adjusted.\n\n"
        + NAMES,
        epilog="Next: labsurvey adjust FOLDER",
    )
    add_names(parser, "project folder", "what was left out, by its name in the file", "why")


def add_names(parser: argparse.ArgumentParser, folder: str, names: str, why: str, required: bool = False) -> None:
    """Folder, names of observations, the reason and who decides. required: whether a reason has to be given."""
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help=folder)
    parser.add_argument("names", nargs="+", metavar="NAME", help=names)
    parser.add_argument("--reason", required=required, default="", metavar="TEXT", help=why)
    parser.add_argument("--author", default="", metavar="TEXT", help="who; default: $LABSURVEY_AUTHOR, or the user")


def _change(excluding: bool, arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    from survey.jobs.excluding import exclude_job, include_job

    job = exclude_job if excluding else include_job
    outcome = job(arguments.folder, arguments.names, arguments.reason, arguments.author)
    show(arguments, outcome, then=f"\nNext: labsurvey adjust {arguments.folder}")
    return DONE
