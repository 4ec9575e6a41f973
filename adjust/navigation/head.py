"""The calibrated head and its beacons, out of an adjustment, with their joint covariance."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from types import MappingProxyType

import numpy as np
from gtsam import Pose3

from adjust.frames.lens_times import LensTimes
from adjust.lenses.crops import crop_size, cropped_lens
from adjust.lenses.models import MODELS, camera_constants
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName, adjusted_numbers, adjusted_pose
from adjust.model.survey import Camera, FloatArray, ImageCrop, Survey
from adjust.navigation.model import Beacons, Head, HeadCamera, HeadTable
from adjust.precision.precision import precision_of


def head_of(survey: Survey) -> str | None:
    """The only station with cameras, or the only one of them on a table."""
    carrying = list(dict.fromkeys(c.station_id for c in survey.cameras))
    turned = [s.station_id for s in survey.stations if s.station_id in carrying and s.motion == "table"]
    return next((choice[0] for choice in (turned, carrying) if len(choice) == 1), None)


def head_and_beacons(
    adjustment: Adjustment, station_id: str, known: Beacons | None = None,
    epochs: Mapping[str, str] = MappingProxyType({}), crops: Mapping[str, ImageCrop] = MappingProxyType({}),
) -> tuple[Head, Beacons]:  # fmt: skip
    """Head ``station_id`` and the beacons of an adjustment (or those given), values and joint covariance.

    epochs: by camera that whose lens is taken; else it is as at its last image. crops: by camera how the images are
    cropped for which the head is, where that is given.

    Raises SurveyError where the station carries no camera, or there is no beacon.
    """
    survey = adjustment.survey
    mine = [c for c in survey.cameras if c.station_id == station_id]
    cameras = tuple(_camera(adjustment, c, epochs.get(c.camera_id)) for c in mine)
    if not cameras:
        stations = sorted({c.station_id for c in survey.cameras})
        raise SurveyError(f"station {station_id!r} carries no camera; stations with cameras: {', '.join(stations)}")
    table = _table(adjustment, station_id)
    names: list[ParameterName] = []
    for camera in cameras:
        names += [("lens", camera.camera_id), ("station_from_camera", camera.camera_id)]
    if table is not None:
        table_id = str(survey.stations_by_id[station_id].table_id)
        names += [("world_from_table", table_id), ("table_geometry", table_id), ("mount_from_station", station_id)]
    points = [("point", p.point_id) for p in survey.points] if known is None else []
    sizes = _full_sizes(cameras, table, len(points))
    cov = adjustment.precision.following(_spreads(adjustment, [*names, *points], epochs), sizes)
    cameras, by_lens = _cropped(cameras, crops, sizes)
    cov = by_lens[:, None] * cov * by_lens
    p = sum(sizes[: len(names)])
    head = Head(cameras, cov[:p, :p], table)
    if known is not None:
        return head, known
    if not points:
        raise SurveyError("the survey has no beacons: name them under [points] in survey.toml, with their coordinates")
    x = np.array([_vector(adjustment, name) for name in points])
    return head, Beacons(tuple(name[1] for name in points), x, cov[p:, p:], cov[:p, p:])


def _full_sizes(cameras: Sequence[HeadCamera], table: HeadTable | None, n_points: int) -> list[int]:
    sizes = [size for c in cameras for size in (len(c.lens), 6)]
    return sizes + ([6, len(table.geometry), 6] if table is not None else []) + [3] * n_points


def _cropped(
    cameras: Sequence[HeadCamera], crops: Mapping[str, ImageCrop], sizes: Sequence[int]
) -> tuple[tuple[HeadCamera, ...], FloatArray]:
    """The cameras with their images cropped, and what the components of all parameters are multiplied with."""
    out, factors, starts = [], np.ones(sum(sizes)), np.cumsum([0, *sizes])
    for i, camera in enumerate(cameras):
        if (crop := crops.get(camera.camera_id)) is not None:
            lens = cropped_lens(MODELS[camera.model], camera.lens, camera.constants, np.asarray(crop.parameters.values))
            factors[starts[2 * i] : starts[2 * i + 1]] = lens.by_lens
            size = crop_size(camera.image_size, crop)
            camera = replace(camera, lens=lens.values, image_size=size)
        out.append(camera)
    return tuple(out), factors


def _camera(adjustment: Adjustment, camera: Camera, epoch_id: str | None) -> HeadCamera:
    camera_id, times = camera.camera_id, LensTimes(adjustment.survey)
    lens = times.lens(camera, epoch_id, partial(_known, adjustment))
    pose = adjusted_pose(adjustment.estimates, ("station_from_camera", camera_id), camera.station_from_camera)
    if pose is None:
        raise SurveyError(f"camera {camera_id}: the adjustment does not tell how it sits on its station")
    return HeadCamera(camera_id, times.size(camera, epoch_id), camera.lens.model, lens, camera_constants(camera), pose)


def _table(adjustment: Adjustment, station_id: str) -> HeadTable | None:
    survey: Survey = adjustment.survey
    station = survey.stations_by_id.get(station_id)
    if station is None or station.motion != "table" or station.table_id is None:
        return None
    table = survey.tables_by_id[station.table_id]
    base = adjusted_pose(adjustment.estimates, ("world_from_table", table.table_id), table.world_from_table)
    mount = adjusted_pose(adjustment.estimates, ("mount_from_station", station_id), station.mount_from_station)
    if base is None or mount is None:
        return None
    values = adjusted_numbers(adjustment.estimates, ("table_geometry", table.table_id), table.geometry)
    return HeadTable(table.axes, base, values, mount)


def _known(adjustment: Adjustment, name: ParameterName) -> FloatArray | None:
    return _vector(adjustment, name) if name in adjustment.estimates else None


def _vector(adjustment: Adjustment, name: ParameterName) -> FloatArray:
    value = adjustment.estimates[name].value
    if isinstance(value, Pose3):
        raise SurveyError(f"{'/'.join(name)} is a pose where numbers were expected")
    return np.asarray(value, dtype=float)


def _spreads(
    adjustment: Adjustment, names: Sequence[ParameterName], epochs: Mapping[str, str]
) -> list[dict[int, FloatArray]]:
    """How every parameter follows from the unknowns, of a lens at its epoch or as it was left."""
    precision = precision_of(adjustment)
    graph, values = precision.graph, precision.solved.values
    unknowns, lenses, out = graph.unknowns, graph.state.lens_states, []
    for name in names:
        if name[0] != "lens":
            out.append(unknowns.spread(name))
        else:
            at = lenses.of(name[1], epochs[name[1]]) if name[1] in epochs else lenses.last(name[1])
            out.append(lenses.spread(at, values, unknowns))
    return out
