"""``njit``: numba's, for kernels that cost nothing until they are called and open from the cache on disk at once.

Before it opens the first cached kernel, numba registers everything that it could compile: half of what a small survey
takes. A cached kernel is machine code and needs only numba's runtime. The compiler still wakes itself where a kernel is
not in the cache. What numba has renamed is left to numba: it is slower then, and right.
"""

import functools
import os
import pickle
import threading
from collections.abc import Callable
from io import BytesIO
from typing import Any, TypeVar

import numpy as np

_F = TypeVar("_F", bound=Callable[..., Any])
_MAKING = threading.Lock()


def njit(*, cache: bool = True, **options: Any) -> Callable[[_F], _F]:
    """``numba.njit(cache=cache, **options)``; numba itself is imported when the first kernel is called."""

    def compiled(function: _F) -> _F:
        return Kernel(function, {"cache": cache, **options})  # type: ignore[return-value]  # called as the function is

    return compiled


class Kernel:
    """A compiled function: numba's dispatcher, made when it is first called, here or by another kernel."""

    def __init__(self, function: Callable[..., Any], options: dict[str, Any]) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self._options = function, options
        self._made: Any = None

    @property
    def dispatcher(self) -> Any:
        """Numba's object."""
        if self._made is None:
            with _MAKING:
                if self._made is None:
                    self._made = _dispatcher(self.py_func, self._options)
        return self._made

    @property
    def _numba_type_(self) -> Any:
        """What numba asks for when another kernel calls this one."""
        return self.dispatcher._numba_type_

    def __call__(self, *arguments: Any) -> Any:
        """Run it."""
        return (self._made or self.dispatcher)(*arguments)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.dispatcher, name)

    def __reduce__(self) -> str:
        return str(self.__qualname__)


def _dispatcher(function: Callable[..., Any], options: dict[str, Any]) -> Any:
    import numba
    from numba.core.caching import FunctionCache

    made = numba.njit(**options)(function)
    made.get_call_template = _one_for_all_values(made.get_call_template)
    if type(getattr(made, "_cache", None)) is FunctionCache:
        made._cache = _cache_class()(function)
    return made


def _one_for_all_values(get_call_template: Callable[..., Any]) -> Callable[..., Any]:
    """A kernel that another one calls with a constant is not compiled once more for just this constant."""
    from numba.core import types

    plain: Callable[[Any], Any] = types.unliteral

    def of_types(args: Any, kws: Any) -> Any:
        return get_call_template(tuple(map(plain, args)), {name: plain(a) for name, a in kws.items()})

    return of_types


@functools.cache
def _cache_class() -> Any:
    """Numba's cache of one function, whose loading registers and imports nothing that only the compiler needs."""
    from numba.core.caching import FunctionCache, IndexDataCacheFile
    from numba.core.environment import Environment, lookup_environment
    from numba.core.runtime.nrt import rtsys

    def rebuild_environment(module: str, constants: Any, name: str) -> Any:
        """As numba's, but without the module: compiled code has its globals inside."""
        found = lookup_environment(name)  # type: ignore[no-untyped-call]  # numba has no types
        if found is None:
            found = Environment({"__name__": module})
            found.consts[:] = constants
            found.env_name = name
            Environment._memo[name] = found
        return found

    class Opening(pickle.Unpickler):
        def find_class(self, module: str, name: str) -> Any:
            if (module, name) == ("numba.core.environment", "_rebuild_env"):
                return rebuild_environment
            return super().find_class(module, name)

    class Files(IndexDataCacheFile):
        def _load_data(self, name: str) -> Any:
            with open(self._data_path(name), "rb") as file:  # type: ignore[no-untyped-call]  # numba has no types
                return Opening(BytesIO(file.read())).load()

    class Opened(FunctionCache):
        def __init__(self, function: Callable[..., Any]) -> None:
            super().__init__(function)  # type: ignore[no-untyped-call]  # numba has no types
            self._cache_file.__class__ = Files
            self._cache_file._source_stamp = (self._cache_file._source_stamp, made_of(function))

        def load_overload(self, sig: Any, target_context: Any) -> Any:
            """The compiled function of a signature, or None where the cache does not hold it."""
            # memory of arrays; all other symbols are there since the context was made
            rtsys.initialize(target_context)
            with self._guard_against_spurious_io_errors():
                return super()._load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # no types

    names = {
        FunctionCache: ("_load_overload", "_guard_against_spurious_io_errors"),
        IndexDataCacheFile: ("_load_data", "_data_path"),
        Environment: ("_memo",),
    }
    return Opened if all(hasattr(c, n) for c, expected in names.items() for n in expected) else FunctionCache


def made_of(function: Callable[..., Any]) -> tuple[Any, ...]:
    """What a kernel's machine code holds beside its own file: size and time of other kernels' files, and constants.

    numba looks at the file of the kernel alone, and goes on with what other files have said before.
    """
    files: dict[str, Any] = {}
    constants: dict[str, str] = {}
    todo, seen = [function], set()
    while todo:
        f = todo.pop()
        if f in seen:
            continue
        seen.add(f)
        stat = os.stat(f.__code__.co_filename)
        files[f.__module__] = (stat.st_mtime_ns, stat.st_size)
        for name in f.__code__.co_names:
            value = f.__globals__.get(name)
            if isinstance(value, Kernel):
                todo.append(value.py_func)
            elif isinstance(value, int | float | tuple):
                constants[f"{f.__module__}.{name}"] = repr(value)
            elif isinstance(value, np.ndarray):
                constants[f"{f.__module__}.{name}"] = repr(value.tobytes())
    return tuple(sorted(files.items())), tuple(sorted(constants.items()))
