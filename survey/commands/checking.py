"""The command ``check``: what a survey cannot give, before anything is adjusted."""

import argparse
from typing import Any

from survey.commands.common import DONE, TEST_FAILED, is_set, print_json, require_project, say
from survey.commands.parser import project_folder


def declare_check(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``check`` to the commands."""
    parser = commands.add_parser(
        "check",
        help="what is weak or suspicious in a project, before it is adjusted",
        usage="labsurvey check lab   (labsurvey check FOLDER)",
        description="Looks at the observations of FOLDER without adjusting them: what they leave undetermined, points\n"
        "without redundancy, names that appear once, epochs without partners, images that are badly covered, boards\n"
        "too far or too flat, suspicious units and sigmas; and what to measure next. Writes nothing.\n"
        "The exit code is 3 where something would stop or spoil the adjustment.",
        epilog="Next: labsurvey adjust FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml")
    parser.set_defaults(run=_check)


def _check(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    from survey.planning.checking import check_job

    outcome = check_job(arguments.folder)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(outcome.text())
        say(arguments, f"Next: labsurvey adjust {arguments.folder}")
    return TEST_FAILED if outcome.n_problems else DONE
