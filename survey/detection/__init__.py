"""Finding boards, markers and LED beacons in images, each point with its covariance."""

from survey.detection.batch import DetectionTask, detect_image, detect_images
from survey.detection.results import Detection, ImageReport, SpotOptions, Spots
from survey.detection.spots import detect_spots

__all__ = [
    "Detection",
    "DetectionTask",
    "ImageReport",
    "SpotOptions",
    "Spots",
    "detect_image",
    "detect_images",
    "detect_spots",
]
