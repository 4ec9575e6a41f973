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
from survey.project.declared.toml_text import Section
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
    if survey.temperatures:
        sections.append((("temperatures_degC",), dict(survey.temperatures)))
    if survey.times:
        sections.append((("times_s",), dict(survey.times)))
    datum: dict[str, Any] = {"kind": survey.datum.kind}
    datum |= {"points": survey.datum.points} if survey.datum.points else {}
    datum |= {"stations": survey.datum.stations} if survey.datum.stations else {}
    return [*sections, (("datum",), datum)]


def head_section(title: str, tie_points: bool, survey: Survey) -> Section:
    """The keys before the first table."""
    step = {} if survey.epoch_interval is None else {"epoch_interval_s": survey.epoch_interval}
    return (), {"format": FORMAT, "title": title, "tie_points": tie_points, **step}


def option_sections(options: AdjustmentOptions, request: SpotsRequest | None, sigmas: Sigmas) -> list[Section]:
    """The sections [spots], [sigmas], [adjustment], [closures] and [tolerances]."""
    sections: list[Section] = []
    if request is not None:
        spots: dict[str, Any] = {"cameras": request.cameras, "diameter_px": request.diameter_px}
        spots["gate_px"] = request.gate_px
        if request.epochs is not None:
            spots["epochs"] = request.epochs
        sections.append((("spots",), spots))
    if sigmas.image_px is not None:
        sections.append((("sigmas",), {"image_px": sigmas.image_px}))
    flags: dict[str, Any] = {"reject_blocks": options.reject_blocks, "reject_points": options.reject_points}
    flags["reject_pairs"] = options.reject_pairs
    if options.variance_components:
        flags["variance_components"] = True
    if options.sigmas is not None:
        flags["sigmas"] = options.sigmas
    if options.pairs != "poses":
        flags["pairs"] = options.pairs
    sections.append((("adjustment",), {"alpha": options.alpha, **flags}))
    sections += closure_sections(options.closures)
    if options.identification:
        sections.append((("identification",), dict(options.identification)))
    return sections + tolerance_sections(options.tolerances)


def pose_to_toml(pose: PoseParameter, where: str) -> dict[str, Any]:
    """The table that ``read_pose`` reads; empty for a free pose without start."""
    result: dict[str, Any] = {} if pose.treatment == "free" else {"treatment": pose.treatment}
    if pose.held:
        result["held"] = pose.held
    if pose.value is not None:
        result["translation_mm"] = from_si(pose.value.translation(), "mm").tolist()
        result["rotation_quaternion_wxyz"] = quaternion_wxyz(pose.value.rotation())
    if pose.treatment != "prior":
        return result
    if pose.prior_cov is None:
        raise SurveyError(f"{where}: a prior without covariance cannot be written; give it one")
    cov = _without_vague_rows(pose.prior_cov)
    if np.count_nonzero(cov) > 6:
        return {**result, "covariance_rad_m": cov.tolist()}
    sigma = np.sqrt(np.diagonal(cov))
    result["sigma_rotation_arcsec"] = from_si(sigma[:3], "arcsec").tolist()
    result["sigma_translation_mm"] = from_si(sigma[3:], "mm").tolist()
    return result


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
    if not poses:
        return []
    where = ".".join((*path, "epochs"))
    return [((*path, "epochs"), {key: pose_to_toml(pose, f"{where}.{key}") for key, pose in poses.items()})]


def _camera(camera: Camera, timed: bool) -> list[Section]:
    path = ("cameras", camera.camera_id)
    values = {"station": camera.station_id, "image_size_px": camera.image_size}
    poses = _poses({"station_from_camera": camera.station_from_camera}, ".".join(path))
    values |= poses | clock_to_toml(camera.clock, timed, f"{'.'.join(path)}.clock")
    return [(path, values), ((*path, "lens"), lens_to_toml(camera.lens))]


def _station(station: Station, timed: bool) -> list[Section]:
    path = ("stations", station.station_id)
    values: dict[str, Any] = {"motion": station.motion}
    poses = {"world_from_station": station.world_from_station}
    if station.motion == "table":
        values["table"] = station.table_id
        poses["mount_from_station"] = station.mount_from_station
    values |= _poses(poses, ".".join(path)) | clock_to_toml(station.clock, timed, f"{'.'.join(path)}.clock")
    return [(path, values), *_epochs(path, station.epochs)]


def _table(table: Table, sigma: FloatArray | None, timed: bool) -> dict[str, Any]:
    values: dict[str, Any] = {"axes": table.axes}
    if sigma is not None:
        values["sigma_arcsec"] = from_si(sigma, "arcsec").tolist()
    values |= _poses({"world_from_table": table.world_from_table}, f"tables.{table.table_id}")
    units = geometry_units(table.geometry.names)
    geometry = vector_to_toml(table.geometry, units, f"tables.{table.table_id}.geometry")
    sigma_of = geometry.pop("sigma", None)
    values |= {"geometry": geometry} | ({} if sigma_of is None else {"geometry_sigma": sigma_of})
    return values | clock_to_toml(table.clock, timed, f"tables.{table.table_id}.clock")


def _target(target: Target, kind: TargetKind) -> list[Section]:
    path = ("targets", target.target_id)
    values = {**_kind(target.target_id, kind), "motion": target.motion}
    if target.station_id is not None:
        values["station"] = target.station_id
    values |= _poses({"pose": target.carrier_from_target}, ".".join(path))
    if target.warp is not None:
        units = {name: WARP_UNITS[name] for name in target.warp.names}
        reference = {} if target.reference_temperature == 20.0 else {"reference_degC": target.reference_temperature}
        values["warp"] = vector_to_toml(target.warp, units, f"targets.{target.target_id}.warp") | reference
    return [(path, values), *_epochs(path, target.epochs)]


def points_file(target_id: str) -> str:
    """The file of a point list."""
    return f"{target_id}_points.csv"


def _kind(target_id: str, kind: TargetKind) -> dict[str, Any]:
    if isinstance(kind, PointList):
        return {"kind": "points", "file": points_file(target_id)}
    if isinstance(kind, MarkerBlock):
        markers = {str(marker): from_si(kind.corners[marker], "mm").tolist() for marker in sorted(kind.corners)}
        return {"kind": "marker_block", "dictionary": kind.dictionary, "markers": markers}
    said = {board_key(f.name): getattr(kind, f.name) for f in fields(kind)}
    said |= {board_key(f.name): float(from_si(getattr(kind, f.name), "mm")) for f in fields(kind) if f.type is float}
    return {"kind": next(name for name, board in BOARDS.items() if type(kind) is board), **said}


def _point(point: PointParameter) -> dict[str, Any]:
    result: dict[str, Any] = {} if point.treatment == "free" else {"treatment": point.treatment}
    if point.held:
        result["held"] = point.held
    if point.value is not None:
        result["x_mm"] = from_si(point.value, "mm").tolist()
    if point.treatment == "prior" and point.prior_cov is not None:
        cov = _without_vague_rows(point.prior_cov)
        if np.count_nonzero(cov) > 3:
            return {**result, "covariance_mm2": from_si(cov, "mm2").tolist()}
        result["sigma_mm"] = from_si(np.sqrt(np.diagonal(cov)), "mm").tolist()
    return result
