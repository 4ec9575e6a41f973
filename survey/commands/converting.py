"""The command ``convert``."""

import argparse
from pathlib import Path
from typing import Any

from survey.commands.common import DONE, is_set, print_json, require_project


def declare_convert(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``convert`` to the commands."""
    parser = commands.add_parser(
        "convert",
        help="pose networks between g2o files and project folders",
        usage="labsurvey convert garage.g2o garage   (labsurvey convert FROM TO [--format g2o|project])",
        description="A g2o file becomes a project whose first station (or what FIX names) is held; the pairs of a\n"
        "project become a g2o file, with adjusted poses where there are results. TO must be new.",
        epilog="Next: labsurvey adjust TO",
        **shaped,
    )
    parser.add_argument("source", type=Path, metavar="FROM", help="g2o file, or project folder")
    parser.add_argument("target", type=Path, metavar="TO", help="new project folder, or new file ending with .g2o")
    parser.add_argument("--format", choices=("g2o", "project"), help="of TO; default: by its ending")
    parser.add_argument(
        "--information", choices=("tangent", "quaternion"), default="tangent",
        help="rotation part of g2o's information: of the rotation vector, or of the quaternion as g2o itself means it",
    )  # fmt: skip
    parser.set_defaults(run=_convert, parser=parser)


def _convert(arguments: argparse.Namespace) -> int:
    if arguments.source.is_dir():
        require_project(arguments.source)
    from survey.converting import convert_job

    outcome = convert_job(
        arguments.source, arguments.target, format=arguments.format, information=arguments.information
    )
    if is_set(arguments, "json"):
        print_json(outcome.summary())
    else:
        print(outcome.text() + (f"\nNext: labsurvey adjust {outcome.target}" if outcome.format == "project" else ""))
    return DONE
