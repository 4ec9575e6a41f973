"""What is wrong with an image as such: a raw Bayer mosaic, interlaced fields, motion while it was exposed.

Each is one regression over pixels, summed by tiles of the image whose scatter gives its covariance: neighbouring pixels
are not independent, and what a scene shows differs from tile to tile (clusters; Liang and Zeger 1986).
"""

from collections.abc import Callable

import cv2
import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.testing.distributions import fisher
from survey.detection.gray import Gray32

_ALPHA = 1e-6
_TILES = 12
"""Along the longer side: so many clusters tell their own scatter."""
_MOSAIC, _FIELDS_PX, _MOTION_PX = 0.02, 0.1, 1.5
"""What matters: share of the grey value, px between the fields, px of motion; less is that of good cameras."""
_SAME = 0.25
"""Two phases of four that differ by less than this share of how much all differ are the two greens."""
_FASTEST_PX = 24
_FEWEST, _MOST = 500, 20_000  # pixels
_UNSEEN = 1e-3
"""Share of the best known direction below which the edges that there are do not tell another one."""
_SMOOTHING_PX, _REACH_PX = 1.0, 15
_WIDER = 1.3
_FLAT, _ROWS = 0.05, 60
_CLEARLY = 0.7  # times the miss without a shift that one of a pixel or more leaves at most
_STRAIGHT, _EDGE = 0.8, 0.03
"""Share of one direction among the gradients around, and of the contrast in the gradient, that make an edge."""


@frozen
class ImageDefect:
    """kind: ``bayer mosaic``, ``interlaced`` or ``motion blur``. size: share of the grey value, px, px; sigma of it.

    p: of the test that there is none. text: for people.
    """

    kind: str
    size: float
    sigma: float
    p: float
    text: str


def image_defect(gray: Gray32) -> ImageDefect | None:
    """What is wrong with an image (h, w), at a level of 1e-6 and above the size that matters; mostly nothing.

    The first of its kinds: a mosaic has no motion, and interlaced fields look like one.
    """
    if min(gray.shape) < 2 * _TILES:
        return None
    return next((d for look in (bayer_mosaic, interlaced_fields, motion_blur) if (d := look(gray)) is not None), None)


def bayer_mosaic(gray: Gray32) -> ImageDefect | None:
    """Pixels of four colours given as grey: where nothing changes they alternate, two of the four alike (the greens).

    What binomial smoothing leaves, regressed on the three patterns of period two times the grey value.
    """
    mean = cv2.sepFilter2D(gray, cv2.CV_32F, _BINOMIAL, _BINOMIAL)
    changes = cv2.morphologyEx(mean, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))

    def columns(at: tuple[IntArray, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
        v, u = at
        X = mean[at] * (1.0 - 2.0 * np.stack([u % 2, v % 2, (u + v) % 2]))
        return X, X, np.asarray(gray[at] - mean[at], float)

    fit = _by_tiles(changes < _FLAT * mean, columns)
    if fit is None:
        return None
    theta, cov, tiles = fit
    phases = np.array([[1, 1, 1], [-1, 1, -1], [1, -1, -1], [-1, -1, 1]]) @ theta
    greens = min(abs(phases[0] - phases[3]), abs(phases[1] - phases[2])) < _SAME * np.ptp(phases)
    size, p = float(np.ptp(phases)) / 2.0, _p_value(theta, cov, tiles)
    if not (greens and size > _MOSAIC and p < _ALPHA):
        return None
    return ImageDefect(
        "bayer mosaic", size, float(np.sqrt(np.trace(cov))), p, "a raw Bayer mosaic given as grey: where nothing "
        f"changes its pixels alternate by +-{100 * size:.2g} % of their grey value, two of four alike",
    )  # fmt: skip


def interlaced_fields(gray: Gray32) -> ImageDefect | None:
    """Rows of odd numbers shifted against those of even ones: half images of other moments, what moved is a comb.

    Half the difference of each row from the mean of those above and below alternates in proportion to the gradient.
    """
    begin = _between_fields(gray)
    even = gray.copy()
    even[1::2] = np.roll(gray[1::2], -begin, axis=1)  # what is left to go is small
    mean = cv2.sepFilter2D(even, cv2.CV_32F, np.ones((1, 1), np.float32), _BINOMIAL)
    du, dv = _gradient(mean)
    used = cv2.magnitude(du, dv) > _EDGE * float(np.ptp(mean))
    used[:, : _FASTEST_PX + 1] = used[:, -_FASTEST_PX - 1 :] = False

    def columns(at: tuple[IntArray, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
        X = np.stack([-du[at], -dv[at], mean[at]])
        return X, X, np.where(at[0] % 2, 1.0, -1.0) * (even[at] - mean[at])

    fit = _by_tiles(used, columns)
    if fit is None:
        return None
    theta, cov, tiles = fit
    shift = 2.0 * theta[:2] + [begin, 0.0]
    size, p = float(np.hypot(*shift)), _p_value(theta[:2] + [begin / 2.0, 0.0], cov[:2, :2], tiles)
    if not (size > _FIELDS_PX and p < _ALPHA):
        return None
    return ImageDefect(
        "interlaced", size, 2.0 * float(np.sqrt(np.trace(cov[:2, :2]))), p, "interlaced: its odd rows are shifted by "
        f"({shift[0]:+.2f}, {shift[1]:+.2f}) px against the even ones, as half images of another moment",
    )  # fmt: skip


def motion_blur(gray: Gray32) -> ImageDefect | None:
    """Edges across one direction wider than those along it; what blurs two directions of edges alike is not told.

    Across an edge of contrast A under a spread of width s gradients g sum to A, their squares to A^2 / (2 r s) with r
    the root of pi (a uniform motion by L: L / sqrt(12) within 3 %); s is regressed on the double angle of the normal,
    from the direction in which most edges stand or lie.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), _SMOOTHING_PX)
    du, dv = _gradient(smooth)
    window = np.ones((2 * _REACH_PX + 1,) * 2, np.uint8)
    contrast, slope = cv2.dilate(smooth, window) - cv2.erode(smooth, window), cv2.magnitude(du, dv)
    parts = [cv2.GaussianBlur(np.asarray(x), (0, 0), 3.0) for x in (du * du, dv * dv, du * dv)]
    one_way = cv2.magnitude(parts[0] - parts[1], 2.0 * parts[2]) > _STRAIGHT * (parts[0] + parts[1])
    used = one_way & (slope > _EDGE * contrast) & (contrast > 0.3 * float(contrast.max()))
    double = (du[used] + 1j * dv[used]) ** 2
    middle = float(np.angle((double * double / np.maximum(slope[used], 1e-9) ** 2).sum())) / 2.0

    def columns(at: tuple[IntArray, ...]) -> tuple[FloatArray, FloatArray, FloatArray]:
        g = slope[at]
        H = np.stack([np.ones(len(g)), np.cos(2.0 * np.arctan2(dv[at], du[at]) - middle)])
        return H, g**2 * H, contrast[at] * g / (2.0 * np.sqrt(np.pi))

    fit = _by_tiles(used, columns)
    if fit is None or not fit[0][0] > abs(fit[0][1]):
        return None
    theta, cov, tiles = fit
    widths = [np.sqrt(max(s**2 - _SMOOTHING_PX**2, 0.0)) for s in (theta[0] + abs(theta[1]), theta[0] - abs(theta[1]))]
    size, p = float(np.sqrt(12.0 * (widths[0] ** 2 - widths[1] ** 2))), _p_value(theta[1:], cov[1:, 1:], tiles)
    if not (size > _MOTION_PX and widths[0] > _WIDER * widths[1] and p < _ALPHA):
        return None
    along = (np.degrees(middle) / 2.0 + 90.0 * (theta[1] < 0.0)) % 180.0
    return ImageDefect(
        "motion blur", size, float(24.0 * theta[0] / size * np.sqrt(cov[1, 1])), p, "motion blur: its edges are "
        f"{widths[0]:.1f} px wide along {along:.0f} deg from the rows, {widths[1]:.1f} px across that, as if moved by "
        f"{size:.1f} px while it was exposed",
    )  # fmt: skip


def _gradient(gray: cv2.typing.MatLike) -> tuple[Gray32, Gray32]:
    """Along rows and along columns: half of what the neighbours on both sides differ by."""
    return _half_difference(gray, 1, 0), _half_difference(gray, 0, 1)


def _half_difference(gray: cv2.typing.MatLike, u: int, v: int) -> Gray32:
    return np.asarray(cv2.Sobel(gray, cv2.CV_32F, u, v, ksize=1, scale=0.5), np.float32)


_BINOMIAL = np.array([0.25, 0.5, 0.25], np.float32)
_Columns = Callable[[tuple[IntArray, ...]], tuple[FloatArray, FloatArray, FloatArray]]


def _by_tiles(used: BoolArray, columns: _Columns) -> tuple[FloatArray, FloatArray, int] | None:
    """Solution (k,) of ``sum H (y - X' theta) = 0`` over used pixels, its covariance (k, k) from the scatter of tiles.

    columns: instruments H (k, n), regressors X (k, n) and y (n,) of pixels.
    """
    of = np.flatnonzero(used)
    of = of[:: len(of) // _MOST | 1]  # by an odd number: what alternates is seen at both of its phases
    if len(of) < _FEWEST:
        return None
    rows, cols = at = np.divmod(of, used.shape[1])
    H, X, y = columns(at)
    edge = -(-max(used.shape) // _TILES)
    place = (rows // edge) * _TILES + cols // edge
    there = np.bincount(place) > 0
    n, tile = int(there.sum()), (np.cumsum(there) - 1)[place]

    def summed(products: FloatArray) -> FloatArray:
        return np.array([np.bincount(tile, p, n) for p in products]).T

    g, N = summed(H * y), np.stack([summed(H * x) for x in X], axis=2)
    unit = 1.0 / np.sqrt(np.maximum(np.diag(N.sum(axis=0)), 1e-300))
    inverse = unit[:, None] * np.linalg.pinv(unit[:, None] * N.sum(axis=0) * unit, rcond=_UNSEEN) * unit
    theta = inverse @ g.sum(axis=0)
    left = (g - N @ theta) @ inverse.T
    return (theta, left.T @ left * (n / (n - 1.0)), n) if n > 2 * len(theta) else None


def _p_value(theta: FloatArray, cov: FloatArray, tiles: int) -> float:
    """Of the test (Fisher's F) that all of them are zero."""
    k = len(theta)
    return float(fisher.sf(theta @ np.linalg.pinv(cov, rcond=1e-6) @ theta / k, k, max(tiles - k, 1)))


def _between_fields(gray: Gray32) -> int:
    """Whole pixels (along rows) by which odd rows fit clearly best to those above and below them; 0 where none does.

    By the rows in which most changes: all others tell their noise alone, which fits nowhere better than elsewhere.
    """
    s = _FASTEST_PX
    odd, even = gray[1:-1:2], 0.5 * (gray[0:-2:2] + gray[2::2])
    changing = np.argsort(-np.square(np.diff(even, axis=1)).sum(axis=1), kind="stable")[:_ROWS]
    odd, even = odd[changing, :], even[changing, s:-s]
    misses = [float(np.square(odd[:, s + d : odd.shape[1] - s + d] - even).mean()) for d in range(-s, s + 1)]
    best = int(np.argmin(misses))
    return best - s if misses[best] < _CLEARLY * misses[s] else 0
