"""Frozen dataclasses that are quick to define.

``dataclass(frozen=True)`` writes and compiles up to six functions for every class: a third of a millisecond, at every
start of a command hundreds of times. Here all classes share functions that go by their fields. All else is as ever:
``fields``, ``replace`` and ``asdict`` of ``dataclasses``, checked types, signatures.
"""

from collections.abc import Callable
from dataclasses import MISSING, Field, FrozenInstanceError, dataclass, field, fields
from itertools import repeat
from operator import attrgetter
from reprlib import recursive_repr
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar, dataclass_transform, overload

if TYPE_CHECKING:
    from inspect import Signature

Class = TypeVar("Class")
_put = object.__setattr__


@overload
def frozen(cls: type[Class], /) -> type[Class]: ...


@overload
def frozen(*, eq: bool = True) -> Callable[[type[Class]], type[Class]]: ...


@dataclass_transform(frozen_default=True, field_specifiers=(field,))
def frozen(cls: type[Class] | None = None, /, *, eq: bool = True) -> Callable[[type[Class]], type[Class]] | type[Class]:
    """As ``dataclass(frozen=True)``. eq=False: equal to nothing but itself, as what has arrays for fields."""

    def made(cls: type[Class]) -> type[Class]:
        own = {name for name, value in vars(cls).items() if value is not None}  # __hash__ is None beside an __eq__
        cls = dataclass(init=False, repr=False, eq=False)(cls)
        functions = _SHARED | {"__init__": _constructor(cls)} | (_comparisons(cls) if eq else {})
        for name in functions.keys() - own:
            setattr(cls, name, functions[name])
        return cls

    return made if cls is None else made(cls)


def _arguments(cls: type[Any]) -> "list[Field[Any]]":
    """Fields that its constructor takes, those that it takes by name alone at the end."""
    return sorted((f for f in fields(cls) if f.init), key=lambda f: bool(f.kw_only))


def _constructor(cls: type[Any]) -> Callable[..., None]:
    arguments = _arguments(cls)
    names = [f.name for f in arguments]
    in_order = [f.name for f in arguments if not f.kw_only]
    defaults = {f.name: f.default for f in arguments if f.default is not MISSING}
    factories = {f.name: f.default_factory for f in arguments if f.default_factory is not MISSING}
    least = max((i for i, name in enumerate(names, start=1) if name not in defaults), default=0)
    absent = tuple(defaults.get(name) for name in names)
    known, finishes = set(names), hasattr(cls, "__post_init__")

    def arranged(values: tuple[object, ...], named: dict[str, object]) -> list[object]:
        given = dict(zip(in_order, values, strict=False)) | named
        made = {name: factory() for name, factory in factories.items() if name not in given} if factories else {}
        full = defaults | made | given
        if len(given) < len(values) + len(named) or full.keys() != known:
            _Signature.of(cls).bind(*values, **named)  # raises, and says what is wrong
        return [full[name] for name in names]

    def init(self: Any, /, *values: object, **named: object) -> None:
        n = len(values)
        in_order_alone = not named and least <= n <= len(in_order)
        found = values + absent[n:] if in_order_alone else arranged(values, named)
        for _ in map(_put, repeat(self), names, found):  # quicker than calls in a loop
            pass
        if finishes:
            self.__post_init__()

    return init


def _comparisons(cls: type[Any]) -> dict[str, Callable[..., Any]]:
    names = [f.name for f in fields(cls) if f.compare]

    def one_by_one(self: object) -> tuple[object, ...]:
        return tuple(getattr(self, name) for name in names)

    compared: Callable[[object], object] = attrgetter(*names) if len(names) > 1 else one_by_one

    def equal(self: object, other: object) -> bool:
        return compared(self) == compared(other) if type(other) is type(self) else NotImplemented

    return {"__eq__": equal, "__hash__": lambda self: hash(compared(self))}


@recursive_repr()
def _repr(self: Any) -> str:
    shown = (f"{f.name}={getattr(self, f.name)!r}" for f in fields(self) if f.repr)
    return f"{type(self).__qualname__}({', '.join(shown)})"


def _refuse(_: object, name: str, *value: object) -> NoReturn:
    raise FrozenInstanceError(f"cannot {'assign to' if value else 'delete'} field {name!r}")


class _Signature:
    """The signature of a class by its fields, made when ``inspect`` asks for it."""

    def __get__(self, _: object, cls: type[Any]) -> "Signature":
        return self.of(cls)

    @staticmethod
    def of(cls: type[Any]) -> "Signature":
        """That of one class."""
        from inspect import Parameter, Signature  # here: no command needs them

        def parameter(f: "Field[Any]") -> Parameter:
            default = f.default if f.default_factory is MISSING else f.default_factory
            kind = Parameter.KEYWORD_ONLY if f.kw_only else Parameter.POSITIONAL_OR_KEYWORD
            there = {} if default is MISSING else {"default": default}
            return Parameter(f.name, kind, annotation=f.type, **there)

        return Signature([parameter(f) for f in _arguments(cls)], return_annotation=None)


_SHARED = {"__repr__": _repr, "__setattr__": _refuse, "__delattr__": _refuse, "__signature__": _Signature()}
