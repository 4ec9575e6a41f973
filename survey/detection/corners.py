"""Corners of boards and markers to a few hundredths of a pixel, each with an honest covariance."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.vision import CORNER_PARAMETERS, ENOUGH_FOR_SLOPES, fit_corners

# Edges are taken for straight lines. What bending by the lens does where it cannot be told from the other corners
# (see ``survey.detection.bent_edges``), and what remains of images without noise where it can: both measured on
# renderings with k1 = -0.2 (tests/survey/test_detection.py, test_detection_sigmas.py).
CROSSING_BENT_PX, MARKER_BENT_PX = 0.002, 0.003
CROSSING_FLOOR_PX, MARKER_FLOOR_PX = 0.0002, 0.0005
_PIXEL_VARIANCE = 1.0 / 12.0
_ROUGH_PX, _FINE_PX = 1e-2, 2e-5  # where the first and the second fit may stop
_NEAR_PX = 5.0  # from a crossing, as far as the first fit looks where the edges' blur ends before that


@dataclass(frozen=True, eq=False)
class CornerFit:
    """Fitted corners: uv (n, 2) px, cov (n, 2, 2) px^2, blur (n,) px of the lens without the pixel, contrast (n,) grey.

    good: which fits are to be trusted; the others have no meaning. angles: (n, 2) rad of both edges in the image.
    bend_px2: (n,) by how much the fit of a straight edge is displaced along its normal, for a curvature of 1 / px.
    bent_px: what bending does at most under usual lenses, not in ``cov`` (see ``survey.detection.bent_edges``).
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
    angles = np.arctan2(edges[:, :, 1], edges[:, :, 0])
    blur = np.full(len(start), 1.0)
    # a second pass from the first one's result: its window is centred and turned to the corner itself
    shapes = _window_shapes(edges, free, crossing, blur)
    strips = shapes[:, 1].any()
    near = shapes if strips else np.minimum(shapes, _NEAR_PX)
    first, _, _, _, status = fit_corners(gray, start, angles, blur, near, crossing, 3.0, _ROUGH_PX)
    unsure = np.flatnonzero(((status != 0) | (first[:, 6] > np.log(_NEAR_PX / 3.5))) & (not strips))
    if len(unsure):
        given = (start[unsure], angles[unsure], blur[unsure], shapes[unsure])
        first[unsure], _, _, _, status[unsure] = fit_corners(gray, *given, crossing, 3.0, _ROUGH_PX)
    again = status == 0
    centred = np.where(again[:, None], first[:, :2], start)
    angles = np.where(again[:, None], first[:, 2:4], angles)
    blur = np.where(again, np.exp(first[:, 6]), blur)
    shapes = _window_shapes(edges, free, crossing, blur)
    p, cov, pixels, rms, status = fit_corners(gray, centred, angles, blur, shapes, crossing, 0.5, _FINE_PX)
    contrast = np.abs(p[:, 5]) * (2.0 if crossing else 1.0)
    total_blur = np.exp(p[:, 6])
    lens_blur = np.sqrt(np.maximum(total_blur**2 - _PIXEL_VARIANCE, 0.0))
    length = np.maximum(shapes[:, :1], shapes[:, 2:])
    floor, bent = (CROSSING_FLOOR_PX, CROSSING_BENT_PX) if crossing else (MARKER_FLOOR_PX, MARKER_BENT_PX)
    cov = _student(cov, pixels) + _sampling_cov(lens_blur, p[:, 2:4], length, crossing) + floor**2 * np.eye(2)
    good = (status == 0) & again & (rms < 0.2 * contrast) & (np.trace(cov, axis1=1, axis2=2) < 1.0)
    good &= total_blur < np.maximum(0.5 * shapes[:, [0, 2, 3]].max(1), 1.0)
    # means of the parabola x^2 / 2: over both sides of the corner, and where it begins if there is but one side
    bend = length**2 / 6.0 if crossing else -(length**2) / 12.0
    return CornerFit(p[:, :2], cov, lens_blur, contrast, good, p[:, 2:4], bend, bent)


def _student(cov: FloatArray, pixels: IntArray) -> FloatArray:
    """Covariances (n, 2, 2) whose noise comes from few residuals: those of Student's distribution, not its scale's."""
    redundancy = pixels - np.where(pixels >= ENOUGH_FOR_SLOPES, CORNER_PARAMETERS, CORNER_PARAMETERS - 2)
    return np.asarray(cov * (redundancy / np.maximum(redundancy - 2.0, 1.0))[:, None, None])


def _sampling_cov(blur: FloatArray, angles: FloatArray, length: FloatArray, crossing: bool) -> FloatArray:
    """What pixels do to sharp edges along their rows and columns, (n, 2, 2) px^2.

    A pixel's square is taken for a Gaussian of equal variance. The difference has a harmonic at one period a pixel,
    which displaces the edge by as much, periodically with its place; an oblique edge averages it over the pixels that
    it passes. blur: (n,) px of the lens; angles: (n, 2) rad; length: (n, 1 or 2) px of the edges in the window, on
    each side of a crossing.
    """
    slope = np.minimum(np.abs(np.sin(angles)), np.abs(np.cos(angles)))
    periods = length * slope
    nodes, amplitude = _sampling_table()
    averaged = np.sinc(2.0 * periods) if crossing else _at_the_end(periods)
    displaced = np.interp(blur, nodes, amplitude)[:, None] * averaged / np.sqrt(2.0)
    normals = np.stack([-np.sin(angles), np.cos(angles)], axis=2)
    parallel = np.abs(np.linalg.det(normals)) < 1e-3
    back = np.linalg.inv(np.where(parallel[:, None, None], np.eye(2), normals)) * displaced[:, None, :]
    return np.asarray(back @ back.transpose(0, 2, 1))


def _at_the_end(periods: FloatArray) -> FloatArray:
    """Amplitude at 0 of the straight line fitted over (0, 1) to a unit sine of that many periods."""
    w = 2j * np.pi * np.maximum(periods, 1e-4)
    end = np.exp(w)
    return np.asarray(np.abs(4.0 * (end - 1.0) / w - 6.0 * (end / w - (end - 1.0) / w**2)))


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
