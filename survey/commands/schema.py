"""The command ``schema``: what a ``survey.toml`` may hold, for editors and for people."""

import argparse
import json
from pathlib import Path
from typing import Any

from survey.commands.common import DONE


def declare_schema(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``schema`` to the commands."""
    parser = commands.add_parser(
        "schema",
        help="print a JSON schema of survey.toml for editors, or its reference",
        usage="labsurvey schema --out lab/survey.schema.json   (labsurvey schema [--markdown] [--out FILE])",
        description="Prints a JSON schema of survey.toml, made from the declarations that check it. With the first\n"
        "line #:schema ./survey.schema.json in survey.toml, editors complete and check its keys.\n"
        "With --markdown: the reference of all keys and of all columns of the tables.",
        epilog="Next: write #:schema ./survey.schema.json above the first line of survey.toml",
        **shaped,
    )
    parser.add_argument("--markdown", action="store_true", help="the reference as a page, not the schema")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write FILE, not to stdout")
    parser.set_defaults(run=_schema)


def _schema(arguments: argparse.Namespace) -> int:
    if arguments.markdown:
        from survey.project.reference import reference_page

        text = reference_page()
    else:
        from survey.project.schema import survey_schema

        text = json.dumps(survey_schema(), indent=1, ensure_ascii=False) + "\n"
    if arguments.out is None:
        print(text, end="")
    else:
        from survey.folder.text import atomic_write

        atomic_write(arguments.out, text)
    return DONE
