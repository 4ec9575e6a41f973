"""``numba.njit`` whose kernels open from the cache on disk without waking the compiler.

Before it opens the first cached kernel, numba registers everything that it could compile: half of what a small survey
takes. A cached kernel is machine code and needs only numba's runtime. The compiler still wakes itself where a kernel is
not in the cache. What numba has renamed is left to numba: it is slower then, and right.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core import types
from numba.core.caching import FunctionCache
from numba.core.runtime.nrt import rtsys

_F = TypeVar("_F", bound=Callable[..., Any])


class _OpenedAsIs(FunctionCache):
    """numba's cache of one function; loading registers nothing."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled function of a signature, or None where the cache does not hold it."""
        rtsys.initialize(target_context)  # memory of arrays; all other symbols are there since the context was made
        with self._guard_against_spurious_io_errors():
            return super()._load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # numba has no types


_KNOWN = all(hasattr(FunctionCache, n) for n in ("_load_overload", "_guard_against_spurious_io_errors"))


def _one_for_all_values(get_call_template: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel that another one calls with a constant is not compiled once more for just this constant."""

    def of_types(args: Any, kws: Any) -> Any:
        plain: Callable[[Any], Any] = types.unliteral
        return get_call_template(tuple(map(plain, args)), {name: plain(a) for name, a in kws.items()})

    return of_types


def njit(*, cache: bool = True, **options: Any) -> Callable[[_F], _F]:
    """``numba.njit(cache=cache, **options)``, with the cache opened as said above."""

    def compiled(function: _F) -> _F:
        dispatcher = numba.njit(cache=cache, **options)(function)
        dispatcher.get_call_template = _one_for_all_values(dispatcher.get_call_template)
        if cache and _KNOWN and type(getattr(dispatcher, "_cache", None)) is FunctionCache:
            dispatcher._cache = _OpenedAsIs(function)  # type: ignore[no-untyped-call]  # numba has no types
        return dispatcher  # type: ignore[no-any-return]  # numba has no types; called as the function is

    return compiled
