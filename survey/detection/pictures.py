"""Pictures of what was found, for the eye."""

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from adjust.model.errors import SurveyError
from survey.detection.gray import AnyImage, Gray8, for_finding, gray_values
from survey.detection.results import Detection, ImageReport, Spots
from survey.project.targets import DetectableTarget

_COLOURS = ((60, 200, 60), (60, 60, 255), (255, 140, 30), (200, 60, 200), (30, 190, 230))  # B G R
_SPOT_COLOUR = (0, 200, 255)


def write_picture(path: Path, image: AnyImage, report: ImageReport, targets: Mapping[str, DetectableTarget]) -> None:
    """Writes a PNG of the image, twice as large where it is small, with every point and its id."""
    scale = 2 if max(image.shape[:2]) <= 1000 else 1
    gray = np.repeat(np.repeat(for_finding(gray_values(image)), scale, axis=0), scale, axis=1)
    canvas = np.asarray(cv2.cvtColor(gray, cv2.COLOR_GRAY2BGR), np.uint8)
    lines = []
    for k, (target_id, detection) in enumerate(report.detections.items()):
        colour = _COLOURS[k % len(_COLOURS)]
        _draw_points(canvas, detection, targets[target_id].points()[0], colour, scale)
        lines.append((f"{target_id}: {_summary(detection)}", colour))
    if report.spots is not None:
        _draw_spots(canvas, report.spots, scale)
        lines.append((f"{len(report.spots)} spots", _SPOT_COLOUR))
    cv2.rectangle(canvas, (0, 0), (560, 12 + 20 * len(lines)), (0, 0, 0), cv2.FILLED)
    for k, (text, colour) in enumerate(lines):
        _text(canvas, text, (8, 22 + 20 * k), colour, 0.55)
    if not cv2.imwrite(str(path), canvas):
        raise SurveyError(f"{path}: the picture could not be written; check the folder")


def _summary(detection: Detection) -> str:
    if not len(detection):
        return detection.reason
    sigma = float(np.sqrt(np.median(np.trace(detection.cov, axis1=1, axis2=2)) / 2.0))
    return f"{len(detection)} points, sigma {sigma:.3f} px, blur {detection.blur_px:.2f} px"


def _draw_points(
    canvas: Gray8, detection: Detection, point_ids: tuple[str, ...], colour: tuple[int, int, int], scale: int
) -> None:
    # OpenCV draws in 1/16 pixel
    places = np.rint(((detection.uv + 0.5) * scale - 0.5) * 16.0).astype(int)
    for (u, v), k in zip(places.tolist(), detection.point_idx.tolist(), strict=True):
        cv2.circle(canvas, (u, v), 5 * 16, colour, 1, cv2.LINE_AA, 4)
        _text(canvas, point_ids[k], (u // 16 + 6, v // 16 - 4), colour, 0.33)


def _draw_spots(canvas: Gray8, spots: Spots, scale: int) -> None:
    places = np.rint(((spots.uv + 0.5) * scale - 0.5) * 16.0).astype(int)
    for k, ((u, v), diameter) in enumerate(zip(places.tolist(), spots.diameter_px.tolist(), strict=True)):
        radius = round(16.0 * scale * (diameter / 2.0 + 2.0))
        cv2.circle(canvas, (u, v), radius, _SPOT_COLOUR, 1, cv2.LINE_AA, 4)
        _text(canvas, f"s{k}", (u // 16 + 8, v // 16 - 6), _SPOT_COLOUR, 0.4)


def _text(canvas: Gray8, text: str, place: tuple[int, int], colour: tuple[int, int, int], size: float) -> None:
    cv2.putText(canvas, text, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
