"""The command ``example``."""

import argparse
from pathlib import Path
from typing import Any

from survey.commands.common import DONE, is_set, not_negative, positive, print_json
from survey.examples import EXAMPLES, write_example


def declare_example(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``example`` to the commands."""
    listed = "\n".join(f"  {name:<15}{what}" for name, what in EXAMPLES.items())
    parser = commands.add_parser(
        "example",
        help="write a ready project folder to try things on",
        usage="labsurvey example full-lab lab   (labsurvey example NAME DIR [--seed N] [--jobs N])",
        description=f"Writes a project with rendered images and simulated readings.\n\n{listed}",
        epilog="Next: labsurvey adjust DIR",
        **shaped,
    )
    parser.add_argument("name", choices=tuple(EXAMPLES), metavar="NAME", help=", ".join(EXAMPLES))
    parser.add_argument("folder", type=Path, metavar="DIR", help="new folder")
    parser.add_argument("--seed", type=not_negative, default=1, metavar="N", help="other numbers give other noise")
    parser.add_argument("--jobs", type=positive, metavar="N", help="images at a time; default: one per processor")
    parser.set_defaults(run=_example)


def _example(arguments: argparse.Namespace) -> int:
    progress = not is_set(arguments, "quiet")
    n = write_example(arguments.name, arguments.folder, seed=arguments.seed, jobs=arguments.jobs, progress=progress)
    if is_set(arguments, "json"):
        print_json({"example": arguments.name, "folder": str(arguments.folder), "seed": arguments.seed, "images": n})
    else:
        print(
            f"{arguments.folder}: example {arguments.name}{f' with {n} images' if n else ''}\n"
            f"Next: labsurvey adjust {arguments.folder}"
        )
    return DONE
