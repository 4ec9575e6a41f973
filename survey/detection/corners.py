"""Corners of boards and markers to a few hundredths of a pixel, each with an honest covariance."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from adjust.model import BoolArray, FloatArray
from adjust.native.vision import fit_corners

# What the fit cannot know: the pixel's square is taken for a Gaussian of equal variance, and edges for straight lines.
# Edges bent by distortion act alike on both sides of a crossing, but not at a marker's corner, where they end. Measured
# on noiseless renderings with k1 = -0.2 (tests/survey/test_detection.py): 0.001 to 0.002 px rms, and 0.002 to 0.003 px.
CROSSING_FLOOR_PX = 0.002
MARKER_FLOOR_PX = 0.003
_PIXEL_VARIANCE = 1.0 / 12.0
_ROUGH_PX, _FINE_PX = 1e-2, 2e-5  # where the first and the second fit may stop


@dataclass(frozen=True, eq=False)
class CornerFit:
    """Fitted corners: uv (n, 2) px, cov (n, 2, 2) px^2, blur (n,) px of the lens without the pixel, contrast (n,) grey.

    good: which fits are to be trusted; the others have no meaning.
    """

    uv: FloatArray
    cov: FloatArray
    blur_px: FloatArray
    contrast: FloatArray
    good: BoolArray


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
    angles = np.arctan2(edges[:, :, 1], edges[:, :, 0])
    blur = np.full(len(start), 1.0)
    # a second pass from the first one's result: its window is centred and turned to the corner itself
    shapes = _window_shapes(edges, free, crossing, blur)
    first, _, _, _, status = fit_corners(gray, start, angles, blur, shapes, crossing, 3.0, _ROUGH_PX)
    again = status == 0
    centred = np.where(again[:, None], first[:, :2], start)
    angles = np.where(again[:, None], first[:, 2:4], angles)
    blur = np.where(again, np.exp(first[:, 6]), blur)
    shapes = _window_shapes(edges, free, crossing, blur)
    p, cov, _, rms, status = fit_corners(gray, centred, angles, blur, shapes, crossing, 0.5, _FINE_PX)
    floor = CROSSING_FLOOR_PX if crossing else MARKER_FLOOR_PX
    cov = cov + floor**2 * np.eye(2)
    contrast = np.abs(p[:, 5]) * (2.0 if crossing else 1.0)
    total_blur = np.exp(p[:, 6])
    good = (status == 0) & again & (rms < 0.2 * contrast) & (np.trace(cov, axis1=1, axis2=2) < 1.0)
    good &= total_blur < np.maximum(0.5 * shapes[:, [0, 2, 3]].max(1), 1.0)
    return CornerFit(p[:, :2], cov, np.sqrt(np.maximum(total_blur**2 - _PIXEL_VARIANCE, 0.0)), contrast, good)


def _window_shapes(edges: FloatArray, free_px: FloatArray, crossing: bool, blur: FloatArray) -> FloatArray:
    """Windows (n, 4) for ``fit_corners``: they keep clear of the neighbouring edges, blurred as those are."""
    lengths = np.linalg.norm(edges, axis=2)
    area = np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
    across = area / np.maximum(lengths.max(1), 1e-9)  # distance to the next parallel edge
    shapes = np.zeros((len(edges), 4))
    if crossing and not np.isfinite(free_px).any():
        shapes[:, 0] = np.clip(np.minimum(0.6 * across, across - 3.0 * blur), 2.6, 11.0)
        return shapes
    limit = np.minimum(free_px, across)
    width = np.clip(np.minimum(0.75 * limit, limit - 2.5 * blur), 1.5, 8.0)
    shapes[:, 0] = width
    shapes[:, 1] = width
    shapes[:, 2:] = np.clip(0.6 * lengths, width[:, None], 14.0 if crossing else 20.0)
    return shapes
