"""How a table of ``survey.toml`` is declared: its keys with their kind, unit, default and meaning.

Readers allow the keys that a declaration names and no others; the reference and the schema for editors are made from
the same declarations (``survey.project.reference``).
What there is stands in ``survey.project.declared.declarations``.
"""

from dataclasses import field
from functools import cached_property
from typing import Any, Literal

from adjust.model.frozen import frozen
from survey.folder.units import unit_in

ValueKind = Literal[
    "text", "choice", "flag", "whole", "number", "numbers", "matrix", "names", "sigma", "table"
]  # fmt: skip
REQUIRED: Any = object()
"""The default of a key that must be there."""
NOTHING = None
"""The default of a key that may be absent and then says nothing."""


@frozen
class Key:
    """One key. size: numbers in a list, rows of a square matrix, components of a sigma (one number for all, or a list).

    choices: words allowed, of names too, and of a flag in whose place a list of them may stand; refers: the table whose
    ids are allowed; least: of a number; positive: above zero; table: name of the declaration of what stands below it.
    """

    name: str
    kind: ValueKind
    what: str
    default: Any = NOTHING
    size: tuple[int, ...] = ()
    choices: tuple[str, ...] = ()
    refers: str = ""
    least: int | None = None
    positive: bool = False
    table: str = ""

    @property
    def unit(self) -> str:
        """The unit that the name ends with, empty where it has none."""
        return unit_in(self.name).replace("mm2", "mm²").replace("_per_", "/").removeprefix("1")


@frozen
class Declared:
    """A table. path: where it stands in the file, ``ID`` for an id of the user's; several may share one path by ``of``.

    of: key and word that choose this declaration among those of one path. free_keys: what keys of the user's own hold.
    """

    name: str
    path: str
    what: str
    keys: tuple[Key, ...] = field(default=())
    of: tuple[str, str] | None = None
    free_keys: Key | None = None

    @cached_property
    def by_name(self) -> dict[str, Key]:
        """The keys by their names."""
        return {key.name: key for key in self.keys}

    def key(self, name: str) -> Key | None:
        """What is declared of a key, of the user's own too; None for one that is not known."""
        return self.by_name.get(name, self.free_keys)


def declare(name: str, path: str, what: str, *keys: Key, free_keys: Key | None = None) -> Declared:
    """A table of these keys."""
    return Declared(name, path, what, keys, free_keys=free_keys)


def vector_keys_declared(units: dict[str, str], said: dict[str, str], free: tuple[str, ...]) -> tuple[Key, ...]:
    """The keys of named scalars with units (``declared.vectors``): which are free, values, sigmas of priors."""
    names = tuple(units)
    keys = [Key("free", "names", f"which of {', '.join(names)} are unknown", default=list(free), choices=names)]
    keys.append(Key("sigma", "table", "a prior: sigmas of the values given, under the same keys", table="vector_sigma"))
    for name in names:
        full = name if units[name] == "1" else f"{name}_{units[name]}"
        keys.append(Key(full, "number", said[name]))
    return tuple(keys)
