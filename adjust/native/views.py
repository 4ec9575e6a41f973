"""Camera poses of single views in the core: those of planes, and all refined and judged by the angles to their rays.

Pose k is one of view ``of[k]``, whose points are the rows ``ptr[of[k]]`` to ``ptr[of[k] + 1]`` of x (N, 3) m, on the
unit rays (N, 3). All functions take the poses that they shall do, so that threads share them. The formulas are in
``views.h`` and ``planes.h``.
"""

from typing import NamedTuple

import numpy as np

from adjust.model import BoolArray, FloatArray, IntArray
from adjust.native.library import Function

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
_ROWS, _WIDEST = 26, 8  # of a point's numbers; numbers in the longest vector


class ViewArrays(NamedTuple):
    """Views of points: of (K,), ptr (B + 1,), x (N, 3), rays (N, 3)."""

    of: IntArray
    ptr: IntArray
    x: FloatArray
    rays: FloatArray

    @staticmethod
    def of_poses(x: FloatArray, rays: FloatArray, ptr: IntArray, of: IntArray | None) -> "ViewArrays":
        """As the core takes them; without ``of`` every view has one pose."""
        which = np.arange(len(ptr) - 1) if of is None else of
        mine, ends = (np.ascontiguousarray(a, dtype=np.int64) for a in (which, ptr))
        at, seen = (np.ascontiguousarray(a, dtype=np.float64) for a in (x, rays))
        return ViewArrays(mine, ends, at, seen)

    @property
    def ends(self) -> IntArray:
        """Numbers of points of the poses before each, and of all: (K + 1,)."""
        return np.concatenate([[0], np.cumsum(np.diff(self.ptr)[self.of])])

    @property
    def most(self) -> int:
        """Points of the largest view."""
        return int(np.diff(self.ptr).max(initial=0))


def refine_views(which: IntArray, views: ViewArrays, iterations: int, robust: bool, poses: FloatArray) -> None:
    """Each listed pose of ``poses`` (K, 4, 4), in place, by Levenberg-Marquardt on the offsets across its rays.

    robust: Cauchy weights at three times the median offset of the view. A pose stays where no step lowers its error.
    """
    _refine_views(which, *views, iterations, robust, poses, np.empty(_ROWS * (views.most + _WIDEST)))


def errors_of_views(which: IntArray, views: ViewArrays, poses: FloatArray, rms: FloatArray, front: BoolArray) -> None:
    """Of each listed pose the rms (K,) of its point offsets, rad, and whether (K,) all its points lie in front."""
    _errors_of_views(which, *views, poses, rms, front)


def offsets_of_views(
    which: IntArray, views: ViewArrays, poses: FloatArray, out: FloatArray, medians: FloatArray
) -> None:
    """Tangents (N,) of the angles between rays and points, infinite for points behind, and their medians (K,).

    A view without points keeps its median.
    """
    _offsets_of_views(which, *views, poses, out, medians, np.empty(views.most))


def plane_poses(
    which: IntArray, views: ViewArrays, thickness: float, widest: float, poses: FloatArray, found: BoolArray
) -> None:
    """Both poses (K, 2, 4, 4) of each listed view of a plane, and whether (K,) it has them.

    thickness: against the extent, below which points count as a plane. widest: cosine of the angle to their mean at
    which rays are too far off.
    """
    _plane_poses(which, *views, thickness, widest, poses, found, np.empty(4 * views.most))


def homographies(
    which: IntArray, ptr: IntArray, xy: FloatArray, uv: FloatArray, refinements: int, h: FloatArray,
    misses: FloatArray, found: BoolArray,
) -> None:  # fmt: skip
    """Of each listed view h (B, 3, 3), rms and median (B, 2) of what it misses, and whether (B,) it is determined."""
    _homographies(which, ptr, xy, uv, refinements, h, misses, found, np.empty(int(np.diff(ptr).max(initial=0))))
