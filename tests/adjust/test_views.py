"""The work on many views at once against OpenCV and plain lines."""

import cv2
import numpy as np
import pytest

from adjust.native.library import SETS, Function, instruction_set
from adjust.native.views import homographies, plane_poses, refine_poses, view_errors, view_offsets
from adjust.spatial.rigid import rigid, rotation_exp, rotation_log
from adjust.start.views import joined, make_views


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
    around = [np.concatenate([part[:2], part, part[:1]]) for part in (x, rays)]
    both, found = plane_poses(*around, np.array([0, 2, 2 + len(x), 3 + len(x)]))
    assert not found[[0, 2]].any()
    return both[1] if found[1] else None


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
            refined = refine_poses(trials, x, rays, np.array([0, len(x)]), 30, of=np.zeros(3, dtype=int))
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
    (found,), ((rms, _),), _ = homographies(xy, uv, np.array([0, 30]))
    theirs = cv2.findHomography(xy, uv, 0)[0]
    np.testing.assert_allclose(found / found[2, 2], theirs, rtol=1e-4, atol=1e-4)
    q = np.column_stack([xy, np.ones(30)]) @ theirs.T
    assert abs(rms - np.sqrt(np.mean(np.sum((q[:, :2] / q[:, 2:] - uv) ** 2, axis=1)))) < 1e-6


def views_of_many_sizes():
    """Views (x, rays, pose) of boards of which 4 to 20 points are seen, with 1e-3 rad of noise."""
    rng = np.random.default_rng(5)
    for i, (x, rays, p) in enumerate(board_views(60, seed=8, sigma=1e-3)):
        seen = rng.permutation(20)[: 4 + i % 17]
        pose = np.eye(4)
        u, _, vt = np.linalg.svd((p - p.mean(axis=0)).T @ (x - x.mean(axis=0)))
        u[:, 2] *= np.sign(np.linalg.det(u @ vt))
        pose[:3, :3] = u @ vt
        pose[:3, 3] = p.mean(axis=0) - pose[:3, :3] @ x.mean(axis=0)
        yield x[seen], rays[seen], pose


def test_a_view_among_others_gives_what_it_gives_alone():
    x, rays, poses = zip(*views_of_many_sizes(), strict=True)
    uv = [r[:, :2] / r[:, 2:] for r in rays]
    ptr = np.cumsum([0] + [len(part) for part in x])
    all_x, all_rays = np.concatenate(x), np.concatenate(rays)
    start = np.array(poses) @ np.block([[rotation_exp(np.full(3, 0.02)), np.full((3, 1), 0.01)], [0.0, 0.0, 0.0, 1.0]])
    refined = refine_poses(start, all_x, all_rays, ptr, 20, robust=True)
    both, found = plane_poses(all_x, all_rays, ptr)
    maps, misses, _ = homographies(all_x[:, :2], np.concatenate(uv), ptr)
    offsets, medians = view_offsets(refined, all_x, all_rays, ptr)
    rms, in_front = view_errors(refined, all_x, all_rays, ptr)
    assert found.mean() > 0.9
    for i, (part, seen) in enumerate(zip(x, rays, strict=True)):
        own = np.array([0, len(part)])
        np.testing.assert_allclose(refined[i], refine_poses(start[i : i + 1], part, seen, own, 20, True)[0], atol=1e-7)
        np.testing.assert_allclose(both[i], plane_poses(part, seen, own)[0][0], atol=1e-7)
        alone = homographies(part[:, :2], uv[i], own)
        np.testing.assert_allclose(maps[i], alone[0][0], rtol=1e-8, atol=1e-12)
        q = np.column_stack([part[:, :2], np.ones(len(part))]) @ maps[i].T
        off = np.linalg.norm(q[:, :2] / q[:, 2:] - uv[i], axis=1)
        np.testing.assert_allclose(misses[i], [np.sqrt(np.mean(off**2)), np.median(off)], atol=1e-10)
        p = part @ refined[i, :3, :3].T + refined[i, :3, 3]
        angles = np.arccos(np.clip((p * seen).sum(axis=1) / np.linalg.norm(p, axis=1), -1.0, 1.0))
        np.testing.assert_allclose(offsets[ptr[i] : ptr[i + 1]], np.tan(angles), atol=1e-7)
        assert abs(medians[i] - np.median(np.tan(angles))) < 1e-7
        assert abs(rms[i] - np.sqrt(np.mean(np.tan(angles) ** 2))) < 1e-7
        assert in_front[i]


def test_views_are_the_same_on_any_number_of_threads(monkeypatch):
    """Bit for bit: every view is worked on alone."""
    x, rays, poses = zip(*list(views_of_many_sizes()) * 20, strict=True)
    ptr = np.cumsum([0] + [len(part) for part in x])
    all_x, all_rays, start = np.concatenate(x), np.concatenate(rays), np.array(poses)
    assert ptr[-1] > 10_000
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("LABSURVEY_THREADS", threads)
        refined = refine_poses(start, all_x, all_rays, ptr, 10, robust=True)
        judged = *view_errors(refined, all_x, all_rays, ptr), *view_offsets(refined, all_x, all_rays, ptr)
        found.append([refined, *judged])
    for one, three in zip(*found, strict=True):
        np.testing.assert_array_equal(one, three)
    assert np.abs(found[0][0] - start).max() > 1e-6


def test_views_are_the_same_with_all_vector_instructions():
    x, rays, poses = zip(*views_of_many_sizes(), strict=True)
    every, found = np.arange(len(poses)), []
    views = every, np.cumsum([0] + [len(p) for p in x]), np.concatenate(x), np.concatenate(rays)
    for name in SETS[: SETS.index(instruction_set()) + 1]:
        refined = np.array(poses)
        declared = "which[*] of[K] ptr[B+1] x[N,3] rays[N,3] iterations robust poses[K,4,4] work[*]"
        refine = Function("refine_views", declared, name)
        refine(every, *views, 10, True, refined, np.empty(26 * 32))
        found.append(refined)
    for other in found[1:]:
        np.testing.assert_allclose(other, found[0], atol=1e-9)  # where a step of rounding's size stops a view


def test_points_behind_are_told():
    x, rays, poses = next(views_of_many_sizes())
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ poses
    ptr = np.array([0, len(x)])
    offsets, medians = view_offsets(turned[None], x, rays, ptr)
    assert np.isinf(offsets).all()
    assert np.isinf(medians).all()
    assert not view_errors(turned[None], x, rays, ptr)[1].any()


def test_refinement_ends_at_the_least_squares_pose():
    """The derivative of the square sum by small motions vanishes there (differences)."""
    for x, rays, pose in list(views_of_many_sizes())[10:20]:
        ptr = np.array([0, len(x)])
        found = refine_poses(pose[None], x, rays, ptr, 40)

        def square_sum(step, found=found, x=x, rays=rays, ptr=ptr):
            moved = np.eye(4)
            moved[:3, :3], moved[:3, 3] = rotation_exp(step[:3]), step[3:]
            return view_errors(moved @ found, x, rays, ptr)[0][0] ** 2

        here = square_sum(np.zeros(6))
        for step in 1e-4 * np.eye(6):
            up, down = square_sum(step), square_sum(-step)
            assert abs(up - down) < 1e-2 * (up + down - 2.0 * here)


@pytest.mark.slow
def test_few_points_off_a_plane_have_their_pose_in_any_order():
    """Four points have several minima, of which a solution from all of them may give a wrong one alone."""
    rng, f, views, true = np.random.default_rng(5), 1900.0, [], []
    for i in range(60):
        R, t = rotation_exp(rng.normal(0.0, 0.5, 3)), np.array([0.0, 0.0, 3.0])
        x = rng.uniform(-1.2, 1.2, (4, 3))
        p = x @ R.T + t
        uv = p[:, :2] / p[:, 2:] + rng.normal(0.0, 0.3 / f, (4, 2))
        rays = np.column_stack([uv, np.ones(4)])
        views.append((i, x, rays / np.linalg.norm(rays, axis=1)[:, None], f))
        true.append(rigid(R, t))
    for order in ([0, 1, 2, 3], [0, 2, 3, 1], [3, 0, 1, 2], [1, 3, 2, 0]):
        found, failed = make_views(joined([(i, x[order], rays[order], f) for i, x, rays, _ in views]))
        assert not failed
        for view, pose in zip(found, true, strict=True):
            off = np.linalg.norm(view.poses[:, :3, 3] - pose[:3, 3], axis=1)
            assert off.min() < 0.05, view.block_idx
