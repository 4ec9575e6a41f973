"""Result files as JSON; many entries with the same keys are kept by columns and written by the core.

Such entries are dictionaries where they are asked for.
"""

import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from json.encoder import encode_basestring
from math import isfinite
from typing import Any, overload

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.text import NUMBERS, TEXT, WORD, Words, record_rows
from survey.folder.plain import PlainEntries, PlainRecords
from survey.folder.text import Piece

Column = np.ndarray[Any, Any] | Sequence[str] | Sequence[list[str]]
"""Of n records: floats, whole numbers or truths (n,), lists of floats (n, k), n words, or n lists of words."""
Tree = Mapping[str, "Column | Tree"]
_FLOATS, _WORDS = {float}, {str}
_JSON = json.JSONEncoder(ensure_ascii=False, allow_nan=False)


@frozen(eq=False)
class Form:
    """Records with the same keys. rows: (n,) their numbers among all. tree: columns by key, nested as they are."""

    rows: IntArray
    tree: Tree


class Records(PlainRecords):
    """Entries by name, in the order of ``names``; every one is of one form, or stands apart with plain values."""

    def __init__(
        self, names: Sequence[str], forms: Sequence[Form], apart: Mapping[str, dict[str, Any]] | None = None
    ) -> None:
        self._forms, self._names, self._apart = [f for f in forms if len(f.rows)], tuple(names), dict(apart or {})
        of = {row: (f, r) for f, form in enumerate(self._forms) for r, row in enumerate(form.rows.tolist())}
        self._place = {name: of.get(row) for row, name in enumerate(self._names)}

    def __getitem__(self, name: str) -> dict[str, Any]:
        place = self._place[name]
        return self._apart[name] if place is None else _entry(self._forms[place[0]].tree, place[1])

    def keys_of(self, name: str) -> Iterable[str]:
        """The keys of a record, without making it."""
        place = self._place[name]
        return self._apart[name] if place is None else self._forms[place[0]].tree

    def __iter__(self) -> Iterator[str]:
        return iter(self._place)

    def __len__(self) -> int:
        return len(self._place)

    def numbers(self, key: str) -> dict[str, float]:
        """What all records have under a key of theirs by name, without making them; nan where one has none."""
        out = np.full(len(self._names), np.nan)
        for form in self._forms:
            column = form.tree.get(key)
            if isinstance(column, np.ndarray):
                out[form.rows] = column
        return dict(zip(self._names, out.tolist(), strict=True))

    def having(self, key: str) -> dict[str, dict[str, Any]]:
        """The records that have a key of theirs, by name, without making the others."""
        found = {row for form in self._forms if key in form.tree for row in form.rows.tolist()}
        return {name: self[name] for row, name in enumerate(self._names)
                if row in found or key in self._apart.get(name, ())}  # fmt: skip

    def lines(self, depth: int) -> list[Piece]:
        """As JSON, one line per entry of a mapping, the whole beginning in a line indented by so many spaces."""
        if not self._names:
            return [b"{}"]
        parts: list[Piece] = [b""] * len(self._names)
        for form in self._forms:
            text, ends = _json_rows(form, [self._names[row] for row in form.rows.tolist()], depth + 1)
            if len(form.rows) == len(self._names):
                return [b"{\n", text[:-2], f"\n{' ' * depth}}}".encode()]
            first = 0
            for row, end in zip(form.rows.tolist(), ends.tolist(), strict=True):
                parts[row], first = text[first:end], end
        before = " " * (depth + 1)
        for row, name in enumerate(self._names):
            if name in self._apart:
                parts[row] = f"{before}{_key(name)}: {_lines(self._apart[name], depth + 1)},\n".encode()
        return [b"{\n", *parts[:-1], parts[-1][:-2], f"\n{' ' * depth}}}".encode()]


class Entries(PlainEntries):
    """n entries with the same keys, each made when it is asked for. tree: columns by key, nested as they are."""

    def __init__(self, tree: Tree, n: int) -> None:
        self._tree, self._n = tree, n

    def __len__(self) -> int:
        return self._n

    @overload
    def __getitem__(self, index: int) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, index: slice) -> list[dict[str, Any]]: ...

    def __getitem__(self, index: int | slice) -> dict[str, Any] | list[dict[str, Any]]:
        rows = range(self._n)[index]
        return _entry(self._tree, rows) if isinstance(rows, int) else [_entry(self._tree, row) for row in rows]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and list(self) == list(other)

    def lines(self, depth: int) -> list[Piece]:
        """As JSON, a list that begins in a line indented by so many spaces."""
        if not self._n:
            return [b"[]"]
        text, _ = _json_rows(Form(np.arange(self._n), self._tree), None, depth + 1)
        return [b"[\n", text[:-2], f"\n{' ' * depth}]".encode()]


def _entry(tree: Tree, row: int) -> dict[str, Any]:
    return {key: _entry(of, row) if isinstance(of, Mapping) else _value(of, row) for key, of in tree.items()}


def _value(column: Column, row: int) -> Any:
    if not isinstance(column, np.ndarray):
        return column[row]
    value = column[row].tolist()
    if isinstance(value, list):
        return [x if isfinite(x) else None for x in value]
    return value if value is True or value is False or isfinite(value) else None


class _Writer:
    """The parts of a record of one form, with the words and values that they name."""

    def __init__(self) -> None:
        self.words, self.text = {"null": 0}, ""
        self.parts: list[tuple[int, int]] = []
        self.of_row: list[IntArray] = []
        self.values: list[FloatArray] = []

    def number(self, word: str) -> int:
        return self.words.setdefault(word, len(self.words))

    def part(self, kind: int, which: int) -> None:
        """What stands in every record comes before it, in one."""
        if self.text:
            self.parts.append((TEXT, self.number(self.text)))
            self.text = ""
        self.parts.append((kind, which))

    def column(self, of: Column, depth: int = 0) -> None:
        if isinstance(of, np.ndarray) and of.dtype == np.float64:
            self.text += "[" * (of.ndim == 2)
            self.values.append(of.reshape(len(of), -1))
            self.part(NUMBERS, self.values[-1].shape[1])
            self.text += "]" * (of.ndim == 2)
            return
        if isinstance(of, np.ndarray) and of.ndim == 1:
            values, at = np.unique(of, return_inverse=True)
            number = np.array([self.number(_JSON.encode(x)) for x in values.tolist()], dtype=np.int64)
            self.of_row.append(number[at])
            self.part(WORD, len(self.of_row) - 1)
            return
        if isinstance(of, np.ndarray):
            said = [_lines(x, depth) for x in of.tolist()]
        else:
            said = [encode_basestring(x) if isinstance(x, str) else _words(x, depth) for x in of]
        known = self.words
        self.of_row.append(np.array([known.setdefault(x, len(known)) for x in said], dtype=np.int64))
        self.part(WORD, len(self.of_row) - 1)

    def tree(self, of: Tree, depth: int) -> None:
        for i, (key, value) in enumerate(of.items()):
            self.text += f"{',' if i else '{'}\n{' ' * (depth + 1)}{encode_basestring(key)}: "
            if isinstance(value, Mapping):
                self.tree(value, depth + 1)
            else:
                self.column(value, depth + 1)
        self.text += f"\n{' ' * depth}}}"


def _json_rows(form: Form, names: Sequence[str] | None, depth: int) -> tuple[memoryview, IntArray]:
    """The records one after the other, each with a comma and a line's end, and where each ends."""
    writer, n = _Writer(), len(form.rows)
    writer.text = " " * depth
    if names is not None:
        writer.column(names)
        writer.text += ": "
    writer.tree(form.tree, depth)
    writer.text += ",\n"
    writer.parts.append((TEXT, writer.number(writer.text)))
    word = np.ascontiguousarray(np.array(writer.of_row).T)
    return record_rows(Words.of(list(writer.words)), word, np.hstack([np.zeros((n, 0)), *writer.values]), writer.parts)


def solution_json(solution: Mapping[str, Any]) -> str:
    """JSON with one line per entry of a mapping and lists of numbers kept on one line; floats by repr."""
    return b"".join(solution_pieces(solution)).decode()


def solution_pieces(solution: Mapping[str, Any]) -> Iterator[Piece]:
    """The same as UTF-8 piece by piece, of which large ones are not put together."""
    before = "{\n"
    for key, value in solution.items():
        yield f"{before} {_key(key)}: ".encode()
        if isinstance(value, Records | Entries):
            yield from value.lines(1)
        else:
            yield _lines(value, 1).encode()
        before = ",\n"
    yield b"\n}\n" if solution else b"{}\n"


def sections(document: bytes, *names: str) -> dict[str, Any]:
    """Those topmost entries that there are of what :func:`solution_json` wrote; all of what looks otherwise.

    Raises ValueError for what is no JSON.
    """
    heads, last = list(re.finditer(rb'\n ("[^"]+"): ', document)), document.rfind(b"\n}")
    if not document.startswith(b"{\n ") or not heads or last < 0:
        return dict(json.loads(document))
    ends = [*(head.start() - 1 for head in heads[1:]), last]  # before a comma
    found = ((json.loads(head[1]), document[head.end() : end]) for head, end in zip(heads, ends, strict=True))
    return {name: json.loads(text) for name, text in found if name in names}


def _lines(value: Any, depth: int) -> str:
    kind = type(value)
    if kind is float:
        return _one(value)
    if kind is dict and value:
        before = " " * (depth + 1)
        inner = ",\n".join([f"{before}{_key(k)}: {_lines(v, depth + 1)}" for k, v in value.items()])
        return f"{{\n{inner}\n{' ' * depth}}}"
    if kind is Records or kind is Entries:
        return b"".join(value.lines(depth)).decode()
    if kind is not list:
        return _one(value)
    kinds = set(map(type, value))
    if kinds == _FLOATS and "n" not in (text := ", ".join(map(float.__repr__, value))):  # not even of nan or inf
        return f"[{text}]"
    if kinds == _WORDS:
        return _words(value, depth)
    if dict in kinds or str in kinds:
        inner = ",\n".join([" " * (depth + 1) + _lines(v, depth + 1) for v in value])
        return f"[\n{inner}\n{' ' * depth}]"
    return f"[{', '.join(map(_one, value))}]"


def _words(value: list[str], depth: int) -> str:
    before = "\n" + " " * (depth + 1)
    return f"[{','.join([before + encode_basestring(word) for word in value])}\n{' ' * depth}]" if value else "[]"


def _one(value: Any) -> str:
    kind = type(value)
    if kind is float and isfinite(value):
        return float.__repr__(value)
    if kind is int:
        return int.__repr__(value)
    return encode_basestring(value) if kind is str else _JSON.encode(value)


_key = lru_cache(encode_basestring)


def keys_of(entries: Mapping[str, dict[str, Any]], name: str) -> Iterable[str]:
    """The keys of an entry."""
    return entries.keys_of(name) if isinstance(entries, Records) else entries[name]


def having(entries: Mapping[str, dict[str, Any]], key: str) -> Mapping[str, dict[str, Any]]:
    """Of entries by name those that have a key."""
    return entries.having(key) if isinstance(entries, Records) else {k: e for k, e in entries.items() if key in e}
