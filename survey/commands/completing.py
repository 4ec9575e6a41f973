"""The command ``completion``, of ``labsurvey`` and of ``labcapture``."""

import argparse
from collections.abc import Callable
from functools import partial
from typing import Any

from survey.commands.common import DONE

_EPILOG = """\
bash: {program} completion bash > ~/.local/share/bash-completion/completions/{program}
zsh:  {program} completion zsh > a file named _{program} in a folder of $fpath
fish: {program} completion fish > ~/.config/fish/completions/{program}.fish
Next: open a new shell, type {program} and press Tab
"""


def declare_completion(
    program: str, build_parser: Callable[[], argparse.ArgumentParser], commands: Any, shaped: dict[str, Any]
) -> None:
    """Add ``completion`` to the commands of a program whose parser ``build_parser`` makes."""
    parser = commands.add_parser(
        "completion",
        help="print what makes Tab complete commands and flags in bash, zsh or fish",
        usage=f"{program} completion bash   ({program} completion SHELL)",
        description="Prints a script for the shell; nothing is installed.",
        epilog=_EPILOG.format(program=program),
        **shaped,
    )
    parser.add_argument("shell", choices=("bash", "zsh", "fish"), metavar="SHELL", help="bash, zsh or fish")
    parser.set_defaults(run=partial(_completion, build_parser))


def _completion(build_parser: Callable[[], argparse.ArgumentParser], arguments: argparse.Namespace) -> int:
    from survey.commands.completion import completion_script

    print(completion_script(build_parser(), arguments.shell), end="")
    return DONE
