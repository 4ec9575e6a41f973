"""How any frame is reached from the world: a chain of slots (:mod:`adjust.frames.unknowns`), each forward or inverse.

The links that are held at identity are left out.
"""

from collections.abc import Mapping
from typing import TypeVar

from gtsam import Pose3

from adjust.frames.unknowns import Chain, Link, TableSlot, Unknowns, vector_map
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import ParameterName
from adjust.model.survey import Camera, Station, Survey, Table, Target
from adjust.model.tables import unit_of

T = TypeVar("T")


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
        return self.unknowns.tidy([link.back for link in reversed(self.world_from(b))] + self.world_from(a))

    def of_image(self, block: ImageBlock) -> Chain:
        """The chain of ``camera_from_target``, or ``camera_from_world``; its halves are shared by many images."""
        camera, target, epoch = block.camera_id, block.target_id, block.epoch_id
        place = camera, "" if camera in self._still_cameras else epoch
        first = self._to_camera.get(place)
        if first is None:
            links = self._camera(self._get(self.cameras, "camera", camera), epoch)
            first = self._to_camera[place] = self.unknowns.tidy([link.back for link in reversed(links)])
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


def in_world(survey: Survey, name: ParameterName) -> bool:
    """Whether a pose parameter is the pose of something in the world."""
    if name[0] == "carrier_from_target":
        return survey.targets_by_id[name[1]].station_id is None
    return name[0] in ("world_from_station", "world_from_table")
