"""Whether a grid of corners is a whole board: of neighbouring squares, and ending where it was said to end."""

import cv2
import numpy as np

from adjust.model.survey import BoolArray, FloatArray
from survey.detection.corners import refine_corners
from survey.detection.gray import Gray32

_MOST = 60  # rows or columns of the largest board
_SEEN = 0.75  # share of the corners of the next row that must be there
_NEAR = 0.2  # squares that they may be from where the grid puts them
_CONTRAST = 0.5  # of the board's own


def is_of_neighbours(gray: Gray32, grid: FloatArray, contrast: float) -> bool:
    """Whether the colours change across every edge of a grid (rows, columns, 2) px, and in turn.

    They do not where a finder took every second corner of a larger board, or went across it. contrast: median step
    from dark to bright. One in five places may be hidden or lit from the side.
    """
    for g in (grid, grid.transpose(1, 0, 2)):
        start, edge, across = g[:-1, 1:-1], g[1:, 1:-1] - g[:-1, 1:-1], (g[:-1, 2:] - g[:-1, :-2]) / 2.0
        row, column = np.indices(start.shape[:2])
        turn = 1.0 - 2.0 * ((row + column) % 2)
        on_edge = start + np.array([0.25, 0.5, 0.75])[:, None, None, None] * edge
        step = turn * np.subtract(*_bilinear(gray, np.stack([on_edge + 0.2 * across, on_edge - 0.2 * across])))
        agree = (np.abs(step) > 0.4 * contrast) * np.sign(step)
        # four of five one way and none the other; which way says whether the first square is dark
        if abs(np.mean(agree)) < 0.8:
            return False
    return True


def grown(gray: Gray32, grid: FloatArray, contrast: float) -> FloatArray:
    """The grid (rows, columns, 2) px, continued on its four sides as far as there are corners of the same board.

    contrast: median step from dark to bright of the corners that were given. A next row is one where at least three
    quarters of its places show a crossing of two edges, of half that contrast, of the colours that follow, where the
    grid puts it. Margins, backgrounds and boards of another pitch do not; nor do places outside the image.
    """
    size = 0 if _may_go_on(gray, grid, _CONTRAST * contrast) else grid.size
    while size < grid.size and max(grid.shape) < _MOST:
        size = grid.size
        for turn in range(4):  # a wider side may go on where a narrow one lacked a corner
            side = np.rot90(grid, turn)
            while max(side.shape) < _MOST and (row := _next_row(gray, side, contrast)) is not None:
                side = np.concatenate([row[None], side])
            grid = np.rot90(side, -turn)
    return np.asarray(grid)


def _may_go_on(gray: Gray32, grid: FloatArray, step: float) -> bool:
    """Whether colours change in turn across the places of a next row on any of the four sides, all looked at at once.

    The places are those of a parabola through the last corners: near enough for squares, not for corners. On most
    images the board ends on all sides; half of what a next row needs is enough to look closer.
    """
    if min(grid.shape[:2]) < 3:
        return True
    sides = [np.rot90(grid, turn) for turn in range(4)]
    first = np.concatenate([side[0] for side in sides])
    place = np.concatenate([3.0 * (side[0] - side[1]) + side[2] for side in sides])
    along = np.concatenate([np.gradient(side[0], axis=0) for side in sides])
    follow = _squares_follow(gray, first, place, np.stack([along, first - place], axis=1), 0.5 * step)
    ends = np.cumsum([side.shape[1] for side in sides])[:-1]
    return any(seen.mean() > 0.5 * _SEEN for seen in np.split(follow, ends))


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
    likely = np.flatnonzero(inside & _squares_follow(gray, grid[0], place, edges, step))
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


def _squares_follow(gray: Gray32, first: FloatArray, place: FloatArray, edges: FloatArray, step: float) -> BoolArray:
    """Whether the two squares beyond each place differ by more than ``step``, and the other way than those before it.

    (n,) bool. first: (n, 2) px, the corners that the places continue. On a margin they are alike, whatever the board's
    own squares do there.
    """
    beyond, before = _difference(gray, place, edges), _difference(gray, first, edges)
    return np.asarray((beyond * before < 0.0) & (np.abs(beyond) > step))


def _difference(gray: Gray32, at: FloatArray, edges: FloatArray) -> FloatArray:
    """Right square minus left square on the far side of a corner, (n,) grey values."""
    right, left = _bilinear(gray, at - 0.3 * edges[:, 1] + np.array([0.3, -0.3])[:, None, None] * edges[:, 0])
    return np.asarray(right - left)


def _bilinear(gray: Gray32, uv: FloatArray) -> FloatArray:
    """Grey values (...) at places (..., 2) px."""
    p = np.asarray(uv, np.float32).reshape(-1, 1, 2)
    level = cv2.remap(gray, p[..., 0], p[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(level, float).reshape(uv.shape[:-1])
