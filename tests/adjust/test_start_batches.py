"""What the start does for all views at once, against one pose at a time, and plain sums over rows."""

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.spatial.rigid import rigid, rotation_exp, skew
from adjust.start.closed_forms.absolute_pose import absolute_pose, best_poses
from adjust.start.lens_refinement import lens_and_poses


def seen(x, pose, rng):
    p = x @ pose[:3, :3].T + pose[:3, 3]
    p += 1e-3 * rng.normal(size=p.shape)
    return p / np.linalg.norm(p, axis=1, keepdims=True)


def test_best_poses_are_those_of_one_view_after_the_other():
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(-0.2, 0.2, (30, 2)), np.zeros(30)])
    block = rng.uniform(-0.2, 0.2, (12, 3))
    line = np.outer(np.linspace(-0.2, 0.2, 8), [1.0, 0.5, 0.0])
    x = [flat, block, line, flat[:5], flat[:3]]
    poses = [rigid(rotation_exp(0.4 * rng.normal(size=3)), np.array([0.1, -0.1, 1.5])) for _ in x]
    rays = [seen(part, pose, rng) for part, pose in zip(x, poses, strict=True)]
    found, error = best_poses(x, rays, 3)
    for i in range(len(x)):
        if i == 2:
            with pytest.raises(SurveyError, match="line"):
                absolute_pose(x[i], rays[i], 3)
            assert np.isinf(error[i])
            continue
        one = absolute_pose(x[i], rays[i], 3)
        assert np.allclose(found[i], one.camera_from_target[0], atol=1e-9)
        assert error[i] == pytest.approx(one.error[0], rel=1e-6, abs=1e-9)
    assert np.linalg.norm(found[0][:3, 3] - poses[0][:3, 3]) < 0.02


def test_normal_equations_are_the_sums_over_their_rows():
    rng = np.random.default_rng(4)
    ptr, m = np.array([0, 4, 4, 9]), 3
    p, r, w = rng.normal(size=(9, 3)), rng.normal(size=(9, 2)), rng.uniform(0.1, 1.0, 9)
    a, by_point = rng.normal(size=(9, 2, m)), rng.normal(size=(9, 2, 3))
    out = lens_and_poses(ptr, p, r, a, by_point, w)
    rows = np.zeros((18, m + 18))
    for i, view in enumerate(np.repeat([0, 1, 2], np.diff(ptr))):
        # camera_from_target moves by turn, then shift, in the camera: dp = turn x p + shift
        j = by_point[i] @ np.hstack([-skew(p[i : i + 1])[0], np.eye(3)])
        rows[2 * i : 2 * i + 2, :m] = a[i]
        rows[2 * i : 2 * i + 2, m + 6 * view : m + 6 * view + 6] = j
    W = np.repeat(w, 2)
    N, g = rows.T @ (W[:, None] * rows), rows.T @ (W * r.ravel())
    assert np.allclose(out[0], N[:m, :m])
    assert np.allclose(out[3], g[:m])
    for view in range(3):
        k = slice(m + 6 * view, m + 6 * view + 6)
        assert np.allclose(out[1][view], N[k, :m])
        assert np.allclose(out[2][view], N[k, k])
        assert np.allclose(out[4][view], g[k])
