"""Normal equations of one lens and the poses of its views, point by point."""

import numpy as np

from adjust.compiling import njit
from adjust.model import FloatArray, IntArray


@njit(cache=True, nogil=True, error_model="numpy")
def lens_and_poses(ptr: IntArray, p: FloatArray, r: FloatArray, a: FloatArray, by_point: FloatArray,
                   weights: FloatArray, lens: FloatArray, mixed: FloatArray, pose: FloatArray, right_lens: FloatArray,
                   right_pose: FloatArray) -> None:  # fmt: skip
    """Add to the lens block (m, m), mixed blocks (B, 6, m), pose blocks (B, 6, 6) and right sides (m,), (B, 6).

    p: (N, 3) points in the camera. r: (N, 2) residuals. a: (N, 2, m) and by_point: (N, 2, 3) their derivatives.
    The tangent of a pose is a turn, then a shift, in the camera's frame.
    """
    m = a.shape[2]
    j = np.empty(6)
    for view in range(len(ptr) - 1):
        for i in range(ptr[view], ptr[view + 1]):
            w = weights[i]
            for c in range(2):
                b0, b1, b2 = by_point[i, c, 0], by_point[i, c, 1], by_point[i, c, 2]
                j[0] = b2 * p[i, 1] - b1 * p[i, 2]
                j[1] = b0 * p[i, 2] - b2 * p[i, 0]
                j[2] = b1 * p[i, 0] - b0 * p[i, 1]
                j[3], j[4], j[5] = b0, b1, b2
                for k in range(6):
                    wj = w * j[k]
                    right_pose[view, k] += wj * r[i, c]
                    for n in range(6):
                        pose[view, k, n] += wj * j[n]
                    for n in range(m):
                        mixed[view, k, n] += wj * a[i, c, n]
                for k in range(m):
                    wa = w * a[i, c, k]
                    right_lens[k] += wa * r[i, c]
                    for n in range(m):
                        lens[k, n] += wa * a[i, c, n]
