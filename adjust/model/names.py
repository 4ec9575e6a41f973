"""The order of names, as people count: epochs and points that are numbered; and what belongs to each of them."""

import re
from collections.abc import Hashable, Iterable
from functools import lru_cache
from typing import TypeVar

import numpy as np

from adjust.model.arrays import IntArray

_PARTS = re.compile(r"\d+|\D+")
_Key = TypeVar("_Key", bound=Hashable)
_Value = TypeVar("_Value")


def grouped(items: Iterable[tuple[_Key, _Value]]) -> dict[_Key, list[_Value]]:
    """By key all values that come with it; both in the order in which they come."""
    out: dict[_Key, list[_Value]] = {}
    for key, value in items:
        out.setdefault(key, []).append(value)
    return out


def numbered(names: Iterable[_Key]) -> tuple[list[_Key], IntArray]:
    """The different ones in the order in which they come, and (n,) of each its number among them."""
    every = list(names)
    number = {name: k for k, name in enumerate(dict.fromkeys(every))}
    return list(number), np.fromiter(map(number.__getitem__, every), np.int64, len(every))


@lru_cache(maxsize=2**15)
def natural_key(name: str) -> tuple[tuple[int, int, str], ...]:
    """Key that sorts ``e2`` before ``e10``; different names have different keys."""
    # 4000: the interpreter refuses to take longer numbers apart
    return tuple([(0, int(part[:4000]), part) if part.isdecimal() else (1, 0, part) for part in _PARTS.findall(name)])
