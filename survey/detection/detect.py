"""One image and the targets that are looked for in it."""

from collections.abc import Mapping

import numpy as np

from survey.detection.checkerboard import find_checkerboard
from survey.detection.gray import AnyImage, Gray8, Gray32, for_finding, gray_values
from survey.detection.markers import SeenMarkers, find_charuco, find_markers
from survey.detection.results import Detection
from survey.project.targets import Charuco, Checkerboard, DetectableTarget


def detect_image(image: AnyImage, target: DetectableTarget) -> Detection:
    """Points of the target in an image, (h, w) grey or (h, w, 3) BGR, of 8 or 16 bit or float.

    Empty with a ``reason`` where the target is not found. Raises SurveyError for what is no image and for a target
    that cannot exist (unknown dictionary, marker larger than its square).
    """
    return detect_targets(image, {"": target})[""]


def detect_targets(image: AnyImage, targets: Mapping[str, DetectableTarget]) -> dict[str, Detection]:
    """:func:`detect_image` for several targets by id; what they need of the image is made once."""
    if not targets:
        return {}
    gray = gray_values(image)
    gray8 = for_finding(np.asarray(image, np.uint8) if image.dtype == np.uint8 and image.ndim == 2 else gray)
    seen = SeenMarkers(gray8)
    return {target_id: _detected(gray, gray8, seen, target) for target_id, target in targets.items()}


def _detected(gray: Gray32, gray8: Gray8, seen: SeenMarkers, target: DetectableTarget) -> Detection:
    if isinstance(target, Checkerboard):
        return find_checkerboard(gray, gray8, target)
    if isinstance(target, Charuco):
        return find_charuco(gray, gray8, target)
    return find_markers(gray, seen, target)
