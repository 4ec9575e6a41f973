"""The command ``completion``."""

import argparse
from typing import Any

from survey.commands.common import DONE

_EPILOG = """\
bash: labsurvey completion bash > ~/.local/share/bash-completion/completions/labsurvey
zsh:  labsurvey completion zsh > a file named _labsurvey in a folder of $fpath
fish: labsurvey completion fish > ~/.config/fish/completions/labsurvey.fish
Next: open a new shell, type labsurvey and press Tab
"""


def declare_completion(commands: Any, shaped: dict[str, Any]) -> None:
    """Add ``completion`` to the commands."""
    parser = commands.add_parser(
        "completion",
        help="print what makes Tab complete commands and flags in bash, zsh or fish",
        usage="labsurvey completion bash   (labsurvey completion SHELL)",
        description="Prints a script for the shell; nothing is installed.",
        epilog=_EPILOG,
        **shaped,
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), metavar="SHELL", help="bash, zsh or fish")
    parser.set_defaults(run=_completion, parser=parser)


def _completion(arguments: argparse.Namespace) -> int:
    from survey.cli import build_parser
    from survey.completion import completion_script

    print(completion_script(build_parser(), arguments.shell), end="")
    return DONE
