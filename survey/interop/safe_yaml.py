"""YAML and JSON of other programs as a tree that knows its lines: data only, whatever the file says.

Nothing is constructed from tags, aliases are refused, size and depth are limited, and scalars stay text until a reader
asks for a number, so that YAML's guesses ("1e-5" is text, "no" is false) do not matter. JSON is read as the YAML it
is, which gives its errors lines too. OpenCV's files begin with "%YAML:1.0" and tag their matrices; both are known.
"""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.text import decode, read_bytes, suggestion
from survey.interop.networks.foreign import Where, number

MAX_BYTES = 32_000_000
MAX_DEPTH = 32
MAX_ENTRIES = 2_000_000
OPENCV_MATRIX = "tag:yaml.org,2002:opencv-matrix"
_LOADER: type = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


@frozen(eq=False)
class Entry:
    """A place in such a file: text, a list or a mapping, with its line and the keys that lead to it."""

    where: Where
    name: str
    value: "str | list[Entry] | dict[str, Entry]"

    def error(self, problem: str) -> SurveyError:
        """An error that says file, line and key."""
        return self.where.error(f"{self.name}: {problem}" if self.name else problem)

    @property
    def mapping(self) -> "dict[str, Entry]":
        """The entries by key; raises SurveyError where this is no mapping."""
        if not isinstance(self.value, dict):
            raise self.error("expected keys with values; correct the file")
        return self.value

    @property
    def items(self) -> "list[Entry]":
        """The entries of a list; raises SurveyError where this is none."""
        if not isinstance(self.value, list):
            raise self.error("expected a list; correct the file")
        return self.value

    @property
    def text(self) -> str:
        """The text of a scalar."""
        if not isinstance(self.value, str):
            raise self.error("expected one word or number; correct the file")
        return self.value

    @property
    def number(self) -> float:
        """The scalar as a finite number."""
        return number(self.text, self.name, self.where)

    def __contains__(self, key: str) -> bool:
        return isinstance(self.value, dict) and key in self.value

    def get(self, key: str) -> "Entry":
        """What stands under a key; raises SurveyError where it is missing."""
        found = self.mapping
        if key not in found:
            raise self.error(f"{key!r} is missing ({suggestion(key, found)}); add it")
        return found[key]

    def count(self, largest: int = 10**6) -> int:
        """The scalar as a whole number from 1 to ``largest``."""
        value = self.number
        if value != int(value) or not 1 <= value <= largest:
            raise self.error(f"found {self.text}; expected a whole number from 1 to {largest}")
        return int(value)

    def size(self) -> tuple[int, int]:
        """A list of two whole numbers: width and height of an image, px."""
        found = [item.count() for item in self.items]
        if len(found) != 2:
            raise self.error("expected width and height; correct it")
        return found[0], found[1]

    def numbers(self, *shape: int) -> FloatArray:
        """A list of numbers of that shape; rows may be nested or not. One -1 in ``shape`` stands for any count."""
        flat = np.array([leaf.number for leaf in _leaves(self)])
        known = int(np.prod([n for n in shape if n >= 0]))
        if len(flat) % known if -1 in shape else len(flat) != known:
            raise self.error(f"found {len(flat)} numbers, expected {' x '.join(str(n) for n in shape)}; correct it")
        return flat.reshape(shape)

    def matrix(self, *shape: int) -> FloatArray:
        """A matrix with rows, cols and data (OpenCV, ROS); without them as ``numbers``."""
        if not isinstance(self.value, dict):
            return self.numbers(*shape)
        rows, cols, data = self.get("rows"), self.get("cols"), self.get("data")
        n = len(data.items)
        if rows.number * cols.number != n:
            raise data.error(f"found {n} numbers, rows and cols say {rows.text} x {cols.text}; correct it")
        return data.numbers(*shape)


def _leaves(entry: Entry) -> Iterator[Entry]:
    if isinstance(entry.value, list):
        for item in entry.value:
            yield from _leaves(item)
    else:
        yield entry


def read_yaml(path: Path) -> Entry:
    """The first document of a YAML or JSON file. Raises SurveyError with the line for what is not read."""
    data = read_bytes(path)[0]
    if len(data) > MAX_BYTES:
        raise SurveyError(f"{path}: has {len(data)} bytes, more than {MAX_BYTES} are not read; give a smaller file")
    text = decode(path, data)
    if text.startswith("%YAML:1.0"):
        text = "%YAML 1.1" + text[len("%YAML:1.0") :]
    elif text.startswith("%YAML 1.2"):
        text = "%YAML 1.1" + text[len("%YAML 1.2") :]
    if text.lstrip().startswith(("{", "[")):
        text = text.replace("\t", " ")  # blanks in JSON, an error in YAML
    return _Builder(path).build(text)


class _Builder:
    """Builds the tree from the parser's events, so that neither depth nor aliases can grow it beyond the file."""

    def __init__(self, path: Path) -> None:
        self.path, self.count = path, 0
        self.stack: list[tuple[Entry, Entry | None]] = []  # open lists and mappings, with the key that waits
        self.root: Entry | None = None

    def build(self, text: str) -> Entry:
        """The whole tree."""
        try:
            for event in yaml.parse(text, Loader=_LOADER):
                if isinstance(event, yaml.DocumentEndEvent):
                    break
                self._event(event)
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            problem = getattr(error, "problem", None) or "a character that is not allowed"
            line = mark.line + 1 if mark is not None else 1
            raise Where(self.path, line).error(f"this is no YAML or JSON ({problem}); correct it") from None
        if self.root is None:
            raise Where(self.path, 1).error("the file is empty; give another one")
        return self.root

    def _event(self, event: yaml.Event) -> None:
        mark: Any = event.start_mark
        where = Where(self.path, mark.line + 1)
        if isinstance(event, yaml.AliasEvent):
            raise where.error(f"the alias *{event.anchor} is not read; write its value out")
        tag = getattr(event, "tag", None)
        if tag is not None and tag != OPENCV_MATRIX and not tag.startswith("tag:yaml.org,2002:"):
            raise where.error(f"the tag {tag} is not read; remove it")
        if tag is not None and "python" in tag:
            raise where.error(f"the tag {tag} is not read; remove it")
        if self.stack and (key := self.stack[-1][1]) is not None:
            where = key.where  # what a block holds begins a line later
        if isinstance(event, yaml.ScalarEvent):
            self._add(Entry(where, self._name(event.value), event.value), where)
        elif isinstance(event, yaml.CollectionStartEvent):
            if len(self.stack) >= MAX_DEPTH:
                raise where.error(f"more than {MAX_DEPTH} levels are not read; is this the right file?")
            entry = Entry(where, self._name(None), {} if isinstance(event, yaml.MappingStartEvent) else [])
            self._add(entry, where)
            self.stack.append((entry, None))
        elif isinstance(event, yaml.CollectionEndEvent):
            self.stack.pop()

    def _name(self, scalar: str | None) -> str:
        if not self.stack:
            return ""
        parent, key = self.stack[-1]
        if isinstance(parent.value, dict):
            last = key.text if key is not None else (scalar or "")
        else:
            last = str(len(parent.value))
        return f"{parent.name}.{last}" if parent.name else last

    def _add(self, entry: Entry, where: Where) -> None:
        self.count += 1
        if self.count > MAX_ENTRIES:
            raise where.error(f"more than {MAX_ENTRIES} entries are not read; is this the right file?")
        if not self.stack:
            self.root = entry
            return
        parent, key = self.stack[-1]
        if isinstance(parent.value, list):
            parent.value.append(entry)
        elif key is None:
            if not isinstance(entry.value, str):
                raise where.error("a key must be one word; correct the file")
            self.stack[-1] = (parent, entry)
        elif isinstance(parent.value, dict):
            if key.text in parent.value:
                raise where.error(f"the key {key.text!r} is there already; remove one")
            parent.value[key.text] = entry
            self.stack[-1] = (parent, None)


class _Dumper(yaml.SafeDumper):
    """Lists stand further in than their key, as OpenCV wants them; numbers have a point, as all readers do."""

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """One level deeper."""
        super().increase_indent(flow, False)


def _opencv_matrix(dumper: yaml.SafeDumper, matrix: FloatArray) -> yaml.Node:
    return dumper.represent_mapping(OPENCV_MATRIX, {**matrix_entry(matrix), "dt": "d"})


_Dumper.add_representer(np.ndarray, _opencv_matrix)


def matrix_entry(matrix: FloatArray) -> dict[str, object]:
    """A matrix (n, m) as OpenCV and ROS have it: rows, cols and its numbers row by row."""
    rows, cols = matrix.shape
    return {"rows": rows, "cols": cols, "data": matrix.ravel().tolist()}


def yaml_text(document: Mapping[str, object]) -> str:
    """YAML of plain values, numbers with every bit; the innermost lists stand in one line, arrays are as OpenCV's."""
    text: str = yaml.dump(dict(document), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=2**31,
                          allow_unicode=True)  # fmt: skip
    return text


def quoted(text: str) -> str:
    """A text as a quoted scalar."""
    return '"' + "".join(f"\\{c}" if c in '"\\' else c for c in text) + '"'
