"""The command ``align``."""

import argparse
from pathlib import Path
from typing import Any

from survey.commands.common import DONE, TEST_FAILED, is_set, require_project, show
from survey.commands.parser import project_folder


def declare_align(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``align`` to the commands."""
    parser = commands.add_parser(
        "align",
        help="say how a board or table is to be turned until it is aligned",
        usage="labsurvey align lab   (labsurvey align FOLDER)",
        description="Adjusts levels, laser spots and everything else of the project, and writes a working sheet for\n"
        "each [align.ID] of survey.toml: which foot to raise and which way to turn, by how much, and\n"
        "whether that is significant. Exit code 3 while something is left to do.",
        epilog="Next: turn, measure again, labsurvey align FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write DIR/results instead of FOLDER/results")
    parser.set_defaults(run=_align)


def _align(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder, arguments.out)
    from survey.jobs.aligning import align_job

    outcome = align_job(arguments.folder, out=arguments.out, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome)
    return DONE if outcome.aligned else TEST_FAILED
