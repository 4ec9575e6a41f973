"""The command ``detect``."""

import argparse
from typing import Any

from survey.commands.common import DONE, is_set, positive, require_project, say, show
from survey.commands.parser import project_folder


def declare_detect(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``detect`` to the commands."""
    parser = commands.add_parser(
        "detect",
        help="find the targets and beacons in the images of a project folder",
        usage="labsurvey detect lab   (labsurvey detect FOLDER [--all] [--jobs N] [--pictures])",
        description="Looks into images that are new or have changed, replaces their rows in "
        "FOLDER/observations/image_points.csv,\nand in spots.csv where beacons are asked for. The rows of other "
        "images stay.",
        epilog="Next: labsurvey adjust FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml and images/")
    parser.add_argument("--all", action="store_true", help="also in images that are as they were")
    parser.add_argument("--jobs", type=positive, metavar="N", help="images at a time; default: one per processor")
    parser.add_argument("--pictures", action="store_true", help="also write every image with what was found in it")
    parser.set_defaults(run=_detect)


def _detect(arguments: argparse.Namespace) -> int:
    require_project(arguments.folder)
    from survey.jobs.detecting import detect_job

    outcome = detect_job(
        arguments.folder,
        jobs=arguments.jobs,
        pictures=arguments.pictures,
        progress=not is_set(arguments, "quiet"),
        everything=arguments.all,
    )
    if is_set(arguments, "verbose"):
        say(arguments, *outcome.messages)
    show(arguments, outcome, then=f"\nNext: labsurvey adjust {arguments.folder}")
    return DONE
