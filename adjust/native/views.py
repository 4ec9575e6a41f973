"""Camera poses of single views in the core: those of planes, and all refined and judged by the angles to their rays.

Points x (N, 3) m on unit rays (N, 3), view after view by ptr (B + 1,); ``of`` (K,): the view of each pose, where there
is not one each. Threads share the poses. The formulas are in ``views.h`` and ``planes.h``.
"""

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.blocks import run_split, split_blocks
from adjust.native.library import Function

PLANAR = 1e-4
"""Thickness against extent below which points count as a plane."""
WIDEST = float(np.cos(np.deg2rad(80.0)))
"""Rays further off the mean direction do not serve a closed form."""

_VIEWS = "which[*] of[K] ptr[B+1] x[N,3] rays[N,3]"
_refine_views = Function("refine_views", f"{_VIEWS} iterations robust poses[K,4,4] work[*]")
_errors_of_views = Function("errors_of_views", f"{_VIEWS} poses[K,4,4] rms[K] in_front[K]")
_offsets_of_views = Function("offsets_of_views", f"{_VIEWS} poses[K,4,4] out[N] medians[K] work[*]")
_plane_poses = Function("plane_poses", f"{_VIEWS} thickness widest poses[K,2,4,4] found[K] work[*]")
_homographies = Function(
    "homographies", "which[*] ptr[B+1] xy[N,2] uv[N,2] refinements h[B,3,3] misses[B,2] found[B] work[*]"
)
turns_by = Function("turns_by", "w[n,3] R[n,3,3]")
"""Rotations of rotation vectors (rad)."""
turns_of = Function("turns_of", "R[n,3,3] w[n,3]")
"""Rotation vectors (rad) of rotations."""
_ROWS, _LANES = 26, 8  # of a point's numbers; of the widest vectors


def _arrays(
    x: FloatArray, rays: FloatArray, ptr: IntArray, of: IntArray | None = None
) -> tuple[tuple[IntArray, IntArray, FloatArray, FloatArray], IntArray, int]:
    """Views as the core takes them, numbers of points before each pose and of all (K + 1,), points of the largest."""
    which, ends = (
        np.ascontiguousarray(a, dtype=np.int64) for a in (np.arange(len(ptr) - 1) if of is None else of, ptr)
    )
    at, seen = (np.ascontiguousarray(a, dtype=np.float64) for a in (x, rays))
    sizes = np.diff(ends)
    return (which, ends, at, seen), np.concatenate([[0], np.cumsum(sizes[which])]), int(sizes.max(initial=0))


def view_errors(
    camera_from_target: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray, of: IntArray | None = None
) -> tuple[FloatArray, BoolArray]:
    """Per pose the rms (K,) of its point offsets, rad, and whether (K,) all its points lie in front."""
    views, ends, _ = _arrays(x, rays, ptr, of)
    poses = np.ascontiguousarray(camera_from_target, dtype=np.float64)
    rms, in_front = np.empty(len(poses)), np.empty(len(poses), dtype=np.bool_)
    run_split(lambda run: _errors_of_views(run, *views, poses, rms, in_front), split_blocks(ends))
    return rms, in_front


def view_offsets(
    camera_from_target: FloatArray, x: FloatArray, rays: FloatArray, ptr: IntArray
) -> tuple[FloatArray, FloatArray]:
    """Tangents (N,) of the angles between rays and points, infinite for points behind, and their medians (B,)."""
    views, ends, most = _arrays(x, rays, ptr)
    poses = np.ascontiguousarray(camera_from_target, dtype=np.float64)
    out, medians = np.empty(len(x)), np.full(len(poses), np.nan)
    run_split(lambda run: _offsets_of_views(run, *views, poses, out, medians, np.empty(most)), split_blocks(ends))
    return out, medians


def refine_poses(
    camera_from_target: FloatArray,
    x: FloatArray,
    rays: FloatArray,
    ptr: IntArray,
    iterations: int = 5,
    robust: bool = False,
    of: IntArray | None = None,
) -> FloatArray:
    """Least-squares poses (K, 4, 4), each of its view alone, by Levenberg-Marquardt on the offsets across its rays.

    With ``robust`` the points of a view carry Cauchy weights at three times its median offset.
    A pose stays where a step does not lower its error.
    """
    views, ends, most = _arrays(x, rays, ptr, of)
    poses, room = np.array(camera_from_target, dtype=np.float64, order="C"), _ROWS * (most + _LANES)
    run_split(lambda run: _refine_views(run, *views, iterations, robust, poses, np.empty(room)), split_blocks(ends))
    return poses


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
    most = int(np.diff(ends).max(initial=0))
    run_split(
        lambda run: _homographies(run, ends, *points, refinements, h, misses, found, np.empty(most)), split_blocks(ends)
    )
    return h, misses, found


def plane_poses(x: FloatArray, rays: FloatArray, ptr: IntArray) -> tuple[FloatArray, BoolArray]:
    """Both poses camera_from_target (B, 2, 4, 4) of planes, from points (N, 3) m on rays (N, 3), view after view.

    Also which views (B,) have them: not those of less than four points, of points off a plane (``PLANAR``) or on a
    line, and with rays far from their mean (``WIDEST``).

    Source: Collins and Bartoli, Infinitesimal plane-based pose estimation, IJCV 109, 2014: the rotations from the first
    derivatives of the homography at the centroid; the translations by linear least squares.
    """
    views, ends, most = _arrays(x, rays, ptr)
    poses, found = np.empty((len(ptr) - 1, 2, 4, 4)), np.empty(len(ptr) - 1, dtype=np.bool_)
    run_split(
        lambda run: _plane_poses(run, *views, PLANAR, WIDEST, poses, found, np.empty(4 * most)), split_blocks(ends)
    )
    return poses, found
