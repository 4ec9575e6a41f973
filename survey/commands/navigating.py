"""The commands ``navigate`` and ``align``: where a head was, and how a body is to be turned."""

import argparse
from pathlib import Path

from survey.commands.common import DONE, TEST_FAILED, is_set, require_project, say, show
from survey.commands.parser import command, flag, project_folder


@command(
    "navigate",
    flag("folder", type=project_folder, metavar="FOLDER", help="folder with a survey.toml"),
    flag("--station", metavar="S", help="the head; default: the one that a table carries"),
    flag("--epochs", nargs="+", metavar="E", help="default: all that show beacons and no target"),
    flag("--interval", type=float, metavar="SECONDS", help="epochs follow each other: bridge by motion"),
    flag("--times", type=Path, metavar="CSV", help="instead, a table of epoch_id and time_s"),
    flag("--no-table", action="store_true", help="make no use of the table's angles"),
    flag("--unnamed", action="store_true", help="forget the names that spots have"),
    flag("--out", type=Path, metavar="DIR", help="write results below DIR, not below FOLDER"),
    help="find the pose of the head at every epoch from beacons, named or not",
    usage="labsurvey navigate lab   (labsurvey navigate FOLDER [--epochs E ...] [--station S] [--interval S])",
    description="Calibrates from the epochs that show targets, then gives the others a pose with covariance from\n"
    "their beacons; writes FOLDER/results/trajectory.csv and .json.",
    epilog="Next: open FOLDER/results/trajectory.csv",
)
def navigate(arguments: argparse.Namespace) -> int:
    """The command ``navigate``."""
    require_project(arguments.folder, arguments.out)
    from survey.jobs.navigating.job import NavigateRequest, navigate_job

    epochs = None if arguments.epochs is None else tuple(arguments.epochs)
    request = NavigateRequest(
        arguments.station, epochs, arguments.interval, not arguments.no_table, arguments.unnamed, arguments.times
    )
    outcome = navigate_job(arguments.folder, request, out=arguments.out, progress=not is_set(arguments, "quiet"))
    if is_set(arguments, "verbose"):
        say(arguments, *(f"{step}: {seconds:.2f} s" for step, seconds in outcome.seconds.items()))
    show(arguments, outcome, outcome.paths.values())
    return DONE


@command(
    "align",
    flag("folder", type=project_folder, metavar="FOLDER", help="project folder"),
    flag("--out", type=Path, metavar="DIR", help="write DIR/results instead of FOLDER/results"),
    help="say how a board or table is to be turned until it is aligned",
    usage="labsurvey align lab   (labsurvey align FOLDER)",
    description="Adjusts levels, laser spots and everything else of the project, and writes a working sheet for\n"
    "each [align.ID] of survey.toml: which foot to raise and which way to turn, by how much, and\n"
    "whether that is significant. Exit code 3 while something is left to do.",
    epilog="Next: turn, measure again, labsurvey align FOLDER",
)
def align(arguments: argparse.Namespace) -> int:
    """The command ``align``."""
    require_project(arguments.folder, arguments.out)
    from survey.jobs.aligning import align_job

    outcome = align_job(arguments.folder, out=arguments.out, progress=not is_set(arguments, "quiet"))
    show(arguments, outcome)
    return DONE if outcome.aligned else TEST_FAILED
