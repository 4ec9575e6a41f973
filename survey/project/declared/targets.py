"""Targets of ``survey.toml``, and what of them a program can find."""

from collections.abc import Callable
from dataclasses import fields, replace
from typing import Any, Literal

import numpy as np

from adjust.model.boards import BENT
from adjust.model.survey import FloatArray, Target, VectorParameter, VectorPrior
from survey.folder.text import suggestion
from survey.folder.units import to_si
from survey.project.declared.bodies import WARP_UNITS
from survey.project.declared.declarations import DECLARATIONS
from survey.project.declared.node import Node
from survey.project.declared.owners import read_epochs
from survey.project.declared.poses import read_pose
from survey.project.declared.vectors import key_of, read_vector
from survey.project.tables.files import read_table
from survey.project.tables.reading import Layout
from survey.project.targets import BOARDS, Board, Charuco, MarkerBlock, PointList, TargetKind

_KINDS = tuple(d.of[1] for d in DECLARATIONS if d.path == "targets.ID" and d.of is not None)
_MOST_ON_BOARD = 250_000  # squares or markers
POINTS_LAYOUT = Layout("points of a target", ("point_id",), ("x_mm", "y_mm", "z_mm"))


def read_targets(
    root: Node, station_ids: tuple[str, ...], camera_ids: tuple[str, ...], inputs: dict[str, str]
) -> tuple[tuple[Target, ...], dict[str, TargetKind], dict[str, tuple[str, ...]]]:
    """The targets under [targets.*], their kinds, and the cameras that may see those that name some.

    The hashes of the files of point lists are added to ``inputs``.
    """
    targets, kinds, seen_by = [], {}, {}
    for target_id, node in root.tables("targets"):
        kind_name = node.choice("kind", _KINDS)
        node = node.declared_as(f"target_{kind_name}")
        motion: Literal["fixed", "epoch"] = node.choice("motion", ("fixed", "epoch"))
        kind = _target_kind(node, kind_name, inputs)
        point_ids, x_in_target = kind.points()
        targets.append(
            Target(
                target_id,
                point_ids,
                x_in_target,
                node.reference("station", station_ids, "station") if node.has("station") else None,
                motion,
                read_pose(node.table("pose")),
                read_epochs(node, motion == "fixed"),
                _warp(node.table("warp"), kind_name) if node.has("warp") else None,
                node.table("warp").number("reference_degC"),
            )
        )
        kinds[target_id] = kind
        if node.has("cameras"):
            seen_by[target_id] = node.references("cameras", camera_ids, "camera")
    return tuple(targets), kinds, seen_by


def _target_kind(node: Node, name: str, inputs: dict[str, str]) -> TargetKind:
    if name in BOARDS:
        return _board(node, BOARDS[name])
    return _points(node, inputs) if name == "points" else _marker_block(node)


def _dictionary(node: Node) -> str:
    from survey.project.dictionaries import dictionary_names  # brings in OpenCV, which few projects need here

    name, known = node.text("dictionary"), dictionary_names()
    if name.upper().removeprefix("DICT_") not in known:
        raise node.error(f"unknown dictionary {name!r}; {suggestion(name.upper(), known)}", "dictionary")
    return name


def _board(node: Node, kind: type[Board]) -> Board:
    """A board by the fields of its kind, each under its name, lengths in mm."""
    read: dict[Any, Callable[[str], Any]] = {int: node.integer, float: node.si, bool: node.flag,
                                             str: lambda _: _dictionary(node)}  # fmt: skip
    found = kind(**{field.name: read[field.type](board_key(field.name)) for field in fields(kind)})
    first, second = (field.name for field in fields(kind)[:2])
    across, down = getattr(found, first), getattr(found, second)
    if across * down > _MOST_ON_BOARD:
        raise node.error(f"found {across} x {down}; a board has at most {_MOST_ON_BOARD}", first)
    if isinstance(found, Charuco) and found.marker_m >= found.square_m:
        raise node.error("the marker is not smaller than the square; correct marker_mm or square_mm", "marker_mm")
    return found


def board_key(field: str) -> str:
    """The key of a field of a board."""
    return f"{field}m" if field.endswith("_m") else field


def _marker_block(node: Node) -> TargetKind:
    markers = node.table("markers")
    corners: dict[int, FloatArray] = {}
    for key in markers.values:
        if not (key.isascii() and key.isdecimal() and len(key) < 10) or int(key) in corners:
            raise markers.error("expected the number of a marker, each once", key)
        corners[int(key)] = to_si(markers.numbers(key, (4, 3)), "mm")
    if not corners:
        raise node.error("no markers; write markers = { 7 = [[x, y, z], ... four corners in mm] }", "markers")
    return MarkerBlock(corners, _dictionary(node))


def _points(node: Node, inputs: dict[str, str]) -> TargetKind:
    name = node.text("file")
    folder = node.file.parent
    path = folder / name
    if not path.resolve().is_relative_to(folder.resolve()):
        raise node.error(f"found {name!r}; the file must lie inside the project folder", "file")
    if not path.is_file():
        raise node.error(f"the file {name!r} does not exist in {folder}; create it or correct the name", "file")
    table = read_table(path, POINTS_LAYOUT)
    inputs[path.relative_to(folder).as_posix()] = table.digest
    ids = table.unique_ids("point_id")
    if not ids:
        raise table.error(0, "the table has no points; a target needs at least one")
    x_mm = np.stack([table.numbers(column) for column in POINTS_LAYOUT.numbers], axis=1)
    return PointList(ids, to_si(x_mm, "mm"))


def _warp(node: Node, kind_name: str) -> VectorParameter:
    """Its first two components always, the others where they are free or not zero."""
    if kind_name == "marker_block":
        raise node.error(f"a target of kind {kind_name!r} is no flat board and has no warp; remove it")
    free: tuple[str, ...] = BENT
    if not isinstance(node.value("free"), bool):
        free = node.references("free", WARP_UNITS, "parameter")
    elif not node.flag("free"):
        free = ()
    asked, keys = (*BENT, *free), {n: key_of(n, WARP_UNITS) for n in WARP_UNITS}
    units = {n: u for n, u in WARP_UNITS.items()
             if n in asked or keys[n] in node.table("sigma").values or node.number(keys[n])}  # fmt: skip
    found = read_vector(node, units, (), chosen=tuple(n for n in units if n in free))
    sigma = node.sigmas("sigma", ("mm",), 2)
    if sigma is None:
        return found
    if not set(BENT) <= set(free):
        raise node.error("the warp has a sigma but is not free; write free = true or remove the sigma", "sigma_mm")
    if found.prior is not None:
        raise node.error("both sigma and sigma_mm are given; keep sigma", "sigma_mm")
    return replace(found, prior=VectorPrior(BENT, found.values[:2], np.diag(sigma**2)))
