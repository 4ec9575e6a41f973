"""Corners of boards and markers to a few hundredths of a pixel, each with an honest covariance; whole boards of them.

A whole board has squares beside each other, and ends where it was said to end.
"""

from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray
from adjust.native import vision
from adjust.native.vision import may_go_on, squares_follow
from survey.detection.gray import Gray32

# Edges are taken for straight lines. What bending by the lens does where it cannot be told from the other corners
# (see :func:`unbent`), and what remains of images without noise where it can: both measured on
# renderings with k1 = -0.2 (tests/survey/test_detection.py, test_detection_sigmas.py).
CROSSING_BENT_PX, MARKER_BENT_PX = 0.002, 0.003
CROSSING_FLOOR_PX, MARKER_FLOOR_PX = 0.0002, 0.0005
_PIXEL_VARIANCE = 1.0 / 12.0


@frozen(eq=False)
class CornerFit:
    """Fitted corners: uv (n, 2) px, cov (n, 2, 2) px^2, blur (n,) px of the lens without the pixel, contrast (n,) grey.

    good: which fits are to be trusted; the others have no meaning. angles: (n, 2) rad of both edges in the image.
    bend_px2: (n, 2) by how much the fit of a straight edge is displaced along its normal, for a curvature of 1 / px.
    bent_px: what bending does at most under usual lenses, not in ``cov`` (see :func:`unbent`).
    """

    uv: FloatArray
    cov: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    good: BoolArray
    angles: FloatArray
    bend_px2: FloatArray
    bent_px: float


def refine_corners(
    gray: npt.NDArray[np.float32],
    start: FloatArray,
    edges: FloatArray,
    free_px: FloatArray | float = np.inf,
    crossing: bool = True,
) -> CornerFit:
    """Fits two blurred edges to each corner.

    start: (n, 2) px, good to about 2 px. edges: (n, 2, 2) px vectors along both edges to where they end (a square's or
    marker's side), the second clockwise of the first as seen in the image. free_px: distance from the edges within
    which there is nothing else, per corner, where that is less than a square (the margin around a marker).
    crossing: corners of four squares; otherwise corners of a dark marker.
    """
    free = np.broadcast_to(np.asarray(free_px, float), (len(start),))
    floor, bent = (CROSSING_FLOOR_PX, CROSSING_BENT_PX) if crossing else (MARKER_FLOOR_PX, MARKER_BENT_PX)
    return CornerFit(*vision.refine_corners(gray, start, edges, free, crossing, floor, *_sampling_table()), bent)


def unbent(fit: CornerFit, xy: FloatArray, keep: BoolArray) -> CornerFit:
    """The fit with its corners displaced by what the lens's bending did, and the uncertainty of that in ``cov``.

    A straight line fitted to an edge of curvature kappa is displaced along the edge's normal by the mean of the
    parabola under it, ``kappa * bend_px2``. The curvature is that of the whole target: a homography keeps lines
    straight, so it is the second derivative, along the edge, of what a homography leaves of the corners, taken as a
    cubic of the place in the image.

    xy: (n, 2) of the corners in the target's plane, any unit. keep: (n,) corners to learn from. Unchanged where these
    are too few to tell bending from noise (20, or 12 for a constant bending); the fit's ``bent_px`` then covers it.
    """
    freed = vision.unbend(fit.uv, fit.cov, xy, keep, fit.angles, fit.bend_px2)
    if freed is None:
        return replace(fit, cov=fit.cov + fit.bent_px**2 * np.eye(2))
    return replace(fit, uv=freed[0], cov=freed[1])


@lru_cache(maxsize=1)
def _sampling_table() -> tuple[FloatArray, FloatArray]:
    """Blurs of the lens (n,) px, and the greatest displacement (n,) px of an edge by the pixels' spacing."""
    blur, x = np.linspace(0.05, 1.2, 24), np.arange(-6.0, 6.0, 0.02)
    amplitude = np.zeros(len(blur))
    for i, b in enumerate(blur):
        total = np.sqrt(b**2 + _PIXEL_VARIANCE)
        ends = [y * ndtr(y / b) + b * np.exp(-0.5 * (y / b) ** 2) / np.sqrt(2.0 * np.pi) for y in (x - 0.5, x + 0.5)]
        density = np.exp(-0.5 * (x / total) ** 2) / (total * np.sqrt(2.0 * np.pi))
        harmonic = (density * (ends[1] - ends[0] - ndtr(x / total)) * np.sin(2.0 * np.pi * x)).sum() * 0.02
        amplitude[i] = 2.0 * abs(harmonic) / ((density**2).sum() * 0.02)
    return blur, amplitude


_MOST = 60  # rows or columns of the largest board
_SEEN = 0.75  # share of the corners of the next row that must be there
_NEAR = 0.2  # squares that they may be from where the grid puts them
_CONTRAST = 0.5  # of the board's own


def grown(gray: Gray32, grid: FloatArray, contrast: float) -> FloatArray:
    """The grid (rows, columns, 2) px, continued on its four sides as far as there are corners of the same board.

    contrast: median step from dark to bright of the corners that were given. A next row is one where at least three
    quarters of its places show a crossing of two edges, of half that contrast, of the colours that follow, where the
    grid puts it. Margins, backgrounds and boards of another pitch do not; nor do places outside the image.
    """
    # on most images the board ends on all sides; half of what a next row needs is enough to look closer
    turns = np.flatnonzero(may_go_on(gray, grid, 0.5 * _CONTRAST * contrast, 0.5 * _SEEN)).tolist()
    while turns and max(grid.shape) < _MOST:
        size = grid.size
        for turn in turns:
            side = np.rot90(grid, turn)
            while max(side.shape) < _MOST and (row := _next_row(gray, side, contrast)) is not None:
                side = np.concatenate([row[None], side])
            grid = np.rot90(side, -turn)
        turns = list(range(4)) if size < grid.size else []  # a wider side may go on where a narrow one lacked a corner
    return np.asarray(grid)


def _next_row(gray: Gray32, grid: FloatArray, contrast: float) -> FloatArray | None:
    """The corners (columns, 2) px before the first row of a grid; None where the board ends there."""
    rows, columns = grid.shape[:2]
    if min(rows, columns) < 2:
        return None
    place, edges = _extrapolated(grid)
    inside = np.all((place > 3.0) & (place < np.array(gray.shape[::-1]) - 4.0), axis=1)
    if inside.sum() < max(2.0, _SEEN * columns):
        return None
    step = _CONTRAST * contrast
    # colours first: most boards end here, and edges that are not there are the slowest to fit
    likely = np.flatnonzero(inside & squares_follow(gray, grid[0], place, edges, step))
    if len(likely) < _SEEN * columns:
        return None
    spacing = np.linalg.norm(edges[likely], axis=2).min(axis=1)
    fit = refine_corners(gray, place[likely], edges[likely])
    near = np.linalg.norm(fit.uv - place[likely], axis=1) < np.maximum(_NEAR * spacing, 1.5)
    there = fit.good & near & (fit.contrast > step)
    if there.sum() < _SEEN * columns:
        return None
    place[likely[there]] = fit.uv[there]
    return place


def _extrapolated(grid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Places (columns, 2) px of the row before the first, and edges (columns, 2, 2) px along the row and the column.

    By the homography of the rows nearest to it, which a lens bends less than the whole board, and what that leaves at
    the first row.
    """
    columns = grid.shape[1]
    near = grid[: min(4, len(grid))]
    y, x = np.indices(near.shape[:2])
    xy = np.stack([x, y], axis=2).reshape(-1, 2).astype(float)
    H = np.asarray(cv2.findHomography(xy, near.reshape(-1, 2), 0)[0], float)

    def at(x: FloatArray, y: float) -> FloatArray:
        q = np.column_stack([x, np.full(len(x), y), np.ones(len(x))]) @ H.T
        return np.asarray(q[:, :2] / q[:, 2:])

    along = np.arange(columns, dtype=float)
    place = at(along, -1.0) + grid[0] - at(along, 0.0)
    edges = np.stack([at(along + 0.5, -1.0) - at(along - 0.5, -1.0), at(along, -0.5) - at(along, -1.5)], axis=1)
    return place, edges
