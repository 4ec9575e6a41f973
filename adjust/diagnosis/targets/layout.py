"""Boards of another number of columns than their owner says, squares counted for corners: points in other rows."""

from collections.abc import Iterator

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.model.rewriting import with_changed
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.native.views import homographies

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
        widths = list(range(2, _WIDEST))
        every = np.array([lattice(n, c, square) for c in widths] + [x])
        *misses, now = np.max([_misses(every[:, b.point_idx, :2], b.uv) for b in some], axis=0).tolist()
        best = min(misses)
        if now > _CLEARLY * best:
            columns = widths[misses.index(best)]
            yield _hypothesis(case.survey, target.target_id, columns, square, now / best)


def lattice(n: int, columns: int, square: float) -> FloatArray:
    """N points (n, 3), row by row."""
    i: IntArray = np.arange(n)
    return square * np.column_stack([i % columns, i // columns, np.zeros(n)])


def _columns(x: FloatArray, square: float) -> int:
    return round(float(np.ptp(x[:, 0])) / square) + 1


def _misses(x: FloatArray, uv: FloatArray) -> FloatArray:
    """(m,) px, rms of the best homographies of points (m, n, 2) to uv (n, 2); infinite where there is none."""
    m, n, _ = x.shape
    return homographies(x.reshape(-1, 2), np.tile(uv, (m, 1)), n * np.arange(m + 1), 0)[1][:, 0]


def _hypothesis(survey: Survey, target: str, columns: int, square: float, evidence: float) -> Hypothesis:
    n = len(survey.targets_by_id[target].point_ids)
    rows = -(-n // columns)
    return Hypothesis(
        "rows and columns", f"target {target} has {columns} columns of points, and {rows} rows: as it is said, its "
        "images are not those of a plane; perhaps squares were counted for corners, or rows for columns",
        f"write columns = {columns}, rows = {rows}", Place("target", (target,), "columns"),
        with_changed(survey, "targets", target, x_in_target=lattice(n, columns, square)),
        (SetKey(("targets", target, "columns"), columns), SetKey(("targets", target, "rows"), rows)),
        1e5 * evidence, 1, _WIDEST,
    )  # fmt: skip
