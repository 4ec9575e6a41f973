"""Finding a checkerboard's inner corners, in an order that its colours define."""

import math
from collections.abc import Callable, Sequence
from typing import Any

import cv2
import numpy as np

from adjust.model.survey import BoolArray, FloatArray
from adjust.native.vision import MOST_CROSSINGS, count_crossings, find_grid, first_is_dark, of_neighbours, off_grid
from survey.detection.corners import CornerFit, grown, refine_corners, unbent
from survey.detection.gray import Gray8, Gray32, halved, reduced
from survey.detection.results import Detection, nothing_found
from survey.project.targets import Checkerboard

_SQUARE_PX = 32  # longer side of the image in which the board is looked for first, for each of its corners at least
_REGULAR = 0.25  # squares by which what is found there may bend from one to the next: more is a corner beside its place
_NEAR = 2.0  # times by which an image may be reduced for its corners to be near enough in the full one
_COARSE_PX = 900  # that of the image in which it is then looked for by all finders
_ABOVE_NOISE = 1.6  # response of a corner, in sigmas of the noise, that noise alone shows nowhere
_SMOOTHED = 0.375  # standard deviation of white noise after the smoothing by 1, 2, 1 along rows and columns
_ROUNDED = 0.3  # that of whole grey values
_CROSSINGS = 0.5  # share of a board's corners that are seen wherever any finder finds them all
_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
_MAX_DECOYS = 3


def find_checkerboard(gray: Gray32, gray8: Gray8, target: Checkerboard) -> Detection:
    """All inner corners of the board that could be measured; empty where the board is not complete in the image.

    Order: rows and columns are right-handed as on the board's front, and the square between r0c0, r0c1, r1c1 and r1c0
    is dark. Where one of the two numbers of corners is odd and the other even, this leaves one order. Otherwise it is
    ambiguous: of the orders left, r0c0 is the one nearest the upper left of the image (least u + v).
    """
    reason, other = f"no complete board of {target.columns} x {target.rows} inner corners", None
    for _ in range(_MAX_DECOYS):
        found = _find(gray8, target.columns, target.rows)
        if found is None:
            break
        detection, whole = _measured(gray, found)
        if len(detection) and whole.size == found.size:
            return detection
        # a larger or a ChArUco board or a picture of a board can look like the one that is wanted: cover it
        reason = detection.reason
        if len(detection):
            other = _size(whole)
            reason = f"the board goes on, to {other[0]} x {other[1]} inner corners at least"
        gray8 = gray8.copy()
        cv2.fillConvexPoly(gray8, cv2.convexHull(np.rint(whole.reshape(-1, 2)).astype(np.int32)), (128,))
    return nothing_found(reason, other_size=other)


def other_boards(images: Sequence[tuple[Gray32, Gray8]], target: Checkerboard) -> list[tuple[int, int]]:
    """Columns and rows of inner corners of boards that have one fewer, as where squares were counted, or one more.

    In both numbers or in one of them; of every image that shows such a board. To be asked where the target itself was
    found in none.
    """
    c, r = target.columns, target.rows
    steps = ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1), (1, -1), (-1, 1))
    sizes = [(c + i, r + j) for i, j in steps if min(c + i, r + j) >= 3]
    for finder in (_glimpsed, _find):  # what is not there takes long: first a quick look at all images for all sizes
        seen = [size for image in images if (size := _first_size(finder, *image, sizes)) is not None]
        if seen:
            return seen
    return []


def _first_size(
    finder: Callable[[Gray8, int, int], FloatArray | None], gray: Gray32, gray8: Gray8, sizes: list[tuple[int, int]]
) -> tuple[int, int] | None:
    for columns, rows in sizes:
        found = finder(gray8, columns, rows)
        if found is not None:
            detection, whole = _measured(gray, found)
            if len(detection):
                return _size(whole)
    return None


def _size(grid: FloatArray) -> tuple[int, int]:
    """Columns and rows of a grid (rows, columns, 2)."""
    return int(grid.shape[1]), int(grid.shape[0])


def _measured(gray: Gray32, rough: FloatArray) -> tuple[Detection, FloatArray]:
    """The detection from corners (rows, columns, 2) px of a finder, and with all rows and columns that continue them.

    Empty where they are no corners of a board.
    """
    grid = _ordered(gray, rough)
    edges = grid_edges(grid)
    start = grid.reshape(-1, 2)
    fit = refine_corners(gray, start, edges.reshape(-1, 2, 2))
    needed = max(6, fit.good.size // 2)
    keep = fit.good & _on_grid(fit, grid.shape[:2]) if fit.good.sum() >= needed else fit.good
    if keep.sum() < needed:
        reason = f"board found, but only {int(keep.sum())} of {keep.size} corners could be measured"
        return nothing_found(reason), rough
    there = keep.reshape(grid.shape[:2])
    if not there[[0, -1]].any(1).all() or not there[:, [0, -1]].any(0).all():
        return nothing_found("the board ends before the size that was looked for"), rough
    row, column = np.divmod(np.arange(keep.size), grid.shape[1])
    fit = unbent(fit, np.stack([column, row], axis=1).astype(float), keep)
    blur_px, contrast = np.median([fit.blur_px[keep], fit.contrast[keep]], axis=1).tolist()
    measured = np.where(keep[:, None], fit.uv, start).reshape(grid.shape)
    if not of_neighbours(gray, measured, contrast):
        return nothing_found("corners found, but not those of neighbouring squares"), rough
    whole = grown(gray, measured, contrast)
    return Detection(np.flatnonzero(keep), fit.uv[keep], fit.cov[keep], blur_px), whole


def _find(gray8: Gray8, columns: int, rows: int) -> FloatArray | None:
    """Corners (rows, columns, 2) px to about a pixel: what is seen at once, or by finders that look longer.

    The classic finder first binarises by the histogram, which is enough for most boards and fast in a small image. On
    an image without a board its other thresholds follow the noise for half a second, unless a look at the squares
    beforehand stops it, which now and then overlooks a board: without that look it has a smoothed image.
    """
    if (found := _glimpsed(gray8, columns, rows)) is not None:
        return found
    if not _may_show(gray8, columns * rows):
        return None
    small, factor = reduced(gray8, _COARSE_PX)
    ok, corners = _found_in(small, (columns, rows))
    if not ok and small is not gray8:
        factor = np.ones(2)
        ok, corners = cv2.findChessboardCorners(gray8, (columns, rows), flags=_CLASSIC | cv2.CALIB_CB_FAST_CHECK)
    return _enlarged(gray8, np.reshape(corners, (rows, columns, 2)).astype(float), factor) if ok else None


def _glimpsed(gray8: Gray8, columns: int, rows: int) -> FloatArray | None:
    """Corners (rows, columns, 2) px that are seen in a small image at once, and lie as on a board."""
    small, factor = halved(gray8, _SQUARE_PX * max(columns, rows))
    grid = find_grid(small, columns, rows)
    if grid is None and _may_show(gray8, columns * rows):
        ok, corners = cv2.findChessboardCorners(small, (columns, rows), flags=0)
        grid = np.reshape(corners, (rows, columns, 2)).astype(float) if ok else None
    return None if grid is None or off_grid(grid).max() > _REGULAR else _enlarged(gray8, grid, factor)


def _may_show(gray8: Gray8, corners: int) -> bool:
    """Whether the image, whole or halved however often, has places enough that look like a board's corners.

    Where it has not, no finder need look, each of which takes longer the less there is to be found.
    """
    while min(gray8.shape) >= _SQUARE_PX:
        above = _ABOVE_NOISE * _SMOOTHED * max(_noise(gray8), _ROUNDED) + 1.0
        smooth = np.asarray(cv2.GaussianBlur(gray8, (3, 3), 0.0), np.uint8)
        if count_crossings(smooth, above) >= min(_CROSSINGS * corners, MOST_CROSSINGS):
            return True
        gray8, _ = halved(gray8, max(gray8.shape) // 2)
    return False


def _noise(gray8: Gray8) -> float:
    """Standard deviation of white noise, by the quartile of second differences along rows: less than half are edges."""
    rows = gray8[:: max(1, len(gray8) // 200)].astype(np.int16)
    second = np.abs(rows[:, 2:] - 2 * rows[:, 1:-1] + rows[:, :-2])
    return float(np.quantile(second, 0.25)) / (0.3186 * math.sqrt(6.0))  # a normal's quartile; weights 1, -2, 1


def _enlarged(gray8: Gray8, grid: FloatArray, factor: FloatArray) -> FloatArray:
    """A grid (rows, columns, 2) px of a reduced image in the full one; good to a pixel or two there."""
    grid = (grid + 0.5) * factor - 0.5
    return grid if factor.max() <= _NEAR else _settled(gray8, grid)


def _found_in(coarse: Gray8, pattern: tuple[int, int]) -> tuple[bool, Any]:
    """What one finder after the other finds."""
    ok, corners = cv2.findChessboardCorners(coarse, pattern, flags=0)
    if not ok:
        ok, corners = cv2.findChessboardCorners(coarse, pattern, flags=_CLASSIC | cv2.CALIB_CB_FAST_CHECK)
    if not ok:
        ok, corners = cv2.findChessboardCornersSB(coarse, pattern, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    if not ok:
        ok, corners = cv2.findChessboardCorners(cv2.GaussianBlur(coarse, (3, 3), 0.0), pattern, flags=_CLASSIC)
    return ok, corners


def _ordered(gray: Gray32, grid: FloatArray) -> FloatArray:
    """The grid (rows, columns, 2) in the order that ``find_checkerboard`` defines."""
    (a, b), (c, d) = (grid[:, -1] - grid[:, 0]).mean(0), (grid[-1] - grid[0]).mean(0)
    if a * d < b * c:
        grid = grid[:, ::-1]
    rows, columns = grid.shape[:2]
    dark = first_is_dark(gray, grid)
    turns = [(grid, dark), (grid[::-1, ::-1], dark == ((rows + columns) % 2 == 0))]
    if rows == columns:  # a quarter turn begins at the other end of a row
        quarter, begins_dark = grid.transpose(1, 0, 2)[:, ::-1], dark == (rows % 2 == 0)
        turns += [(quarter, begins_dark), (quarter[::-1, ::-1], begins_dark)]
    possible = [turn for turn, begins_dark in turns if begins_dark] or [turn for turn, _ in turns]
    return min(possible, key=lambda turn: float(turn[0, 0].sum()))


def grid_edges(grid: FloatArray) -> FloatArray:
    """Vectors (rows, columns, 2, 2) px along the row and along the column at each corner of a grid, one square long."""
    edges = np.empty((*grid.shape, 2)).swapaxes(2, 3)
    for axis in (0, 1):
        g, e = grid.swapaxes(0, axis), edges[:, :, 1 - axis].swapaxes(0, axis)
        e[1:-1] = 0.5 * (g[2:] - g[:-2])
        e[0], e[-1] = g[1] - g[0], g[-1] - g[-2]
    return np.ascontiguousarray(edges)


def _settled(gray8: Gray8, grid: FloatArray) -> FloatArray:
    """The grid (rows, columns, 2) moved to the saddles of the grey values nearby, where they are within the window."""
    edges = grid_edges(grid)
    area = np.abs(edges[..., 0, 0] * edges[..., 1, 1] - edges[..., 0, 1] * edges[..., 1, 0])
    across = float(np.min(area / np.linalg.norm(edges, axis=3).max(2)))
    half = int(np.clip(0.4 * across, 2, 9))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    points = grid.astype(np.float32).reshape(-1, 1, 2)
    moved = cv2.cornerSubPix(gray8, points, (half, half), (-1, -1), criteria).reshape(grid.shape).astype(float)
    near = np.linalg.norm(moved - grid, axis=2) <= half
    return np.where(near[..., None], moved, grid)


def _on_grid(fit: CornerFit, shape: tuple[int, int]) -> BoolArray:
    """Which corners lie where their neighbours in the row and the column put them, to a fifth of a square."""
    return off_grid(np.where(fit.good[:, None], fit.uv, np.nan).reshape(*shape, 2)).ravel() <= 0.4
