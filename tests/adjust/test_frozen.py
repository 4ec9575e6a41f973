"""Frozen values are dataclasses in all but how their functions are made: beside those that the library makes."""

import ast
import copy
import dataclasses
import inspect
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from adjust.model.frozen import frozen

ROOT = Path(__file__).parents[2]


@frozen
class Ours:
    a: int
    b: str = "b"
    c: list[int] = dataclasses.field(default_factory=list, repr=False)
    d: float = dataclasses.field(default=0.5, kw_only=True)


@dataclasses.dataclass(frozen=True)
class Theirs:
    a: int
    b: str = "b"
    c: list[int] = dataclasses.field(default_factory=list, repr=False)
    d: float = dataclasses.field(default=0.5, kw_only=True)


@frozen
class Wider(Ours):
    e: int = 7


@frozen(eq=False)
class Itself:
    """Of one field, which is computed with at the end."""

    x: int

    def __post_init__(self) -> None:
        if self.x < 0:
            raise ValueError("x")

    def __repr__(self) -> str:
        return "its own"


@frozen
class One:
    x: float


@frozen
class Empty:
    pass


CALLS: list[Callable[[Any], Any]] = [
    lambda made: made(1), lambda made: made(1, "x", [2]), lambda made: made(b="y", a=2), lambda made: made(1, d=2.0),
    lambda made: dataclasses.replace(made(1, "x"), b="z", d=3.0), lambda made: copy.deepcopy(made(1, c=[3])),
]  # fmt: skip


@pytest.mark.parametrize("call", CALLS)
def test_values_are_those_of_the_library(call: Callable[[Any], Any]) -> None:
    ours, theirs = call(Ours), call(Theirs)
    assert dataclasses.asdict(ours) == dataclasses.asdict(theirs)
    assert list(vars(ours)) == list(vars(theirs))
    assert repr(ours) == repr(theirs).replace("Theirs", "Ours")
    assert ours == call(Ours)
    assert ours != theirs
    assert ours != dataclasses.replace(ours, a=9)
    assert pickle.loads(pickle.dumps(ours)) == ours


@pytest.mark.parametrize("call", [
    lambda made: made(), lambda made: made(1, "x", [], 2.0), lambda made: made(1, a=1), lambda made: made(1, e=1),
    lambda made: dataclasses.replace(made(1), e=1), lambda made: hash(made(1)),
])  # fmt: skip
def test_what_the_library_refuses_is_refused(call: Callable[[Any], Any]) -> None:
    for made in (Theirs, Ours):
        with pytest.raises(TypeError):
            call(made)


def test_a_refusal_says_what_is_missing() -> None:
    untyped: Callable[..., Ours] = Ours
    with pytest.raises(TypeError, match="'a'"):
        untyped(b="x")


def test_default_values_are_not_shared() -> None:
    assert Ours(1).c is not Ours(1).c


def test_nothing_can_be_changed() -> None:
    value = Ours(1)
    for change in (lambda: setattr(value, "a", 2), lambda: setattr(value, "new", 2), lambda: delattr(value, "a")):
        with pytest.raises(dataclasses.FrozenInstanceError):
            change()
    assert value == Ours(1)


def test_equal_values_have_equal_hashes_and_are_of_one_class() -> None:
    assert hash(One(0.5)) == hash(One(0.5))
    assert One(0.5) == One(0.5) != One(0.25)
    assert Empty() == Empty()
    assert len({Empty(), Empty(), One(1.0), One(1.0)}) == 2
    assert Wider(1) != Ours(1)
    assert Wider(1, "b", [], 8, d=2.0).e == 8


def test_values_with_arrays_are_equal_to_themselves_alone() -> None:
    value = Itself(1)
    assert value == value
    assert value != Itself(1)
    assert len({value, Itself(1)}) == 2


def test_what_a_class_says_itself_stands() -> None:
    assert repr(Itself(1)) == "its own"
    with pytest.raises(ValueError, match="x"):
        Itself(-1)


def test_signatures_are_those_of_the_library() -> None:
    ours, theirs = inspect.signature(Ours), inspect.signature(Theirs)
    assert [(p.name, p.kind, p.annotation) for p in ours.parameters.values()] == [
        (p.name, p.kind, p.annotation) for p in theirs.parameters.values()
    ]
    assert ours.parameters["b"].default == "b"
    assert ours.parameters["a"].default is inspect.Parameter.empty


def test_all_frozen_values_of_the_packages_are_made_so() -> None:
    """But where they have slots, which only the library makes."""
    written = [
        f"{path.relative_to(ROOT)}:{node.lineno}"
        for package in ("adjust", "survey", "capture")
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "dataclass"
        and {"frozen", "slots"} & {k.arg for k in node.keywords} == {"frozen"}
    ]  # fmt: skip
    assert written == []
