"""What was found out about a survey, or one that is like it: whoever asks again is told the same."""

from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from hashlib import blake2b
from typing import TypeVar, cast

import numpy as np

_T = TypeVar("_T")
_remembered: ContextVar[dict[object, object] | None] = ContextVar("remembered", default=None)


@contextmanager
def remembering() -> Iterator[None]:
    """Inside, and inside of what is inside, nothing is found out twice."""
    if _remembered.get() is not None:
        yield
        return
    token = _remembered.set({})
    try:
        yield
    finally:
        _remembered.reset(token)


def remembered(find: Callable[..., _T], *of: Hashable) -> _T:
    """``find(*of)``, or what it gave for the same before; surveys are told apart by identity."""
    return once((find, of), lambda: find(*of))


def once(of: Hashable, find: Callable[[], _T]) -> _T:
    """``find()``, or what was found ``of`` the same before; nobody may change it."""
    known = _remembered.get()
    if known is None:
        return find()
    if of not in known:
        known[of] = find()
    return cast(_T, known[of])


def content(*parts: object) -> bytes:
    """A number that two lists share only where all arrays in them are the same, and all else reads the same."""
    digest = blake2b(digest_size=20)
    for part in parts:
        if isinstance(part, np.ndarray):
            digest.update(repr((part.dtype.str, part.shape)).encode())
            digest.update(np.ascontiguousarray(part).data)
        else:
            digest.update(repr(part).encode())
    return digest.digest()
