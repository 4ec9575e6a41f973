"""One image, one target."""

import numpy as np

from survey.detection.checkerboard import find_checkerboard
from survey.detection.gray import AnyImage, for_finding, gray_values
from survey.detection.markers import find_charuco, find_markers
from survey.detection.results import Detection
from survey.targets import Charuco, Checkerboard, DetectableTarget


def detect_image(image: AnyImage, target: DetectableTarget) -> Detection:
    """Points of the target in an image, (h, w) grey or (h, w, 3) BGR, of 8 or 16 bit or float.

    Empty with a ``reason`` where the target is not found. Raises SurveyError for what is no image and for a target
    that cannot exist (unknown dictionary, marker larger than its square).
    """
    gray = gray_values(image)
    gray8 = for_finding(np.asarray(image, np.uint8) if image.dtype == np.uint8 and image.ndim == 2 else gray)
    if isinstance(target, Checkerboard):
        return find_checkerboard(gray, gray8, target)
    if isinstance(target, Charuco):
        return find_charuco(gray, gray8, target)
    return find_markers(gray, gray8, target)
