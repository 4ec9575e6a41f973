"""Whether JSON that may come from anywhere has the shape that a program wrote: said once, checked before it is used.

>>> misfit({"epoch_id": "t01", "angles_deg": [1.0, "x"]}, {"epoch_id": str, "angles_deg": [NUMBER]})
"angles_deg: 'x'"
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, TypeGuard

from adjust.model.frozen import frozen

_LARGEST = 1e15


@frozen
class Each:
    """A dictionary of any keys, all values of one shape; ``key`` may refuse some."""

    shape: object
    key: Callable[[str], bool] = lambda _: True


@frozen
class Either:
    """One of several shapes."""

    shapes: tuple[Any, ...]


def is_number(value: object) -> TypeGuard[float]:
    """Whether a value is a finite number of a size that can be meant."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= _LARGEST


def is_whole(value: object) -> TypeGuard[int]:
    """Whether a value is an integer of 64 bits."""
    return isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63


def at_least_0(value: object) -> TypeGuard[float]:
    """Whether a value is a number, and not negative."""
    return is_number(value) and value >= 0.0


def is_real(value: object) -> TypeGuard[float]:
    """Whether a value is a number, or says that there is none (nan, inf)."""
    return is_number(value) or (isinstance(value, float) and not math.isfinite(value))


NUMBER, WHOLE, POSITIVE, REAL = is_number, is_whole, at_least_0, is_real


def misfit(value: object, shape: Any, name: str = "") -> str | None:
    """Where a value first differs from a shape and what is there, None where it fits.

    shape: a type, a function that says yes or no, None, [shape of each item], {key: shape} (a key with ``?`` behind it
    may be missing, other keys do not matter), :class:`Each`, :class:`Either`.
    """
    if isinstance(shape, Either):
        return None if any(misfit(value, one) is None for one in shape.shapes) else _found(name, value)
    if isinstance(shape, Mapping | Each):
        return _of_dictionary(value, shape, name)
    if isinstance(shape, list):
        if not isinstance(value, list | tuple):
            return _found(name, value)
        return next((said for item in value if (said := misfit(item, shape[0], name)) is not None), None)
    if shape is None:
        return None if value is None else _found(name, value)
    fits = isinstance(value, shape) if isinstance(shape, type) else shape(value)
    return None if fits else _found(name, value)


def _of_dictionary(value: object, shape: Mapping[str, object] | Each, name: str) -> str | None:
    if not isinstance(value, dict):
        return _found(name, value)
    if isinstance(shape, Each):
        pairs = [(key, shape.shape) for key in value]
        bad = next((key for key in value if not shape.key(key)), None)
        if bad is not None:
            return _found(name, bad)
    else:
        pairs = [(key.removesuffix("?"), one) for key, one in shape.items()
                 if not key.endswith("?") or key.removesuffix("?") in value]  # fmt: skip
    for key, one in pairs:
        inside = f"{name}.{key[:40]}".lstrip(".")
        if key not in value:
            return f"{inside}: missing"
        if (said := misfit(value[key], one, inside)) is not None:
            return said
    return None


def _found(name: str, value: object) -> str:
    shown = "a list" if isinstance(value, list) else "a table" if isinstance(value, dict) else repr(value)[:40]
    return f"{name}: {shown}" if name else shown
