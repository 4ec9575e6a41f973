"""Whether a grid of corners is a whole board: of neighbouring squares, and ending where it was said to end."""

import cv2
import numpy as np

from adjust.model.survey import FloatArray
from adjust.native.vision import may_go_on, squares_follow
from survey.detection.corners import refine_corners
from survey.detection.gray import Gray32

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
