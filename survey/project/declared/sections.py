"""A survey as the sections of ``survey.toml``, the inverse of ``owners``, ``kinds``, ``lenses`` and ``poses``."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.survey import (
    Camera,
    FloatArray,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
)
from survey.folder.units import from_si
from survey.project.declared.bodies import WARP_UNITS
from survey.project.declared.clocks import clock_to_toml
from survey.project.declared.instruments import body_sections, instrument_sections, vertical_sections
from survey.project.declared.lenses import lens_to_toml
from survey.project.declared.options import closure_sections, tolerance_sections
from survey.project.declared.owners import geometry_units
from survey.project.declared.poses import quaternion_wxyz
from survey.project.declared.targets import board_key
from survey.project.declared.toml_text import Section, in_units
from survey.project.declared.vectors import vector_to_toml
from survey.project.project import FORMAT, AdjustmentOptions, Sigmas, SpotsRequest
from survey.project.targets import BOARDS, MarkerBlock, PointList, TargetKind


def survey_sections(survey: Survey, kinds: Mapping[str, TargetKind], sigmas: Sigmas) -> list[Section]:
    """The sections of what there is and of the datum."""
    sections: list[Section] = []
    timed = bool(survey.times) or survey.epoch_interval is not None
    for camera in survey.cameras:
        sections += _camera(camera, timed)
    for station in survey.stations:
        sections += _station(station, timed)
    for table in survey.tables:
        sections.append((("tables", table.table_id), _table(table, sigmas.tables.get(table.table_id), timed)))
    for target in survey.targets:
        sections += _target(target, kinds[target.target_id])
    if survey.points:
        sections.append((("points",), {point.point_id: _point(point.x_in_world) for point in survey.points}))
    sections += vertical_sections(survey.vertical, survey.bearings)
    sections += instrument_sections(survey.instruments, survey.setups, sigmas.instruments)
    sections += body_sections(survey.beams, survey.surfaces)
    for name, by_epoch in (("temperatures_degC", survey.temperatures), ("times_s", survey.times)):
        if by_epoch:
            sections.append(((name,), dict(by_epoch)))
    datum = survey.datum
    return [*sections, (("datum",), in_units(kind=datum.kind, points=datum.points, stations=datum.stations))]


def head_section(title: str, tie_points: bool, survey: Survey) -> Section:
    """The keys before the first table."""
    return (), {"format": FORMAT, "title": title, "tie_points": tie_points,
                **in_units(epoch_interval_s=survey.epoch_interval)}  # fmt: skip


def option_sections(options: AdjustmentOptions, request: SpotsRequest | None, sigmas: Sigmas) -> list[Section]:
    """The sections [spots], [sigmas], [adjustment], [closures] and [tolerances]."""
    x = options
    spots = {} if request is None else in_units(
        cameras=request.cameras, diameter_px=request.diameter_px, gate_px=request.gate_px, epochs=request.epochs
    )  # fmt: skip
    adjustment = in_units(
        alpha=x.alpha, alpha0=x.alpha0, power=None if x.power == AdjustmentOptions.power else x.power,
        reject_blocks=x.reject_blocks, reject_points=x.reject_points, reject_pairs=x.reject_pairs,
        variance_components=x.variance_components or None, sigmas=x.sigmas,
        pairs=None if x.pairs == "poses" else x.pairs,
    )  # fmt: skip
    before = [("spots", spots), ("sigmas", in_units(image_px=sigmas.image_px)), ("adjustment", adjustment)]
    found: list[Section] = [((name,), values) for name, values in before if values] + closure_sections(x.closures)
    if x.identification:
        found.append((("identification",), dict(x.identification)))
    return found + tolerance_sections(x.tolerances)


def pose_to_toml(pose: PoseParameter, where: str) -> dict[str, object]:
    """The table that ``read_pose`` reads; empty for a free pose without start."""
    x = pose.value
    result = in_units(
        treatment=None if pose.treatment == "free" else pose.treatment, held=pose.held,
        translation_mm=None if x is None else np.asarray(x.translation()),
        rotation_quaternion_wxyz=None if x is None else quaternion_wxyz(x.rotation()),
    )  # fmt: skip
    if pose.treatment != "prior":
        return result
    if pose.prior_cov is None:
        raise SurveyError(f"{where}: a prior without covariance cannot be written; give it one")
    cov = _without_vague_rows(pose.prior_cov)
    if np.count_nonzero(cov) > 6:
        return result | in_units(covariance_rad_m=cov)
    sigma = np.sqrt(np.diagonal(cov))
    return result | in_units(sigma_rotation_arcsec=sigma[:3], sigma_translation_mm=sigma[3:])


def _without_vague_rows(cov: FloatArray) -> FloatArray:
    """``cov`` with zeros beside every infinite variance: what stands there has no meaning."""
    result = cov.copy()
    for i in np.flatnonzero(np.isinf(np.diagonal(cov))).tolist():
        result[i, :] = result[:, i] = 0.0
        result[i, i] = np.inf
    return result


def _poses(poses: Mapping[str, PoseParameter], where: str) -> dict[str, Any]:
    """Poses by key, those that say nothing left out."""
    tables = {key: pose_to_toml(pose, f"{where}.{key}") for key, pose in poses.items()}
    return {key: table for key, table in tables.items() if table}


def _epochs(path: tuple[str, ...], poses: Mapping[str, PoseParameter]) -> list[Section]:
    where = ".".join((*path, "epochs"))
    found = {key: pose_to_toml(pose, f"{where}.{key}") for key, pose in poses.items()}
    return [((*path, "epochs"), found)] if found else []


def _camera(camera: Camera, timed: bool) -> list[Section]:
    path = ("cameras", camera.camera_id)
    values = {"station": camera.station_id, "image_size_px": camera.image_size}
    poses = _poses({"station_from_camera": camera.station_from_camera}, ".".join(path))
    values |= poses | clock_to_toml(camera.clock, timed, f"{'.'.join(path)}.clock")
    return [(path, values), ((*path, "lens"), lens_to_toml(camera.lens))]


def _station(station: Station, timed: bool) -> list[Section]:
    path, on_table = ("stations", station.station_id), station.motion == "table"
    poses = {"world_from_station": station.world_from_station}
    poses |= {"mount_from_station": station.mount_from_station} if on_table else {}
    values = in_units(motion=station.motion, table=station.table_id if on_table else None)
    values |= _poses(poses, ".".join(path)) | clock_to_toml(station.clock, timed, f"{'.'.join(path)}.clock")
    return [(path, values), *_epochs(path, station.epochs)]


def _table(table: Table, sigma: FloatArray | None, timed: bool) -> dict[str, object]:
    where = f"tables.{table.table_id}"
    geometry = vector_to_toml(table.geometry, geometry_units(table.geometry.names), f"{where}.geometry")
    values = in_units(axes=table.axes, sigma_arcsec=sigma, geometry_sigma=geometry.pop("sigma", None))
    values |= {"geometry": geometry} | _poses({"world_from_table": table.world_from_table}, where)
    return values | clock_to_toml(table.clock, timed, f"{where}.clock")


def _target(target: Target, kind: TargetKind) -> list[Section]:
    path, warp = ("targets", target.target_id), None
    if target.warp is not None:
        reference = None if target.reference_temperature == 20.0 else target.reference_temperature
        units = {name: WARP_UNITS[name] for name in target.warp.names}
        warp = vector_to_toml(target.warp, units, f"{'.'.join(path)}.warp") | in_units(reference_degC=reference)
    values = _kind(target.target_id, kind) | in_units(
        motion=target.motion, station=target.station_id, warp=warp,
        pose=pose_to_toml(target.carrier_from_target, f"{'.'.join(path)}.pose"),
    )  # fmt: skip
    return [(path, values), *_epochs(path, target.epochs)]


def points_file(target_id: str) -> str:
    """The file of a point list."""
    return f"{target_id}_points.csv"


def _kind(target_id: str, kind: TargetKind) -> dict[str, object]:
    if isinstance(kind, PointList):
        return {"kind": "points", "file": points_file(target_id)}
    if isinstance(kind, MarkerBlock):
        markers = {str(marker): from_si(kind.corners[marker], "mm").tolist() for marker in sorted(kind.corners)}
        return {"kind": "marker_block", "dictionary": kind.dictionary, "markers": markers}
    name = next(name for name, board in BOARDS.items() if type(kind) is board)
    return {"kind": name} | in_units(**{board_key(f.name): getattr(kind, f.name) for f in fields(kind)})


def _point(point: PointParameter) -> dict[str, object]:
    cov = None if point.prior_cov is None or point.treatment != "prior" else _without_vague_rows(point.prior_cov)
    correlated = cov is not None and np.count_nonzero(cov) > 3
    return in_units(
        treatment=None if point.treatment == "free" else point.treatment, held=point.held, x_mm=point.value,
        covariance_mm2=cov if correlated else None,
        sigma_mm=None if cov is None or correlated else np.sqrt(np.diagonal(cov)),
    )  # fmt: skip
