"""Which unknowns a survey has, under which GTSAM key, and how any frame is reached from the world.

Poses live in *slots*: every pose parameter, free or held, and every table motion has one. A frame is a chain of slots,
each taken forward or inverse; the links that are held at identity are left out.
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
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import ParameterName
from adjust.model.survey import Camera, FloatArray, PoseParameter, Station, Survey, Table, Target, VectorParameter
from adjust.model.tables import unit_of

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


@dataclass(frozen=True, eq=False)
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


Chain = tuple[Link, ...]


@dataclass(frozen=True, eq=False)
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


@dataclass(frozen=True, eq=False)
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
        return tuple("held" if i in held else treatment for i in range(dim))

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


def inverse(chain: Chain) -> list[Link]:
    """The chain the other way round."""
    return [Link(link.slot, not link.inverse) for link in reversed(chain)]


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


class FrameTree:
    """How every frame hangs in the world; makes the unknowns on the way, only those that observations need."""

    def __init__(self, survey: Survey, unknowns: Unknowns) -> None:
        self.unknowns = unknowns
        self.cameras, self.stations = survey.cameras_by_id, survey.stations_by_id
        self.tables, self.targets = survey.tables_by_id, survey.targets_by_id
        self.on_table = {(r.table_id, r.epoch_id) for r in survey.table_readings}
        still = {s.station_id for s in survey.stations if s.motion == "fixed"}
        self._still_cameras = {c.camera_id for c in survey.cameras if c.station_id in still}
        self._still_targets = {
            t.target_id for t in survey.targets
            if t.motion != "epoch" and (t.station_id is None or t.station_id in still)
        }  # fmt: skip
        self._to_camera: dict[tuple[str, str], Chain] = {}
        self._from_target: dict[tuple[str, str], Chain] = {}

    def world_from(self, frame: FrameRef) -> list[Link]:
        """The chain from a frame to the world. Raises SurveyError for a frame that does not exist."""
        if frame.kind == "world":
            return []
        if frame.kind == "camera":
            return self._camera(self._get(self.cameras, "camera", frame.frame_id), frame.epoch_id)
        if frame.kind == "station":
            return self._station(self._get(self.stations, "station", frame.frame_id), frame.epoch_id)
        if frame.kind == "target":
            return self._target(self._get(self.targets, "target", frame.frame_id), frame.epoch_id)
        table: Table = self._get(self.tables, "table", frame.frame_id)
        if frame.kind == "mount":
            return self._mount(table, frame.epoch_id)
        return [Link(self.unknowns.slot(("world_from_table", table.table_id), table.world_from_table))]

    def relative(self, a: FrameRef, b: FrameRef) -> Chain:
        """The chain of ``b_from_a``."""
        return self.unknowns.tidy(inverse(tuple(self.world_from(b))) + self.world_from(a))

    def of_image(self, block: ImageBlock) -> Chain:
        """The chain of ``camera_from_target``, or ``camera_from_world``; its halves are shared by many images."""
        camera, target, epoch = block.camera_id, block.target_id, block.epoch_id
        place = camera, "" if camera in self._still_cameras else epoch
        first = self._to_camera.get(place)
        if first is None:
            links = self._camera(self._get(self.cameras, "camera", camera), epoch)
            first = self._to_camera[place] = self.unknowns.tidy(inverse(tuple(links)))
        if target is None:
            return first
        place = target, "" if target in self._still_targets else epoch
        second = self._from_target.get(place)
        if second is None:
            links = self._target(self._get(self.targets, "target", target), epoch)
            second = self._from_target[place] = self.unknowns.tidy(links)
        if first and second and first[-1].slot == second[0].slot:
            return self.unknowns.tidy([*first, *second])
        return first + second

    @staticmethod
    def _get(things: Mapping[str, T], kind: str, thing_id: str) -> T:
        if thing_id not in things:
            raise SurveyError(f"{kind} {thing_id!r} is observed but not part of the survey; add it or correct the id")
        return things[thing_id]

    def _camera(self, camera: Camera, epoch_id: str | None) -> list[Link]:
        station = self._get(self.stations, "station", camera.station_id)
        slot = self.unknowns.slot(("station_from_camera", camera.camera_id), camera.station_from_camera)
        return self._station(station, epoch_id) + [Link(slot)]

    def _station(self, station: Station, epoch_id: str | None) -> list[Link]:
        if station.motion == "fixed":
            return [Link(self.unknowns.slot(("world_from_station", station.station_id), station.world_from_station))]
        if epoch_id is None:
            raise SurveyError(f"station {station.station_id!r} moves between epochs: name the observation's epoch")
        if station.motion == "table" and (station.table_id, epoch_id) in self.on_table:
            table = self._get(self.tables, "table", station.table_id or "")
            slot = self.unknowns.slot(("mount_from_station", station.station_id), station.mount_from_station)
            return [*self._mount(table, epoch_id), Link(slot)]
        parameter = station.epochs.get(epoch_id, station.world_from_station)
        return [Link(self.unknowns.slot(("world_from_station", station.station_id, epoch_id), parameter))]

    def _mount(self, table: Table, epoch_id: str | None) -> list[Link]:
        if epoch_id is None or (table.table_id, epoch_id) not in self.on_table:
            found = f"no reading at epoch {epoch_id!r}" if epoch_id else "no epoch named"
            raise SurveyError(f"mount of table {table.table_id!r}: {found}; name an epoch at which its axes are read")
        base = Link(self.unknowns.slot(("world_from_table", table.table_id), table.world_from_table))
        return [base, Link(self._table_motion(table, epoch_id))]

    def _target(self, target: Target, epoch_id: str | None) -> list[Link]:
        name: ParameterName = ("carrier_from_target", target.target_id)
        parameter = target.carrier_from_target
        if target.motion == "epoch":
            if epoch_id is None:
                raise SurveyError(f"target {target.target_id!r} moves between epochs: name the observation's epoch")
            name = (*name, epoch_id)
            parameter = target.epochs.get(epoch_id, parameter)
        link = [Link(self.unknowns.slot(name, parameter))]
        if target.station_id is None:
            return link
        return self._station(self._get(self.stations, "station", target.station_id), epoch_id) + link

    def _table_motion(self, table: Table, epoch_id: str) -> int:
        name: ParameterName = ("table_motion", table.table_id, epoch_id)
        u = self.unknowns
        if name in u.slot_of:
            return u.slot_of[name]
        geometry_name: ParameterName = ("table_geometry", table.table_id)
        if geometry_name not in u.vectors:
            units = tuple(unit_of(x) for x in table.geometry.names)
            u.vectors[geometry_name] = vector_map(table.geometry, units, u, geometry_name)
        components = tuple(f"axis{i + 1}" for i in range(len(table.axes)))
        angles = u.add(("table_angles", table.table_id, epoch_id), "vector", components, ("rad",) * len(components))
        slot = u.slot_of[name] = len(u.slot_key)
        u.slot_key.append(angles.key)
        u.slot_pose.append(Pose3())
        u.slot_identity.append(False)
        geometry = u.vectors[geometry_name]
        u.table_slots[slot] = TableSlot(slot, table.table_id, epoch_id, table.axes, angles.key, geometry)
        return slot
