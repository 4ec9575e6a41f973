"""Dialects: the language of a serial or TCP controller as a small TOML file, so that a new table is a file, not code.

A dialect names its commands with the text to send and the pattern of the reply; ``two-axis`` and ``newport-esp301`` are
shipped, and any path to a file may be given instead. ``docs/capture.md`` describes the keys.
"""

import math
import re
import warnings
from collections.abc import Mapping
from dataclasses import field
from pathlib import Path
from string import Formatter

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from survey.folder.text import suggestion
from survey.project.declared.node import Node, read_toml

FOLDER = Path(__file__).parent / "dialects"
_DEG = math.pi / 180
_UNITS = {"deg": _DEG, "arcmin": _DEG / 60, "arcsec": _DEG / 3600, "mdeg": _DEG / 1000, "rad": 1.0}
_COMMANDS = ("init", "move", "position", "status", "stop", "home", "errors")
_SPEC = re.compile(r"[-+ #0]{0,3}[0-9]{0,2}(\.[0-9]{1,2})?[bdeEfFgGxX]?")  # of a number, at most 99 characters wide
_PLACES = {"axis": "1", "value": 1.0, "delta": 1.0, "counts": 1, "delta_counts": 1}


@frozen
class Command:
    """One exchange.

    send: a format of {axis}, {value}, {delta}, {counts}, {delta_counts}. reply: a pattern that the whole reply must
    match, None where none comes. each_axis: sent once for every axis.
    """

    name: str
    send: str
    reply: re.Pattern[str] | None
    each_axis: bool = True
    moving: re.Pattern[str] | None = None
    fault: re.Pattern[str] | None = None
    good: re.Pattern[str] | None = None


@frozen
class Dialect:
    """How a controller speaks. unit: radians per unit of its angles; counts: its angles are whole numbers."""

    name: str
    title: str
    channels: tuple[str, ...]
    unit: float
    counts: bool = False
    modulo: float | None = None
    send_end: str = "\r\n"
    reply_end: str = "\r\n"
    encoding: str = "ascii"
    reply_timeout_s: float = 0.5
    pause_s: float = 0.0
    serial: Mapping[str, int | float | str] = field(default_factory=dict)
    commands: Mapping[str, Command] = field(default_factory=dict)
    init: tuple[str, ...] = ()
    refusal: re.Pattern[str] | None = None
    texts: Mapping[str, str] = field(default_factory=dict)


def shipped_dialects() -> tuple[str, ...]:
    """Names of the dialects that come with this package."""
    return tuple(sorted(path.stem for path in FOLDER.glob("*.toml")))


def read_dialect(name: str, base: Path = Path()) -> Dialect:
    """A shipped dialect by name, or the file ``base / name``. Raises SurveyError."""
    path = base / name if name.endswith(".toml") else FOLDER / f"{name}.toml"
    if not path.is_file():
        near = suggestion(name, shipped_dialects())
        raise SurveyError(f"{path}: there is no such dialect; {near}; or give the path of a .toml file")
    root, _ = read_toml(path)
    known = ("format", "title", "channels", "units", "units_per_deg", "counts", "modulo", "line", "serial", "commands")
    root.allow(*known, "init", "refusal")
    if root.integer("format", 1) != 1:
        raise root.error("this program reads format 1", "format")
    line, refusal = root.table("line"), root.table("refusal")
    line.allow("send_end", "reply_end", "encoding", "reply_timeout_s", "pause_s")
    refusal.allow("reply", "texts")
    unit = _unit(root)
    return Dialect(
        name=path.stem,
        title=root.text("title", path.stem),
        channels=root.names("channels"),
        unit=unit,
        counts=root.flag("counts", False),
        modulo=root.number("modulo", positive=True) * unit if root.has("modulo") else None,
        send_end=line.text("send_end", "\r\n"),
        reply_end=line.text("reply_end", "\r\n"),
        encoding=line.choice("encoding", ("ascii", "latin-1", "utf-8"), "ascii"),
        reply_timeout_s=line.number("reply_timeout_s", 0.5, positive=True),
        pause_s=line.number("pause_s", 0.0),
        serial=_serial(root.table("serial")),
        commands=_commands(root.table("commands")),
        init=root.names("init", []),
        refusal=_pattern(refusal, "reply", ("code",)) if refusal.has("reply") else None,
        texts=_texts(refusal.table("texts")),
    )


def _unit(root: Node) -> float:
    if root.has("units") == root.has("units_per_deg"):
        raise root.error("give either units or units_per_deg", "units")
    if root.has("units"):
        return _UNITS[root.choice("units", _UNITS)]
    return math.radians(1.0) / root.number("units_per_deg", positive=True)


def _serial(node: Node) -> Mapping[str, int | float | str]:
    node.allow("baudrate", "bytesize", "parity", "stopbits", "xonxoff", "rtscts")
    values: dict[str, int | float | str] = {
        "baudrate": node.integer("baudrate", 1, 9600),
        "bytesize": node.integer("bytesize", 5, 8),
        "parity": node.choice("parity", ("N", "E", "O", "M", "S"), "N"),
        "stopbits": node.number("stopbits", 1.0, positive=True),
    }
    return values | {key: node.flag(key, False) for key in ("xonxoff", "rtscts")}


def _texts(node: Node) -> Mapping[str, str]:
    return {key: node.text(key) for key in node.values}


def _commands(node: Node) -> Mapping[str, Command]:
    node.allow(*_COMMANDS)
    for needed in ("move", "position", "stop"):
        if not node.has(needed):
            raise node.error(f"the command {needed!r} is missing; add [commands.{needed}]", needed)
    return {name: _command(name, node.table(name)) for name in node.values}


def _command(name: str, node: Node) -> Command:
    groups = {"position": ("value",), "status": ("state",), "errors": ("code",)}.get(name, ())
    node.allow("send", "reply", "each_axis", *(("moving", "fault") if name == "status" else ()), *_good(name))
    send = node.text("send")
    try:
        fields = [(name, spec) for _, name, spec, _ in Formatter().parse(send) if name is not None]
        wrong = next((name for name, spec in fields if name not in _PLACES or not _SPEC.fullmatch(spec or "")), None)
        if wrong is not None:  # attributes of values, or a width that fills the memory
            raise ValueError(wrong)
        send.format(**_PLACES)
    except (KeyError, IndexError, ValueError) as error:
        places = ", ".join(f"{{{place}}}" for place in _PLACES)
        raise node.error(f"{send!r} cannot be filled in ({error!r}); places are {places}", "send") from error
    if groups and not node.has("reply"):
        raise node.error(f"the reply of {name!r} is missing; give its pattern", "reply")
    return Command(
        name,
        send,
        _pattern(node, "reply", groups) if node.has("reply") else None,
        node.flag("each_axis", "{axis}" in send),
        _pattern(node, "moving") if name == "status" else None,
        _pattern(node, "fault") if node.has("fault") else None,
        _pattern(node, "good") if name == "errors" else None,
    )


def _good(name: str) -> tuple[str, ...]:
    return ("good",) if name == "errors" else ()


def _pattern(node: Node, key: str, groups: tuple[str, ...] = ()) -> re.Pattern[str]:
    text = node.text(key)
    try:
        with warnings.catch_warnings(action="error"):
            pattern = re.compile(text)
    except (FutureWarning, DeprecationWarning) as error:
        raise node.error(f"{text!r} is ambiguous ({error}); write a backslash before brackets", key) from error
    except (re.error, OverflowError, RecursionError) as error:
        raise node.error(f"{text!r} is not a pattern ({error}); correct it", key) from error
    for group in groups:
        if group not in pattern.groupindex:
            raise node.error(f"{text!r} does not say where the {group} is; write (?P<{group}>...)", key)
    return pattern
