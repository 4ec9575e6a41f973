"""Views of planes, many at once: homographies, and both poses that one allows."""

import numpy as np

from adjust.model import BoolArray, FloatArray, IntArray
from adjust.native import views as kernels
from adjust.parallel import run_split, split_blocks

PLANAR = 1e-4  # thickness against extent below which points count as a plane
WIDEST = float(np.cos(np.deg2rad(80.0)))  # rays further off the mean direction are left to the refinement


def homographies(
    xy: FloatArray, uv: FloatArray, ptr: IntArray, refinements: int = 3
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Of every view ``h`` (B, 3, 3) with uv ~ h (x, y, 1), and rms and median (B, 2) of what it misses, in uv's unit.

    xy, uv: (N, 2), view after view by ptr (B + 1,). Also which (B,) are determined: not those of less than four points
    or of points on one line, which miss by infinity.

    Source: direct linear transformation on normalised points (Hartley and Zisserman, Multiple View Geometry, alg. 4.2),
    then Gauss-Newton steps on the distance in the image.
    """
    n, ends = len(ptr) - 1, np.ascontiguousarray(ptr, dtype=np.int64)
    h, misses, found = np.empty((n, 3, 3)), np.empty((n, 2)), np.empty(n, dtype=np.bool_)
    points = [np.ascontiguousarray(a, dtype=np.float64) for a in (xy, uv)]
    run_split(kernels.homographies, split_blocks(ends), ends, *points, refinements, h, misses, found)
    return h, misses, found


def plane_poses(x: FloatArray, rays: FloatArray, ptr: IntArray) -> tuple[FloatArray, BoolArray]:
    """Both poses camera_from_target (B, 2, 4, 4) of planes, from points (N, 3) m on rays (N, 3), view after view.

    Also which views (B,) have them: not those of less than four points, of points off a plane (``PLANAR``) or on a
    line, and with rays far from their mean (``WIDEST``).

    Source: Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014: the rotations from the first
    derivatives of the homography at the centroid; the translations by linear least squares.
    """
    views = kernels.ViewArrays.of_poses(x, rays, ptr, None)
    poses, found = np.empty((len(ptr) - 1, 2, 4, 4)), np.empty(len(ptr) - 1, dtype=np.bool_)
    run_split(kernels.plane_poses, split_blocks(views.ptr), views, PLANAR, WIDEST, poses, found)
    return poses, found
