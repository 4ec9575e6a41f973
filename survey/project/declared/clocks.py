"""Clocks of cameras, turntables and measured poses, and the times of epochs, in ``survey.toml``."""

from collections.abc import Mapping
from typing import Any

from adjust.model.errors import SurveyError
from adjust.model.survey import Clock, VectorParameter
from survey.project.declared.bodies import CLOCK_UNITS
from survey.project.declared.node import Node
from survey.project.declared.toml_text import in_units
from survey.project.declared.vectors import key_of, read_vector, vector_to_toml


def read_clock(node: Node, timed: bool) -> Clock | None:
    """The table ``clock`` of a node; None where there is none. timed: whether the times of the epochs are known."""
    if not node.has("clock"):
        return None
    clock = node.table("clock")
    declared = clock.declared.by_name if clock.declared else {}
    units = {name: unit for name, unit in CLOCK_UNITS.items() if key_of(name, CLOCK_UNITS) in declared}
    known = [key for key in (*(key_of(name, units) for name in units), "sigma", "jitter_ms") if clock.has(key)]
    if known and not timed:
        raise clock.error("the times of the epochs are not known; give times_s or epoch_interval_s, or leave it out",
                          known[0])  # fmt: skip
    intervals = clock.number("jitter_intervals")
    if timed and intervals != 0.0:
        raise clock.error("the times of the epochs are known; give jitter_ms", "jitter_intervals")
    jitter = clock.si("jitter_ms") if timed else intervals
    if not jitter >= 0.0:
        raise clock.error(f"found {jitter:g}; a sigma is not negative", "jitter_ms" if timed else "jitter_intervals")
    given = read_vector(clock, units, ("offset",))
    needed = [n in given.free or value != 0.0 for n, value in zip(given.names, given.values, strict=True)]
    names = tuple(n for n, keep in zip(given.names, needed, strict=True) if keep)
    return Clock(VectorParameter(names, given.values[needed], given.free, given.prior), jitter)


def clock_to_toml(clock: Clock | None, timed: bool, where: str) -> dict[str, Any]:
    """The key that :func:`read_clock` reads; nothing where there is no clock."""
    if clock is None:
        return {}
    units = {name: CLOCK_UNITS[name] for name in clock.parameters.names}
    zero = {key_of(n, units) for n, x in zip(clock.parameters.names, clock.parameters.values, strict=True) if x == 0.0}
    table = {key: value for key, value in vector_to_toml(clock.parameters, units, where).items() if key not in zero}
    if not timed and table.keys() - {"free"}:
        raise SurveyError(f"{where}: has values, but the times of the epochs are not known; give them")
    table |= in_units(**{"jitter_ms" if timed else "jitter_intervals": clock.jitter or None})
    return {"clock": table}


def read_times(root: Node) -> dict[str, Any]:
    """The fields of a survey that say when its epochs are."""
    node = root.table("times_s")
    if root.has("epoch_interval_s") and node.values:
        raise root.error("times_s is given too; keep one of the two", "epoch_interval_s")
    times = {epoch_id: node.number(epoch_id) for epoch_id in node.values}
    return {"times": times, "epoch_interval": root.si("epoch_interval_s", None)}


def are_timed(times: Mapping[str, Any]) -> bool:
    """Whether what :func:`read_times` read says any time."""
    return bool(times["times"]) or times["epoch_interval"] is not None
