"""Cameras, stations and tables of ``survey.toml``."""

from collections.abc import Iterable
from typing import Literal

from adjust.lenses.crops import crop_size
from adjust.model.survey import (
    TABLE_GEOMETRY,
    Camera,
    FloatArray,
    PoseParameter,
    Station,
    Table,
    VectorParameter,
)
from adjust.model.tables import HARMONICS, HIGHEST, harmonic_names, in_order, unit_of
from survey.project.declared.clocks import read_clock
from survey.project.declared.lenses import read_lens, read_size
from survey.project.declared.node import Node
from survey.project.declared.poses import read_pose
from survey.project.declared.vectors import key_of, read_vector

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
                read_pose(node.table("mount_from_station")) if motion == "table" else PoseParameter(),
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


def geometry_units(names: Iterable[str]) -> dict[str, str]:
    """The units of geometry parameters in a project: of harmonics arcsec or mm."""
    return {name: _GEOMETRY_UNITS.get(name) or {"rad": "arcsec", "m": "mm"}[unit_of(name)] for name in names}


def _read_geometry(node: Node, n_axes: int) -> VectorParameter:
    """Its own parameters always, harmonics where they are free or not zero."""
    base = TABLE_GEOMETRY if n_axes == 2 else ("zero_1",)
    geometry, sigma = node.table("geometry"), node.table("geometry_sigma")
    known = (*base, *(n for kind in HARMONICS for i in range(n_axes) for n in harmonic_names(kind, i, HIGHEST)))
    units = geometry_units(known)
    geometry.allow("free", *(key_of(n, units) for n in known))
    sigma.allow(*(key_of(n, units) for n in known))
    free = geometry.references("free", known, "table parameter", base[:2] if n_axes == 2 else ())
    free = (*free, *(n for n in _harmonics(node.table("harmonics"), n_axes) if n not in free))
    asked = in_order([n for n in known if n in base or n in free or sigma.has(key := key_of(n, units))
                      or (geometry.has(key) and geometry.number(key))])  # fmt: skip
    return read_vector(geometry, geometry_units(asked), (), 0.0, tuple(n for n in asked if n in free), sigma)


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
