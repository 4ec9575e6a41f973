"""Residuals as CSV: one row per image point, one row per component of every other observation.

Rows are assembled as matrices of bytes, not line by line: a million image points take about a second.
"""

import csv
import io
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from math import isfinite

import numpy as np
import numpy.typing as npt

from adjust.model.observations import Reading
from adjust.model.result import Adjustment, ReadingResiduals
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.native.parallel import workers
from adjust.observations.terrestrial.statistics import reading_names, reading_unit
from survey.folder.text import cell_text
from survey.solution.quantities import sigma_unit_for_people, unit_for_people

Bytes = npt.NDArray[np.uint8]
IMAGE_COLUMNS = (
    "epoch_id,camera_id,target_id,point_id,u_px,v_px,residual_u_px,residual_v_px,sigma_u_px,sigma_v_px,"
    "redundancy_u,redundancy_v,standardized_u,standardized_v,test,used"
)
OTHER_COLUMNS = (
    "kind,group,ids,component,value_unit,observed,adjusted,residual_unit,residual,sigma,redundancy,standardized,test,"
    "used"
)
_CHUNK = 50_000


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
    uv, sigmas = np.empty((ptr[-1], 2)), np.empty((ptr[-1], 2))
    point = np.empty(ptr[-1], dtype=np.int64)
    for block, first, last in zip(blocks, ptr[:-1], ptr[1:], strict=True):
        uv[first:last] = block.uv
        sigmas[first:last] = np.sqrt(np.diagonal(block.cov, axis1=1, axis2=2))
        point[first:last] = start[block.target_id] + np.asarray(block.point_idx)
    return ImageRows(np.repeat(np.arange(len(blocks)), np.diff(ptr)), uv, sigmas, point, point_ids)


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
    by_block = [
        _text([cell_text(b.epoch_id) for b in blocks]),
        _text([cell_text(b.camera_id) for b in blocks]),
        _text([cell_text(b.target_id or "") for b in blocks]),
    ]
    points = _text([cell_text(p) for p in rows.point_ids])
    numbers = (
        (rows.uv, 4), (found.residuals, 6), (rows.sigmas, 6), (found.redundancy, 5), (found.standardized, 4),
        (found.test[:, None], 4), (found.used[:, None].astype(float), 0),
    )  # fmt: skip

    def text(first: int) -> bytes:
        part = slice(first, first + _CHUNK)
        columns = [names[rows.block[part]] for names in by_block] + [points[rows.point[part]]]
        columns += [_fixed(values[part, j], decimals) for values, decimals in numbers for j in range(values.shape[1])]
        return _join(columns)

    with ThreadPoolExecutor(workers()) as pool:
        return b"".join([IMAGE_COLUMNS.encode() + b"\n", *pool.map(text, range(0, rows.block.size, _CHUNK))])


def _text(words: Sequence[str]) -> Bytes:
    """Words as rows of bytes, padded with zeros, quoted where CSV needs it."""
    quoted = ['"' + w.replace('"', '""') + '"' if any(c in w for c in ',"\r\n') else w for w in words] or [""]
    padded = np.array([w.encode() for w in quoted])
    width = max(padded.dtype.itemsize, 1)
    return padded.astype(f"S{width}").view(np.uint8).reshape(len(quoted), width)


def _fixed(values: FloatArray, decimals: int) -> Bytes:
    """Numbers as rows of bytes with a fixed number of decimals, padded with zeros; empty where not finite."""
    finite = np.isfinite(values)
    magnitude = np.where(finite, np.abs(values), 0.0) * 10.0**decimals
    if magnitude.size and magnitude.max() > 1e17:
        return _text([repr(float(v) + 0.0) if ok else "" for v, ok in zip(values, finite, strict=True)])
    whole = np.rint(magnitude).astype(np.int64)
    n_digits = max(len(str(int(whole.max()))) if whole.size else 1, decimals + 1)
    out = np.zeros((values.size, n_digits + 1 + (decimals > 0)), dtype=np.uint8)
    out[:, 0] = np.where((values < 0.0) & (whole > 0), ord("-"), 0)
    rest, column = whole.copy(), out.shape[1] - 1
    for place in range(n_digits):
        if place == decimals and decimals:
            out[:, column] = ord(".")
            column -= 1
        written = rest > 0 if place > decimals else np.True_
        rest, digit = np.divmod(rest, 10)
        out[:, column] = np.where(written, digit + ord("0"), 0)
        column -= 1
    out[~finite] = 0
    return out


def _join(columns: list[Bytes]) -> bytes:
    n = columns[0].shape[0]
    comma, end = np.full((n, 1), ord(","), np.uint8), np.full((n, 1), ord("\n"), np.uint8)
    parts = [part for column in columns for part in (column, comma)]
    flat = np.concatenate([*parts[:-1], end], axis=1).ravel()
    return bytes(flat[flat != 0].tobytes())


def other_residuals_csv(adjustment: Adjustment) -> bytes:
    """``residuals_other.csv``: values in mm and degrees, residuals and sigmas in mm and arcseconds."""
    out = io.StringIO()
    writer, readings = csv.writer(out, lineterminator="\n"), adjustment.reading_residuals
    writer.writerow(OTHER_COLUMNS.split(","))
    n = len(adjustment.other_residuals) - (0 if readings is None else len(readings.observed))
    for o in adjustment.other_residuals[:n]:
        of, used = (o.kind, cell_text(o.group), cell_text(" ".join(o.ids))), int(o.used)
        values = (np.asarray(x, dtype=float).tolist()
                  for x in (o.observed, o.adjusted, o.residual, o.sigma, o.redundancy, o.standardized))  # fmt: skip
        test = _number(o.test)
        for component, unit, observed, adjusted, residual, sigma, *numbers in zip(
            o.components, o.units, *values, strict=True
        ):
            value_unit, factor, small_unit, small = _units(component, unit)
            writer.writerow((
                *of, component, value_unit, _number(observed * factor), _number(adjusted * factor), small_unit,
                _number(residual * small), _number(sigma * small), *map(_number, numbers), test, used,
            ))  # fmt: skip
    if readings is not None:
        writer.writerows(_reading_rows(adjustment.survey.readings, readings))
    return out.getvalue().encode()


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
