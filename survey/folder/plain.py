"""Values as JSON knows them; loads nothing that a list of runs does not need."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_AS_IT_IS = frozenset((str, int, bool, type(None)))
_FLOATS = {float}


class PlainRecords(Mapping[str, dict[str, object]]):
    """Entries by name whose values are what JSON knows already."""


class PlainEntries(Sequence[dict[str, object]]):
    """The same one after the other, without names."""


def attributes(thing: object, *names: str) -> dict[str, Any]:
    """What a thing says under these names, in this order."""
    return {name: getattr(thing, name) for name in names}


def differing(a: Mapping[str, object], b: Mapping[str, object]) -> list[str]:
    """Keys under which two mappings have different values, or one has none, in order."""
    return sorted(key for key in {*a, *b} if a.get(key) != b.get(key))


def plain(value: Any) -> Any:
    """Only what JSON knows: mappings and sequences kept, numbers as Python's, None for what is not finite."""
    kind = type(value)
    if kind in _AS_IT_IS or isinstance(value, PlainRecords | PlainEntries):
        return value
    if kind is float:
        return value if math.isfinite(value) else None
    if kind is list:
        kinds = set(map(type, value))
        if kinds <= _AS_IT_IS or (kinds == _FLOATS and all(map(math.isfinite, value))):
            return value
    if isinstance(value, Mapping):
        return {str(k): v if type(v) in _AS_IT_IS else plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(v) for v in value]
    if isinstance(value, bool | np.bool_):
        return bool(value)
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, int | np.integer):
        return int(value)
    return str(value)
