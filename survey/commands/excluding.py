"""The commands ``exclude`` and ``include``."""

import argparse

from survey.commands.common import DONE, require_project, show
from survey.commands.parser import Argument, command, flag, project_folder

NAMES = """\
Names: image:X/h05  epoch:h05  camera:X  target:board  target:X/h05/board  point:board/r7c2  point:B07
  image_point:X/h05/board/r7c2  spot:X/n01/s2  distances:B01-B02  table_angles:turntable/t09
A name alone will do where only one thing has it; an epoch goes before its readings, a reading before its point.
"""


def names(folder: str, what: str, why: str, required: bool = False) -> tuple[Argument, ...]:
    """Folder, names of observations, the reason and who decides. required: whether a reason has to be given."""
    return (
        flag("folder", type=project_folder, metavar="FOLDER", help=folder),
        flag("names", nargs="+", metavar="NAME", help=what),
        flag("--reason", required=required, default="", metavar="TEXT", help=why),
        flag("--author", default="", metavar="TEXT", help="who; default: $LABSURVEY_AUTHOR, or the user"),
    )


@command(
    "exclude",
    *names("project folder", "what is to be left out", "why; stands in the report", required=True),
    help="leave observations out from now on, with the reason",
    usage='labsurvey exclude lab X/h05 --reason "motion blur"   (labsurvey exclude FOLDER NAME [NAME ...] '
    "--reason TEXT)",
    description="Adds rows to FOLDER/observations/exclusions.csv, which every command obeys; nothing is adjusted.\n\n"
    + NAMES,
    epilog="Next: labsurvey adjust FOLDER",
)
def exclude(arguments: argparse.Namespace) -> int:
    """The command ``exclude``."""
    return _change(arguments, True)


@command(
    "include",
    *names("project folder", "what was left out, by its name in the file", "why"),
    help="take back what was excluded",
    usage="labsurvey include lab X/h05   (labsurvey include FOLDER NAME [NAME ...] [--reason TEXT])",
    description="Adds rows to FOLDER/observations/exclusions.csv that take others back; nothing is adjusted.\n\n"
    + NAMES,
    epilog="Next: labsurvey adjust FOLDER",
)
def include(arguments: argparse.Namespace) -> int:
    """The command ``include``."""
    return _change(arguments, False)


def _change(arguments: argparse.Namespace, excluding: bool) -> int:
    require_project(arguments.folder)
    from survey.jobs.excluding import exclude_job, include_job

    job = exclude_job if excluding else include_job
    outcome = job(arguments.folder, arguments.names, arguments.reason, arguments.author)
    show(arguments, outcome, then=f"\nNext: labsurvey adjust {arguments.folder}")
    return DONE
