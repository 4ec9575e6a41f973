"""The command ``open``."""

import argparse
import os
from typing import Any

from survey.commands.common import DONE, not_negative, say
from survey.commands.parser import project_folder


def declare_open(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``open`` to the commands."""
    parser = commands.add_parser(
        "open",
        help="look at a project in the browser: find what is wrong, leave it out, adjust again",
        usage="labsurvey open lab   (labsurvey open FOLDER [--at PLACE] [--port N] [--read-only] [--no-browser])",
        description="Serves the workbench of a project on this machine alone, under an address that holds a token, "
        "until Ctrl-C. What is decided there goes to observations/exclusions.csv and survey.toml at once; results and "
        "runs are written by Save.\n\nFrom another machine: ssh -L 8790:127.0.0.1:8790 THIS_MACHINE",
        epilog="Next: labsurvey adjust FOLDER, labsurvey runs FOLDER",
        **shaped,
    )
    parser.add_argument("folder", type=project_folder, metavar="FOLDER", help="project folder")
    parser.add_argument("--at", metavar="PLACE", default="", help="what to show first: '#image=X/hX05', '#point=B07'")
    parser.add_argument("--port", type=not_negative, default=8790, metavar="N", help="0 takes a free one")
    parser.add_argument("--host", default="127.0.0.1", metavar="ADDRESS", help="loopback: 127.0.0.1 or ::1")
    parser.add_argument("--read-only", action="store_true", help="look only; nothing can be changed")
    parser.add_argument("--no-browser", action="store_true", help="print the address, open no browser")
    parser.set_defaults(run=_open)


def _open(arguments: argparse.Namespace) -> int:
    from survey.folder.kept import require_project

    require_project(arguments.folder)
    from survey.workbench.guard import loopback_address
    from survey.workbench.opening import open_folder

    host = loopback_address(arguments.host, arguments.port)
    read_only = arguments.read_only or not os.access(arguments.folder, os.W_OK)
    if read_only and not arguments.read_only:
        say(arguments, f"{arguments.folder}: cannot be written; it is open for reading only")
    open_folder(arguments.folder, host, arguments.port, read_only, not arguments.no_browser,
                lambda line: say(arguments, line), arguments.at)  # fmt: skip
    return DONE
