"""Bundles with unknown points in the core: rows, Schur complements, back-substitution, covariances; ``bundles.h``.

Observations are sorted by point, then camera. Rows A (K, 2, MAX_LENS + 7) of image points are whitened: lens in 0..,
pose in MAX_LENS.., residual last.
"""

from typing import NamedTuple

import numpy as np

from adjust.model.survey import FloatArray, IntArray
from adjust.native.images import LENSES, LensArrays
from adjust.native.library import Function

_BUNDLE = (
    "block[K] camera_of[K] pose_at[K] point_at[K] ptr[P+1] point_of[r] by_block[r] by_ptr[B+1] pc_ptr[P+1] "
    "pc_camera[pairs] pc_of[r] n_lens[c] lens_at[c] first_pose"
)
_ROWS, _REDUCED = "A[K,2,21]", "Vi[P,3,3] W[K,3,6] WL[pairs,3,14]"
_rows = Function(
    "bundle_rows", f"block[K] camera[B] {LENSES} R[B,3,3] t[B,3] X[K,3] uv[K,2] W[K,3] {_ROWS} chi[B] depth[B]"
)
_block_squares = Function("block_squares", f"block[K] {_ROWS} out[B,6,6]")
_add_direct = Function("add_direct", f"first last {_BUNDLE} {_ROWS} S[n,n] g[n]")
_reduce_points = Function("reduce_points", f"{_BUNDLE} {_ROWS} damping S[n,n] g[n] {_REDUCED} h[P,3]")
_pose_rows = Function("pose_rows", f"run[*] {_BUNDLE} {_ROWS} {_REDUCED} S[n,n] T[n,8]")
_fill_upper = Function("fill_upper", "S[n,n]")
_symmetric_rows = Function("symmetric_rows", "S[n,n] rows[r] out[r,n]")
_between_poses = Function("between_poses", "S[*,*] at[a] J[a,6,6] inward lower out[*,*]")
_back_substitute = Function("back_substitute", f"{_BUNDLE} {_REDUCED} h[P,3,k] d[*,k] dX[P,3,k]")
_of_points = Function("of_points", f"{_BUNDLE} W[K,3,6] WL[pairs,3,14] v[P,3,k] out[*,k]")
_point_from_local = Function("point_from_local", f"{_BUNDLE} {_REDUCED} Y[K,3,6] YL[pairs,3,14]")
_with_poses = Function("with_poses", f"run[*] {_BUNDLE} Q[n,n] Y[K,3,6] YL[pairs,3,14] B[K,3,6] P[n,8]")
_with_lenses = Function(
    "with_lenses", f"{_BUNDLE} Vi[P,3,3] Q[n,n] Y[K,3,6] YL[pairs,3,14] B[K,3,6] BL[pairs,3,14] C[P,3,3]"
)
_reduced_influence = Function(
    "reduced_influence", f"run[*] {_BUNDLE} {_ROWS} Q[n,n] B[K,3,6] BL[pairs,3,14] C[P,3,3] influence[K,3]"
)
_direct_influence = Function("direct_influence", f"first last {_BUNDLE} {_ROWS} Q[n,n] influence[K,3]")


class BundleArrays(NamedTuple):
    """How observations, reduced points, images and cameras of a bundle belong together.

    block, camera_of, pose_at, point_at: of every observation (K,): its image, camera, first local unknown of its pose
    and of a point that stays (-1: held or reduced). ptr (P + 1,), point_of: observations of the reduced points.
    by_block, by_ptr: these, image by image. pc_ptr, pc_camera, pc_of: pairs of a reduced point and a camera. n_lens,
    lens_at: free parameters of every camera and the first local unknown of them. first_pose: that of all poses.
    """

    block: IntArray
    camera_of: IntArray
    pose_at: IntArray
    point_at: IntArray
    ptr: IntArray
    point_of: IntArray
    by_block: IntArray
    by_ptr: IntArray
    pc_ptr: IntArray
    pc_camera: IntArray
    pc_of: IntArray
    n_lens: IntArray
    lens_at: IntArray
    first_pose: int


class ReducedArrays(NamedTuple):
    """What stays of reduced points: inverse Vi (P, 3, 3) of their own blocks, W by poses, WL by lenses."""

    Vi: FloatArray
    W: FloatArray
    WL: FloatArray


class SightArrays(NamedTuple):
    """Image points (K): their image (block); the images (B): camera, R (B, 3, 3), t (B, 3) m; X (K, 3) m, uv px, W."""

    block: IntArray
    camera: IntArray
    R: FloatArray
    t: FloatArray
    X: FloatArray
    uv: FloatArray
    W: FloatArray


def rows(lenses: LensArrays, sights: SightArrays, A: FloatArray, chi: FloatArray, depth: FloatArray) -> None:
    """Whitened rows A of all image points; chi (B,), least depth (B,) of the images.

    The derivative by the point equals that by the translation of the pose.
    """
    _rows(sights.block, sights.camera, *lenses, *sights[2:], A, chi, depth)


def block_squares(block: IntArray, A: FloatArray, out: FloatArray) -> None:
    """Normal matrix (B, 6, 6) of each block's pose by its own image points alone, all points known."""
    _block_squares(block, A, out)


def add_direct(first: int, last: int, bundle: BundleArrays, A: FloatArray, S: FloatArray, g: FloatArray) -> None:
    """Add observations first..last as they are (points that stay or are held) to the lower triangle of S, and to g."""
    _add_direct(first, last, *bundle, A, S, g)


def reduce_points(
    bundle: BundleArrays, A: FloatArray, damping: float, S: FloatArray, g: FloatArray, reduced: ReducedArrays,
    h: FloatArray,
) -> int:  # fmt: skip
    """Reduce the points: their share in g and among lenses in S (lower); -1, or the bad point.

    ``reduced`` and h (P, 3) stay: for :func:`pose_rows`, which does the rest of S, and for the back-substitution.
    """
    return _reduce_points(*bundle, A, damping, S, g, *reduced, h)


def pose_rows(run: IntArray, bundle: BundleArrays, A: FloatArray, reduced: ReducedArrays, S: FloatArray) -> None:
    """Rows of S, up to the diagonal block, of the poses of the blocks in ``run``: from the reduced points alone."""
    _pose_rows(run, *bundle, A, *reduced, S, np.empty((len(S), 8)))


def fill_upper(S: FloatArray) -> None:
    """Copy the lower triangle of S (n, n) to the upper one."""
    _fill_upper(S)


def symmetric_rows(S: FloatArray, rows_of: IntArray, out: FloatArray) -> None:
    """Rows of a symmetric S of which only the lower triangle is there, out (r, n)."""
    _symmetric_rows(S, rows_of, out)


def between_poses(S: FloatArray, at: IntArray, J: FloatArray, inward: bool, lower: bool, out: FloatArray) -> None:
    """Blocks out[6a.., 6b..] of J_a' S J_b (``inward``), S at rows at[a], at[b]: its lower triangle, a >= b.

    Else the other way: out at at[a], at[b] of J_a S J_b', S at 6a, 6b. lower: only that of out, not mirrored.
    """
    _between_poses(S, at, J, inward, lower, out)


def back_substitute(
    bundle: BundleArrays, reduced: ReducedArrays, h: FloatArray, d: FloatArray, dX: FloatArray
) -> None:
    """Steps dX (P, 3, k) of the reduced points from those of the local unknowns d (n_local, k); h: their own part."""
    _back_substitute(*bundle, *reduced, h, d, dX)


def of_points(bundle: BundleArrays, reduced: ReducedArrays, v: FloatArray, out: FloatArray) -> None:
    """Subtract W' v from ``out`` (n_local, k), for v (P, 3, k): what reduced points carry over to the others."""
    _of_points(*bundle, reduced.W, reduced.WL, v, out)


def point_from_local(bundle: BundleArrays, reduced: ReducedArrays, Y: FloatArray, YL: FloatArray) -> None:
    """-V^-1 W by poses, Y (K, 3, 6), and by lenses, YL (pairs, 3, MAX_LENS)."""
    _point_from_local(*bundle, *reduced, Y, YL)


def with_poses(
    run: IntArray, bundle: BundleArrays, Q: FloatArray, Y: FloatArray, YL: FloatArray, B: FloatArray
) -> None:
    """Covariance B (K, 3, 6) of every observation's reduced point with its pose, for the blocks in ``run``."""
    _with_poses(run, *bundle, Q, Y, YL, B, np.zeros((len(Q), 8)))


class PointCovariances(NamedTuple):
    """Of reduced points with poses B (K, 3, 6), with lenses BL (pairs, 3, MAX_LENS), their own C (P, 3, 3)."""

    B: FloatArray
    BL: FloatArray
    C: FloatArray


def with_lenses(
    bundle: BundleArrays, Vi: FloatArray, Q: FloatArray, Y: FloatArray, YL: FloatArray, out: PointCovariances
) -> None:
    """The covariances with lenses and of the points themselves, from those with poses."""
    _with_lenses(*bundle, Vi, Q, Y, YL, *out)


def reduced_influence(
    run: IntArray, bundle: BundleArrays, A: FloatArray, Q: FloatArray, points: PointCovariances, influence: FloatArray
) -> None:
    """Whitened A Q A' (K, 3) of observations of reduced points; A: rows whitened as if all were used."""
    _reduced_influence(run, *bundle, A, Q, *points, influence)


def direct_influence(
    first: int, last: int, bundle: BundleArrays, A: FloatArray, Q: FloatArray, influence: FloatArray
) -> None:
    """Whitened A Q A' of observations first..last, whose point stays or is held."""
    _direct_influence(first, last, *bundle, A, Q, influence)
