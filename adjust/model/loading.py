"""Public names of a package that are loaded when they are first used."""

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any


def lazily(package: dict[str, Any], places: Mapping[str, str]) -> Callable[[str], Any]:
    """The ``__getattr__`` of a package. package: its ``globals()``. places: by name its module, or ``module:name``."""

    def found(name: str) -> Any:
        if name not in places:
            raise AttributeError(f"module {package['__name__']!r} has no attribute {name!r}")
        module, _, attribute = places[name].partition(":")
        package[name] = getattr(import_module(module), attribute or name)
        return package[name]

    return found
