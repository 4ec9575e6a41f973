"""The shared library of this machine, and functions of it that check what they are given.

The library is built once for every set of vector instructions (``build_tools``); which one runs is chosen by what the
processor says. A C++ function tells itself of which kind its arguments are, see ``arrays.h``; what belongs together in
shape is said here, beside its Python face. A function runs without Python's lock, so threads run it side by side.
"""

import ctypes
import os
from array import array
from collections.abc import Callable
from functools import cache, cached_property
from operator import index
from pathlib import Path
from typing import Any
from weakref import ref

import numpy as np

from adjust.model.errors import SurveyError

_KINDS = {kind: np.dtype(of) for kind, of in
          (("f", np.float64), ("i", np.int64), ("s", np.float32), ("u", np.uint8), ("b", np.bool_))}  # fmt: skip
_ORDERED, _WRITEABLE = 0x0101, 0x0400  # flags of NumPy's arrays: row by row and aligned; may be written to
_begins: Callable[[Any], Any] = (ctypes.c_char * 0).from_buffer
"""At the first byte of an array that may be written to, in a quarter of the time of ``ndarray.ctypes``."""
_MOST_SHAPES = 64
_FOLDER = Path(__file__).parent
_FAMILIES = ("images", "bundles", "navigation", "vision")
SETS = ("base", "avx2", "avx512")
"""Sets of vector instructions for which the library may have been built, the widest last."""


def _nothing() -> None:
    """What was given before the first call."""


class _Entry(ctypes.Structure):
    _fields_ = (("name", ctypes.c_char_p), ("run", ctypes.c_void_p), ("describe", ctypes.c_void_p))


def _path(name: str) -> Path:
    return _FOLDER / f"kernels_{name}.so"


@cache
def opened(name: str) -> dict[str, tuple[Callable[[int], int], str]]:
    """Functions and kinds of arguments of the library for a set of instructions, which the processor must have."""
    path = _path(name)
    if not path.exists():
        raise SurveyError(f"{path} is missing: build it by 'pip install .' or 'python setup.py build_ext --inplace'")
    library = ctypes.CDLL(str(path))
    found: dict[str, tuple[Callable[[int], int], str]] = {}
    for family in _FAMILIES:
        table = library[family]
        table.restype = ctypes.POINTER(_Entry)
        entries = table()
        i = 0
        while entries[i].name is not None:
            text = ctypes.create_string_buffer(256)
            ctypes.CFUNCTYPE(None, ctypes.c_char_p)(entries[i].describe)(text)
            run = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_void_p)(entries[i].run)
            found[entries[i].name.decode()] = (run, text.value.decode())
            i += 1
    return found


@cache
def instruction_sets() -> tuple[str, ...]:
    """The sets of vector instructions that both the processor and the build have, the widest last."""
    if not _path("base").exists():
        opened("base")  # tells what to do
    widest = ctypes.CDLL(str(_path("base"))).widest_instructions()
    return tuple(name for i, name in enumerate(SETS) if i <= widest and _path(name).exists())


@cache
def instruction_set() -> str:
    """The set in use: the widest, or that of ``LABSURVEY_VECTORS``."""
    wanted, found = os.environ.get("LABSURVEY_VECTORS"), instruction_sets()
    if wanted and wanted not in found:
        raise SurveyError(f"LABSURVEY_VECTORS is {wanted!r}; here run: {', '.join(found)}")
    return wanted or found[-1]


class Function:
    """A function of the library with named arguments, checked against each other at every call.

    arguments: a name for each, arrays with the names of their dimensions: ``"which[k] ptr[B+1] W[3,N] damping"``. A
    dimension is a number, a name (equal wherever it stands), ``name+1``, or ``*`` for any length.
    """

    def __init__(self, name: str, arguments: str, instructions: str | None = None) -> None:
        self.name = name
        self._arguments = arguments
        self._instructions = instructions
        self._run: Callable[[int], int] | None = None
        self._kinds = ""
        self._expected: list[tuple[str, tuple[_Dimension, ...], np.dtype[Any] | None, int, tuple[int, ...]]] = []
        """Of every argument: name, shape, dtype, flags needed (of a number: whether it is whole), zeros that follow."""
        self._fitting: set[tuple[tuple[int, ...], ...]] = set()
        """Shapes of all arrays of a call that were found to fit together."""
        self._known: list[tuple[Callable[[], Any], int]] = []
        """Of every argument: the array given last and its address. NumPy moves no array that is weakly referred to."""

    def using(self, instructions: str | None) -> "Function":
        """The same function with a set of vector instructions; that in use for None."""
        return Function(self.name, self._arguments, instructions)

    @cached_property
    def _declared(self) -> list[tuple[str, tuple["_Dimension", ...]]]:
        """Name and dimensions of every argument."""
        return [_declared(part) for part in self._arguments.split()]

    def kinds(self) -> list[tuple[str, str]]:
        """Name and kind of every argument, as the library knows them: f, i, s, u, b (``_KINDS``).

        Capital letters are written to. A number is n (integer) or d.
        """
        if self._run is None:
            self._open()
        return [(name, kind) for (name, _), kind in zip(self._declared, self._kinds, strict=True)]

    def shapes(self) -> list[tuple[str, "tuple[_Dimension, ...]"]]:
        """Name and declared dimensions of every argument; a number has none."""
        return list(self._declared)

    def _open(self) -> Callable[[int], int]:
        run, described = opened(self._instructions or instruction_set())[self.name]
        self._kinds = described[::2]
        dims = [int(d) for d in described[1::2]]
        expected = [len(shape) for _, shape in self._declared]
        if dims != expected:
            raise TypeError(f"{self.name}: the library takes arrays of {dims} dimensions, declared are {expected}")
        self._expected = [
            (name, shape, _KINDS.get(kind.lower()), _ORDERED | _WRITEABLE * kind.isupper() if shape else kind == "n",
             (0,) * (4 - len(shape)))
            for (name, shape), kind in zip(self._declared, self._kinds, strict=True)
        ]  # fmt: skip
        self._known = [(_nothing, 0)] * len(dims)
        self._run = run
        return run

    def __call__(self, *arguments: Any) -> int:
        """Run it; raises TypeError or ValueError naming the argument that does not fit."""
        run = self._run or self._open()
        if len(arguments) != len(self._declared):
            raise TypeError(f"{self.name} takes {len(self._declared)} arguments, {len(arguments)} were given")
        packed: list[int] = []
        shapes: list[tuple[int, ...]] = []
        known = self._known
        for i, value in enumerate(arguments):
            name, _, dtype, needed, rest = self._expected[i]
            if dtype is None:
                packed += (self._number(name, needed, value), *rest)
                continue
            if not isinstance(value, np.ndarray) or value.dtype != dtype:
                raise TypeError(f"{self.name}: {name} must be an array of {dtype.name}, not {_told(value)}")
            shapes.append(given := value.shape)
            last, at = known[i]
            if last() is not value or value.flags.num & needed != needed:
                at = self._address(name, needed, value)
                known[i] = ref(value), at
            packed += (at, *given, *rest)
        if (together := tuple(shapes)) not in self._fitting:
            self._check(shapes)
            if len(self._fitting) >= _MOST_SHAPES:
                self._fitting.clear()
            self._fitting.add(together)
        kept = array("q", packed)
        return run(kept.buffer_info()[0])

    def _address(self, name: str, needed: int, value: np.ndarray[Any, Any]) -> int:
        """Where an array begins, which must be row by row."""
        flags = value.flags.num
        if flags & needed != needed:
            raise ValueError(f"{self.name}: {name} must be contiguous{' and writable' * (needed != _ORDERED)}")
        return ctypes.addressof(_begins(value)) if flags & _WRITEABLE else value.ctypes.data

    def _check(self, given: list[tuple[int, ...]]) -> None:
        """Whether the shapes of all arrays fit together."""
        sizes: dict[str, int] = {}
        arrays = (argument for argument in self._expected if argument[2] is not None)
        for (name, shape, *_), found in zip(arrays, given, strict=True):
            if len(found) != len(shape) or not _fits(shape, found, sizes):
                raise ValueError(f"{self.name}: {name} must be ({', '.join(map(_text, shape))}), not {found}"
                                 f" with {sizes}")  # fmt: skip

    def _number(self, name: str, whole: int, value: Any) -> int:
        """The bits of a number."""
        try:
            return array("q", (index(value),))[0] if whole else array("q", array("d", (value,)).tobytes())[0]
        except (TypeError, OverflowError):
            wanted = "a whole number" if whole else "a number"
            raise TypeError(f"{self.name}: {name} must be {wanted}, not {_told(value)}") from None


_Dimension = int | tuple[str, int] | None
"""A length; a name and what is added to it; any length."""


def _declared(part: str) -> tuple[str, tuple[_Dimension, ...]]:
    name, _, inside = part.rstrip("]").partition("[")
    return name, tuple(_dimension(text) for text in inside.split(",")) if inside else ()


def _dimension(text: str) -> _Dimension:
    if text == "*":
        return None
    if text.isdigit():
        return int(text)
    name, _, more = text.partition("+")
    return name, int(more or 0)


def _fits(shape: tuple[_Dimension, ...], given: tuple[int, ...], sizes: dict[str, int]) -> bool:
    for wanted, n in zip(shape, given, strict=True):
        if wanted is None:
            continue
        if isinstance(wanted, int):
            if n != wanted:
                return False
        elif sizes.setdefault(wanted[0], n - wanted[1]) != n - wanted[1]:
            return False
    return True


def _text(dimension: _Dimension) -> str:
    if dimension is None:
        return "any"
    if isinstance(dimension, int):
        return str(dimension)
    return f"{dimension[0]} + {dimension[1]}" if dimension[1] else dimension[0]


def _told(value: Any) -> str:
    return f"an array of {value.dtype}" if isinstance(value, np.ndarray) else type(value).__name__
