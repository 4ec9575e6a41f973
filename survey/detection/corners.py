"""Corners of boards and markers to a few hundredths of a pixel, each with an honest covariance."""

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from adjust.model.survey import BoolArray, FloatArray
from adjust.native import vision

# Edges are taken for straight lines. What bending by the lens does where it cannot be told from the other corners
# (see :func:`unbent`), and what remains of images without noise where it can: both measured on
# renderings with k1 = -0.2 (tests/survey/test_detection.py, test_detection_sigmas.py).
CROSSING_BENT_PX, MARKER_BENT_PX = 0.002, 0.003
CROSSING_FLOOR_PX, MARKER_FLOOR_PX = 0.0002, 0.0005
_PIXEL_VARIANCE = 1.0 / 12.0


@dataclass(frozen=True, eq=False)
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
