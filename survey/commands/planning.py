"""The command ``plan``."""

import argparse
from pathlib import Path
from typing import Any

from survey.commands.common import DONE, is_set, print_json, require_project


def declare_plan(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``plan`` to the commands."""
    parser = commands.add_parser(
        "plan",
        help="say what a network of pairs will tell, before it is measured",
        usage="labsurvey plan lab   (labsurvey plan FOLDER)",
        description="Counts conditions and redundancy from survey.toml and observations/pairs.csv, which needs no "
        "values yet, only pair_id,a_id,b_id; names the pairs that close no loop.",
        epilog="Next: labsurvey adjust FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="folder with a survey.toml")
    parser.set_defaults(run=_plan, parser=parser)


def _plan(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    from survey.network import plan_job

    outcome = plan_job(arguments.folder)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(f"{outcome.text()}\nNext: labsurvey adjust {arguments.folder}")
    return DONE
