"""Cameras, stations and tables of ``survey.toml``."""

from typing import Literal

import numpy as np

from adjust.lenses.crops import crop_size
from adjust.model.survey import (
    TABLE_GEOMETRY,
    Camera,
    FloatArray,
    PoseParameter,
    Station,
    Table,
    VectorParameter,
    VectorPrior,
)
from adjust.model.tables import HARMONICS, HIGHEST, harmonic_names, in_order, unit_of
from survey.project.declared.clocks import read_clock
from survey.project.declared.lenses import read_lens, read_size
from survey.project.declared.node import Node
from survey.project.declared.poses import read_pose

_GEOMETRY_UNITS = {"non_orthogonality": "arcsec", "axis_offset": "mm", "zero_1": "deg", "zero_2": "deg"}


def read_cameras(root: Node, station_ids: tuple[str, ...], timed: bool) -> tuple[Camera, ...]:
    """The cameras under [cameras.*]."""
    cameras = []
    for camera_id, node in root.tables("cameras"):
        station_id = node.reference("station", station_ids, "station")
        size = read_size(node, "image_size_px")
        if not node.has("lens"):
            raise node.error(f"the table [cameras.{camera_id}.lens] is missing; add it", "lens")
        lens = read_lens(node.table("lens"))
        for epoch, crop in lens.crops.items():
            if min(crop_size(size, crop)) < 1:
                raise node.table("lens").table("crops").error("leaves nothing of the image; correct it", epoch)
        if node.table("lens").has("shared"):
            others = [c for c, _ in root.tables("cameras") if c != camera_id]
            node.table("lens").table("shared").reference("camera", others, "camera")
        pose = read_pose(node.table("station_from_camera"))
        cameras.append(Camera(camera_id, station_id, size, lens, pose, read_clock(node, timed)))
    return tuple(cameras)


def read_stations(root: Node, table_ids: tuple[str, ...], timed: bool) -> tuple[Station, ...]:
    """The stations under [stations.*]."""
    stations = []
    for station_id, node in root.tables("stations"):
        motion: Literal["fixed", "epoch", "table"] = node.choice("motion", ("fixed", "epoch", "table"))
        table_id = None
        if motion == "table":
            if not node.has("table"):
                raise node.error('motion = "table" needs the id of the table; add table = "..."', "table")
            table_id = node.reference("table", table_ids, "table")
        for key in ("table", "mount_from_station") if motion != "table" else ():
            if key in node.values:
                raise node.error(f'only a station with motion = "table" has {key!r}; remove it', key)
        stations.append(
            Station(
                station_id,
                motion,
                read_pose(node.table("world_from_station")),
                read_epochs(node, motion == "fixed"),
                table_id,
                read_pose(node.table("mount_from_station")),
                read_clock(node, timed),
            )
        )
    return tuple(stations)


def read_epochs(node: Node, is_fixed: bool) -> dict[str, PoseParameter]:
    """The poses below ``epochs``."""
    if is_fixed and node.has("epochs"):
        raise node.error('motion is "fixed", which has no epochs; write motion = "epoch" or remove them', "epochs")
    return {epoch_id: read_pose(epoch) for epoch_id, epoch in node.tables("epochs")}


def read_tables(root: Node, timed: bool) -> tuple[tuple[Table, ...], dict[str, FloatArray]]:
    """The tables under [tables.*] and the sigmas (axes,) rad of their readings, by table id."""
    tables, sigmas = [], {}
    for table_id, node in root.tables("tables"):
        axes = node.references("axes", ("x", "y", "z"), "axis")
        if len(axes) not in (1, 2):
            raise node.error(f"found {len(axes)} axes; a table has one or two, outermost first", "axes")
        sigma = node.sigmas("sigma", ("arcsec",), len(axes))
        if sigma is not None:
            sigmas[table_id] = sigma
        pose = read_pose(node.table("world_from_table"))
        geometry, clock = _read_geometry(node, len(axes)), read_clock(node, timed)
        tables.append(Table(table_id, axes, pose, geometry, clock))
    return tuple(tables), sigmas


def geometry_unit(name: str) -> str:
    """The unit of a geometry parameter in a project: of harmonics arcsec or mm."""
    return _GEOMETRY_UNITS.get(name) or {"rad": "arcsec", "m": "mm"}[unit_of(name)]


def geometry_key(name: str) -> str:
    """The key of a geometry parameter: its name with the unit."""
    return f"{name}_{geometry_unit(name)}"


def _read_geometry(node: Node, n_axes: int) -> VectorParameter:
    base = TABLE_GEOMETRY if n_axes == 2 else ("zero_1",)
    geometry, sigma = node.table("geometry"), node.table("geometry_sigma")
    known = (*base, *(n for kind in HARMONICS for i in range(n_axes) for n in harmonic_names(kind, i, HIGHEST)))
    keys = {geometry_key(name): name for name in known}
    geometry.allow("free", *keys)
    free = geometry.references("free", known, "table parameter", base[:2] if n_axes == 2 else ())
    free = (*free, *(n for n in _harmonics(node.table("harmonics"), n_axes) if n not in free))
    values = {name: geometry.si(key, 0.0) for key, name in keys.items()}
    sigma.allow(*keys)
    for key in sigma.values:
        if keys[key] not in free:
            raise sigma.error(f"{keys[key]} has a sigma but is not free; add it to geometry.free", key)
    names = tuple(in_order([n for n in known if n in base or n in free or values[n]]))
    chosen, given = np.array([values[n] for n in names]), tuple(n for n in names if geometry_key(n) in sigma.values)
    free = tuple(n for n in names if n in free)
    if not given:
        return VectorParameter(names, chosen, free)
    sigmas = np.array([sigma.si(geometry_key(n)) for n in given])
    mean = np.array([values[name] for name in given])
    return VectorParameter(names, chosen, free, VectorPrior(given, mean, np.diag(sigmas**2)))


def _harmonics(node: Node, n_axes: int) -> list[str]:
    """All components of the harmonics that the table asks for."""
    node.allow(*(f"{kind}_{axis + 1}" for kind in HARMONICS for axis in range(n_axes)))
    found: list[str] = []
    for key in node.values:
        kind, axis = key.rsplit("_", 1)
        if (highest := node.integer(key, 0)) > HIGHEST:
            raise node.error(f"found {highest}; harmonics have names up to order {HIGHEST}", key)
        found += harmonic_names(kind, int(axis) - 1, highest)
    return found
