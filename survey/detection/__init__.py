"""Finding boards, markers and LED beacons in images, each point with its covariance."""

from survey.detection.detect import detect_image
from survey.detection.results import Detection, ImageReport, SpotOptions, Spots

__all__ = ["Detection", "ImageReport", "SpotOptions", "Spots", "detect_image"]
