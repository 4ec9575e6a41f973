"""A camera survey on its way out: a value for everything, how well it is known, and lenses as other programs have them.

Lenses are in the parameters of other programs exactly where they can be, else the nearest with its difference.
"""

from collections.abc import Callable, Iterator, Mapping
from typing import cast

import numpy as np
from gtsam import Pose3

from adjust.lenses.conversion import convert
from adjust.lenses.models import MODELS, camera_constants, lens_constants
from adjust.model.boards import deformed
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import FrameRef, ImageBlock
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import Camera, FloatArray, Station, Survey, Target
from survey.interop.cameras.rig import Rig, RigCamera
from survey.project import Project
from survey.project.targets import TargetKind
from survey.solution.frames import AdjustedFrames
from survey.solution.quantities import scale_of

BROWN_4 = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
BROWN_5 = (*BROWN_4, "k3")
BROWN_8 = (*BROWN_5, "k4", "k5", "k6")
FISHEYE_4 = ("fx", "fy", "u0", "v0", "k1", "k2", "k3", "k4")


@frozen(eq=False)
class MappedLens:
    """A lens as another program has it. values: by parameter name. cov: (n, n) in the order of the model, or None.

    largest_px: how far the two lenses differ anywhere in the image. note: says so for people where they do, and which
    lens it is of one that changes.
    """

    model: str
    values: dict[str, float]
    cov: FloatArray | None
    largest_px: float = 0.0
    note: str | None = None

    def array(self, *names: str) -> FloatArray:
        """Values of the named parameters."""
        return np.array([self.values[n] for n in names])

    def distortion(self) -> FloatArray:
        """Coefficients in OpenCV's order: four of a fisheye, else five, or eight where the rational ones are needed."""
        if self.model == "fisheye":
            return self.array("k1", "k2", "k3", "k4")
        k = self.array("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        return k if k[5:].any() else k[:5]


def mapped_lens(
    camera: Camera, values: FloatArray, choices: Mapping[str, tuple[str, ...]], cov: FloatArray | None = None
) -> MappedLens:
    """The lens (n,) of a camera in one of the allowed forms, ``choices``: model name to its usable parameters.

    The first exact choice is taken; where none is, the lens is fitted over the whole image by
    ``adjust.lenses.conversion`` in the first model, a fisheye's in a fisheye where that is among the choices. Of a lens
    that changes the note says which one it is. Raises SurveyError where no lens of that form fits.
    """
    model, taken = MODELS[camera.lens.model], _which(camera)
    if model.name in choices:
        usable = choices[model.name]
        if all(v == 0.0 or n in usable for n, v in zip(model.names, values, strict=True)):
            return MappedLens(model.name, dict(zip(model.names, map(float, values), strict=True)), cov, note=taken)
    wanted = MODELS[model.name if model.name in choices else next(iter(choices))]
    usable = choices[wanted.name]
    # three rational terms beside three others cannot be told apart: fit without them
    free = tuple(n for n in usable if wanted.name != "brown" or n not in ("k4", "k5", "k6"))
    found = convert(
        model, values, camera_constants(camera), wanted, lens_constants(wanted, camera.image_size), camera.image_size,
        free=free, cov=cov,
    )  # fmt: skip
    largest, (u, v) = found.largest_difference_px, found.largest_at
    note = (
        f"camera {camera.camera_id}: the lens {model.name} is written as {wanted.name} with {', '.join(free)}, which "
        f"differs by up to {largest:.2g} px, at ({u:.0f}, {v:.0f}); the rms is {found.rms_px:.2g} px"
    )
    return MappedLens(
        wanted.name, dict(zip(wanted.names, map(float, found.values), strict=True)), found.cov,
        largest, note if taken is None else f"{taken}; {note}",
    )  # fmt: skip


def _which(camera: Camera) -> str | None:
    """Which lens is written of one that changes or whose images are cropped."""
    lens, parts = camera.lens, []
    if lens.drift is not None:
        temperature = lens.drift.reference_temperature
        parts.append("of the first block of epochs" if temperature is None else f"at {temperature:g} degC")
    parts += ["of whole images"] if lens.crops else []
    return f"camera {camera.camera_id}: its lens is written as it is {' and '.join(parts)}" if parts else None


@frozen(eq=False)
class _Start:
    """What ``AdjustedFrames`` needs of an adjustment, where there is none."""

    survey: Survey
    estimates: Mapping[ParameterName, Estimate]


@frozen(eq=False)
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


def stations_of_cameras(values: CameraValues, station_id: str | None, format: str) -> list[str]:
    """The stations that carry cameras, or the one chosen. Raises SurveyError where there is none."""
    ids = list(dict.fromkeys(c.station_id for c in values.survey.cameras))
    if not ids:
        raise SurveyError(f"the project has no cameras; {format} holds nothing else")
    if station_id is not None and station_id not in ids:
        raise SurveyError(f"station {station_id!r} carries no camera; choose one of {', '.join(ids)}")
    return ids if station_id is None else [station_id]


def one_station(values: CameraValues, station_id: str | None, format: str) -> Station:
    """The station whose cameras go into a format that holds one rig. Raises SurveyError where it is not clear."""
    ids = stations_of_cameras(values, station_id, format)
    if len(ids) > 1:
        raise SurveyError(f"{format} holds the cameras of one station; choose with --station: {', '.join(ids)}")
    return values.survey.stations_by_id[ids[0]]


@frozen(eq=False)
class RigValues:
    """The cameras of one station for a format, each with its lens as that format has it."""

    rig: Rig
    lenses: tuple[MappedLens, ...]

    @property
    def notes(self) -> tuple[str, ...]:
        """What was approximated, for people."""
        return tuple(lens.note for lens in self.lenses if lens.note)

    def files(self, text: Callable[[RigCamera, MappedLens], str], ending: str) -> dict[str, str]:
        """A text for each camera by the name of its file, "" where there is one alone."""
        texts = {c.camera_id: text(c, lens) for c, lens in zip(self.rig.cameras, self.lenses, strict=True)}
        return {f"{name}{ending}" if len(texts) > 1 else "": found for name, found in texts.items()}


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
