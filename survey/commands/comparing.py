"""The commands ``compare`` and ``cross-validate``."""

import argparse

from survey.commands.common import DONE, begin_adjusting, is_set, require_project, show
from survey.commands.parser import command, flag, project_folder


@command(
    "compare",
    flag("first", type=project_folder, metavar="A", help="project folder of the first epoch"),
    flag("second", type=project_folder, metavar="B", help="project folder of the second epoch"),
    help="say what has moved and turned between two epochs",
    usage="labsurvey compare spring autumn   (labsurvey compare A B)",
    description="Adjusts both project folders, writes nothing, and tests the motion of every station against the\n"
    "next one of the same id in both, and of all common points and stations against those that are stable.",
    epilog="Next: labsurvey adjust B",
)
def compare(arguments: argparse.Namespace) -> int:
    """The command ``compare``."""
    require_project(arguments.first)
    require_project(arguments.second)
    begin_adjusting()
    from survey.jobs.comparing import compare_job

    outcome = compare_job(arguments.first, arguments.second, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome)
    return DONE


@command(
    "cross-validate",
    flag("folder", type=project_folder, metavar="FOLDER", help="project folder"),
    flag("--distance", type=float, default=float("inf"), metavar="METRES",
         help="how far the points are that are looked at (infinitely)"),
    help="compare the lenses of two halves of the epochs",
    usage="labsurvey cross-validate lab   (labsurvey cross-validate FOLDER [--distance METRES])",
    description="Adjusts the epochs in two halves, each by itself, and compares what the lenses see, with the\n"
    "motion of the camera taken out, with what their covariances expect. Writes nothing.",
    epilog="Next: labsurvey open FOLDER --at '#view=halves'",
)
def cross_validate(arguments: argparse.Namespace) -> int:
    """The command ``cross-validate``."""
    require_project(arguments.folder)
    begin_adjusting()
    from survey.jobs.cross_validation import cross_validate
    from survey.project import read

    progress = not is_set(arguments, "quiet")
    show(arguments, cross_validate(read(arguments.folder), arguments.distance, progress=progress))
    return DONE
