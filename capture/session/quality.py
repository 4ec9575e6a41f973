"""How good an image is, quickly enough to be told while the session runs: light, sharpness, targets, coverage."""

from collections.abc import Mapping
from dataclasses import field

import cv2
import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray
from capture.devices.camera import Frame, GrayImage
from survey.detection.batch import detect_image
from survey.detection.gray import Gray32
from survey.project.targets import DetectableTarget

_LOOK_PX = 400  # longer side of the image in which targets are looked for
_SMOOTHING_PX = 1.0
_EDGE_SHARE = 0.25  # of the strongest gradient: what counts as an edge
_FEWEST_EDGE_PX = 50


@frozen(eq=False)
class ImageQuality:
    """What can be said about one image.

    brightness, peak: mean and 99.9 % quantile of the grey values over the full range, 0 to 1. saturated: share of the
    pixels at the end of the range. blur_px: standard deviation of the point spread as the edges show it, NaN where
    there is no edge. points: by target id, image points (n, 2) px of the targets that were looked for; rough, to a
    tenth of a pixel or so.
    """

    brightness: float
    peak: float
    saturated: float
    blur_px: float
    points: Mapping[str, FloatArray] = field(default_factory=dict)


def image_quality(frame: Frame, targets: Mapping[str, DetectableTarget] | None = None) -> ImageQuality:
    """Quality of a frame, and the targets in it; without ``targets`` none is looked for."""
    full = float(2**frame.bits - 1)
    gray = frame.image.astype(np.float32)
    blur_px = edge_blur_px(gray)
    # where nothing has an edge the finders would try long and in vain
    points = {
        target_id: np.zeros((0, 2)) if np.isnan(blur_px) else _found(frame.image, target)
        for target_id, target in (targets or {}).items()
    }
    return ImageQuality(
        float(gray.mean()) / full,
        float(np.quantile(gray[::3, ::3], 0.999)) / full,
        float(np.mean(frame.image >= full)),
        blur_px,
        points,
    )


def _found(image: GrayImage, target: DetectableTarget) -> FloatArray:
    """Image points (n, 2) px of a target, looked for in a reduced image."""
    factor = max(1.0, max(image.shape) / _LOOK_PX)
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    reduced = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1.0 else image
    scale = np.array([image.shape[1] / size[0], image.shape[0] / size[1]])
    return np.asarray((detect_image(np.asarray(reduced), target).uv + 0.5) * scale - 0.5, float)


def edge_blur_px(gray: Gray32) -> float:
    """Standard deviation (px) of the blur of straight edges in an image (h, w); NaN where there are none.

    Across a step under a Gaussian of variance s^2 the squares of first and second derivative integrate to A^2 / (2 r s)
    and A^2 / (4 r s^3) with r the root of pi, so half of their ratio is s^2. The noise of flat parts is taken off both.
    The differences that stand for the derivatives are means over two pixels: s^2 grows by 1/12 by that. Corners of
    squares bend more than edges, so that a checkerboard comes out some 12 % too sharp, more where squares are small.
    """
    smooth = cv2.GaussianBlur(gray, (0, 0), _SMOOTHING_PX)
    gx, gy = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1) / 2.0, cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1) / 2.0
    first, second = gx**2 + gy**2, np.asarray(cv2.Laplacian(smooth, cv2.CV_32F, ksize=1)) ** 2
    near = _near_edges(np.asarray(first))
    if near.sum() < _FEWEST_EDGE_PX or near.all():
        return float("nan")
    energies = zip((first, second), _MEDIAN_OF_SQUARE, strict=True)
    slope, bend = (float(e[near].mean() - np.median(e[~near]) / share) for e, share in energies)
    if slope <= 0.0 or bend <= 0.0:
        return float("nan")
    variance = slope / bend / 2.0 - 1.0 / 12.0 - _SMOOTHING_PX**2
    return float(np.sqrt(max(variance, 0.0)))


# median over mean of chi-square with two degrees of freedom (the gradient) and with one (the Laplacian)
_MEDIAN_OF_SQUARE = (0.6931, 0.4549)


def _near_edges(squared_gradient: FloatArray) -> BoolArray:
    """Pixels (h, w) within a few pixels of a strong edge; the sides of an edge count as much as its middle."""
    strongest = float(np.quantile(squared_gradient[::2, ::2], 0.999))
    strong = squared_gradient > max(_EDGE_SHARE**2 * strongest, 1e-6)
    ellipse = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (9, 9))
    return np.asarray(cv2.dilate(strong.astype(np.uint8), ellipse), bool)
