"""Which unknowns a survey has, under which GTSAM key, and what follows from them.

Poses live in *slots*: every pose parameter, free or held, and every table motion has one.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple, TypeVar

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import ParameterName
from adjust.model.survey import FloatArray, PoseParameter, VectorParameter

T = TypeVar("T")
POSE_COMPONENTS = ("rx", "ry", "rz", "tx", "ty", "tz")
POSE_UNITS = ("rad", "rad", "rad", "m", "m", "m")
_IDENTITY = Pose3()


class Unknown(NamedTuple):
    """One GTSAM variable. ``kind`` is pose, point or vector; components and units are those of its tangent."""

    name: ParameterName
    key: int
    kind: str
    components: tuple[str, ...]
    units: tuple[str, ...]

    @property
    def dim(self) -> int:
        """Number of tangent components."""
        return len(self.components)


@frozen(eq=False)
class VectorMap:
    """A parameter vector from its unknown: full = base + matrix @ free; ``key`` is None when all is held.

    borrowed: by free component (its number) the key and the component of it that it is, where that is another vector's;
    the other free components are those of ``key``, in their order.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    base: FloatArray
    matrix: FloatArray
    key: int | None
    free: tuple[str, ...]
    status: tuple[str, ...]
    borrowed: Mapping[int, tuple[int, int]] = field(default_factory=dict)

    @property
    def own(self) -> tuple[str, ...]:
        """The free components that are those of ``key``."""
        return tuple(x for i, x in enumerate(self.free) if i not in self.borrowed)

    @property
    def sources(self) -> list[tuple[int, int]]:
        """Of every free component the key, and which component of it."""
        own = self.own
        return [self.borrowed[i] if i in self.borrowed else (int(self.key or 0), own.index(x))
                for i, x in enumerate(self.free)]  # fmt: skip

    def full(self, values: gtsam.Values) -> FloatArray:
        """The whole vector (n,) at these values."""
        if self.borrowed:
            return np.asarray(self.base + self.matrix @ [values.atVector(key)[j] for key, j in self.sources])
        if self.key is None:
            return self.base
        return np.asarray(self.base + self.matrix @ values.atVector(self.key))


class Link(NamedTuple):
    """One step of a chain: a slot, taken as it is or inverted."""

    slot: int
    inverse: bool = False

    @property
    def back(self) -> "Link":
        """The same the other way round."""
        return Link(self.slot, not self.inverse)


Chain = tuple[Link, ...]


@frozen(eq=False)
class TableSlot:
    """A slot that is the motion of a table at an epoch: from its angles and its geometry."""

    slot: int
    table_id: str
    epoch_id: str
    axes: tuple[str, ...]
    angles_key: int
    geometry: VectorMap

    @property
    def parts(self) -> list[tuple[int, int, int]]:
        """Of every unknown that it follows from the key, its first column among the derivatives, and their number."""
        k, geometry = len(self.axes), self.geometry
        angles = (self.angles_key, 0, k)
        return [angles] if geometry.key is None else [angles, (geometry.key, k, len(geometry.free))]


@frozen(eq=False)
class ShiftedSlot:
    """A slot that is another one, the first of ``nodes``, at another time than its epoch's.

    nodes: slots of the same body at n epochs around. times: of the other n - 1 after the first, in the unit of clocks.
    clocks: vectors whose components, each times a number, add up to the time. parts: as of a table's.
    """

    slot: int
    nodes: tuple[int, ...]
    times: tuple[float, ...]
    clocks: tuple[tuple[VectorMap, FloatArray], ...]
    parts: list[tuple[int, int, int]]

    @cached_property
    def by_clocks(self) -> FloatArray:
        """(c,) derivatives of the time by the free components of all clocks."""
        return np.concatenate([rates @ vector.matrix for vector, rates in self.clocks])


@dataclass(eq=False)
class Unknowns:
    """All unknowns and slots of a survey, filled once by :func:`collect_unknowns` and then only read."""

    by_name: dict[ParameterName, Unknown] = field(default_factory=dict)
    by_key: dict[int, Unknown] = field(default_factory=dict)
    slot_of: dict[ParameterName, int] = field(default_factory=dict)
    slot_key: list[int | None] = field(default_factory=list)
    slot_pose: list[Pose3] = field(default_factory=list)
    slot_identity: list[bool] = field(default_factory=list)
    table_slots: dict[int, TableSlot] = field(default_factory=dict)
    shifted_slots: dict[int, ShiftedSlot] = field(default_factory=dict)
    vectors: dict[ParameterName, VectorMap] = field(default_factory=dict)
    held_points: dict[str, FloatArray] = field(default_factory=dict)
    parameters: dict[ParameterName, PoseParameter] = field(default_factory=dict)
    held: dict[int, tuple[int, ...]] = field(default_factory=dict)
    """By key: the components of an unknown that keep their value; the others are estimated."""

    @property
    def dims(self) -> dict[int, int]:
        """Components of every unknown by key, held ones too."""
        return {key: unknown.dim for key, unknown in self.by_key.items()}

    @property
    def n_unknowns(self) -> int:
        """Number of components that are estimated."""
        return sum(u.dim for u in self.by_name.values()) - sum(len(held) for held in self.held.values())

    def hold(self, unknown: Unknown, names: tuple[str, ...]) -> None:
        """Keep some components. Raises SurveyError for a component that there is not, or where none is left free."""
        if names:
            wrong = [x for x in names if x not in unknown.components]
            if wrong or len(set(names)) == unknown.dim:
                what = f"no component {wrong[0]!r}" if wrong else "all components held; treat the whole as 'held'"
                raise SurveyError(f"{' '.join(unknown.name)}: {what} (components: {', '.join(unknown.components)})")
            self.held[unknown.key] = tuple(i for i, x in enumerate(unknown.components) if x in names)

    def status(self, key: int | None, treatment: str, dim: int) -> tuple[str, ...]:
        """Per component: the treatment of the whole, or "held"."""
        held = self.held.get(key, ()) if key is not None else ()
        return tuple("held" if i in held else treatment for i in range(dim)) if held else (treatment,) * dim

    def add(self, name: ParameterName, kind: str, components: tuple[str, ...], units: tuple[str, ...]) -> Unknown:
        """Register a variable under the next key of its letter."""
        letter = {"lens": "l", "point": "p", "table_angles": "a", "world_from_station": "s"}.get(name[0], "f")
        unknown = Unknown(name, gtsam.symbol(letter, len(self.by_name)), kind, components, units)
        self.by_name[name] = unknown
        self.by_key[unknown.key] = unknown
        return unknown

    def slot(self, name: ParameterName, parameter: PoseParameter) -> int:
        """The slot of a pose parameter, made at first use."""
        slot = self.slot_of.setdefault(name, len(self.slot_key))
        if slot < len(self.slot_key):
            return slot
        held = parameter.treatment == "held"
        pose = parameter.value if parameter.value is not None else _IDENTITY
        key = None
        if not held:
            unknown = self.add(name, "pose", POSE_COMPONENTS, POSE_UNITS)
            self.hold(unknown, parameter.held)
            key = unknown.key
        self.slot_key.append(key)
        self.slot_pose.append(pose)
        self.slot_identity.append(held and pose.equals(_IDENTITY, 0.0))
        self.parameters[name] = parameter
        return slot

    def link_keys(self, slot: int) -> list[int]:
        """The unknowns that a slot depends on: its pose, or all those that it follows from; none where all is held."""
        found, key = self.derived(slot), self.slot_key[slot]
        if found is not None:
            return [key for key, _, _ in found.parts]
        return [] if key is None else [key]

    def derived(self, slot: int) -> TableSlot | ShiftedSlot | None:
        """What a slot follows from that is no unknown itself."""
        return self.table_slots.get(slot) or self.shifted_slots.get(slot)

    def spread(self, name: ParameterName) -> dict[int, FloatArray]:
        """How all n components of a parameter follow from unknowns: (n, dim) by key; none of what is held."""
        vector, out = self.vectors.get(name), dict[int, FloatArray]()
        if vector is None:
            found = self.by_name.get(name)
            if found is not None:
                out[found.key] = np.eye(found.dim)
                out[found.key][list(self.held.get(found.key, ()))] = 0.0
            return out
        for column, (key, component) in enumerate(vector.sources):
            part = out.setdefault(key, np.zeros((len(vector.names), self.by_key[key].dim)))
            part[:, component] += vector.matrix[:, column]
        return out

    def tidy(self, chain: list[Link]) -> Chain:
        """Leave out identities and links that meet their own inverse."""
        out: list[Link] = []
        for link in chain:
            if self.slot_identity[link.slot]:
                continue
            if out and out[-1].slot == link.slot and out[-1].inverse != link.inverse:
                out.pop()
            else:
                out.append(link)
        return tuple(out)


def vector_map(
    parameter: VectorParameter, units: tuple[str, ...], unknowns: Unknowns, name: ParameterName,
    lent: Mapping[str, tuple[int, int]] = MappingProxyType({}),
) -> VectorMap:  # fmt: skip
    """Resolve free, held and tied components; registers the unknown where any component is free.

    lent: free components that are those of another key already.
    """
    n = len(parameter.names)
    free = tuple(x for x in parameter.names if x in parameter.free)
    tied = {tie.name: tie for tie in parameter.ties}
    base, matrix = np.array(parameter.values, dtype=float), np.zeros((n, len(free)))
    status = []
    for i, component in enumerate(parameter.names):
        if component in tied and tied[component].to in free:
            tie = tied[component]
            base[i], matrix[i, free.index(tie.to)] = 0.0, tie.factor
            status.append("tied")
        elif component in free:
            base[i], matrix[i, free.index(component)] = 0.0, 1.0
            known = parameter.prior is not None and component in parameter.prior.names
            status.append("tied" if component in lent else "prior" if known else "free")
        else:
            status.append("held")
    key, own = None, tuple(x for x in free if x not in lent)
    if own:
        own_units = tuple(units[parameter.names.index(x)] for x in own)
        key = unknowns.add(name, "vector", own, own_units).key
    borrowed = {i: lent[x] for i, x in enumerate(free) if x in lent}
    return VectorMap(parameter.names, units, base, matrix, key, free, tuple(status), borrowed)
