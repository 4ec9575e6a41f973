"""A camera survey on its way out of the program: a value for everything, and how well it is known."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import cast

import numpy as np
from gtsam import Pose3

from adjust.model.boards import deformed
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import Camera, FloatArray, Station, Survey, Target
from survey.interop.cameras.lens_maps import MappedLens, mapped_lens
from survey.interop.cameras.rig import Rig, RigCamera
from survey.project import Project
from survey.project.targets import TargetKind
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import scale_of


@dataclass(frozen=True, eq=False)
class _Start:
    """What ``AdjustedFrames`` needs of an adjustment, where there is none."""

    survey: Survey
    estimates: Mapping[ParameterName, Estimate]


@dataclass(frozen=True, eq=False)
class CameraValues:
    """A survey with values: adjusted where the project has results, else its start values.

    factor: on all sigmas, squared on covariances. kinds: of the targets.
    """

    survey: Survey
    title: str
    frames: AdjustedFrames
    estimates: Mapping[ParameterName, Estimate]
    factor: float
    adjusted: bool
    kinds: Mapping[str, TargetKind]

    def lens(self, camera: Camera) -> FloatArray:
        """Values (n,) of a camera's lens. Raises SurveyError where it has none yet."""
        estimate = self.estimates.get(("lens", camera.camera_id))
        if estimate is not None and not isinstance(estimate.value, Pose3):
            return np.asarray(estimate.value, dtype=float)
        if camera.lens.values is None:
            raise SurveyError(f"camera {camera.camera_id!r}: its lens has no values yet; adjust the project first")
        return camera.lens.values

    def cov(self, *name: str) -> FloatArray | None:
        """Covariance of a parameter in its tangent, None where it was not adjusted."""
        estimate = self.estimates.get(name)
        return None if estimate is None else self.factor**2 * estimate.cov

    def world_from(self, frame: FrameRef) -> Pose3:
        """``world_from_<frame>``. Raises SurveyError where it is not known."""
        pose = self.frames.world_from(frame)
        if pose is None:
            at = f" at epoch {frame.epoch_id!r}" if frame.epoch_id else ""
            raise SurveyError(f"{frame.kind} {frame.frame_id!r}: has no pose{at} yet; adjust the project first")
        return pose

    def point(self, point_id: str) -> FloatArray | None:
        """World coordinates (3,) m of a beacon, None where they are not known."""
        estimate = self.estimates.get(("point", point_id))
        if estimate is not None:
            return np.asarray(estimate.value, dtype=float)
        found = next((p for p in self.survey.points if p.point_id == point_id), None)
        return None if found is None else found.x_in_world.value

    def x_in_target(self, target: Target) -> FloatArray:
        """Points (n, 3) m of a target, its warp included, at its reference temperature."""
        estimate = self.estimates.get(("warp", target.target_id))
        return deformed(target, None if estimate is None else np.asarray(estimate.value))

    def station_from_camera(self, camera: Camera) -> Pose3:
        """Where a camera is on its station. Raises SurveyError where that is not known."""
        pose = self.frames.pose(("station_from_camera", camera.camera_id), camera.station_from_camera)
        if pose is None:
            raise SurveyError(f"camera {camera.camera_id!r}: has no pose on its station; adjust the project first")
        return pose

    def blocks(self) -> Iterator[ImageBlock]:
        """Image points in use."""
        for block in self.survey.image_blocks:
            used = block.mask
            if used.any():
                yield ImageBlock(block.camera_id, block.epoch_id, block.target_id, block.point_idx[used],
                                 block.uv[used], block.cov[used])  # fmt: skip

    def epochs_of(self, station: Station) -> list[str]:
        """Epochs at which a station that moves has a pose."""
        if station.motion == "fixed":
            return []
        found = dict.fromkeys(name[2] for name in self.estimates if name[:2] == ("world_from_station",
                                                                                station.station_id) and len(name) == 3)
        found |= dict.fromkeys(station.epochs)
        if station.motion == "table":
            found |= dict.fromkeys(r.epoch_id for r in self.survey.table_readings if r.table_id == station.table_id)
        return [e for e in found if self.frames.world_from(FrameRef("station", station.station_id, e)) is not None]


def camera_values(project: Project, result: Adjustment | None = None) -> CameraValues:
    """The values of a project: those of its adjustment, or its start values where there is none."""
    survey, kinds = project.survey, project.target_kinds
    if result is None:
        start = cast(Adjustment, _Start(survey, {}))
        return CameraValues(survey, project.title, AdjustedFrames(start), {}, 1.0, False, kinds)
    factor = scale_of(result, project.options.sigmas).factor
    return CameraValues(
        result.survey, project.title, AdjustedFrames(result), result.estimates, factor, True, kinds
    )


def one_station(values: CameraValues, station_id: str | None, format: str) -> Station:
    """The station whose cameras go into a format that holds one rig. Raises SurveyError where it is not clear."""
    ids = list(dict.fromkeys(c.station_id for c in values.survey.cameras))
    if not ids:
        raise SurveyError(f"the project has no cameras; {format} holds nothing else")
    if station_id is not None and station_id not in ids:
        raise SurveyError(f"station {station_id!r} carries no camera; choose one of {', '.join(ids)}")
    if station_id is None and len(ids) > 1:
        raise SurveyError(f"{format} holds the cameras of one station; choose with --station: {', '.join(ids)}")
    return next(s for s in values.survey.stations if s.station_id == (station_id or ids[0]))


@dataclass(frozen=True, eq=False)
class RigValues:
    """The cameras of one station for a format, each with its lens as that format has it."""

    rig: Rig
    lenses: tuple[MappedLens, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was approximated, for people."""
        return tuple(lens.note for lens in self.lenses if lens.note)


def rig_values(
    values: CameraValues, station_id: str | None, format: str, choices: Mapping[str, tuple[str, ...]]
) -> RigValues:
    """The cameras of one station with lenses in a format's forms, see ``lens_maps.mapped_lens``."""
    station = one_station(values, station_id, format)
    cameras, lenses = [], []
    for camera in values.survey.cameras:
        if camera.station_id != station.station_id:
            continue
        lens_cov, pose_cov = values.cov("lens", camera.camera_id), values.cov("station_from_camera", camera.camera_id)
        lenses.append(mapped_lens(camera, values.lens(camera), choices, lens_cov))
        cameras.append(
            RigCamera(camera.camera_id, camera.image_size, camera.lens, values.station_from_camera(camera),
                      lenses[-1].cov, pose_cov)
        )  # fmt: skip
    return RigValues(Rig(station.station_id, tuple(cameras)), tuple(lenses))
