"""Tables of image points into one block per camera, epoch and target, without a step per row."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from adjust.lenses.crops import possible_sizes
from adjust.model.names import natural_key
from adjust.model.observations import ImageBlock, ImageBlocks, ImagePoints
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from survey.folder.text import suggestion
from survey.project.project import ImagePointsWhere, Sigmas, SpotBlock
from survey.project.tables.covariance import covariance_from_sigmas, sigmas_and_correlations, table_correlations
from survey.project.tables.reading import Columns, Layout, Table, TextColumn, checked_groups, first_row
from survey.project.tables.references import Names

_SIGMAS = ("sigma_u_px", "sigma_v_px", "rho_uv")
IMAGE_POINTS = Layout(
    "image_points",
    ("epoch_id", "camera_id", "point_id"),
    ("u_px", "v_px"),
    ("target_id", "group", "used"),
    _SIGMAS,
)
SPOTS = Layout("spots", ("epoch_id", "camera_id", "spot_id"), ("u_px", "v_px"), (), _SIGMAS)


@dataclass(frozen=True, eq=False)
class _Rows:
    """The rows of a table as numbers: codes in natural order of names, positions of points, measured values."""

    camera: IntArray
    epoch: IntArray
    uv: FloatArray
    cov: FloatArray


def world_names(table: Table) -> set[str]:
    """Ids of the points without target."""
    target, point = table.text("target_id"), table.text("point_id")
    if "" not in target.names:
        return set()
    in_world = target.codes == target.names.index("")
    return {point.names[code] for code in np.unique(point.codes[in_world]).tolist()}


def read_image_blocks(table: Table, names: Names, sigmas: Sigmas) -> tuple[tuple[ImageBlock, ...], ImagePointsWhere]:
    """Blocks by camera, epoch, target (the world's points last) and group; their points in the target's order."""
    cameras, epochs = table.ids("camera_id"), table.ids("epoch_id")
    targets, groups = table.text("target_id"), _groups(table)
    rows = _measured(table, cameras, epochs, names, sigmas, groups)
    point_idx = _point_positions(table, targets, names)
    target, group = _ranks(targets, blank_last=True), _ranks(groups)
    _refuse_duplicates(table, "point_id", rows.camera, rows.epoch, target, point_idx)
    block = rows.camera, rows.epoch, target, group
    order = ordered(*block, point_idx)[0]
    ptr, used = _starts(order, block), table.flags("used")
    first = order[ptr[:-1]]
    texts = [TextColumn(c.names, c.codes[first]).values() for c in (cameras, epochs, targets, groups)]
    place: IntArray | slice = slice(None) if (order == np.arange(len(order))).all() else order
    point_idx, uv, cov, used, lines = point_idx[place], rows.uv[place], rows.cov[place], used[place], table.lines[place]
    all_used = np.logical_and.reduceat(used, ptr[:-1]).tolist() if len(first) else []
    blocks, where = [], []
    ranges = pairwise(ptr.tolist())
    for (i, j), whole, camera, epoch, target_id, group_name in zip(ranges, all_used, *texts, strict=True):
        kept = None if whole else used[i:j]
        blocks.append(ImageBlock(camera, epoch, target_id or None, point_idx[i:j], uv[i:j], cov[i:j], kept, group_name))
        where.append(lines[i:j])
    return ImageBlocks(blocks, ImagePoints(ptr, point_idx, uv, cov, used)), ImagePointsWhere(table.path, tuple(where))


def read_spots(table: Table, names: Names, sigmas: Sigmas) -> tuple[SpotBlock, ...]:
    """Unidentified spots in blocks by camera and epoch, sorted by id."""
    cameras, epochs, spots = table.ids("camera_id"), table.ids("epoch_id"), table.ids("spot_id")
    image = TextColumn(("image",), np.zeros(len(table), dtype=np.int64))
    rows = _measured(table, cameras, epochs, names, sigmas, image)
    spot = _ranks(spots)
    _refuse_duplicates(table, "spot_id", rows.camera, rows.epoch, spot)
    order, blocks = ordered(rows.camera, rows.epoch, spot)[0], []
    for i, j in pairwise(_starts(order, (rows.camera, rows.epoch)).tolist()):
        part = order[i:j]
        camera_id, epoch_id = (column.names[column.codes[part[0]]] for column in (cameras, epochs))
        spot_ids = tuple(spots.names[code] for code in spots.codes[part].tolist())
        blocks.append(SpotBlock(camera_id, epoch_id, spot_ids, rows.uv[part], rows.cov[part]))
    return tuple(blocks)


def ordered(*codes: IntArray) -> tuple[IntArray, BoolArray]:
    """Rows (n,) in the order of these codes, the first first; which of them (n - 1,) has the same as the one before.

    Rows that are in order already, as this program writes them, cost next to nothing.
    """
    sizes = [int(c.max(initial=0)) + 1 for c in codes]
    if math.prod(sizes) < 2**62:
        key = codes[0]
        for code, size in zip(codes[1:], sizes[1:], strict=True):
            key = key * size + code
        order = np.argsort(key, kind="stable")
        return order, np.diff(key[order]) == 0
    order = np.lexsort(codes[::-1])
    return order, ~_changes(order, codes)


def _changes(order: IntArray, codes: Sequence[IntArray]) -> BoolArray:
    """Where along ``order`` (n,) one of the codes changes (n - 1,)."""
    out: BoolArray = np.zeros(max(len(order) - 1, 0), dtype=np.bool_)
    for code in codes:
        of_row = code[order]
        out |= of_row[1:] != of_row[:-1]
    return out


def _starts(order: IntArray, codes: Sequence[IntArray]) -> IntArray:
    """Ranges (b + 1,) of ``order`` (n,) over which the codes stay the same."""
    if not len(order):
        return np.zeros(1, dtype=np.int64)
    return np.concatenate([[0], np.flatnonzero(_changes(order, codes)) + 1, [len(order)]])


def _groups(table: Table) -> TextColumn:
    groups = checked_groups(table)
    return TextColumn(tuple(name or "image" for name in groups.names), groups.codes)


def _ranks(column: TextColumn, blank_last: bool = False) -> IntArray:
    """Codes (n,) that sort as the names do, whatever the order of the rows."""
    order = sorted(set(column.names), key=lambda name: (blank_last and not name, natural_key(name)))
    rank = {name: i for i, name in enumerate(order)}
    return np.array([rank[name] for name in column.names], dtype=np.int64)[column.codes]


def _measured(
    table: Table, cameras: TextColumn, epochs: TextColumn, names: Names, sigmas: Sigmas, groups: TextColumn
) -> _Rows:
    sizes = {camera.camera_id: np.max(possible_sizes(camera), axis=0) for camera in names.survey.cameras}
    for code, name in enumerate(cameras.names):
        if name not in sizes:
            row = first_row(cameras.codes == code)
            raise table.error(row, f"camera_id: unknown camera {name!r}; {suggestion(name, sizes)}")
    uv = np.stack([table.numbers("u_px"), table.numbers("v_px")], axis=1)
    size = np.array([sizes[name] for name in cameras.names], dtype=float).reshape(-1, 2)
    out_u, out_v = ((x < -0.5) | (x > most[cameras.codes]) for x, most in zip(uv.T, size.T - 0.5, strict=True))
    outside = out_u | out_v
    if outside.any():
        row = first_row(outside)
        width, height = size[cameras.codes[row]].astype(int)
        problem = f"the point ({uv[row, 0]:g}, {uv[row, 1]:g}) px is outside the image of {width} x {height} px"
        raise table.error(row, f"{problem}; correct the table or image_size_px")
    scale = np.array([sigmas.scale.get(name, 1.0) for name in groups.names])[groups.codes]
    return _Rows(_ranks(cameras), _ranks(epochs), uv, _covariances(table, sigmas.image_px, scale))


def _covariances(table: Table, default_px: float | None, scale: FloatArray) -> FloatArray:
    """Covariances (n, 2, 2) px^2, from the sigma columns or, where a row has none, from ``default_px``."""
    sigma = np.stack([table.positive("sigma_u_px"), table.positive("sigma_v_px")], axis=1)
    blank = np.isnan(sigma)
    half = (blank[:, 0] != blank[:, 1]) | (blank[:, 0] & ~np.isnan(table.numbers("rho_uv")))
    if half.any():
        raise table.error(first_row(half), "sigma_u_px, sigma_v_px: one is missing; give both or leave all blank")
    filled = table_correlations(table, ("rho_uv",))
    if blank.any():
        if default_px is None:
            problem = "the row has no sigma; fill in sigma_u_px, sigma_v_px, or give [sigmas] image_px in survey.toml"
            raise table.error(first_row(blank[:, 0]), problem)
        sigma[blank] = default_px
    return covariance_from_sigmas(sigma * scale[:, None], filled)


def _point_positions(table: Table, targets: TextColumn, names: Names) -> IntArray:
    """Position (n,) of every row's point in its target, or among the world's points."""
    points = table.ids("point_id")
    pairs, first, inverse = _distinct(targets.codes * len(points.names) + points.codes)
    found = np.empty(len(pairs), dtype=np.int64)
    for i in np.argsort(first).tolist():
        target_code, point_code = divmod(int(pairs[i]), len(points.names))
        target_id, point_id = targets.names[target_code], points.names[point_code]
        row = int(first[i])
        if target_id:
            table.require(row, "target_id", "target", target_id, names.target_points)
        known = names.target_points[target_id] if target_id else names.points
        if point_id not in known:
            owner = f"target {target_id!r} has no point {point_id!r}" if target_id else f"unknown point {point_id!r}"
            hint = "" if target_id else f"; list it as [points.{point_id}], or set tie_points = true"
            raise table.error(row, f"point_id: {owner}; {suggestion(point_id, known)}{hint}")
        found[i] = known[point_id]
    return np.asarray(found[inverse])


def _distinct(codes: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """The different codes, not below zero, where each stands first, and the place of every one among them."""
    n, size = len(codes), int(codes.max(initial=-1)) + 1
    if size > 4 * n + 1000:
        values, first, inverse = np.unique(codes, return_index=True, return_inverse=True)
        return values, first, inverse.reshape(-1)
    at = np.full(size, -1)
    at[codes[::-1]] = np.arange(n)[::-1]  # of those that stand in several places the last is kept: the first of all
    values = np.flatnonzero(at >= 0)
    first = at[values]
    at[values] = np.arange(len(values))
    return values, first, at[codes]


def _refuse_duplicates(table: Table, column: str, *codes: IntArray) -> None:
    order, same_as_before = ordered(*codes)
    same = np.flatnonzero(same_as_before)
    if len(same):
        i = same[np.argmin(order[same + 1])]
        name = table.text(column).values()[order[i]]
        line = table.lines[order[i]]
        problem = f"{name!r} stands already in line {line} for this camera, epoch and target; remove one"
        raise table.error(int(order[i + 1]), f"{column}: {problem}")


def image_point_columns(blocks: Sequence[ImageBlock], survey: Survey) -> Columns:
    """One row per image point; ``group`` and ``used`` only where they are not as usual."""
    names: dict[str | None, tuple[str, ...]] = {target.target_id: target.point_ids for target in survey.targets}
    names[None] = tuple(point.point_id for point in survey.points)
    index: dict[str, int] = {}
    codes = {owner: np.array([index.setdefault(n, len(index)) for n in ids], int) for owner, ids in names.items()}
    sizes = [len(block.uv) for block in blocks]
    used = [block.mask for block in blocks]
    flags = np.concatenate([np.zeros(0, bool), *used])
    points = [codes[block.target_id][np.asarray(block.point_idx, int)] for block in blocks]
    return {
        "epoch_id": _repeat([block.epoch_id for block in blocks], sizes),
        "camera_id": _repeat([block.camera_id for block in blocks], sizes),
        "target_id": _repeat([block.target_id or "" for block in blocks], sizes),
        "point_id": TextColumn(tuple(index), np.concatenate([np.zeros(0, int), *points])),
        **_measured_columns(blocks),
        **({"group": _repeat([b.group for b in blocks], sizes)} if any(b.group != "image" for b in blocks) else {}),
        **({} if flags.all() else {"used": TextColumn(("false", "true"), flags.astype(int))}),
    }


def spot_columns(spots: Sequence[SpotBlock]) -> Columns:
    """One row per unidentified spot."""
    sizes = [len(block.uv) for block in spots]
    return {
        "epoch_id": _repeat([block.epoch_id for block in spots], sizes),
        "camera_id": _repeat([block.camera_id for block in spots], sizes),
        "spot_id": [spot_id for block in spots for spot_id in block.spot_ids],
        **_measured_columns(spots),
    }


def _measured_columns(blocks: Sequence[ImageBlock] | Sequence[SpotBlock]) -> dict[str, FloatArray]:
    uv = np.concatenate([np.zeros((0, 2)), *(block.uv for block in blocks)])
    sigma, rho = sigmas_and_correlations(np.concatenate([np.zeros((0, 2, 2)), *(block.cov for block in blocks)]))
    columns = np.column_stack([uv, sigma, rho])
    return dict(zip(("u_px", "v_px", "sigma_u_px", "sigma_v_px", "rho_uv"), columns.T, strict=True))


def _repeat(values: Sequence[str], sizes: Sequence[int]) -> TextColumn:
    index = {name: i for i, name in enumerate(dict.fromkeys(values))}
    return TextColumn(tuple(index), np.repeat(np.array([index[name] for name in values], int), sizes))
