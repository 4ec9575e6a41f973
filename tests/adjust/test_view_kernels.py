"""The compiled work on single views against OpenCV and plain lines."""

import cv2
import numpy as np

from adjust.closed_forms import homography, refine_poses, rotation_exp, rotation_log
from adjust.closed_forms.plane_kernels import plane_poses

WIDEST = float(np.cos(np.radians(80.0)))


def board_views(n, seed=3, sigma=0.0):
    """Points (20, 3) of tilted boards anywhere, and rays, pose of each view."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        flat = np.column_stack([rng.uniform(-0.1, 0.1, (20, 2)), np.zeros(20)])
        x = flat @ rotation_exp(rng.normal(size=3)).T + rng.normal(0.0, 0.3, 3)
        R, t = rotation_exp(rng.normal(0.0, 0.4, 3)), rng.uniform((-0.4, -0.4, 0.8), (0.4, 0.4, 1.5))
        p = (x - x.mean(axis=0)) @ R.T + t
        normal = np.linalg.svd(p - p.mean(axis=0))[2][2]
        if abs(normal @ t) > 0.2 * np.linalg.norm(t):
            noisy = p[:, :2] / p[:, 2:] + rng.normal(0.0, sigma, (20, 2)) if sigma else p[:, :2] / p[:, 2:]
            rays = np.column_stack([noisy, np.ones(20)])
            yield x, rays / np.linalg.norm(rays, axis=1)[:, None], p


def planes_of(x, rays):
    """Both poses (2, 4, 4) of a plane, found among other points; None where it is no plane."""
    both = np.empty((3, 2, 4, 4))
    around = [np.concatenate([part[:2], part, part[:1]]) for part in (x, rays)]
    return both[1] if plane_poses(*around, 2, 2 + len(x), 1e-4, WIDEST, 1, both) else None


def test_one_of_both_poses_of_a_plane_is_the_true_one():
    views = list(board_views(200))
    assert len(views) > 100
    for x, rays, p in views:
        both = planes_of(x, rays)
        assert min(np.abs(x @ m[:3, :3].T + m[:3, 3] - p).max() for m in both) < 1e-10
        np.testing.assert_allclose(np.linalg.det(both[:, :3, :3]), 1.0, atol=1e-9)


def test_both_poses_of_a_plane_as_opencv_has_them():
    """From noisy points both solutions, refined, are the two of OpenCV's IPPE, refined in the same way."""
    apart = []
    for x, rays, _ in board_views(40, seed=9, sigma=1e-3):
        both = planes_of(x, rays)
        centre = x.mean(axis=0)
        axes = np.linalg.svd(x - centre)[2]
        axes *= np.array([[1.0], [1.0], [np.linalg.det(axes)]])
        local = (x - centre) @ axes.T * np.array([1.0, 1.0, 0.0])
        _, turns, shifts, _ = cv2.solvePnPGeneric(local, rays[:, :2] / rays[:, 2:], np.eye(3), None,
                                                  flags=cv2.SOLVEPNP_IPPE)  # fmt: skip
        for turn, shift in zip(turns, shifts, strict=True):
            other = np.eye(4)
            other[:3, :3] = cv2.Rodrigues(turn)[0] @ axes
            other[:3, 3] = shift.ravel() - other[:3, :3] @ centre
            trials = np.concatenate([both, other[None]])
            ptr = np.arange(4) * len(x)
            refined = refine_poses(trials, np.tile(x, (3, 1)), np.tile(rays, (3, 1)), ptr, 30)
            apart.append(min(np.linalg.norm(rotation_log(m[:3, :3].T @ refined[2, :3, :3])) for m in refined[:2]))
    assert np.mean(np.array(apart) < 1e-5) > 0.95


def test_no_plane_no_answer():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(10, 3))
    p = x + (0.0, 0.0, 8.0)
    rays = p / np.linalg.norm(p, axis=1)[:, None]
    assert planes_of(x, rays) is None
    line = np.outer(np.linspace(-1, 1, 10), (1.0, 2.0, 0.0))
    p = line + (0.0, 0.0, 8.0)
    assert planes_of(line, p / np.linalg.norm(p, axis=1)[:, None]) is None


def test_homography_is_the_least_squares_one():
    """Noise of 0.5 px: OpenCV's plain least squares (method 0, refined) has the same residuals."""
    rng = np.random.default_rng(4)
    xy = rng.uniform(-1.0, 1.0, (30, 2))
    h = np.array([[800.0, 30.0, 640.0], [-20.0, 780.0, 500.0], [0.1, -0.05, 1.0]])
    p = np.column_stack([xy, np.ones(30)]) @ h.T
    uv = p[:, :2] / p[:, 2:] + rng.normal(0.0, 0.5, (30, 2))
    found, rms = homography(xy, uv)
    theirs = cv2.findHomography(xy, uv, 0)[0]
    np.testing.assert_allclose(found / found[2, 2], theirs, rtol=1e-4, atol=1e-4)
    q = np.column_stack([xy, np.ones(30)]) @ theirs.T
    assert abs(rms - np.sqrt(np.mean(np.sum((q[:, :2] / q[:, 2:] - uv) ** 2, axis=1)))) < 1e-6
