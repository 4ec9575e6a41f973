"""Where everything is after an adjustment: any frame of the survey in the world, from the adjusted values."""

import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.tables import table_poses
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment, ParameterName, adjusted_numbers, adjusted_pose
from adjust.model.survey import FloatArray, PoseParameter, Station, Table, Target


def table_from_mount(axes: tuple[str, ...], geometry: dict[str, float], angles: FloatArray) -> list[Pose3]:
    """The motions of a table at angles (n, k), the formula of ``adjust.model.survey.Table``.

    geometry: by name, missing is zero.
    """
    motions = zip(*table_poses(axes, geometry, angles), strict=True)
    return [Pose3(Rot3(turn), shift) for turn, shift in motions]


class AdjustedFrames:
    """Frames of an adjusted survey; what neither was estimated nor has a value is None."""

    def __init__(self, adjustment: Adjustment) -> None:
        survey = adjustment.survey
        self.estimates = adjustment.estimates
        self.cameras, self.stations = survey.cameras_by_id, survey.stations_by_id
        self.tables, self.targets = survey.tables_by_id, survey.targets_by_id
        self.readings = {(r.table_id, r.epoch_id): r for r in survey.table_readings}
        self._motions: dict[str, dict[str, Pose3]] = {}

    def pose(self, name: ParameterName, parameter: PoseParameter) -> Pose3 | None:
        """The adjusted pose of a parameter; where it was held, its constant."""
        return adjusted_pose(self.estimates, name, parameter)

    def world_from(self, frame: FrameRef) -> Pose3 | None:
        """``world_from_<frame>``, None where the survey does not tell (or the frame does not exist)."""
        if frame.kind == "world":
            return Pose3()
        if frame.kind == "camera" and frame.frame_id in self.cameras:
            camera = self.cameras[frame.frame_id]
            mount = self.pose(("station_from_camera", camera.camera_id), camera.station_from_camera)
            return _product(self.world_from(FrameRef("station", camera.station_id, frame.epoch_id)), mount)
        if frame.kind == "station" and frame.frame_id in self.stations:
            return self._station(self.stations[frame.frame_id], frame.epoch_id)
        if frame.kind == "target" and frame.frame_id in self.targets:
            return self._target(self.targets[frame.frame_id], frame.epoch_id)
        if frame.kind == "table" and frame.frame_id in self.tables:
            return self._table(self.tables[frame.frame_id])
        return None

    def _table(self, table: Table) -> Pose3 | None:
        return self.pose(("world_from_table", table.table_id), table.world_from_table)

    def _station(self, station: Station, epoch_id: str | None) -> Pose3 | None:
        if station.motion == "fixed":
            return self.pose(("world_from_station", station.station_id), station.world_from_station)
        if epoch_id is None:
            return None
        if station.motion == "table" and (station.table_id, epoch_id) in self.readings:
            table = self.tables[station.table_id or ""]
            mount = self.pose(("mount_from_station", station.station_id), station.mount_from_station)
            return _product(_product(self._table(table), self._motion(table, epoch_id)), mount)
        parameter = station.epochs.get(epoch_id, station.world_from_station)
        return self.pose(("world_from_station", station.station_id, epoch_id), parameter)

    def _motion(self, table: Table, epoch_id: str) -> Pose3:
        """At an epoch; those of all epochs are found when one is first asked for."""
        if table.table_id not in self._motions:
            read = {epoch: r.angles for (table_id, epoch), r in self.readings.items() if table_id == table.table_id}
            geometry = adjusted_numbers(self.estimates, ("table_geometry", table.table_id), table.geometry)
            angles = np.array([self._angles(table.table_id, *one) for one in read.items()], dtype=float)
            motions = table_from_mount(table.axes, geometry, angles)
            self._motions[table.table_id] = dict(zip(read, motions, strict=True))
        return self._motions[table.table_id][epoch_id]

    def _angles(self, table_id: str, epoch_id: str, read: FloatArray) -> FloatArray:
        adjusted = self.estimates.get(("table_angles", table_id, epoch_id))
        return read if adjusted is None or isinstance(adjusted.value, Pose3) else adjusted.value

    def _target(self, target: Target, epoch_id: str | None) -> Pose3 | None:
        name: ParameterName = ("carrier_from_target", target.target_id)
        parameter = target.carrier_from_target
        if target.motion == "epoch":
            if epoch_id is None:
                return None
            name, parameter = (*name, epoch_id), target.epochs.get(epoch_id, parameter)
        pose = self.pose(name, parameter)
        if target.station_id is None:
            return pose
        return _product(self.world_from(FrameRef("station", target.station_id, epoch_id)), pose)


def _product(a: Pose3 | None, b: Pose3 | None) -> Pose3 | None:
    return None if a is None or b is None else a * b
