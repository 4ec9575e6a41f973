"""Tables of image points into one block per camera, epoch and target, without a step per row."""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from adjust.lenses.crops import possible_sizes
from adjust.model.names import natural_key
from adjust.model.observations import ImageBlock, ImageBlocks, ImagePoints
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.native.parallel import side_by_side
from survey.folder.text import suggestion
from survey.project.project import Sigmas, SpotBlock
from survey.project.tables.covariance import covariance_from_sigmas, sigmas_and_correlations, table_correlations
from survey.project.tables.reading import Columns, Table, TextColumn, checked_groups, first_row
from survey.project.tables.references import Names

_PART = 2**15  # rows at a time


def world_names(table: Table) -> set[str]:
    """Ids of the points without target."""
    target, point = table.text("target_id"), table.text("point_id")
    if "" not in target.names:
        return set()
    in_world = target.codes == target.names.index("")
    return {point.names[code] for code in np.unique(point.codes[in_world]).tolist()}


def read_image_blocks(table: Table, names: Names, sigmas: Sigmas) -> tuple[ImageBlock, ...]:
    """Blocks by camera, epoch, target (the world's points last) and group; their points in the target's order."""
    cameras, epochs = table.ids("camera_id"), table.ids("epoch_id")
    targets, groups = table.text("target_id"), _groups(table)
    uv, cov = _measured(table, cameras, names, sigmas, groups)
    columns = (cameras, False), (epochs, False), (targets, True), (groups, False)
    parts: list[Callable[[], IntArray]] = [partial(_point_positions, table, targets, names)]
    parts += [partial(_ranks, *column) for column in columns]
    point_idx, *ranks, of_group = side_by_side(lambda part: part(), parts)
    order, ptr = _arranged(table, "point_id", one_code(*ranks), point_idx, of_group)
    first, used = order[ptr[:-1]], table.flags("used")
    texts = [TextColumn(c.names, c.codes[first]).values() for c in (cameras, epochs, targets, groups)]
    if (order != np.arange(len(order))).any():
        arrays: list[npt.NDArray[Any]] = [cov, uv, point_idx, used]
        cov, uv, point_idx, used = side_by_side(lambda x: x.take(order, axis=0), arrays)
    all_used = [True] * len(first) if used.all() else np.logical_and.reduceat(used, ptr[:-1]).tolist()
    blocks = []
    ranges = pairwise(ptr.tolist())
    for (i, j), whole, camera, epoch, target_id, group_name in zip(ranges, all_used, *texts, strict=True):
        kept = None if whole else used[i:j]
        blocks.append(ImageBlock(camera, epoch, target_id or None, point_idx[i:j], uv[i:j], cov[i:j], kept, group_name))
    return ImageBlocks(blocks, ImagePoints(ptr, point_idx, uv, cov, used))


def read_spots(table: Table, names: Names, sigmas: Sigmas) -> tuple[SpotBlock, ...]:
    """Unidentified spots in blocks by camera and epoch, sorted by id."""
    cameras, epochs, spots = table.ids("camera_id"), table.ids("epoch_id"), table.ids("spot_id")
    image = TextColumn(("image",), np.zeros(len(table), dtype=np.int64))
    uv, cov = _measured(table, cameras, names, sigmas, image)
    order, ptr = _arranged(table, "spot_id", one_code(_ranks(cameras), _ranks(epochs)), _ranks(spots), image.codes)
    blocks = []
    for i, j in pairwise(ptr.tolist()):
        part = order[i:j]
        camera_id, epoch_id = (column.names[column.codes[part[0]]] for column in (cameras, epochs))
        spot_ids = tuple(spots.names[code] for code in spots.codes[part].tolist())
        blocks.append(SpotBlock(camera_id, epoch_id, spot_ids, uv[part], cov[part]))
    return tuple(blocks)


def one_code(*codes: IntArray) -> IntArray:
    """One code (n,) of each row, that sorts as these do one after the other, the first first."""
    key = codes[0]
    for code in codes[1:]:
        size = int(code.max(initial=0)) + 1
        if (int(key.max(initial=0)) + 1) * size >= 2**62:
            key = np.unique(key, return_inverse=True)[1].reshape(-1)
        key = key * size + code
    return key


def _arranged(table: Table, column: str, seen: IntArray, item: IntArray, group: IntArray) -> tuple[IntArray, IntArray]:
    """The rows (n,) by what was ``seen`` where and when, group and item, and where (b + 1,) one of the first two ends.

    Raises SurveyError where the same item of ``column`` was seen twice.
    """
    every, order = one_code(seen, item), np.arange(len(seen))
    if (every[1:] <= every[:-1]).any():  # not in order already, as this program writes it
        order = np.argsort(every, kind="stable")
        _check_once(table, column, every[order], order)
    block = seen
    if group.any():
        block = one_code(seen, group)
        order = order[np.argsort(block[order], kind="stable")]
    block = block[order]
    ends = np.flatnonzero(block[1:] != block[:-1]) + 1
    return order, np.concatenate([[0], ends, [len(block)]] if len(block) else [[0]])


def _check_once(table: Table, column: str, every: IntArray, order: IntArray) -> None:
    """Raises SurveyError where two of the rows in this order have the same code."""
    same = np.flatnonzero(every[1:] == every[:-1])
    if len(same):
        i = same[np.argmin(order[same + 1])]
        name = table.text(column).values()[order[i]]
        line = table.lines[order[i]]
        problem = f"{name!r} stands already in line {line} for this camera, epoch and target; remove one"
        raise table.error(int(order[i + 1]), f"{column}: {problem}")


def _groups(table: Table) -> TextColumn:
    groups = checked_groups(table)
    return TextColumn(tuple(name or "image" for name in groups.names), groups.codes)


def _ranks(column: TextColumn, blank_last: bool = False) -> IntArray:
    """Codes (n,) that sort as the names do, whatever the order of the rows."""
    order = sorted(set(column.names), key=lambda name: (blank_last and not name, natural_key(name)))
    rank = {name: i for i, name in enumerate(order)}
    return np.array([rank[name] for name in column.names], dtype=np.int64)[column.codes]


def _measured(
    table: Table, cameras: TextColumn, names: Names, sigmas: Sigmas, groups: TextColumn
) -> tuple[FloatArray, FloatArray]:
    """Image coordinates (n, 2) px and their covariances (n, 2, 2) px^2; part by part, as far as a core's own memory."""
    sizes = {camera.camera_id: np.max(possible_sizes(camera), axis=0) for camera in names.survey.cameras}
    for code, name in enumerate(cameras.names):
        if name not in sizes:
            row = first_row(cameras.codes == code)
            raise table.error(row, f"camera_id: unknown camera {name!r}; {suggestion(name, sizes)}")
    size = np.array([sizes[name] for name in cameras.names], dtype=float).reshape(-1, 2)
    scale = np.array([sigmas.scale.get(name, 1.0) for name in groups.names])
    ends = np.ascontiguousarray(size.T - 0.5)
    uv, cov = np.empty((len(table), 2)), np.empty((len(table), 2, 2))

    def measure(first: int) -> None:
        rows = slice(first, first + _PART)
        part, camera = table.part(rows), cameras.codes[rows]
        uv[rows, 0], uv[rows, 1] = part.numbers("u_px"), part.numbers("v_px")
        outside = np.logical_or(*((x < -0.5) | (x > most[camera]) for x, most in zip(uv[rows].T, ends, strict=True)))
        if outside.any():
            row = first_row(outside)
            (u, v), (width, height) = uv[first + row], size[camera[row]].astype(int)
            problem = f"the point ({u:g}, {v:g}) px is outside the image of {width} x {height} px"
            raise part.error(row, f"{problem}; correct the table or image_size_px")
        cov[rows] = _covariances(part, sigmas.image_px, scale[groups.codes[rows]])

    side_by_side(measure, range(0, len(table), _PART))
    return uv, cov


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
