"""The parser of both programs: wrong usage is said in one line that offers what was probably meant."""

import argparse
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NoReturn, Protocol

from survey.commands.common import Version

_CHOICE = re.compile(
    r"argument (?P<what>.+?): invalid choice: '?(?P<found>.*?)'? \(choose from (?P<known>.*)\)", re.DOTALL
)
_NUMBER = re.compile(r"argument (?P<what>.+?): invalid (?:int|float) value: '(?P<found>.*)'", re.DOTALL)
_FLAG = re.compile(r"(?<![\w-])--[a-z][a-z-]*")


class Takes(Protocol):
    """What arguments can be added to: a parser, or a group in it."""

    def add_argument(self, *names: str, **how: Any) -> argparse.Action:
        """As argparse's."""


class Parser(argparse.ArgumentParser):
    """As argparse's, with other words where the usage is wrong; commands are of this class too.

    arguments: all that it takes, in their order; commands: those of a program, by name, with a line of help each.
    """

    def __init__(self, prog: str | None = None, parents: "Sequence[Parser]" = (), **options: Any) -> None:
        self.arguments: list[argparse.Action] = []
        self.commands: dict[str, tuple[str, Parser]] = {}
        super().__init__(prog, parents=parents, **options)
        self.arguments += [argument for parent in parents for argument in parent.arguments]

    def add_argument(self, *names: str, **how: Any) -> argparse.Action:
        """As argparse's, and it is remembered."""
        self.arguments.append(super().add_argument(*names, **how))
        return self.arguments[-1]

    def add_group(self, title: str, arguments: "Iterable[Argument]") -> None:
        """Arguments that stand together in the help."""
        place = self.add_argument_group(title)
        self.arguments += [argument(place) for argument in arguments]

    def add_subparsers(self, **options: Any) -> Any:
        """Commands are called by the program's name; argparse would put the whole usage in front of them."""
        return super().add_subparsers(**{"prog": self.prog, **options})

    def parse_args(self, args: Sequence[str] | None = None, namespace: Any = None) -> Any:  # type: ignore[override]  # its overloads
        """The arguments; what is left over is an error of the command that it was given to."""
        found, left = self.parse_known_args(args, namespace)
        if left:
            command = getattr(found, "parser", self)
            command.error(_left_over(left, command))
        return found

    def error(self, message: str) -> NoReturn:
        """Exit code 2, after the usage and what is wrong."""
        self.print_usage(sys.stderr)
        self.exit(2, f"{self.prog}: error: {_mended(message, self.prog)}\n")


class Commands:
    """The commands of a program."""

    def __init__(self, parser: Parser, shaped: dict[str, object]) -> None:
        self._program, self._shaped = parser, shaped
        self._known = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)

    def add(self, name: str, run: "Run", **words: str) -> Parser:
        """A command that ``run`` carries out. words: help, usage, description and epilog, as argparse has them."""
        parser: Parser = self._known.add_parser(name, **{**self._shaped, **words})
        self._program.commands[name] = words.get("help", ""), parser
        parser.set_defaults(run=run, parser=parser)  # every command's arguments know the parser that they came through
        return parser


Run = Callable[[argparse.Namespace], int]
Argument = Callable[[Takes], argparse.Action]
Addition = Callable[[Parser], object]


def command(name: str, *additions: Addition, **words: str) -> Callable[[Run], Callable[[Commands], None]]:
    """What makes a command of the function that carries it out; words: as of :meth:`Commands.add`."""

    def declared(run: Run) -> Callable[[Commands], None]:
        def declare(commands: Commands) -> None:
            parser = commands.add(name, run, **words)
            for add_to in additions:
                add_to(parser)

        return declare

    return declared


def flag(*names: str, **how: Any) -> Argument:
    """An argument as :meth:`argparse.ArgumentParser.add_argument` takes it."""
    return lambda place: place.add_argument(*names, **how)


def group(title: str, *arguments: Argument) -> Addition:
    """Arguments that stand together in the help."""
    return lambda parser: parser.add_group(title, arguments)


def program_parser(
    program: str, opening: str, description: str, epilog: str, flags: Mapping[str, str],
    declared: Iterable[Callable[[Commands], None]],
) -> Parser:  # fmt: skip
    """A program's parser with all its commands. flags: that stand before or after any of them, with their help."""
    shared = Parser(add_help=False)
    for names, help in flags.items():  # SUPPRESS: a flag before the command is not reset by the command's own default
        shared.add_argument(*names.split(), action="store_true", default=argparse.SUPPRESS, help=help)
    shaped: Any = {"formatter_class": argparse.RawDescriptionHelpFormatter, "parents": [shared]}
    parser = Parser(
        program, usage=f"{opening}   ({program} COMMAND ...)", description=description, epilog=epilog, **shaped
    )
    parser.add_argument("--version", action=Version, nargs=0, help="print the version and stop")
    commands = Commands(parser, shaped)
    for declare in declared:
        declare(commands)
    return parser


def project_folder(text: str) -> Path:
    """A project's folder from the command line, also where its survey.toml was named."""
    path = Path(text)
    return path.parent if path.name == "survey.toml" and path.is_file() else path


def _left_over(left: Sequence[str], command: argparse.ArgumentParser) -> str:
    word = left[0]
    if not word.startswith("-"):
        return f"{word!r} is one too many; see the usage above"
    from survey.folder.text import suggestion

    flags = _FLAG.findall(command.format_help())
    return f"unknown flag {word.split('=')[0]}; {suggestion(word.split('=')[0], flags)}"


def _mended(message: str, program: str) -> str:
    """A message of argparse in the words of the project: what was found, what to do."""
    choice, number = _CHOICE.fullmatch(message), _NUMBER.fullmatch(message)
    if choice:
        from survey.folder.text import choice_hint

        known = [a or b for a, b in re.findall(r"'([^']*)'|([^',\s]+)", choice["known"])]
        what = "command" if choice["what"] == "COMMAND" else choice["what"]
        return f"{what} {choice['found']!r} is unknown; {choice_hint(choice['found'], known)}"
    if number:
        return f"{number['what']}: found {number['found']!r}; expected a number"
    if message == "the following arguments are required: COMMAND":
        return f"no command is given; {program} --help lists them"
    missing = re.fullmatch(r"the following arguments are required: (.*)", message)
    if missing:
        return f"{missing[1]} is missing; see the usage above"
    return message


def port(text: str) -> int:
    """A port from the command line, 0 for any that is free."""
    value = int(text) if re.fullmatch(r"\d{1,5}", text, re.ASCII) else -1
    if not 0 <= value <= 65535:
        raise argparse.ArgumentTypeError(f"found {text!r}; expected a port, 1 to 65535, or 0 for one that is free")
    return value
