"""The commands ``compare`` and ``cross-validate``."""

import argparse

from survey.commands.common import DONE, begin_adjusting, is_set, require_project, show
from survey.commands.parser import Commands, project_folder


def declare_compare(commands: Commands) -> None:
    """Add ``compare`` to the commands."""
    parser = commands.add(
        "compare",
        _compare,
        help="say what has moved and turned between two epochs",
        usage="labsurvey compare spring autumn   (labsurvey compare A B)",
        description="Adjusts both project folders, writes nothing, and tests the motion of every station against the\n"
        "next one of the same id in both, and of all common points and stations against those that are stable.",
        epilog="Next: labsurvey adjust B",
    )
    parser.add_argument("first", type=project_folder, metavar="A", help="project folder of the first epoch")
    parser.add_argument("second", type=project_folder, metavar="B", help="project folder of the second epoch")


def _compare(arguments: argparse.Namespace) -> int:
    require_project(arguments.first)
    require_project(arguments.second)
    begin_adjusting()
    from survey.jobs.comparing import compare_job

    outcome = compare_job(arguments.first, arguments.second, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome)
    return DONE


def declare_cross_validate(commands: Commands) -> None:
    """Add ``cross-validate`` to the commands."""
    parser = commands.add(
        "cross-validate",
        _cross_validate,
        help="compare the lenses of two halves of the epochs",
        usage="labsurvey cross-validate lab   (labsurvey cross-validate FOLDER [--distance METRES])",
        description="Adjusts the epochs in two halves, each by itself, and compares what the lenses see, with the\n"
        "motion of the camera taken out, with what their covariances expect. Writes nothing.",
        epilog="Next: labsurvey open FOLDER --at '#view=halves'",
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder")
    parser.add_argument("--distance", type=float, default=float("inf"), metavar="METRES",
                        help="how far the points are that are looked at (infinitely)")  # fmt: skip


def _cross_validate(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    begin_adjusting()
    from survey.jobs.cross_validation import cross_validate
    from survey.project import read

    progress = not is_set(arguments, "quiet")
    show(arguments, cross_validate(read(arguments.folder), arguments.distance, progress=progress))
    return DONE
