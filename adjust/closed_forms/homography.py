"""The plane-to-plane projective map between target and image."""

import numpy as np

from adjust.closed_forms.plane_kernels import plane_to_image
from adjust.errors import SurveyError
from adjust.model import FloatArray


def apply_homography(h: FloatArray, xy: FloatArray) -> FloatArray:
    """Points (n, 2) mapped by h (3, 3)."""
    p = xy @ h[:, :2].T + h[:, 2]
    return np.asarray(p[:, :2] / p[:, 2:])


def homography(xy: FloatArray, uv: FloatArray, refinements: int = 3) -> tuple[FloatArray, float]:
    """``h`` (3, 3) with uv ~ h (x, y, 1) and the rms of its residuals in the unit of uv.

    Source: direct linear transformation on normalised points (Hartley and Zisserman, Multiple View Geometry, alg. 4.2),
    then Gauss-Newton steps on the distance in the image. Raises SurveyError for fewer than four points or for points on
    one line.
    """
    if len(xy) < 4:
        raise SurveyError(f"a homography needs 4 points, got {len(xy)}: show more of the target")
    h = np.empty((3, 3))
    rms = plane_to_image(
        np.ascontiguousarray(xy, dtype=np.float64), np.ascontiguousarray(uv, dtype=np.float64), 0, refinements, h
    )
    if rms < 0:
        raise SurveyError(
            "the points of a planar target lie on one line: no homography is determined; show more points"
        )
    return h, rms
