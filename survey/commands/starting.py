"""The commands ``init`` and ``detect``: a project begins, and its images tell their points."""

import argparse
from pathlib import Path

from survey.commands.common import DONE, is_set, positive, print_json, require_project, say, show
from survey.commands.parser import Commands, project_folder


def declare_init(commands: Commands) -> None:
    """Add ``init`` to the commands."""
    parser = commands.add(
        "init",
        _init,
        help="begin a project with a folder of images: cameras, sizes and boards recognised",
        usage="labsurvey init IMAGES lab   (labsurvey init IMAGES FOLDER)",
        description="Copies the images of IMAGES (one camera) or of its folders (one for each camera) to FOLDER/images "
        "and\nwrites a commented survey.toml. The name of an image is its epoch: images of the same name were taken "
        "at the\nsame moment.",
        epilog="Next: labsurvey open FOLDER, or labsurvey adjust FOLDER",
    )
    parser.add_argument("images", type=Path, metavar="IMAGES", help="images, or folders of them by camera")
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="new folder")


def _init(arguments: argparse.Namespace) -> int:
    from survey.jobs.starting import start_project

    outcome = start_project(arguments.images, arguments.folder)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(f"{outcome.text()}\nNext: labsurvey open {arguments.folder}")
    return DONE


def declare_detect(commands: Commands) -> None:
    """Add ``detect`` to the commands."""
    parser = commands.add(
        "detect",
        _detect,
        help="find the targets and beacons in the images of a project folder",
        usage="labsurvey detect lab   (labsurvey detect FOLDER [--all] [--jobs N] [--pictures])",
        description="Looks into images that are new or have changed, replaces their rows in "
        "FOLDER/observations/image_points.csv,\nand in spots.csv where beacons are asked for. The rows of other "
        "images stay.",
        epilog="Next: labsurvey adjust FOLDER",
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml and images/")
    parser.add_argument("--all", action="store_true", help="also in images that are as they were")
    parser.add_argument("--jobs", type=positive, metavar="N", help="images at a time; default: one per processor")
    parser.add_argument("--pictures", action="store_true", help="also write every image with what was found in it")


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
