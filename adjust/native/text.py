"""Rows of large tables as text, by the core: names by number, numbers with fixed decimals (``text.h``)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from adjust.model.survey import FloatArray, IntArray
from adjust.native.library import Function

_LONGEST = 27
_number_rows = Function(
    "number_rows",
    "of_block[*] block_ptr[*] block[n] of_item[*] item_ptr[*] item[n] values[n,k] power[k] decimals[k] out[*]",
)


class Words(NamedTuple):
    """Texts one after the other as bytes, text i from ptr[i] to ptr[i + 1]."""

    characters: npt.NDArray[np.uint8]
    ptr: IntArray

    @classmethod
    def of(cls, words: Sequence[str]) -> "Words":
        """UTF-8."""
        every = [word.encode() for word in words]
        ptr = np.cumsum([0, *map(len, every)], dtype=np.int64)
        return cls(np.frombuffer(b"".join(every), np.uint8), ptr)


def number_rows(
    blocks: Words, block: IntArray, items: Words, item: IntArray, values: FloatArray, decimals: Sequence[int]
) -> bytes | None:
    """A line for each of n rows: text of its block and of its item, then its values (n, k), each after a comma.

    block, item: (n,) which texts. decimals: (k,) of the values; a number that is not finite is blank. None where one
    is larger than 1e17 units of its last decimal.
    """
    if min(x.min(initial=0) for x in (block, item)) < 0 or any(
        x.max(initial=-1) >= len(words.ptr) - 1 for x, words in ((block, blocks), (item, items))
    ):
        raise IndexError("a row names a text that there is not")
    names = sum(int(np.diff(words.ptr).max(initial=0)) for words in (blocks, items))
    out = np.empty(len(values) * (names + _LONGEST * values.shape[1] + 1), dtype=np.uint8)
    power = np.array([10.0**d for d in decimals])
    n = _number_rows(*blocks, block, *items, item, values, power, np.array(decimals, dtype=np.int64), out)
    return None if n < 0 else out[:n].tobytes()
