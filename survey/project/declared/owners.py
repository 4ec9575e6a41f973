"""Cameras, stations and tables of ``survey.toml``."""

from typing import Literal

import numpy as np

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
from survey.folder.text import suggestion
from survey.folder.units import to_si
from survey.project.declared.declarations import keys_of
from survey.project.declared.lenses import read_lens
from survey.project.declared.node import Node
from survey.project.declared.poses import read_pose

GEOMETRY_UNITS = {"non_orthogonality": "arcsec", "axis_offset": "mm", "zero_1": "deg", "zero_2": "deg"}


def read_cameras(root: Node, station_ids: tuple[str, ...]) -> tuple[Camera, ...]:
    """The cameras under [cameras.*]."""
    cameras = []
    for camera_id, node in root.tables("cameras"):
        node.allow(*keys_of("camera"))
        station_id = node.reference("station", station_ids, "station")
        width, height = node.numbers("image_size_px", (2,))
        if min(width, height) < 1 or width % 1 or height % 1:
            raise node.error(f"found [{width:g}, {height:g}]; expected whole numbers, [width, height]", "image_size_px")
        if not node.has("lens"):
            raise node.error(f"the table [cameras.{camera_id}.lens] is missing; add it", "lens")
        lens = read_lens(node.table("lens"))
        pose = read_pose(node.table("station_from_camera"))
        cameras.append(Camera(camera_id, station_id, (int(width), int(height)), lens, pose))
    return tuple(cameras)


def read_stations(root: Node, table_ids: tuple[str, ...]) -> tuple[Station, ...]:
    """The stations under [stations.*]."""
    stations = []
    for station_id, node in root.tables("stations"):
        node.allow(*keys_of("station"))
        name = node.choice("motion", ("fixed", "epoch", "table"), "fixed")
        motion: Literal["fixed", "epoch", "table"] = name if name in ("epoch", "table") else "fixed"  # type: ignore[assignment]  # mypy does not narrow str by a tuple
        table_id = None
        if motion == "table":
            if not node.has("table"):
                raise node.error('motion = "table" needs the id of the table; add table = "..."', "table")
            table_id = node.reference("table", table_ids, "table")
        for key in ("table", "mount_from_station"):
            if motion != "table" and node.has(key):
                raise node.error(f'only a station with motion = "table" has {key!r}; remove it', key)
        stations.append(
            Station(
                station_id,
                motion,
                read_pose(node.table("world_from_station")),
                read_epochs(node, motion == "fixed"),
                table_id,
                read_pose(node.table("mount_from_station")),
            )
        )
    return tuple(stations)


def read_epochs(node: Node, is_fixed: bool) -> dict[str, PoseParameter]:
    """The poses below ``epochs``."""
    if is_fixed and node.has("epochs"):
        raise node.error('motion is "fixed", which has no epochs; write motion = "epoch" or remove them', "epochs")
    return {epoch_id: read_pose(epoch) for epoch_id, epoch in node.tables("epochs")}


def read_tables(root: Node) -> tuple[tuple[Table, ...], dict[str, FloatArray]]:
    """The tables under [tables.*] and the sigmas (axes,) rad of their readings, by table id."""
    tables, sigmas = [], {}
    for table_id, node in root.tables("tables"):
        node.allow(*keys_of("turntable"))
        axes = node.references("axes", ("x", "y", "z"), "axis", ("x", "z"))
        if len(axes) not in (1, 2):
            raise node.error(f"found {len(axes)} axes; a table has one or two, outermost first", "axes")
        sigma = node.sigmas("sigma", ("arcsec",), len(axes))
        if sigma is not None:
            sigmas[table_id] = sigma
        pose = read_pose(node.table("world_from_table"))
        tables.append(Table(table_id, axes, pose, _read_geometry(node, len(axes))))
    return tuple(tables), sigmas


def geometry_key(name: str) -> str:
    """The key of a geometry parameter: its name with the unit."""
    return f"{name}_{GEOMETRY_UNITS[name]}"


def _read_geometry(node: Node, n_axes: int) -> VectorParameter:
    names = TABLE_GEOMETRY if n_axes == 2 else ("zero_1",)
    geometry = node.table("geometry")
    keys = tuple(geometry_key(name) for name in names)
    geometry.allow("free", *keys)
    free = geometry.references("free", names, "table parameter", names[:2] if n_axes == 2 else ())
    values = np.array([to_si(geometry.number(geometry_key(name), 0.0), GEOMETRY_UNITS[name]) for name in names])
    table = node.table("geometry_sigma")
    for key in table.values:
        if key not in keys:
            raise table.error(f"unknown key; {suggestion(key, keys)}", key)
    priors = tuple(name for name in names if geometry_key(name) in table.values)
    for name in priors:
        if name not in free:
            raise table.error(f"{name} has a sigma but is not free; add it to geometry.free", geometry_key(name))
    if not priors:
        return VectorParameter(names, values, free)
    sigmas = np.array([to_si(table.number(geometry_key(n), positive=True), GEOMETRY_UNITS[n]) for n in priors])
    mean = np.array([values[names.index(name)] for name in priors])
    return VectorParameter(names, values, free, VectorPrior(priors, mean, np.diag(sigmas**2)))
