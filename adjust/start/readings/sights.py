"""Readings sorted by what they say of approximate coordinates: turned directions, distances, height differences.

Coordinates are taken along the zero of bearings, counter-clockwise of it, and up; horizontal ones as complex numbers.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from math import sqrt
from statistics import median
from typing import TypeVar, cast

import numpy as np

from adjust.model.names import grouped
from adjust.model.observations import PositionRef, Reading, position_text
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.averaging import circular_median
from adjust.spatial.vertical import plumb

Node = str
"""A world point's id, or the text of a position in a frame that is known."""
_Value = TypeVar("_Value", float, FloatArray)
_Place = TypeVar("_Place")
_Grown = TypeVar("_Grown")


@dataclass(eq=False)
class Sights:
    """directions: per set (a setup at one node, or angles that hang together) the node and angles to targets (rad).

    azimuths: angle from a node to another. level: horizontal distances (m); slope: others, with the height of the
    target's end above the instrument's end less that of the points. rise: height differences between points.
    zenith: (angle, instrument minus target height). All but directions several values per ordered pair of nodes (a, b).
    """

    directions: dict[str, tuple[Node, dict[Node, float]]] = field(default_factory=dict)
    azimuths: dict[tuple[Node, Node], list[float]] = field(default_factory=dict)
    level: dict[tuple[Node, Node], list[float]] = field(default_factory=dict)
    slope: dict[tuple[Node, Node], list[tuple[float, float]]] = field(default_factory=dict)
    rise: dict[tuple[Node, Node], list[float]] = field(default_factory=dict)
    zenith: dict[tuple[Node, Node], list[tuple[float, float]]] = field(default_factory=dict)
    nodes: set[Node] = field(default_factory=set)

    def distances(self, height: Mapping[Node, float]) -> dict[tuple[Node, Node], float]:
        """Horizontal distances, the median of all, in both orders; slopes where both heights are known."""
        found: dict[tuple[Node, Node], list[float]] = {}
        for (a, b), values in self.level.items():
            found.setdefault((min(a, b), max(a, b)), []).extend(values)
        for (a, b), slopes in self.slope.items():
            if a in height and b in height:
                for s, above in slopes:
                    across = s * s - (height[b] - height[a] + above) ** 2
                    if across > 0.0:
                        found.setdefault((min(a, b), max(a, b)), []).append(sqrt(across))
        middle = {pair: median(v) for pair, v in found.items()}
        return middle | {(b, a): d for (a, b), d in middle.items()}

    @cached_property
    def rises(self) -> list[tuple[Node, Node, float]]:
        """Height differences, the median of all of each pair."""
        return [(a, b, median(values)) for (a, b), values in self.rise.items()]


def node_of(ref: PositionRef) -> Node:
    """The node of a position."""
    return position_text(ref)


def horizon_axes(survey: Survey) -> FloatArray:
    """Rows (3, 3): zero of bearings, counter-clockwise of it, up, at the origin and the given tilt."""
    vertical = survey.vertical
    line = plumb(vertical, survey.bearings.zero, np.asarray(vertical.tilt.values, dtype=float))
    return np.array([line.zero, np.cross(line.up, line.zero), line.up])


def ties(survey: Survey) -> list[tuple[PositionRef, PositionRef, FloatArray]]:
    """Positions and the observed differences (3,) m from the first to the second, where used and whole."""
    return [
        (a, b, v)
        for d in survey.coordinate_differences if d.used
        for a, b, v, variances in zip(d.at, d.to, d.values, np.diag(d.cov).reshape(-1, 3), strict=True)
        if np.isfinite(variances).all()
    ]  # fmt: skip


def spread_differences(survey: Survey, known: dict[Node, FloatArray]) -> bool:
    """Add to ``known``, (3,) m in the world, what lies at the other end of observed differences; whether any does."""
    before = len(known)
    known |= spread([(node_of(a), node_of(b), v) for a, b, v in ties(survey)], known)
    return len(known) > before


def spread(steps: Sequence[tuple[Node, Node, _Value]], known: Mapping[Node, _Value]) -> dict[Node, _Value]:
    """Values of all nodes that steps from one to another, each with its difference, join to known ones.

    The median of all ways of the same length. Numbers or arrays.
    """
    near = grouped(way for a, b, step in steps for way in ((a, (b, step)), (b, (a, -step))))
    out = dict(known)
    front = list(out)
    while front:
        ways: dict[Node, list[_Value]] = {}
        for a in front:
            for b, step in near.get(a, ()):
                if b not in out:
                    ways.setdefault(b, []).append(out[a] + step)
        out |= {b: _middle(values) for b, values in ways.items()}
        front = list(ways)
    return out


def _middle(values: Sequence[_Value]) -> _Value:
    if isinstance(values[0], float):
        return median(values)
    return cast(_Value, np.median(values, axis=0))


def best_of_places(
    nodes: Iterable[Node], places: Callable[[Node], Sequence[_Place]], grown: Callable[[Node, _Place], _Grown],
    misfit: Callable[[_Grown], tuple[int, float]],
) -> _Grown | None:  # fmt: skip
    """Of the first node that can be in several places what grows from the best of them; None where there is none."""
    for node in sorted(nodes):
        found = places(node)
        if len(found) > 1:
            return min((grown(node, place) for place in found), key=misfit)
    return None


def collect_sights(survey: Survey) -> Sights:
    """All used readings and distances of levelled setups."""
    out = Sights()
    sign = -1.0 if survey.bearings.clockwise else 1.0
    tilted = {s.setup_id for s in survey.setups if not s.levelled}
    polar: dict[tuple[str, Node, Node], dict[str, Reading]] = {}
    sets: dict[str, tuple[Node, dict[Node, list[float]]]] = {}
    angles: list[Reading] = []
    for r in survey.readings:
        if not r.used or r.setup_id in tilted:
            continue
        a, b = node_of(r.at), node_of(r.to)
        out.nodes |= {a, b}
        if r.kind == "direction":
            _, targets = sets.setdefault(f"{r.setup_id}/{a}", (a, {}))
            targets.setdefault(b, []).append(sign * r.value)
        elif r.kind == "angle":
            angles.append(r)
        elif r.kind == "azimuth":
            out.azimuths.setdefault((a, b), []).append(sign * r.value)
        elif r.kind == "horizontal_distance":
            out.level.setdefault((a, b), []).append(r.value)
        elif r.kind == "height_difference":
            out.rise.setdefault((a, b), []).append(r.value + r.instrument_height - r.target_height)
        else:
            polar.setdefault((r.setup_id, a, b), {})[r.kind] = r
    for (_, a, b), found in polar.items():
        _polar(out, a, b, found)
    _angles(out, sets, angles, sign)
    for name, (a, targets) in sets.items():
        out.directions[name] = a, {b: circular_median(np.array(values)) for b, values in targets.items()}
    for d in survey.distances:
        if d.used:
            a, b = node_of(d.a), node_of(d.b)
            out.nodes |= {a, b}
            out.slope.setdefault((a, b), []).append((d.value, 0.0))
    return out


def _polar(out: Sights, a: Node, b: Node, found: Mapping[str, Reading]) -> None:
    slope, zenith = found.get("slope_distance"), found.get("zenith")
    if slope is not None and zenith is not None:
        out.level.setdefault((a, b), []).append(slope.value * abs(np.sin(zenith.value)))
        rise = slope.value * np.cos(zenith.value) + zenith.instrument_height - zenith.target_height
        out.rise.setdefault((a, b), []).append(float(rise))
    elif slope is not None:
        out.slope.setdefault((a, b), []).append((slope.value, slope.target_height - slope.instrument_height))
    elif zenith is not None:
        out.zenith.setdefault((a, b), []).append((zenith.value, zenith.instrument_height - zenith.target_height))


def _angles(
    out: Sights, sets: dict[str, tuple[Node, dict[Node, list[float]]]], angles: list[Reading], sign: float
) -> None:
    """Angles at one node, hung together through their targets, are as good as directions."""
    left = list(angles)
    count = 0
    while left:
        first = left[0]
        if first.second is None:
            left.pop(0)
            continue
        a = node_of(first.at)
        out.nodes |= {node_of(first.second)}
        targets = {node_of(first.to): [0.0]}
        grew = True
        while grew:
            grew, rest = False, []
            for r in left:
                to, second = node_of(r.to), node_of(r.second) if r.second is not None else ""
                if node_of(r.at) != a or not (to in targets or second in targets):
                    rest.append(r)
                elif to in targets:
                    targets.setdefault(second, []).append(targets[to][0] + sign * r.value)
                    grew = True
                else:
                    targets.setdefault(to, []).append(targets[second][0] - sign * r.value)
                    grew = True
            left = rest
        out.nodes |= set(targets)
        sets[f"angles {count} at {a}"] = (a, targets)
        count += 1
