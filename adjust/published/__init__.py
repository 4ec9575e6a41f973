"""The three-camera head's own calibration on a two-axis table, step by step: a reference for the joint adjustment.

"Checkerboard-fixed post-processing calibration" (CPC): every camera is calibrated alone (Zhang), then small-angle least
squares separates table and camera Z, then the other cameras follow one after the other. The joint adjustment of the
same observations reaches the Cramer-Rao bound; this shows what the steps leave.
"""

from adjust.published.head import ComparedPose, HeadComparison, compare_head
from adjust.published.method import Calibration, CpcInput, PaperRotation, PaperVector, calibrate, propagate
from adjust.published.steps import Fit, TableImages
from adjust.published.surveys import body_on_main_axis, single_camera_survey, table_images

__all__ = [
    "Calibration",
    "ComparedPose",
    "CpcInput",
    "Fit",
    "HeadComparison",
    "PaperRotation",
    "PaperVector",
    "TableImages",
    "body_on_main_axis",
    "calibrate",
    "compare_head",
    "propagate",
    "single_camera_survey",
    "table_images",
]
