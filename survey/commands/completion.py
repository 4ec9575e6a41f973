"""Completion of a command line in bash, zsh and fish, made from its parser, so that it never lags behind."""

import argparse
import re
from collections.abc import Callable, Iterator
from functools import partial

from adjust.model.frozen import frozen
from survey.commands.common import DONE
from survey.commands.parser import Commands, Parser

SHELLS = ("bash", "zsh", "fish")
_EPILOG = """\
bash: {program} completion bash > ~/.local/share/bash-completion/completions/{program}
zsh:  {program} completion zsh > a file named _{program} in a folder of $fpath
fish: {program} completion fish > ~/.config/fish/completions/{program}.fish
Next: open a new shell, type {program} and press Tab
"""


@frozen
class Flag:
    """A flag of a command. choices: what may follow it, empty where that is free or nothing."""

    names: tuple[str, ...]
    help: str
    choices: tuple[str, ...]
    takes_value: bool


@frozen
class Command:
    """A command, its flags, and the words that may stand in it where they are known."""

    name: str
    help: str
    flags: tuple[Flag, ...]
    words: tuple[str, ...]


def commands_of(parser: Parser) -> tuple[Command, ...]:
    """The commands of a parser in their order."""
    return tuple(_command(name, help, found) for name, (help, found) in parser.commands.items())


def _command(name: str, help: str, parser: Parser) -> Command:
    flags: list[Flag] = []
    words: list[str] = []
    for argument in parser.arguments:
        choices = tuple(str(c) for c in argument.choices or ())
        if argument.option_strings:
            flags.append(Flag(tuple(argument.option_strings), _plain(argument.help), choices, argument.nargs != 0))
        else:
            words += choices
    return Command(name, _plain(help), tuple(flags), tuple(words))


def _plain(text: str | None) -> str:
    """A help text that no shell can take for anything else."""
    return re.sub(r"[^\w ,.;/()=+-]", "", (text or "").replace("\n", " "))


def completion_script(parser: Parser, shell: str) -> str:
    """The script that teaches ``shell`` the commands of ``parser``. Raises ValueError for another shell."""
    makers = {"bash": _bash, "zsh": _zsh, "fish": _fish}
    if shell not in makers:
        raise ValueError(f"unknown shell {shell!r}; known: {', '.join(SHELLS)}")
    return "\n".join(makers[shell](parser.prog, commands_of(parser))) + "\n"


def _bash(program: str, commands: tuple[Command, ...]) -> Iterator[str]:
    names = " ".join(c.name for c in commands)
    yield f"_{program}() {{"
    yield '    local cur="${COMP_WORDS[COMP_CWORD]}" prev="${COMP_WORDS[COMP_CWORD-1]}" command="" word words=""'
    yield "    COMPREPLY=()"
    yield '    for word in "${COMP_WORDS[@]:1:COMP_CWORD-1}"; do'
    yield f'        case "$word" in {names.replace(" ", "|")}) command="$word"; break ;; esac'
    yield "    done"
    yield '    case "$command:$prev" in'
    for c in commands:
        for flag in c.flags:
            if flag.choices:
                yield f'        {"|".join(f"{c.name}:{n}" for n in flag.names)}) words="{" ".join(flag.choices)}" ;;'
            elif flag.takes_value:
                yield f"        {'|'.join(f'{c.name}:{n}' for n in flag.names)}) return ;;"
    yield f'        :*) words="{names} --help --version" ;;'
    for c in commands:
        flags = " ".join(n for flag in c.flags for n in flag.names)
        words = " ".join(c.words)
        yield f'        {c.name}:*) if [[ "$cur" == -* ]]; then words="{flags}"; else words="{words}"; fi ;;'
    yield "    esac"
    yield '    COMPREPLY=($(compgen -W "$words" -- "$cur"))'
    yield "}"
    yield f"complete -o default -F _{program} {program}  # default: names of files where nothing else fits"


def _zsh(program: str, commands: tuple[Command, ...]) -> Iterator[str]:
    yield f"#compdef {program}"
    yield f"_{program}() {{"
    yield "    if (( CURRENT == 2 )); then"
    yield "        local -a known=(" + " ".join(f"'{c.name}:{c.help}'" for c in commands) + ")"
    yield "        _describe command known"
    yield "        return"
    yield "    fi"
    yield '    case "$words[2]:$words[CURRENT-1]" in'
    for c in commands:
        for flag in c.flags:
            if flag.choices:
                patterns = "|".join(f"{c.name}:{n}" for n in flag.names)
                yield f"        {patterns}) compadd -- {' '.join(flag.choices)}; return ;;"
    yield "    esac"
    yield '    case "$words[2]" in'
    for c in commands:
        flags = " ".join(n for flag in c.flags for n in flag.names)
        words = f"compadd -- {' '.join(c.words)}; " if c.words else ""
        yield f'        {c.name}) if [[ "$PREFIX" == -* ]]; then compadd -- {flags}; else {words}_files; fi ;;'
    yield "    esac"
    yield "}"
    yield f'if [ "$funcstack[1]" = "_{program}" ]; then _{program} "$@"; else compdef _{program} {program}; fi'


def _fish(program: str, commands: tuple[Command, ...]) -> Iterator[str]:
    for c in commands:
        yield f"complete -c {program} -n __fish_use_subcommand -f -a {c.name} -d '{c.help}'"
        seen = f"-n '__fish_seen_subcommand_from {c.name}'"
        for flag in c.flags:
            names = " ".join(f"-l {n[2:]}" if n.startswith("--") else f"-s {n[1:]}" for n in flag.names)
            value = f" -x -a '{' '.join(flag.choices)}'" if flag.choices else " -r" if flag.takes_value else ""
            yield f"complete -c {program} {seen} {names}{value} -d '{flag.help}'"
        if c.words:
            yield f"complete -c {program} {seen} -a '{' '.join(c.words)}'"


def declare_completion(program: str, build_parser: Callable[[], Parser], commands: Commands) -> None:
    """Add ``completion`` to the commands of a program whose parser ``build_parser`` makes."""
    parser = commands.add(
        "completion",
        partial(_completion, build_parser),
        help="print what makes Tab complete commands and flags in bash, zsh or fish",
        usage=f"{program} completion bash   ({program} completion SHELL)",
        description="Prints a script for the shell; nothing is installed.",
        epilog=_EPILOG.format(program=program),
    )
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help="bash, zsh or fish")


def _completion(build_parser: Callable[[], Parser], arguments: argparse.Namespace) -> int:
    print(completion_script(build_parser(), arguments.shell), end="")
    return DONE
