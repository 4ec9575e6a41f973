"""Boards of another number of columns than their owner says, squares counted for corners: points in other rows."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.model.survey import FloatArray, IntArray, Survey

_CLEARLY = 5.0
_WIDEST, _IMAGES = 40, 4
_FEWEST = 9


def other_layouts(case: Case) -> Iterator[Hypothesis]:
    """For each grid of points: the number of columns for which its images are those of a plane."""
    for target in case.survey.targets:
        mine = [b for b in case.survey.image_blocks if b.target_id == target.target_id and len(b.uv) >= _FEWEST]
        x, n = target.x_in_target, len(target.point_ids)
        if not mine or n < _FEWEST or np.ptp(x[:, 2]) > 1e-6:
            continue
        some = sorted(mine, key=lambda b: -len(b.uv))[:_IMAGES]
        square = float(np.linalg.norm(x[1] - x[0]))
        if not np.allclose(x, lattice(n, _columns(x, square), square), atol=1e-6):
            continue
        misses = {c: max(_miss(lattice(n, c, 1.0)[b.point_idx], b.uv) for b in some) for c in range(2, _WIDEST)}
        now = max(_miss(x[b.point_idx] / square, b.uv) for b in some)
        best = min(misses, key=lambda c: misses[c])
        if now > _CLEARLY * misses[best]:
            yield _hypothesis(case.survey, target.target_id, best, square, now / misses[best])


def lattice(n: int, columns: int, square: float) -> FloatArray:
    """N points (n, 3), row by row."""
    i: IntArray = np.arange(n)
    return square * np.column_stack([i % columns, i // columns, np.zeros(n)])


def _columns(x: FloatArray, square: float) -> int:
    return round(float(np.ptp(x[:, 0])) / square) + 1


def _miss(x: FloatArray, uv: FloatArray) -> float:
    """px, rms of the best homography of points (n, 3) of a plane to uv (n, 2), by the direct linear transformation."""
    a, _ = _normalized(x[:, :2])
    b, scale = _normalized(uv)
    one, zero = np.column_stack([a, np.ones(len(a))]), np.zeros((len(a), 3))
    A = np.concatenate([np.hstack([one, zero, -b[:, :1] * one]), np.hstack([zero, one, -b[:, 1:] * one])])
    H = np.linalg.svd(A, full_matrices=False)[2][-1].reshape(3, 3)
    q = one @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        miss = (q[:, :2] / q[:, 2:] - b) / scale
    return float(np.sqrt((np.minimum(np.abs(np.nan_to_num(miss, nan=1e6)), 1e6) ** 2).mean()))


def _normalized(x: FloatArray) -> tuple[FloatArray, float]:
    centred = x - x.mean(axis=0)
    scale = 1.0 / max(float(np.abs(centred).max()), 1e-12)
    return scale * centred, scale


def _hypothesis(survey: Survey, target: str, columns: int, square: float, evidence: float) -> Hypothesis:
    n = next(len(t.point_ids) for t in survey.targets if t.target_id == target)
    rows = -(-n // columns)
    targets = tuple(
        replace(t, x_in_target=lattice(n, columns, square)) if t.target_id == target else t for t in survey.targets
    )
    return Hypothesis(
        "rows and columns", f"target {target} has {columns} columns of points, and {rows} rows: as it is said, its "
        "images are not those of a plane; perhaps squares were counted for corners, or rows for columns",
        f"write columns = {columns}, rows = {rows}", Place("target", (target,), "columns"),
        replace(survey, targets=targets),
        (SetKey(("targets", target, "columns"), columns), SetKey(("targets", target, "rows"), rows)),
        1e5 * evidence, 1, _WIDEST,
    )  # fmt: skip
