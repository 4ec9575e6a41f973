"""A table of ``survey.toml``: typed access to its keys, with file, line and key in every error."""

import math
import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar, overload

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray
from survey.folder.text import LARGEST_NUMBER, choice_hint, decode, id_problem, read_bytes, suggestion, with_digest
from survey.folder.units import to_si, unit_in
from survey.project.declared.declarations import below, declared
from survey.project.declared.keys import NOTHING, REQUIRED, Declared, Key
from survey.project.declared.toml_text import KeyLines, KeyPath, read_tables

_Word = TypeVar("_Word", bound=str)
_NO_KEY = Key("", "text", "")
_LARGEST_TOML = 256 * 2**20  # bytes: some millions of stations
_DEEPEST_KEY = 32  # parts between dots; time and memory grow with their square
_NUMBERS, _FLOATS = {int, float}, {float}
_LONGEST_INTEGER = 1000  # bits: all that a double can hold, and less than what cannot be printed
_MANY_DIGITS = re.compile(r"[0-9A-Fa-f_]{200}")  # no integer of so many bits has fewer, in whatever base
_KEY_PART = re.compile(r"[ \t]*([A-Za-z0-9_-]+|\"[^\"\n]*\"|'[^'\n]*')[ \t]*")


def read_toml(path: Path, instead: str | None = None) -> tuple["Node", str]:
    """The root table of a TOML file and the sha256 of the file. instead: what is to stand in it, not yet written."""
    data, digest = read_bytes(path, _LARGEST_TOML) if instead is None else with_digest(instead.encode())
    text = decode(path, data)
    if not text.strip():
        raise SurveyError(f"{path}:1: the file is empty; it starts with 'format = 1'")
    _check_keys(path, text)
    try:
        values = read_tables(text)
        root = Node(path, KeyLines(text), (), values)
        if _MANY_DIGITS.search(text):
            _check_integers(root, values, ())
    except ValueError as error:  # of tomllib, or of the interpreter for an integer of thousands of digits
        found = re.search(r"at line (\d+)", str(error))
        line = int(found[1]) if found else _line_of_digits(text) or text.count("\n") + 1
        raise SurveyError(f"{path}:{line}: not valid TOML: {error}; correct this line") from error
    except RecursionError as error:
        raise SurveyError(f"{path}:1: lists or tables are nested too deeply; remove the brackets") from error
    return root, digest


def _check_keys(path: Path, text: str) -> None:
    """Refuse keys of very many parts before anything tries to take them apart."""
    if all(line.count(".") < _DEEPEST_KEY - 1 for line in text.split("\n")):
        return
    run = at = 0
    for part in text.split("."):
        run = run + 1 if _KEY_PART.fullmatch(part) else 0
        if run >= _DEEPEST_KEY:
            raise SurveyError(f"{path}:{_line_at(text, at)}: a key has too many dots; shorten it")
        at += len(part) + 1


def _line_of_digits(text: str) -> int | None:
    found = re.search(r"[0-9_]{4000}", text)
    return _line_at(text, found.start()) if found else None


def _line_at(text: str, at: int) -> int:
    return text.count("\n", 0, at) + 1


def _check_integers(root: "Node", value: object, keys: KeyPath) -> None:
    """Refuse integers beyond every number that can be meant; some could not even be shown in a message."""
    if isinstance(value, dict | list):
        for key, item in value.items() if isinstance(value, dict) else enumerate(value):
            _check_integers(root, item, (*keys, key))
    elif isinstance(value, int) and value.bit_length() > _LONGEST_INTEGER:
        raise root.error("the number is too large to be meant; correct it", *keys)


@frozen(eq=False)
class Node:
    """``values`` is the table at ``path`` of ``file``; ``lines`` holds the line of every key of the whole file.

    declared: what its keys are, of survey.toml: others are refused, and what a reader does not say of a default, of
    bounds and signs holds as it is declared there.
    """

    file: Path
    lines: Mapping[KeyPath, int]
    path: KeyPath
    values: Mapping[str, Any]
    declared: Declared | None = None

    def declared_as(self, what: Declared | str) -> "Node":
        """With the keys of a declaration, or of that of a name. Raises at the first key that is none of them."""
        what = declared(what) if isinstance(what, str) else what
        if what.free_keys is None:
            self.allow(*what.by_name)
        return replace(self, declared=what)

    def _key(self, name: str) -> Key:
        return (self.declared and self.declared.key(name)) or _NO_KEY

    def error(self, problem: str, *keys: str | int) -> SurveyError:
        """An error at a key below this table, or at the table itself; a missing key is shown at its table."""
        path = (*self.path, *keys)
        at = path
        while at and at not in self.lines:
            at = at[:-1]
        name = ".".join(str(part) for part in path)
        return SurveyError(f"{self.file}:{self.lines.get(at, 1)}: {name + ': ' if name else ''}{problem}")

    def fail(self, *keys: str | int) -> Callable[[str], SurveyError]:
        """What makes an error of a problem at a key below this table."""
        return lambda problem: self.error(problem, *keys)

    def allow(self, *known: str, what: str = "key") -> None:
        """Raise at the first key that is not ``known``."""
        for key in self.values:
            if key not in known:
                raise self.error(f"unknown {what}; {suggestion(key, known)}", key)

    def has(self, *keys: str) -> bool:
        """Whether any of the keys is given."""
        return not self.values.keys().isdisjoint(keys)

    def value(self, key: str, default: Any = REQUIRED) -> Any:
        """The raw value of a key."""
        if key in self.values:
            return self.values[key]
        if default is REQUIRED:
            default = self._key(key).default
            if default is REQUIRED or default is NOTHING:
                raise self.error(f"the key {key!r} is missing; add it", key)
        return default

    def table(self, key: str) -> "Node":
        """The table under a key, empty where it is absent."""
        value = self.values.get(key, {})
        if not isinstance(value, dict):
            raise self.error(f"expected a table, found {_kind(value)}; write {{ ... }}", key)
        what = below(self.declared, key) if self.declared else None
        found = Node(self.file, self.lines, (*self.path, key), value, what)
        if value and what and what.free_keys is None:
            found.allow(*what.by_name)
        return found

    def tables(self, key: str) -> list[tuple[str, "Node"]]:
        """The tables under the ids below a key, in the order of the file."""
        if key not in self.values:
            return []
        parent = self.table(key)
        for name in parent.values:
            problem = id_problem(name)
            if problem:
                raise parent.error(problem, name)
        return [(name, parent.table(name)) for name in parent.values]

    def text(self, key: str, default: Any = REQUIRED) -> str:
        """A string."""
        return str(self._typed(key, default, str, "text"))

    def choice(self, key: str, options: Iterable[_Word], default: Any = REQUIRED) -> _Word:
        """One of the ``options``."""
        options = tuple(options)
        value = self.text(key, default)
        for option in options:
            if option == value:
                return option
        raise self.error(f"found {value!r}; {choice_hint(value, options)}", key)

    def flag(self, key: str, default: Any = REQUIRED) -> bool:
        """True or false."""
        return bool(self._typed(key, default, bool, "true or false"))

    def integer(self, key: str, minimum: int | None = None, default: Any = REQUIRED) -> int:
        """A whole number, at least ``minimum``."""
        value = self._typed(key, default, int, "a whole number")
        minimum = self._key(key).least if minimum is None else minimum
        if minimum is not None and value < minimum:
            raise self.error(f"found {value}; it must be at least {minimum}", key)
        return int(value)

    def number(self, key: str, default: Any = REQUIRED, positive: bool = False) -> float:
        """A finite number."""
        value = self._number(self.value(key, default), key)
        if not math.isfinite(value):
            raise self.error(f"found {value}; it must be a finite number", key)
        if abs(value) > LARGEST_NUMBER:
            raise self.error(f"found {value:g}, which is too large to be meant; correct it", key)
        if (positive or self._key(key).positive) and value <= 0:
            raise self.error(f"found {value}; it must be positive", key)
        return value

    @overload
    def si(self, key: str, default: float = ..., positive: bool = ...) -> float: ...
    @overload
    def si(self, key: str, default: None, positive: bool = ...) -> float | None: ...
    def si(self, key: str, default: Any = REQUIRED, positive: bool = False) -> float | None:
        """A finite number in SI, by the unit that the key ends with, as is ``default``; its None, nan or inf stay."""
        if key not in self.values and (default is None or (isinstance(default, float) and not math.isfinite(default))):
            return default
        return float(to_si(self.number(key, default, positive), unit_in(key)))

    def numbers(
        self, key: str, shape: tuple[int, ...], default: Any = REQUIRED, infinite: bool = False, blank: bool = False
    ) -> FloatArray:
        """Numbers of the given shape; ``infinite`` allows ``inf``, also written "inf", ``blank`` allows ``nan``."""
        value = self.value(key, default)
        plain = type(value) is list and (len(value),) == shape and set(map(type, value)) == _FLOATS
        if plain and math.hypot(*value) <= LARGEST_NUMBER:  # as nearly all are, of thousands of stations
            return np.array(value)
        array = np.empty(shape)
        self._fill(array, value, (key,))
        if np.abs(array).max(initial=0.0) <= LARGEST_NUMBER:
            return array
        if (not blank and np.isnan(array).any()) or (not infinite and np.isinf(array).any()):
            raise self.error("found a number that is not finite; give finite numbers", key)
        if (np.abs(array[np.isfinite(array)]) > LARGEST_NUMBER).any():
            raise self.error(f"found a number above {LARGEST_NUMBER:g}, too large to be meant; correct it", key)
        return array

    def names(self, key: str, default: Any = REQUIRED) -> tuple[str, ...]:
        """Different strings."""
        values = self.value(key, default)
        if not isinstance(values, list | tuple) or not all(isinstance(value, str) for value in values):
            raise self.error(f'expected a list of names, found {_kind(values)}; write ["a", "b"]', key)
        for i, value in enumerate(values):
            if value in values[:i]:
                raise self.error(f"{value!r} is named twice; remove one", key, i)
        return tuple(values)

    def references(self, key: str, known: Iterable[str], what: str, default: Any = REQUIRED) -> tuple[str, ...]:
        """Names that must all be ``known``."""
        known = tuple(known)
        names = self.names(key, default)
        for i, name in enumerate(names):
            if name not in known:
                raise self.error(f"unknown {what} {name!r}; {suggestion(name, known)}", key, i)
        return names

    def reference(self, key: str, known: Iterable[str], what: str) -> str:
        """A name that must be ``known``."""
        known = tuple(known)
        name = self.text(key)
        if name not in known:
            raise self.error(f"unknown {what} {name!r}; {suggestion(name, known)}", key)
        return name

    def sigmas(self, name: str, units: tuple[str, ...], k: int, infinite: bool = False) -> FloatArray | None:
        """Positive sigmas (k,) in SI under ``name_unit``, one for all or one each, or None where absent."""
        given = [unit for unit in units if f"{name}_{unit}" in self.values]
        if not given:
            return None
        if len(given) > 1:
            raise self.error(f"{name}_{given[0]} is given too; keep one of the two", f"{name}_{given[1]}")
        key = f"{name}_{given[0]}"
        shape = (k,) if isinstance(self.values[key], list) else ()
        values = np.broadcast_to(self.numbers(key, shape, infinite=infinite), (k,))
        if (values <= 0).any():
            raise self.error(f"found {values.min():g}; a sigma must be positive (to hold it, leave it out)", key)
        return to_si(values, given[0])

    def _typed(self, key: str, default: Any, kind: type, words: str) -> Any:
        value = self.value(key, default)
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise self.error(f"expected {words}, found {_kind(value)}", key)
        return value

    def _number(self, value: object, *keys: str | int) -> float:
        if value == "inf":
            return math.inf
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(f"expected a number, found {_kind(value)}", *keys)
        return float(value)

    def _fill(self, array: FloatArray, value: object, keys: tuple[str | int, ...]) -> None:
        if array.ndim == 0:
            array[()] = self._number(value, *keys)
            return
        if not isinstance(value, list) or len(value) != len(array):
            found = f"a list of {len(value)}" if isinstance(value, list) else _kind(value)
            raise self.error(f"expected a list of {len(array)}, found {found}", *keys)
        if array.ndim == 1 and set(map(type, value)) <= _NUMBERS:
            array[:] = value
            return
        for i, item in enumerate(value):
            self._fill(array[i : i + 1].reshape(array.shape[1:]), item, (*keys, i))


def _kind(value: object) -> str:
    if isinstance(value, dict):
        return "a table"
    if isinstance(value, list):
        return f"a list of {len(value)}"
    return f"{'text ' if isinstance(value, str) else ''}{value!r}"
