"""The command ``init``."""

import argparse
from pathlib import Path
from typing import Any

from survey.commands.common import DONE, is_set, print_json


def declare_init(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``init`` to the commands."""
    parser = commands.add_parser(
        "init",
        help="begin a project with a folder of images: cameras, sizes and boards recognised",
        usage="labsurvey init IMAGES lab   (labsurvey init IMAGES FOLDER)",
        description="Copies the images of IMAGES (one camera) or of its folders (one for each camera) to FOLDER/images "
        "and\nwrites a commented survey.toml. The name of an image is its epoch: images of the same name were taken "
        "at the\nsame moment.",
        epilog="Next: labsurvey open FOLDER, or labsurvey adjust FOLDER",
        **shaped,
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", help="images, or folders of them by camera")
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="new folder")
    parser.set_defaults(run=_init)


def _init(arguments: argparse.Namespace) -> int:
    from survey.jobs.starting import start_project

    outcome = start_project(arguments.images, arguments.folder)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(f"{outcome.text()}\nNext: labsurvey open {arguments.folder}")
    return DONE
