"""What the start does for all views at once, against one at a time and plain least squares of lens and poses."""

import cv2
import numpy as np
import pytest
from scipy.optimize import least_squares

from adjust.lenses.models import MODELS, default_start, lens_constants
from adjust.model.errors import SurveyError
from adjust.native.lenses import Lens, fit_lens
from adjust.native.views import refine_poses
from adjust.spatial.rigid import rigid, rotation_exp
from adjust.start.closed_forms.absolute_pose import best_poses, pose_solutions


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
    found, error = best_poses(np.concatenate(x), np.concatenate(rays), np.cumsum([0] + [len(part) for part in x]), 3)
    for i in range(len(x)):
        (alone,), (least,) = best_poses(x[i], rays[i], np.array([0, len(x[i])]), 3)
        if i == 2:
            with pytest.raises(SurveyError, match="line"):
                pose_solutions(x[i], rays[i])
            assert np.isinf([error[i], least]).all()
            continue
        assert np.allclose(found[i], alone, atol=1e-9)
        assert error[i] == pytest.approx(least, rel=1e-6, abs=1e-9)
        several = refine_poses(candidates := pose_solutions(x[i], rays[i]), x[i], rays[i], np.array([0, len(x[i])]), 3,
                               of=np.zeros(len(candidates), dtype=int))  # fmt: skip
        assert np.abs(several - alone).max(axis=(1, 2)).min() < 1e-9
    assert np.linalg.norm(found[0][:3, 3] - poses[0][:3, 3]) < 0.02


def test_a_lens_and_its_poses_are_the_robust_least_squares_of_plain_rows():
    """Against SciPy on OpenCV's projection, weights and all, with gross points; and the covariance of what is free."""
    rng, true, places = np.random.default_rng(4), np.array([1500.0, 1510.0, 630.0, 500.0, -0.1]), [0, 1, 3, 4, 5]
    x = np.column_stack([np.mgrid[:7, :5].reshape(2, -1).T * 0.04 - 0.1, np.zeros(35)])

    def pixels(p):
        lens, out = p[:5], []
        for turn, shift in p[5:].reshape(-1, 2, 3):
            K = np.array([[lens[0], 0.0, lens[2]], [0.0, lens[1], lens[3]], [0.0, 0.0, 1.0]])
            out.append(cv2.projectPoints(x, turn, shift, K, np.array([lens[4], 0.0, 0.0, 0.0]))[0][:, 0])
        return np.concatenate(out)

    motions = np.array([[0.3 * rng.normal(size=3), [*rng.uniform(-0.1, 0.1, 2), 0.8]] for _ in range(6)])
    found = np.concatenate([true, motions.ravel()])
    uv = pixels(found) + rng.normal(0.0, 0.3, (6 * len(x), 2))
    uv[::40] += 9.0
    for _ in range(8):
        off = np.linalg.norm(pixels(found) - uv, axis=1)
        limit = 3.0 * np.median(off)
        half = np.sqrt(limit / np.maximum(off, limit))
        solved = least_squares(lambda p, half=half: (half[:, None] * (pixels(p) - uv)).ravel(), found, x_scale="jac")
        found = solved.x
    values = default_start(MODELS["brown"], (1280, 1024), 1550.0)
    directions = np.ascontiguousarray(np.eye(13)[:, places])
    start = np.array([rigid(rotation_exp(turn + 0.01), shift + 0.01) for turn, shift in motions])
    squares, cov = fit_lens(Lens(0, values, lens_constants("brown", (1280, 1024))), directions, len(x) * np.arange(7),
                            np.tile(x, (6, 1)), uv, 25, start)  # fmt: skip
    expected = np.linalg.inv(solved.jac.T @ solved.jac)[:5, :5]
    sigma = 0.3 * np.sqrt(np.diag(expected))
    assert np.all(np.abs(values[places] - found[:5]) < 0.05 * sigma)
    assert np.all(values[[2, 6, 7, 8, 9, 10, 11, 12]] == 0.0)
    np.testing.assert_allclose(cov, expected, rtol=1e-2, atol=1e-2 * np.sqrt(np.outer(*2 * [np.diag(expected)])).min())
    np.testing.assert_allclose(np.sqrt(squares), np.linalg.norm(pixels(found) - uv, axis=1), atol=0.02)
    for pose, (turn, shift) in zip(start, found[5:].reshape(-1, 2, 3), strict=True):
        np.testing.assert_allclose(pose, rigid(rotation_exp(turn), shift), atol=2e-4)


def test_what_the_images_leave_open_has_an_infinite_covariance():
    """Skew and its double are one: the fit goes on in what they share."""
    rng = np.random.default_rng(5)
    x = np.column_stack([rng.uniform(-0.1, 0.1, (20, 2)), np.zeros(20)])
    pose = rigid(rotation_exp(np.array([0.3, 0.2, 0.1])), np.array([0.0, 0.0, 0.8]))
    values = default_start(MODELS["brown"], (1280, 1024), 1500.0)
    p = x @ pose[:3, :3].T + pose[:3, 3]
    uv = 1500.0 * p[:, :2] / p[:, 2:] + values[3:5]
    constants, ptr = lens_constants("brown", (1280, 1024)), np.array([0, 20])
    values[2] = 3.0
    directions = np.outer(np.eye(13)[2], [1.0, 2.0])
    squares, cov = fit_lens(Lens(0, values, constants), directions, ptr, x, uv, 25, pose[None].copy())
    assert abs(values[2]) < 0.1
    assert np.isinf(np.diag(cov)).all()
    assert squares.max() < 1e-2
