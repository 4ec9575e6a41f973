"""The command ``compare``."""

import argparse
from typing import Any

from survey.commands.common import DONE, is_set, require_project, show
from survey.commands.parser import project_folder


def declare_compare(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``compare`` to the commands."""
    parser = commands.add_parser(
        "compare",
        help="say what has moved and turned between two epochs",
        usage="labsurvey compare spring autumn   (labsurvey compare A B)",
        description="Adjusts both project folders, writes nothing, and tests the motion of every station against the\n"
        "next one of the same id in both, and of all common points and stations against those that are stable.",
        epilog="Next: labsurvey adjust B",
        **shaped,
    )
    parser.add_argument("first", type=project_folder, metavar="A", help="project folder of the first epoch")
    parser.add_argument("second", type=project_folder, metavar="B", help="project folder of the second epoch")
    parser.set_defaults(run=_compare)


def _compare(arguments: argparse.Namespace) -> int:
    require_project(arguments.first)
    require_project(arguments.second)
    from survey.jobs.comparing import compare_job

    outcome = compare_job(arguments.first, arguments.second, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome)
    return DONE
