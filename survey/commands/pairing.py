"""The command ``pairs``."""

import argparse
from pathlib import Path
from typing import Any

from survey.commands.common import DONE, is_set, print_json, say
from survey.commands.parser import project_folder


def declare_pairs(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``pairs`` to the commands."""
    parser = commands.add_parser(
        "pairs",
        help="pairs of a station's cameras, marker blocks or trackers, from what each of them saw",
        usage="labsurvey pairs lab --out closed   (labsurvey pairs FOLDER [--station ID] [--out DIR] [--joint])",
        description="Each camera is adjusted by itself before its own targets, which stand still; each marker block\n"
        "before a camera that stands still; then every two of them, without a common view.\n"
        "FOLDER/trajectories/EYE.csv (t,x,y,z,qx,qy,qz,qw) are read instead where they are there.\n"
        "DIR becomes a project in which every eye is a station, with observations/pairs.csv.",
        epilog="Next: labsurvey adjust DIR closes the loops",
        **shaped,
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder with image points")
    parser.add_argument("--station", metavar="ID", help="station whose eyes they are; default: the only one with two")
    parser.add_argument("--out", type=Path, metavar="DIR", help="write a project with the pairs to the new folder DIR")
    parser.add_argument(
        "--joint", action="store_true",
        help="write the station from all eyes at once: one pair from its first eye to each other, already closed",
    )  # fmt: skip
    parser.set_defaults(run=_pairs)


def _pairs(arguments: argparse.Namespace) -> int:
    if arguments.joint and arguments.out is None:
        arguments.parser.error("--joint says what is written; name --out DIR too")
    from survey.jobs.pairs import station_pairs

    outcome = station_pairs(arguments.folder, station=arguments.station, out=arguments.out, joint=arguments.joint)
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(outcome.text())
        say(arguments, *([f"written: {outcome.written}"] if outcome.written else []))
    return DONE
