"""TOML: tables as text, and the lines on which the keys of a text stand."""

import json
import re
import tomllib
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from typing import Any, NoReturn

import numpy as np

from survey.folder.units import from_si, unit_in

Section = tuple[tuple[str, ...], Mapping[str, object]]


def toml_text(sections: Iterable[Section]) -> str:
    """A document of ``sections``: path of the header (empty for the top) and its keys; tables below them are inline."""
    parts = []
    for path, values in sections:
        lines = [f"[{'.'.join(_key(part) for part in path)}]"] if path else []
        lines += [f"{_key(key)} = {_value(value)}" for key, value in values.items()]
        parts.append("\n".join(lines) + "\n")
    return "\n".join(parts)


def _key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else _string(key)


def _string(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # JSON leaves DEL as it is, TOML does not


def _value(value: object) -> str:
    if isinstance(value, str):
        return _string(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, int):
        return str(value)
    if isinstance(value, float):
        return repr(value)  # inf and nan are TOML, too
    if isinstance(value, Mapping):
        inner = ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items())
        return f"{{ {inner} }}" if inner else "{}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(_value(item) for item in value)}]"
    raise TypeError(f"no TOML for {type(value)}")


def in_units(**values: Any) -> dict[str, object]:
    """Keys with what they hold: numbers in SI as the unit at the end of the key wants them; without what is empty."""
    found = {key: from_si(x, unit_in(key)).tolist() if isinstance(x, float | np.ndarray) else x
             for key, x in values.items()}  # fmt: skip
    return {key: x for key, x in found.items() if x is not None and x not in ((), [], {})}


_HEADER = re.compile(r"\[([A-Za-z0-9_-]+(?:\.[A-Za-z0-9_-]+)*)\]")
_INLINE_KEY = re.compile(r"(?<![A-Za-z0-9_-])(?=[A-Za-z0-9_-]+ = )")
_TEXTS = re.compile(r'("[^"]*")')


def read_tables(text: str) -> dict[str, object]:
    """A valid document as plain values; raises as :func:`tomllib.loads`.

    What looks as :func:`toml_text` writes it is read line by line, its values as those of JSON: several times as fast
    where there are thousands of stations. ``tomllib`` reads everything else, and says what is wrong.
    """
    found = None if any(sign in text for sign in _NOT_PLAIN) else _plain_tables(text)
    return tomllib.loads(text) if found is None else found


_NOT_PLAIN = ("\\", "\r", "\x7f", "null", "'''", '"""')  # what JSON and TOML read differently, or in several lines


def _plain_tables(text: str) -> dict[str, object] | None:
    """The same; None for a line that is anything but a header, a key with its value, a comment, or blank."""
    root: dict[str, object] = {}
    below: dict[tuple[str, ...], dict[str, object]] = {(): root}
    headers, table = {()}, root
    for line in text.split("\n"):
        key, equals, value = line.partition(" = ")
        if equals and key[:1] != "#":
            if key in table or not _BARE.fullmatch(key):
                return None
            try:
                table[key] = _plain_value(value)
            except ValueError:
                return None
        elif line and not (line[0] == "#" and line.isprintable()):
            header = _HEADER.fullmatch(line)
            path = tuple(header[1].split(".")) if header else ()
            if path in headers:
                return None
            headers.add(path)
            for i, name in enumerate(path):
                if path[: i + 1] not in below:
                    if name in below[path[:i]]:
                        return None
                    below[path[: i + 1]] = below[path[:i]][name] = {}
            table = below[path]
    return root


def _plain_value(text: str) -> Any:
    parts = _TEXTS.split(text) if '"' in text else [text]
    if ":" in "".join(parts[::2]):
        raise ValueError(text)
    if " = " in text:
        parts[::2] = [_INLINE_KEY.sub('"', part).replace(" = ", '": ') for part in parts[::2]]
        text = "".join(parts)
    value, end = _JSON.raw_decode(text)
    if end < len(text):
        raise ValueError(text)
    return value


def _once(pairs: list[tuple[str, object]]) -> dict[str, object]:
    found = dict(pairs)
    if len(found) < len(pairs):
        raise ValueError("a key comes twice")
    return found


def _no_constant(name: str) -> NoReturn:
    raise ValueError(name)


_JSON = json.JSONDecoder(object_pairs_hook=_once, parse_constant=_no_constant)
KeyPath = tuple[str | int, ...]
_BARE = re.compile(r"[A-Za-z0-9_-]+")
_TOKEN = re.compile(
    r'"""(?:[^"\\]|\\.|"{1,2}(?!"))*"{3,5}'
    r"|'''(?:[^']|'{1,2}(?!'))*'{3,5}"
    r'|"(?:[^"\\\n]|\\.)*"'
    r"|'[^'\n]*'|#[^\n]*|[][{},.=\n]|[^][{},.=\s#\"']+",
    re.DOTALL,
)
_END = (",", "]", "}", "\n", "")


def key_lines(text: str) -> dict[KeyPath, int]:
    """Line (from 1) of every key, table header and array item of ``text``, which must be valid TOML."""
    scanner = _Scanner(text.replace("\r\n", "\n"))
    scanner.document()
    return scanner.lines


class KeyLines(Mapping[KeyPath, int]):
    """The lines of :func:`key_lines`, looked for when one is first asked for: only errors ask."""

    def __init__(self, text: str) -> None:
        self._text = text

    @cached_property
    def _found(self) -> dict[KeyPath, int]:
        return key_lines(self._text)

    def __getitem__(self, key: KeyPath) -> int:
        return self._found[key]

    def __iter__(self) -> Iterator[KeyPath]:
        return iter(self._found)

    def __len__(self) -> int:
        return len(self._found)


def _unquoted(text: str) -> str:
    return str(tomllib.loads(f"k = {text}")["k"]) if "\\" in text else text[1:-1]


class _Scanner:
    """Walks over the tokens of a valid document; it checks nothing, because ``tomllib`` has."""

    def __init__(self, text: str) -> None:
        self.lines: dict[KeyPath, int] = {}
        self._items: dict[KeyPath, int] = {}
        self._tokens, line = deque[tuple[str, int]](), 1
        for match in _TOKEN.finditer(text):
            token = match.group()
            if not token.startswith("#"):
                self._tokens.append((token, line))
            line += token.count("\n")
        self._tokens.append(("", line))

    @property
    def _next(self) -> str:
        return self._tokens[0][0]

    def _take(self) -> str:
        return self._tokens.popleft()[0]

    def document(self) -> None:
        table: KeyPath = ()
        while self._next:
            if self._next == "\n":
                self._take()
            elif self._next == "[":
                table = self._header()
            else:
                self._key_value(table)

    def _header(self) -> KeyPath:
        line, brackets = self._tokens[0][1], 0
        while self._next == "[":
            self._take()
            brackets += 1
        path = self._key()
        for _ in range(brackets):
            self._take()
        if brackets == 2:
            self._items[path] = self._items.get(path, -1) + 1
            path = (*path, self._items[path])
        self._record((), path, line)
        return path

    def _key_value(self, table: KeyPath) -> None:
        line = self._tokens[0][1]
        key = self._key()
        self._record(table, key, line)
        self._take()  # the equals sign
        self._value(table + key)

    def _record(self, table: KeyPath, key: KeyPath, line: int) -> None:
        for length in range(1, len(key) + 1):
            self.lines.setdefault(table + key[:length], line)

    def _key(self) -> KeyPath:
        parts: list[str] = []
        while True:
            part = self._take()
            parts.append(_unquoted(part) if part[0] in "\"'" else part)
            if self._next != ".":
                return tuple(parts)
            self._take()

    def _value(self, path: KeyPath) -> None:
        closing = {"[": "]", "{": "}"}.get(self._next)
        if closing is None:
            while self._next not in _END:
                self._take()
            return
        self._take()
        item = 0
        while self._next != closing:
            if self._next in _END:
                self._take()
            elif closing == "}":
                self._key_value(path)
            else:
                self.lines.setdefault((*path, item), self._tokens[0][1])
                self._value((*path, item))
                item += 1
        self._take()
