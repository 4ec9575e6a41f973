"""Residuals as CSV: one row per image point, one row per component of every other observation.

Rows are made by the core: a million image points take a fraction of a second.
"""

from collections.abc import Iterator, Sequence
from itertools import chain, groupby
from math import isfinite
from typing import Any

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.observations import Reading
from adjust.model.result import Adjustment, ImageResiduals, Named, names_of
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.native.parallel import side_by_side, workers
from adjust.native.text import NUMBERS, TEXT, WORD, Words, number_rows, record_rows
from adjust.observations.terrestrial.statistics import reading_names, reading_unit
from survey.folder.text import Piece, cell_text, csv_text
from survey.project.tables.arrow import parquet_bytes
from survey.project.tables.reading import TextColumn
from survey.solution.quantities import units_for_people

IMAGE_COLUMNS = (
    "epoch_id,camera_id,target_id,point_id,u_px,v_px,residual_u_px,residual_v_px,sigma_u_px,sigma_v_px,"
    "redundancy_u,redundancy_v,standardized_u,standardized_v,test,used"
)
OTHER_COLUMNS = (
    "kind,group,ids,component,value_unit,observed,adjusted,residual_unit,residual,sigma,redundancy,standardized,test,"
    "used"
)
_DECIMALS = (4, 4, 6, 6, 6, 6, 5, 5, 4, 4, 4, 0)
_CHUNK = 16_384
_NEEDS_QUOTES = frozenset(',"\r\n')


@frozen(eq=False)
class ImageRows:
    """What belongs to each row of ``Adjustment.image_residuals``.

    block: (N,) position in ``Survey.image_blocks``. uv, sigmas: (N, 2) px. point: (N,) position in ``point_ids``,
    the points of the world followed by those of every target.
    """

    block: IntArray
    uv: FloatArray
    sigmas: FloatArray
    point: IntArray
    point_ids: tuple[str, ...]


def image_rows(adjustment: Adjustment) -> ImageRows:
    """Observed values, sigmas and names of all image points, row by row."""
    survey = adjustment.survey
    point_ids, start = _point_names(survey)
    points, lengths = survey.image_points, np.diff(survey.image_points.ptr)
    first = np.array([start[b.target_id] for b in survey.image_blocks], dtype=np.int64)
    point = points.point_idx + np.repeat(first, lengths)
    sigmas = np.sqrt(np.diagonal(points.cov, axis1=1, axis2=2))
    return ImageRows(np.repeat(np.arange(len(lengths)), lengths), points.uv, sigmas, point, point_ids)


def _point_names(survey: Survey) -> tuple[tuple[str, ...], dict[str | None, int]]:
    names = [p.point_id for p in survey.points]
    start: dict[str | None, int] = {None: 0}
    for target in survey.targets:
        start[target.target_id] = len(names)
        names += target.point_ids
    return tuple(names), start


def image_residuals_csv(adjustment: Adjustment, rows: ImageRows | None = None) -> Iterator[bytes]:
    """``residuals.csv``, piece by piece; sigmas are a priori; no number is written where there is none.

    rows: of the adjustment, where they are known already.
    """
    rows, found = rows or image_rows(adjustment), adjustment.image_residuals
    blocks = adjustment.survey.image_blocks
    names = [(b.epoch_id, b.camera_id, b.target_id or "") for b in blocks]
    cell = {name: _quoted(cell_text(name)) for name in set(chain.from_iterable(names))}
    heads = Words.of([f"{cell[epoch]},{cell[camera]},{cell[target]}," for epoch, camera, target in names])
    points = Words.of([_quoted(cell_text(p)) for p in rows.point_ids])
    numbers = _numbers(rows, found)

    def text(first: int) -> bytes:
        part = slice(first, first + _CHUNK)
        values: FloatArray = np.column_stack([x[part] for x in numbers]).astype(np.float64)
        made = number_rows(heads, rows.block[part], points, rows.point[part], values, _DECIMALS)
        return made if made is not None else _by_one(adjustment, rows, part, values)

    yield IMAGE_COLUMNS.encode() + b"\n"
    step = _CHUNK * workers()  # memory is used again from one step to the next
    for begin in range(0, rows.block.size, step):
        yield from side_by_side(text, range(begin, min(begin + step, rows.block.size), _CHUNK))


def _numbers(rows: ImageRows, found: ImageResiduals) -> tuple[FloatArray | BoolArray, ...]:
    """What follows the names in a row."""
    return rows.uv, found.residuals, rows.sigmas, found.redundancy, found.standardized, found.test, found.used


def image_residuals_parquet(adjustment: Adjustment) -> bytes:
    """``residuals.parquet``: the columns of ``residuals.csv``, its numbers in full, ``used`` as true or false."""
    rows, blocks = image_rows(adjustment), adjustment.survey.image_blocks
    names = IMAGE_COLUMNS.split(",")
    columns: dict[str, Any] = {}
    for name, words in zip(names, ([b.epoch_id for b in blocks], [b.camera_id for b in blocks],
                                   [b.target_id or "" for b in blocks]), strict=False):  # fmt: skip
        index = {word: i for i, word in enumerate(dict.fromkeys(words))}
        of_block = np.array([index[word] for word in words], dtype=np.int64)
        columns[name] = TextColumn(tuple(index), of_block[rows.block])
    columns["point_id"] = TextColumn(rows.point_ids, rows.point)
    parts = [x.reshape(len(x), -1) for x in _numbers(rows, adjustment.image_residuals)]
    values = (part[:, j] for part in parts for j in range(part.shape[1]))
    return parquet_bytes(columns | dict(zip(names[4:], values, strict=True)))


def _by_one(adjustment: Adjustment, rows: ImageRows, part: slice, values: FloatArray) -> bytes:
    """Rows of which some number is too large for fixed decimals: all in full."""
    out = []
    for b, point, row in zip(rows.block[part].tolist(), rows.point[part].tolist(), values.tolist(), strict=True):
        block = adjustment.survey.image_blocks[b]
        names = (block.epoch_id, block.camera_id, block.target_id or "", rows.point_ids[point])
        out.append((*map(cell_text, names), *("" if not isfinite(v) else repr(v) for v in row[:-1]), int(row[-1])))
    return csv_text(out).encode()


def _quoted(word: str) -> str:
    return word if _NEEDS_QUOTES.isdisjoint(word) else '"' + word.replace('"', '""') + '"'


def other_residuals_csv(adjustment: Adjustment) -> list[Piece]:
    """``residuals_other.csv``, piece by piece: values in mm and degrees, residuals and sigmas in mm and arcseconds."""
    readings, arrays = adjustment.reading_residuals, adjustment.other_arrays
    n = len(adjustment.other_residuals) - (0 if readings is None else len(readings.observed))
    first, at = 0, 0
    out: list[Piece] = [OTHER_COLUMNS.encode() + b"\n"]
    columns = np.column_stack([arrays.observed, arrays.adjusted, arrays.residual, arrays.sigma, arrays.redundancies,
                               arrays.standardized, arrays.test[arrays.observation]])  # fmt: skip
    names = names_of(adjustment.other_residuals)[:n]
    for (_, components, _), alike in groupby(names, lambda named: (named[0], *named[3:])):
        some = list(alike)
        end = at + len(some) * len(components)
        out.append(_other_rows(some, columns[at:end], arrays.used[first : first + len(some)]))
        first, at = first + len(some), end
    if readings is not None:
        out.append(_reading_rows(adjustment.survey.readings, columns[at:], readings.used))
    return out


def _other_rows(some: Sequence[Named], columns: FloatArray, used: BoolArray) -> memoryview:
    """Of observations with the same components."""
    (kind, *_, components, units), k = some[0], len(some[0][3])
    names, factor, small_names, small = zip(*map(units_for_people, components, units), strict=True)
    of_group = {group: _cells(kind, group) for group in {group for _, group, *_ in some}}
    heads = [f"{of_group[group]},{_cells(' '.join(ids))}" for _, group, ids, *_ in some]
    own = np.tile(np.arange(k), len(some))
    which = np.repeat(np.arange(len(some)), k), own, own
    return _rows(heads, list(map(_cells, components, names)), small_names, which, (np.array(factor), np.array(small)),
                 columns, np.repeat(used, k))  # fmt: skip


def _reading_rows(readings: Sequence[Reading], columns: FloatArray, used: BoolArray) -> memoryview:
    """The same of readings, which are many and have one component."""
    of = [(r.kind, *units_for_people(r.kind, reading_unit(r.kind))) for r in readings]
    kinds = list(dict.fromkeys(of))
    number = {kind: i for i, kind in enumerate(kinds)}
    own = np.array([number[kind] for kind in of], dtype=np.int64)
    names, units, factor, small_units, small = zip(*kinds, strict=True)
    heads = [_cells(r.kind, r.group, " ".join(reading_names(r))) for r in readings]
    which = np.arange(len(readings)), own, own
    return _rows(heads, list(map(_cells, names, units)), small_units, which, (np.array(factor), np.array(small)),
                 columns, used)  # fmt: skip


def _cells(*words: str) -> str:
    return ",".join(_quoted(cell_text(word)) for word in words)


def _rows(
    heads: Sequence[str], middles: Sequence[str], units: Sequence[str], which: tuple[IntArray, IntArray, IntArray],
    factors: tuple[FloatArray, FloatArray], columns: FloatArray, used: BoolArray,
) -> memoryview:  # fmt: skip
    """Rows of ``residuals_other.csv``: words of each, numbers with 12 digits, blank where there is none, used or not.

    heads: kind, group and ids; middles: component and its unit; units: of the residual. which: of these, by row (n,).
    factors: from SI to the unit of the value and of the residual, by component. columns: (n, 7) in the table's order.
    """
    factor, small = (x[which[1]] for x in factors)
    one = np.ones(len(columns))
    words = ["", ",", ",1\n", ",0\n", *heads, *middles, *units]
    first = 4 + np.cumsum([0, len(heads), len(middles)])
    word = np.column_stack([*(i + at for i, at in zip(which, first.tolist(), strict=True)), np.where(used, 2, 3)])
    comma, number = (TEXT, 1), (NUMBERS, 1)
    value = [comma, number]
    parts = [(WORD, 0), comma, (WORD, 1), *value, *value, comma, (WORD, 2), *value * 5, (WORD, 3)]
    values = columns * np.column_stack([factor, factor, small, small, one, one, one])
    return record_rows(Words.of(words), word, values, parts, 12)[0]
