"""Rows of large tables as text, by the core: names by number, numbers with fixed decimals or as repr (``text.h``)."""

from collections.abc import Sequence
from functools import cache
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
_record_rows = Function(
    "record_rows",
    "words[*] ptr[*] word[n,w] values[n,k] parts[p,2] significant powers[617,2] ends[n] out[*]",
)
WHOLE = 17
"""Significant digits of numbers in full, as by repr."""
TEXT, WORD, NUMBERS = 0, 1, 2
"""Kinds of the parts of a record."""
_LEAST_POWER, _POWERS = -292, 617
_LONGEST_NUMBER = 26


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


def record_rows(
    words: Words, word: IntArray, values: FloatArray, parts: Sequence[tuple[int, int]], significant: int = WHOLE
) -> tuple[memoryview, IntArray]:
    """Records of one form one after the other, and where each ends (n,).

    parts: of every record, in turn: (TEXT, i) the i-th of the words; (WORD, j) the word of number ``word[row, j]``;
    (NUMBERS, m) the next m of ``values[row]``, (n, k), with ", " between them, the first of the words for what is not
    finite. significant: digits at most; fewer than ``WHOLE`` are written as by ``"%.12g"``.
    """
    length, numbers = np.diff(words.ptr), sum(m for kind, m in parts if kind == NUMBERS)
    texts, columns = ([i for kind, i in parts if kind == wanted] for wanted in (TEXT, WORD))
    if len(word) and (word.min(initial=0) < 0 or word.max(initial=-1) >= len(length)):
        raise IndexError("a record names a word that there is not")
    if numbers > values.shape[1] or max(texts, default=-1) >= len(length) or max(columns, default=-1) >= word.shape[1]:
        raise IndexError("a part is of something that there is not")
    each = int(length[texts].sum()) + numbers * (_LONGEST_NUMBER + int(length[:1].sum()))
    out = np.empty(len(values) * each + int(length[word[:, columns]].sum()) + _LONGEST_NUMBER, dtype=np.uint8)
    ends = np.empty(len(values), dtype=np.int64)
    made = _record_rows(*words, word, values, np.array(parts, dtype=np.int64), significant, _powers(), ends, out)
    return out[:made].data, ends


@cache
def _powers() -> IntArray:
    """128 bits of the powers of ten from ``_LEAST_POWER`` on, rounded up: the upper and the lower 64 of each."""
    out = np.empty((_POWERS, 2), dtype=np.uint64)
    for row, e in enumerate(range(_LEAST_POWER, _LEAST_POWER + _POWERS)):
        shift = 127 - (e * 1741647 >> 19)  # floor(log2(10^e)), as text.h has it
        above, below = 10 ** max(e, 0) << max(shift, 0), 10 ** max(-e, 0) << max(-shift, 0)
        bits = -(-above // below)
        out[row] = bits >> 64, bits & (1 << 64) - 1
    return out.view(np.int64)
