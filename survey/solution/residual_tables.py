"""Residuals as CSV: one row per image point, one row per component of every other observation.

Rows are made by the core: a million image points take a fraction of a second.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, groupby
from math import isfinite
from typing import Any

import numpy as np

from adjust.model.observations import Reading
from adjust.model.result import Adjustment, ImageResiduals, ObservationResidual, ReadingResiduals
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.native.parallel import side_by_side
from adjust.native.text import Words, number_rows
from adjust.observations.terrestrial.statistics import reading_names, reading_unit
from survey.folder.text import cell_text
from survey.project.tables.arrow import parquet_bytes
from survey.project.tables.reading import TextColumn
from survey.solution.quantities import sigma_unit_for_people, unit_for_people

IMAGE_COLUMNS = (
    "epoch_id,camera_id,target_id,point_id,u_px,v_px,residual_u_px,residual_v_px,sigma_u_px,sigma_v_px,"
    "redundancy_u,redundancy_v,standardized_u,standardized_v,test,used"
)
OTHER_COLUMNS = (
    "kind,group,ids,component,value_unit,observed,adjusted,residual_unit,residual,sigma,redundancy,standardized,test,"
    "used"
)
_DECIMALS = (4, 4, 6, 6, 6, 6, 5, 5, 4, 4, 4, 0)
_CHUNK = 50_000
_NEEDS_QUOTES = frozenset(',"\r\n')


@dataclass(frozen=True, eq=False)
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
    blocks, ptr = survey.image_blocks, adjustment.image_residuals.block_ptr
    lengths, none = np.diff(ptr), np.zeros((0, 2))
    uv = np.concatenate([none, *(b.uv for b in blocks)])
    cov = np.concatenate([np.zeros((0, 2, 2)), *(b.cov for b in blocks)])
    first = np.array([start[b.target_id] for b in blocks], dtype=np.int64)
    point = np.concatenate([np.zeros(0, dtype=np.int64), *(b.point_idx for b in blocks)]) + np.repeat(first, lengths)
    sigmas = np.sqrt(np.diagonal(cov, axis1=1, axis2=2))
    return ImageRows(np.repeat(np.arange(len(blocks)), lengths), uv, sigmas, point, point_ids)


def _point_names(survey: Survey) -> tuple[tuple[str, ...], dict[str | None, int]]:
    names = [p.point_id for p in survey.points]
    start: dict[str | None, int] = {None: 0}
    for target in survey.targets:
        start[target.target_id] = len(names)
        names += target.point_ids
    return tuple(names), start


def image_residuals_csv(adjustment: Adjustment) -> bytes:
    """``residuals.csv``; sigmas are those of the observations, a priori; no number is written where there is none."""
    rows, found = image_rows(adjustment), adjustment.image_residuals
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

    return b"".join([IMAGE_COLUMNS.encode() + b"\n", *side_by_side(text, range(0, rows.block.size, _CHUNK))])


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
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    for b, point, row in zip(rows.block[part].tolist(), rows.point[part].tolist(), values.tolist(), strict=True):
        block = adjustment.survey.image_blocks[b]
        names = (block.epoch_id, block.camera_id, block.target_id or "", rows.point_ids[point])
        writer.writerow((*map(cell_text, names), *("" if not isfinite(v) else repr(v) for v in row[:-1]), int(row[-1])))
    return out.getvalue().encode()


def _quoted(word: str) -> str:
    return word if _NEEDS_QUOTES.isdisjoint(word) else '"' + word.replace('"', '""') + '"'


def other_residuals_csv(adjustment: Adjustment) -> bytes:
    """``residuals_other.csv``: values in mm and degrees, residuals and sigmas in mm and arcseconds."""
    out = io.StringIO()
    writer, readings = csv.writer(out, lineterminator="\n"), adjustment.reading_residuals
    writer.writerow(OTHER_COLUMNS.split(","))
    n = len(adjustment.other_residuals) - (0 if readings is None else len(readings.observed))
    for alike, some in groupby(adjustment.other_residuals[:n], lambda o: (o.kind, o.components, o.units)):
        writer.writerows(_other_rows(alike[0], list(map(_units, *alike[1:])), list(some)))
    if readings is not None:
        writer.writerows(_reading_rows(adjustment.survey.readings, readings))
    return out.getvalue().encode()


def _other_rows(
    kind: str, units: Sequence[tuple[str, float, str, float]], some: Sequence[ObservationResidual]
) -> Iterator[tuple[str | int, ...]]:
    """Of observations with the same components, column by column."""
    names, factor, small_names, small = (list(x) for x in zip(*units, strict=True))
    k, components = len(units), list(some[0].components)
    values: list[list[float]] = [
        (np.array([getattr(o, name) for o in some], dtype=float).reshape(-1, k) * scale).ravel().tolist()
        for name, scale in (("observed", factor), ("adjusted", factor), ("residual", small), ("sigma", small),
                            ("redundancy", 1.0), ("standardized", 1.0))
    ]  # fmt: skip
    observed, adjusted, *rest = (map(_number, column) for column in values)
    of = ((cell_text(o.group), cell_text(" ".join(o.ids)), _number(o.test), int(o.used)) for o in some)
    groups, ids, tests, used = zip(*(row for row in of for _ in range(k)), strict=True)
    each = (components, names, small_names)
    component, value_unit, small_unit = (x * len(some) for x in each)
    return zip([kind] * len(ids), groups, ids, component, value_unit, observed, adjusted, small_unit, *rest, tests,
               used, strict=True)  # fmt: skip


def _reading_rows(readings: Sequence[Reading], found: ReadingResiduals) -> Iterator[tuple[str | int, ...]]:
    """The same of readings, which are many and have one component, column by column."""
    kinds = [r.kind for r in readings]
    value_units, factors, small_units, smalls = zip(*(_units(k, reading_unit(k)) for k in kinds), strict=True)
    factor, small = np.array(factors), np.array(smalls)
    observed, adjusted, residual, sigma, *numbers = (
        list(map(_number, x.tolist()))
        for x in (found.observed * factor, found.adjusted * factor, found.residual * small, found.sigma * small,
                  found.redundancy, found.standardized, found.test)
    )  # fmt: skip
    groups, ids = [cell_text(r.group) for r in readings], [cell_text(" ".join(reading_names(r))) for r in readings]
    return zip(kinds, groups, ids, kinds, value_units, observed, adjusted, small_units, residual, sigma, *numbers,
               found.used.astype(int).tolist(), strict=True)  # fmt: skip


@lru_cache
def _units(component: str, unit: str) -> tuple[str, float, str, float]:
    return *unit_for_people(component, unit), *sigma_unit_for_people(unit)


def _number(value: float) -> str:
    return f"{value:.12g}" if isfinite(value) else ""
