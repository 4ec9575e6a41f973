"""Frozen options out of a table of a plan."""

from collections.abc import Mapping
from dataclasses import fields, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, TypeVar, get_args

from survey.folder.units import from_si, unit_in
from survey.project.declared.node import Node

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

_Options = TypeVar("_Options", bound="DataclassInstance")


def with_given(
    default: _Options, node: Node, least: Mapping[str, float] = MappingProxyType({}), also: tuple[str, ...] = ()
) -> _Options:
    """``default`` with what a table says of its fields: each under its name, angles (rad) with ``_deg`` behind it.

    Numbers are positive, or at least as ``least`` says; words are those of the field's type. also: keys that somebody
    else reads. Raises SurveyError, for keys that are none of these too.
    """
    keys = {f.name: f"{f.name}_deg" if f.type is float and unit_in(f.name) == "1" else f.name for f in fields(default)}
    node.allow(*keys.values(), *also)
    found: dict[str, object] = {}
    for f in fields(default):
        key, usual, lowest = keys[f.name], getattr(default, f.name), least.get(f.name)
        if f.type is bool:
            found[f.name] = node.flag(key, usual)
        elif f.type is int:
            found[f.name] = node.integer(key, int(lowest or 0), usual)
        elif f.type is float:
            shown = float(from_si(usual, "deg")) if key != f.name else usual
            number = node.number(key, shown, positive=lowest is None)
            if lowest is not None and number < lowest:
                rule = "cannot be negative" if lowest == 0.0 else f"must be at least {lowest:g}"
                raise node.error(f"found {number:g}; it {rule}", key)
            found[f.name] = usual if key not in node.values else node.si(key) if key != f.name else number
        else:
            found[f.name] = node.choice(key, get_args(f.type), usual)
    return replace(default, **found)
