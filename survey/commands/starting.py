"""How a project begins: the commands ``init``, ``detect``, ``example`` and ``schema`` of what survey.toml may hold."""

import argparse
import json
from pathlib import Path

from survey.commands.common import DONE, is_set, not_negative, positive, require_project, say, show, tell
from survey.commands.parser import command, flag, project_folder
from survey.examples import EXAMPLES, write_example


@command(
    "init",
    flag("images", type=Path, metavar="IMAGES", help="images, or folders of them by camera"),
    flag("folder", type=Path, metavar="FOLDER", help="new folder"),
    help="begin a project with a folder of images: cameras, sizes and boards recognised",
    usage="labsurvey init IMAGES lab   (labsurvey init IMAGES FOLDER)",
    description="Copies the images of IMAGES (one camera) or of its folders (one for each camera) to FOLDER/images "
    "and\nwrites a commented survey.toml. The name of an image is its epoch: images of the same name were taken "
    "at the\nsame moment.",
    epilog="Next: labsurvey open FOLDER, or labsurvey adjust FOLDER",
)
def init(arguments: argparse.Namespace) -> int:
    """The command ``init``."""
    from survey.jobs.starting import start_project

    outcome = start_project(arguments.images, arguments.folder)
    show(arguments, outcome, then=f"\nNext: labsurvey open {arguments.folder}")
    return DONE


@command(
    "detect",
    flag("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml and images/"),
    flag("--all", action="store_true", help="also in images that are as they were"),
    flag("--jobs", type=positive, metavar="N", help="images at a time; default: one per processor"),
    flag("--pictures", action="store_true", help="also write every image with what was found in it"),
    help="find the targets and beacons in the images of a project folder",
    usage="labsurvey detect lab   (labsurvey detect FOLDER [--all] [--jobs N] [--pictures])",
    description="Looks into images that are new or have changed, replaces their rows in "
    "FOLDER/observations/image_points.csv,\nand in spots.csv where beacons are asked for. The rows of other "
    "images stay.",
    epilog="Next: labsurvey adjust FOLDER",
)
def detect(arguments: argparse.Namespace) -> int:
    """The command ``detect``."""
    require_project(arguments.folder)
    from survey.jobs.detecting.job import detect_job

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


_LISTED = "\n".join(f"  {name:<15}{what}" for name, what in EXAMPLES.items())


@command(
    "example",
    flag("name", choices=tuple(EXAMPLES), metavar="NAME", help=", ".join(EXAMPLES)),
    flag("folder", type=Path, metavar="DIR", help="new folder"),
    flag("--seed", type=not_negative, default=1, metavar="N", help="other numbers give other noise"),
    flag("--jobs", type=positive, metavar="N", help="images at a time; default: one per processor"),
    help="write a ready project folder to try things on",
    usage="labsurvey example full-lab lab   (labsurvey example NAME DIR [--seed N] [--jobs N])",
    description=f"Writes a project with rendered images and simulated readings.\n\n{_LISTED}",
    epilog="Next: labsurvey adjust DIR",
)
def example(arguments: argparse.Namespace) -> int:
    """The command ``example``."""
    progress = not is_set(arguments, "quiet")
    n = write_example(arguments.name, arguments.folder, seed=arguments.seed, jobs=arguments.jobs, progress=progress)
    found = {"example": arguments.name, "folder": str(arguments.folder), "seed": arguments.seed, "images": n}
    tell(arguments, found, f"{arguments.folder}: example {arguments.name}{f' with {n} images' if n else ''}\n"
         f"Next: labsurvey adjust {arguments.folder}")  # fmt: skip
    return DONE


@command(
    "schema",
    flag("--markdown", action="store_true", help="the reference as a page, not the schema"),
    flag("--out", type=Path, metavar="FILE", help="write FILE, not to stdout"),
    help="print a JSON schema of survey.toml for editors, or its reference",
    usage="labsurvey schema --out lab/survey.schema.json   (labsurvey schema [--markdown] [--out FILE])",
    description="Prints a JSON schema of survey.toml, made from the declarations that check it. With the first\n"
    "line #:schema ./survey.schema.json in survey.toml, editors complete and check its keys.\n"
    "With --markdown: the reference of all keys and of all columns of the tables.",
    epilog="Next: write #:schema ./survey.schema.json above the first line of survey.toml",
)
def schema(arguments: argparse.Namespace) -> int:
    """The command ``schema``."""
    if arguments.markdown:
        from survey.project.reference import reference_page

        text = reference_page()
    else:
        from survey.project.reference import survey_schema

        text = json.dumps(survey_schema(), indent=1, ensure_ascii=False) + "\n"
    if arguments.out is None:
        print(text, end="")
    else:
        from survey.folder.text import atomic_write

        atomic_write(arguments.out, text)
    return DONE
