"""Luminous spots (LED beacons): finding them on an uneven background, and their centres with covariance."""

from collections.abc import Iterable

import cv2
import numpy as np
import numpy.typing as npt

from adjust.model.survey import FloatArray
from adjust.native.vision import GAUSSIAN, fit_spots
from survey.detection.gray import AnyImage, Gray32, gray_values, saturation_level
from survey.detection.results import Detection, SpotOptions, Spots

# Neither profile is quite that of a small disc under a point spread: at most 0.0008 px rms on renderings without noise
# (tests/survey/test_detection_spots.py). Of a full spot only the rim is left, where it shows in the residuals and so in
# the covariance; the floor is for what all of them share.
SPOT_FLOOR_PX = 0.0005
SATURATED_FLOOR_PX = 0.002
_FWHM = 2.3548200450309493


def detect_spots(image: AnyImage, options: SpotOptions | None = None) -> Spots:
    """All spots of the wanted size, brightest first.

    The centre is that of a pixel-integrated elliptic Gaussian or of a disc with a soft rim, whichever fits better;
    saturated pixels are left out. The covariance is that of the fit, with the residuals' variance; where pixels are
    saturated, that by each pixel's own residual if it is larger (MacKinnon and White 1985, HC3).
    """
    options = options or SpotOptions()
    gray = gray_values(image)
    background, noise = _background(gray, options.diameter_px[1])
    labels, start, diameter, peak, elongation = _candidates(gray - background, noise, options)
    if not len(start):
        return Spots(np.zeros((0, 2)), np.zeros((0, 2, 2)), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))
    level = saturation_level(image)
    full = level - max(1.0, 0.01 * level)
    base = background[np.rint(start[:, 1]).astype(int), np.rint(start[:, 0]).astype(int)].astype(float)
    label = labels[np.rint(start[:, 1]).astype(int), np.rint(start[:, 0]).astype(int)].astype(np.int64)
    p, profile, cov, rms, saturated = fit_spots(gray, labels, full, start, label, diameter, peak, base)
    width = _diameters(p, profile)
    shape = np.exp(np.abs(p[:, 4] - p[:, 5]))
    low, high = options.diameter_px
    good = (profile >= 0) & (rms < 0.15 * peak) & (np.hypot(*(p[:, :2] - start).T) < 0.5 * diameter + 0.5)
    # a spot cut by the edge may have its centre outside: no image point
    good &= ((p[:, :2] > -0.5) & (p[:, :2] < np.array(gray.shape[::-1]) - 0.5)).all(axis=1)
    sized = good & (width >= low) & (width <= high)
    round_ = sized & (np.maximum(shape, elongation) <= options.max_elongation)
    order = np.flatnonzero(round_)[np.argsort(-peak[round_], kind="stable")][: options.max_count]
    floor = np.where(saturated[order] > 0, SATURATED_FLOOR_PX, SPOT_FLOOR_PX)
    honest = cov[order] + floor[:, None, None] ** 2 * np.eye(2)
    return Spots(p[order, :2], honest, width[order], peak[order], saturated[order])


def outside_targets(spots: Spots, detections: Iterable[Detection]) -> Spots:
    """The spots that are no bright cells of the targets found: outside their points' hull by more than the spacing."""
    keep = np.ones(len(spots), bool)
    for uv in (detection.uv for detection in detections if len(detection) >= 4):
        between = np.linalg.norm(uv[:, None] - uv[None], axis=2) + np.where(np.eye(len(uv)) > 0, np.inf, 0.0)
        margin = 1.2 * float(np.median(between.min(1)))
        hull = cv2.convexHull(uv.astype(np.float32))
        inside = [cv2.pointPolygonTest(hull, (float(u), float(v)), True) > -margin for u, v in spots.uv]
        keep &= ~np.array(inside, bool)
    if keep.all():
        return spots
    return Spots(spots.uv[keep], spots.cov[keep], spots.diameter_px[keep], spots.peak[keep], spots.saturated[keep])


def _diameters(p: FloatArray, profile: npt.NDArray[np.int64]) -> FloatArray:
    """Full width at half maximum (n,) px, the geometric mean of both axes."""
    mean = np.exp((p[:, 4] + p[:, 5]) / 2.0)
    return np.asarray(np.where(profile == GAUSSIAN, _FWHM * mean, 2.0 * mean))


def _background(gray: Gray32, largest_px: float) -> tuple[Gray32, float]:
    """Background (medians over some spots' widths) and the standard deviation of the noise on it."""
    step = max(2, round(largest_px / 2.0))
    height, width = gray.shape
    size = (max(1, width // step), max(1, height // step))
    small = cv2.medianBlur(cv2.resize(gray, size, interpolation=cv2.INTER_AREA), 5)
    background = np.asarray(cv2.resize(small, (width, height), interpolation=cv2.INTER_LINEAR), np.float32)
    sample = (gray - background)[::3, ::3]
    noise = 1.4826 * float(np.median(np.abs(sample - np.median(sample))))
    return background, max(noise, 0.3)


def _candidates(
    residual: Gray32, noise: float, options: SpotOptions
) -> tuple[npt.NDArray[np.int32], FloatArray, FloatArray, FloatArray, FloatArray]:
    """Bright places at half their height: labels (h, w), centroid (n, 2), diameter, peak, elongation (n,)."""
    mask = (residual > options.min_contrast * noise).astype(np.uint8)
    n, low = cv2.connectedComponents(mask, connectivity=8, ltype=cv2.CV_32S)
    peaks = np.zeros(n, np.float32)
    np.maximum.at(peaks, np.asarray(low[mask > 0], np.int64), residual[mask > 0])
    half = ((low > 0) & (residual > 0.5 * peaks[low])).astype(np.uint8)
    n, labels, stats, _ = cv2.connectedComponentsWithStats(half, connectivity=8, ltype=cv2.CV_32S)
    rows = []
    smallest, largest = 0.4 * options.diameter_px[0], 1.6 * options.diameter_px[1]
    for k in range(1, n):
        left, top, width, height, area = (int(a) for a in stats[k])
        diameter = 2.0 * np.sqrt(area / np.pi)
        if not smallest <= diameter <= largest or max(width, height) > 2.0 * largest:
            continue
        window = np.where(labels[top : top + height, left : left + width] == k, 1.0, 0.0)
        weight = window * residual[top : top + height, left : left + width]
        u, v, elongation = _moments(np.asarray(weight, float), left, top)
        # the axes of a dozen pixels are noise; the fit judges those
        rows.append((u, v, elongation if area >= 12 else 1.0, diameter, float(weight.max())))
    table = np.array(rows).reshape(-1, 5)
    return labels, table[:, :2], table[:, 3], table[:, 4], table[:, 2]


def _moments(weight: FloatArray, left: int, top: int) -> tuple[float, float, float]:
    """Centroid u, v and elongation (ratio of the axes) of the weights; a pixel's own extent keeps tiny spots round."""
    total = weight.sum()
    v, u = np.mgrid[: weight.shape[0], : weight.shape[1]]
    cu, cv = (weight * u).sum() / total, (weight * v).sum() / total
    du, dv = u - cu, v - cv
    a, b, c = ((weight * m).sum() / total for m in (du * du, du * dv, dv * dv))
    w = np.linalg.eigvalsh(np.array([[a + 0.15, b], [b, c + 0.15]]))
    return float(cu + left), float(cv + top), float(np.sqrt(w[1] / w[0]))
