"""Fits of corners and spots to the pixels of an image, and the renderer's inner loops, in the core.

The formulas are in ``corners.h``, ``grids.h``, ``boards.h``, ``spots.h``, ``fits.h`` and ``rendering.h``. Places are
px, the centre of the first pixel is (0, 0).
"""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.library import Function

Gray = npt.NDArray[np.float32]

CORNER_PARAMETERS = 9
"""u, v, angle 1, angle 2, level, step, log(blur), slope u, slope v."""
ENOUGH_FOR_SLOPES = 45
"""Pixels of a corner from which the last two are free: fewer cannot tell them from the corner's own form."""
GAUSSIAN, DISC = 0, 1
_LANES, _BAND = 8, 8  # of the widest vectors; rows that spread_and_sum makes together

_refine_corners = Function(
    "refine_corners",
    "image[*,*] start[n,2] edges[n,2,2] free[n] crossing enough floor blurs[k] displaced[k] "
    "uv[n,2] cov[n,2,2] blur[n] contrast[n] good[n] angles[n,2] bend[n,2]",
)
_corner_rows = Function("corner_rows", "xy[n,2] p[9] crossing value[n] rows[n,9]")
_fit_spots = Function(
    "fit_spots",
    "gray[h,w] labels[h,w] saturation start[n,2] label[n] diameter[n] peak[n] background[n] p[n,7] best[n] cov[n,2,2] "
    "rms[n] saturated[n] work[*]",
)
_spot_rows = Function("spot_rows_of_profile", "xy[n,2] p[7] profile value[n] rows[n,7]")
_pixel_corner_rays = Function("pixel_corner_rays", "first last lens[14] rays[*,*,2]")
_draw_facets = Function(
    "draw_facets",
    "first last rays[*,*,2] n from_ray[f,3,3] bounds[f,4] counts[f,2] x_edges[f,*] y_edges[f,*] cells[f,*,*] "
    "background samples[*,2] weights[4,*] image[*,*] candidates[f]",
)

_of_neighbours = Function("of_neighbours", "image[*,*] grid[r,c,2] contrast")
_first_is_dark = Function("first_is_dark", "image[*,*] grid[r,c,2]")
_squares_follow = Function("squares_follow", "image[*,*] corners[n,2] places[n,2] edges[n,2,2] step follow[n]")
_may_go_on = Function("may_go_on", "image[*,*] grid[r,c,2] step share sides[4]")
_off_grid = Function("off_grid", "grid[r,c,2] off[r,c] work[*]")
_find_grid = Function("find_grid", "image[h,w] response[h,w] grid[r,c,2]")
MOST_CROSSINGS = 600  # that are counted, as in grids.h
_count_crossings = Function("count_crossings", "image[h,w] above response[h,w]")
_unbend = Function("unbend", "xy[n,2] keep[n] angles[n,2] bend[n,2] uv[n,2] cov[n,2,2] work[*]")
_spread_and_sum = Function("spread_and_sum", "first last image[*,*] weights[t] reach n out[*,*] work[*,*]")


class Facets(NamedTuple):
    """Planes of grey cells: ``from_ray`` (F, 3, 3) takes x/z, y/z, 1 to the facet's x, y, 1 over its depth.

    bounds: (F, 4) boxes x from, x to, y from, y to in x/z, y/z. counts: (F, 2) cells in x and y, whose edges and grey
    values follow.
    """

    from_ray: FloatArray
    bounds: FloatArray
    counts: IntArray
    x_edges: FloatArray
    y_edges: FloatArray
    cells: FloatArray


def refine_corners(
    image: Gray, start: FloatArray, edges: FloatArray, free: FloatArray, crossing: bool, floor: float,
    blurs: FloatArray, displaced: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray, FloatArray, FloatArray]:  # fmt: skip
    """Fit two blurred edges to every corner, twice, the second time in a window centred and turned to it.

    start: (n, 2) px, good to about 2 px. edges: (n, 2, 2) px, both, the second clockwise of the first. free: (n,) px
    from the edges within which there is nothing else, infinite for a whole square. floor: px, added to the covariance.
    displaced: (k,) px by which pixels displace an edge along them, at most, for ascending blurs (k,) px of the lens.
    Returns uv (n, 2), covariance (n, 2, 2), blur px of the lens and contrast (n,), which are good (n,), angles (n, 2)
    rad of the edges, and px^2 (n, 2) by how much an edge of a curvature of 1 / px is displaced along its normal.
    """
    n = len(start)
    found = (np.empty((n, 2)), np.empty((n, 2, 2)), np.empty(n), np.empty(n), np.empty(n, bool), np.empty((n, 2)),
             np.empty((n, 2)))  # fmt: skip
    given = (np.ascontiguousarray(a, dtype=np.float64) for a in (start, edges, free))
    _refine_corners(np.ascontiguousarray(image), *given, crossing, ENOUGH_FOR_SLOPES, floor, blurs, displaced, *found)
    return found


def unbend(
    uv: FloatArray, cov: FloatArray, xy: FloatArray, keep: BoolArray, angles: FloatArray, bend: FloatArray
) -> tuple[FloatArray, FloatArray] | None:
    """Corners uv (n, 2) px of a plane at xy (n, 2), freed from the bending of their edges, and cov (n, 2, 2) with it.

    keep: (n,) to learn from. angles, bend: as :func:`refine_corners` gives them. None where too few tell the bending.
    """
    uv, cov, n = uv.copy(), cov.copy(), len(uv)
    given = (np.ascontiguousarray(a) for a in (xy, keep, angles, bend))
    return (uv, cov) if _unbend(*given, uv, cov, np.empty(8 * n)) else None


def find_grid(image: npt.NDArray[np.uint8], columns: int, rows: int) -> FloatArray | None:
    """Corners (rows, columns, 2) px, to about half a pixel, of the checkerboard that is whole in a small image.

    None where there is none, or one with more corners. Squares of less than some ten pixels are not seen.
    """
    grid = np.empty((rows, columns, 2))
    image = np.ascontiguousarray(image)
    return grid if _find_grid(image, np.empty_like(image), grid) else None


def count_crossings(image: npt.NDArray[np.uint8], above: float) -> int:
    """How many places respond so strongly as the corner of four squares; at most MOST_CROSSINGS.

    A corner responds by a third of what its squares differ by in grey value at least, and by all of it at most, where
    the ring of five pixels around it lies in its four squares: those of less than some six pixels are not seen.
    """
    image = np.ascontiguousarray(image)
    return _count_crossings(image, above, np.empty_like(image))


def of_neighbours(image: Gray, grid: FloatArray, contrast: float) -> bool:
    """Whether the colours change across every edge of a grid (rows, columns, 2) px, and in turn.

    They do not where a finder took every second corner of a larger board, or went across it. contrast: median step
    from dark to bright. One in five places may be hidden or lit from the side.
    """
    return bool(_of_neighbours(image, np.ascontiguousarray(grid), contrast))


def first_is_dark(image: Gray, grid: FloatArray) -> bool:
    """Whether the first of the squares between the corners (rows, columns, 2) px is one of the darker ones."""
    return bool(_first_is_dark(image, np.ascontiguousarray(grid)))


def squares_follow(image: Gray, corners: FloatArray, places: FloatArray, edges: FloatArray, step: float) -> BoolArray:
    """Whether squares beyond places (n, 2) px differ by more than step, the other way than those before the corners.

    corners: (n, 2) px, those that the places continue. edges: (n, 2, 2) px, along the row and back to the corners.
    """
    follow = np.empty(len(corners), bool)
    _squares_follow(image, *(np.ascontiguousarray(a) for a in (corners, places, edges)), step, follow)
    return follow


def may_go_on(image: Gray, grid: FloatArray, step: float, share: float) -> BoolArray:
    """Whether more than a share of a next row's squares follow a grid (rows, columns, 2) px on each side (4,).

    Side k is that of the first row after k quarter turns (``numpy.rot90``). By places of a parabola through the last
    corners: near enough for squares, not for corners. True below 3 x 3.
    """
    sides = np.empty(4, bool)
    _may_go_on(image, np.ascontiguousarray(grid), step, share, sides)
    return sides


def off_grid(grid: FloatArray) -> FloatArray:
    """Second differences (rows, columns) of a grid (rows, columns, 2) px, the larger of both ways, in squares."""
    off = np.empty(grid.shape[:2])
    _off_grid(np.ascontiguousarray(grid), off, np.empty(off.size))
    return off


def corner_rows(xy: FloatArray, p: FloatArray, crossing: bool) -> tuple[FloatArray, FloatArray]:
    """Grey values (n,) at places xy (n, 2) px from a window's centre, and derivatives (n, 9) by the parameters p."""
    value, rows = np.empty(len(xy)), np.empty((len(xy), CORNER_PARAMETERS))
    _corner_rows(xy, p, crossing, value, rows)
    return value, rows


def fit_spots(
    gray: Gray, labels: npt.NDArray[np.integer[Any]], saturation: float, start: FloatArray, label: IntArray,
    diameter: FloatArray, peak: FloatArray, background: FloatArray,
) -> tuple[FloatArray, IntArray, FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Fit each spot with both profiles and keep the better one.

    gray: (h, w). labels: (h, w) component of each pixel, 0 none; pixels of other components are left out, and so are
    those at or above ``saturation``. start: (n, 2) px. label, diameter (px), peak, background: (n,) of each spot.
    Returns p (n, 7) with absolute u, v; profile (n,), -1 where none converged; covariance (n, 2, 2); residual rms (n,);
    number of saturated pixels (n,).
    """
    n = len(start)
    p, cov, rms = np.zeros((n, 7)), np.zeros((n, 2, 2)), np.zeros(n)
    best, saturated = np.full(n, -1, np.int64), np.zeros(n, np.int64)
    reach = int(np.ceil(float(diameter.max(initial=0.0)) + 3.0))
    given = (np.ascontiguousarray(a, dtype=np.float64) for a in (diameter, peak, background))
    _fit_spots(np.ascontiguousarray(gray), np.ascontiguousarray(labels, dtype=np.int64), saturation,
               np.ascontiguousarray(start, dtype=np.float64), label, *given, p, best, cov, rms, saturated,
               np.empty(3 * (2 * reach + 1) ** 2))  # fmt: skip
    return p, best, cov, rms, saturated


def spot_rows(xy: FloatArray, p: FloatArray, profile: int) -> tuple[FloatArray, FloatArray]:
    """Grey values (n,) at xy (n, 2) and derivatives (n, 7) by u, v, background, amplitude, log widths, log softness."""
    value, rows = np.empty(len(xy)), np.empty((len(xy), 7))
    _spot_rows(xy, p, profile, value, rows)
    return value, rows


def pixel_corner_rays(width: int, height: int, lens: FloatArray) -> FloatArray:
    """Undistorted x/z, y/z of all pixel corners, (height + 1, width + 1, 2); NaN where the lens cannot be inverted.

    lens: Brown's parameters (13,), as :mod:`adjust.lenses.models` orders them.
    """
    rays = np.empty((height + 1, width + 1, 2))
    _pixel_corner_rays(0, height + 1, np.append(lens, 0.0), rays)
    return rays


def draw_facets(rays: FloatArray, n: int, facets: Facets, background: float, samples: FloatArray, image: Gray) -> None:
    """Draw sub-pixels (n * height, n * width), each integrated over its area, into image; rays: of the pixel corners.

    samples: (S, 2) offsets in the unit square of a sub-pixel that sees an edge.
    """
    if image.shape != (n * (rays.shape[0] - 1), n * (rays.shape[1] - 1)):
        raise ValueError(f"draw_facets: image is {image.shape}, {n} sub-pixels for each of {rays.shape} corners")
    s, t = samples.T
    weights = np.zeros((4, -(-len(samples) // _LANES) * _LANES))
    weights[:, : len(samples)] = (1 - s) * (1 - t), s * (1 - t), (1 - s) * t, s * t
    _draw_facets(0, len(rays) - 1, rays, n, *facets, background, samples, weights, image,
                 np.empty(len(facets.from_ray), np.int64))  # fmt: skip


def spread_and_sum(image: Gray, n: int, sigma: float) -> Gray:
    """Means over n x n sub-pixels of an image (n h, n w) under a Gaussian point spread, (h, w); sigma in sub-pixels.

    The image goes on beyond its border as it is there. The point spread ends at four and a half sigma.
    """
    reach = int(np.ceil(4.5 * sigma))
    spread = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
    weights = np.convolve(spread / spread.sum(), np.full(n, 1.0 / n)).astype(np.float32)
    height, width = image.shape[0] // n, image.shape[1] // n
    out = np.empty((height, width), np.float32)
    work = np.empty((_BAND * n, width + (2 * reach + n) // n + 1), np.float32)
    _spread_and_sum(0, height, image, weights, reach, n, out, work)
    return out
