"""Camera poses of single views in the core: refined and judged by the angles between rays and points.

Pose k is one of view ``of[k]``, whose points are the rows ``ptr[of[k]]`` to ``ptr[of[k] + 1]`` of x (N, 3) m, on the
unit rays (N, 3). All functions take the poses that they shall do, so that threads share them. The formulas are in
``views.h``.
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.native.library import Function

_VIEWS = "which[*] of[K] ptr[B+1] x[N,3] rays[N,3]"
_refine_views = Function("refine_views", f"{_VIEWS} iterations robust poses[K,4,4] work[*]")
_errors_of_views = Function("errors_of_views", f"{_VIEWS} poses[K,4,4] rms[K] in_front[K]")
_offsets_of_views = Function("offsets_of_views", f"{_VIEWS} poses[K,4,4] out[N] medians[K] work[*]")
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
