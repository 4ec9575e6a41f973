"""Closed forms against plain constructions: exact data, noisy data, bad data, degenerate data."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.native.views import homographies, refine_poses, view_errors
from adjust.spatial.averaging import mean_pose, pose_distance
from adjust.spatial.rigid import align, rigid, rotation_exp, rotation_log, transform
from adjust.start.closed_forms.absolute_pose import pose_solutions
from adjust.start.closed_forms.hand_eye import relative_motions, solve_ax_xb, solve_ax_zb
from adjust.start.closed_forms.triangulation import intersect
from adjust.start.closed_forms.zhang import pinhole_from_homographies

K = np.array([[1600.0, 0, 630.0], [0, 1590.0, 520.0], [0, 0, 1]])
SIZE = (1280, 1024)


def board(columns=11, rows=8, step=0.02):
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def motion(rng, turn=0.5, shift=0.1):
    m = np.eye(4)
    m[:3, :3] = Rotation.from_rotvec(rng.normal(0, turn, 3)).as_matrix()
    m[:3, 3] = rng.normal(0, shift, 3)
    return m


def views(rng, n, tilt=0.4):
    out = []
    for _ in range(n):
        m = np.eye(4)
        m[:3, :3] = Rotation.from_rotvec(rng.uniform(-tilt, tilt, 3)).as_matrix()
        m[:3, 3] = m[:3, :3] @ [-0.1, -0.07, 0] + rng.uniform([-0.03, -0.03, 0.4], [0.03, 0.03, 0.6])
        out.append(m)
    return out


def pixels(x, m, distortion=None):
    rvec = Rotation.from_matrix(m[:3, :3]).as_rotvec()
    return cv2.projectPoints(x, rvec, m[:3, 3], K, distortion)[0][:, 0]


def rays_of(x, m):
    p = x @ m[:3, :3].T + m[:3, 3]
    return p / np.linalg.norm(p, axis=1, keepdims=True)


def angle_deg(a, b):
    return np.rad2deg(np.linalg.norm(Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()))


def test_rotation_vectors_agree_with_scipy_up_to_half_a_turn():
    w = np.random.default_rng(1).normal(size=(50, 3))
    w *= np.linspace(0, np.pi - 1e-9, 50)[:, None] / np.linalg.norm(w, axis=1, keepdims=True)
    r = rotation_exp(w)
    np.testing.assert_allclose(r, Rotation.from_rotvec(w).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(rotation_log(r), w, atol=1e-7)


def test_align_recovers_a_motion_and_takes_the_smallest_turn_for_two_points():
    rng = np.random.default_rng(2)
    m, x = motion(rng), rng.normal(size=(6, 3))
    np.testing.assert_allclose(align(transform(m, x), x), m, atol=1e-12)
    two = align(np.array([[0.0, 0, 0], [0, 1, 0]]), np.array([[1.0, 0, 0], [2, 0, 0]]))
    np.testing.assert_allclose(two[:3, :3], Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix(), atol=1e-12)


def test_homography_of_a_known_map_and_of_noisy_points():
    rng = np.random.default_rng(3)
    true = np.array([[900.0, 40, 300], [-30, 950, 200], [0.3, -0.2, 1]])
    xy = board()[:, :2]
    uv = cv2.perspectiveTransform(xy[None], true)[0]
    noisy = uv + rng.normal(0, 0.5, uv.shape)
    n = len(xy)
    xys, uvs = np.concatenate([xy, xy, xy[:11], xy[:3]]), np.concatenate([uv, noisy, uv[:11], uv[:3]])
    h, misses, good = homographies(xys, uvs, np.array([0, n, 2 * n, 2 * n + 11, 2 * n + 14]))
    rms = misses[:, 0]
    np.testing.assert_allclose(h[0] / h[0, 2, 2], true, rtol=1e-9)
    assert rms[0] < 1e-9
    reference = cv2.findHomography(xy, noisy)[0]
    reference_rms = np.sqrt(np.mean(np.sum((cv2.perspectiveTransform(xy[None], reference)[0] - noisy) ** 2, axis=1)))
    assert rms[1] <= reference_rms * 1.0001
    assert good.tolist() == [True, True, False, False]  # points on one line, and three


def seen_homographies(rng, n, tilt=0.4, noise=0.0):
    xy = board()[:, :2] / 0.2
    images = [pixels(board(), m) + rng.normal(0, noise, (88, 2)) for m in views(rng, n, tilt)]
    return homographies(np.tile(xy, (n, 1)), np.concatenate(images), 88 * np.arange(n + 1))[0]


def test_zhang_is_exact_without_noise_and_near_with_it():
    start = pinhole_from_homographies(seen_homographies(np.random.default_rng(4), 6), SIZE)
    assert start.variant == "full"
    np.testing.assert_allclose(start.values, [1600, 1590, 630, 520], rtol=1e-6)
    noisy = pinhole_from_homographies(seen_homographies(np.random.default_rng(5), 15, noise=0.2), SIZE)
    np.testing.assert_allclose(noisy.values, [1600, 1590, 630, 520], atol=30)


def test_zhang_falls_back_to_the_centre_for_one_image_and_refuses_frontal_ones():
    start = pinhole_from_homographies(seen_homographies(np.random.default_rng(7), 1, tilt=0.6), SIZE)
    assert start.variant != "full"
    np.testing.assert_allclose(start.values[:2], 1595, rtol=0.1)
    np.testing.assert_allclose(start.values[2:], [639.5, 511.5])
    with pytest.raises(SurveyError, match="tilt the target"):
        pinhole_from_homographies(seen_homographies(np.random.default_rng(8), 4, tilt=0.0), SIZE)


def all_poses(x, rays):
    """Refined poses (k, 4, 4) with the points in front, each once, the best first, and their errors (k,) rad."""
    poses = pose_solutions(x, rays)
    ptr, of = np.array([0, len(x)]), np.zeros(len(poses), dtype=int)
    poses = refine_poses(poses, x, rays, ptr, 5, of=of)
    error, in_front = view_errors(poses, x, rays, ptr, of)
    order = np.argsort(np.where(in_front, error, np.inf))[: in_front.sum()]
    kept = [i for n, i in enumerate(order) if not any(np.allclose(poses[i], poses[j], atol=1e-6) for j in order[:n])]
    return poses[kept], error[kept]


def test_planar_pose_gives_the_truth_first_and_the_second_solution_with_its_error():
    rng = np.random.default_rng(10)
    for m in views(rng, 10):
        found, error = all_poses(board(), rays_of(board(), m))
        np.testing.assert_allclose(found[0], m, atol=1e-8)
        assert np.all(np.diff(error) >= 0)
    far = m.copy()
    far[:3, 3] *= 20
    assert len(all_poses(board(3, 3), rays_of(board(3, 3), far))[0]) == 2


@pytest.mark.parametrize("n", [4, 5, 8])
def test_pose_from_points_in_space_with_rays_beyond_ninety_degrees(n):
    rng = np.random.default_rng(n)
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0, 1.9, 0]).as_matrix()  # everything behind the camera's image plane
    m = turned @ motion(rng, 0.4)
    m[:3, 3] = turned[:3, :3] @ [0.1, 0.2, 2.0]
    x = rng.normal(0, 0.5, (n, 3))
    rays = rays_of(x, m)
    assert np.all(rays @ m[:3, 3] > 0)
    found, _ = all_poses(x, rays)
    assert min(np.abs(found - m).max(axis=(1, 2))) < 1e-7


def test_three_points_leave_several_poses_among_them_the_true_one():
    rng = np.random.default_rng(11)
    m = views(rng, 1)[0]
    x = rng.normal(0, 0.1, (3, 3))
    found, _ = all_poses(x, rays_of(x, m))
    assert min(np.abs(p - m).max() for p in found) < 1e-7
    with pytest.raises(SurveyError, match="one line"):
        pose_solutions(np.outer(np.arange(4.0), [1, 2, 3]), rays_of(np.outer(np.arange(4.0), [1, 2, 3]), m))


def test_refinement_of_ragged_views_ignores_a_gross_error_when_robust():
    rng = np.random.default_rng(12)
    ms = views(rng, 3)
    xs = [board(), board(5, 4), board(8, 6)]
    rays = [rays_of(x, m) for x, m in zip(xs, ms, strict=True)]
    rays[1][3] = rays_of(xs[1][:1] + [0.05, 0, 0], ms[1])[0]
    ptr = np.cumsum([0, *map(len, xs)])
    start = np.array([m @ motion(rng, 0.02, 0.005) for m in ms])
    found = refine_poses(start, np.concatenate(xs), np.concatenate(rays), ptr, 30, robust=True)
    np.testing.assert_allclose(found[[0, 2]], np.array(ms)[[0, 2]], atol=1e-8)
    plain = refine_poses(start, np.concatenate(xs), np.concatenate(rays), ptr, 30)
    assert angle_deg(found[1], ms[1]) < 0.1 * angle_deg(plain[1], ms[1])


def hand_eye_data(rng, n, noise_deg=0.0):
    x, z = motion(rng, 1.0), motion(rng, 1.0)
    a = np.array([motion(rng, 0.8, 0.3) for _ in range(n)])
    b = np.array([np.linalg.inv(z) @ m @ x for m in a])
    b = np.array([m @ motion(rng, np.deg2rad(noise_deg), 1e-3 * noise_deg) for m in b])
    return x, z, a, b


def test_robot_world_is_exact_and_survives_a_bad_pair():
    rng = np.random.default_rng(13)
    x, z, a, b = hand_eye_data(rng, 12)
    found_x, found_z, _ = solve_ax_zb(a, b)
    np.testing.assert_allclose(found_x, x, atol=1e-9)
    np.testing.assert_allclose(found_z, z, atol=1e-9)
    b[4] = b[4] @ motion(rng, 0.7, 0.2)
    found_x, found_z, weights = solve_ax_zb(a, b)
    np.testing.assert_allclose(found_x, x, atol=1e-6)
    np.testing.assert_allclose(found_z, z, atol=1e-6)
    assert np.argmin(weights) == 4
    assert weights[4] < 0.01


def test_hand_eye_is_exact_and_survives_a_bad_pair():
    rng = np.random.default_rng(14)
    x, _, a, b = hand_eye_data(rng, 12)
    motions_a, motions_b = relative_motions(a, b)
    # a_i x = z b_i gives (a_j^-1 a_i) x = x (b_j^-1 b_i)
    found, _ = solve_ax_xb(motions_a, motions_b)
    np.testing.assert_allclose(found, x, atol=1e-8)
    motions_b[5] = motions_b[5] @ motion(rng, 0.7, 0.2)
    found, weights = solve_ax_xb(motions_a, motions_b)
    np.testing.assert_allclose(found, x, atol=1e-6)
    assert weights[5] < 0.01


def test_noisy_hand_eye_is_as_good_as_its_data():
    x, _, a, b = hand_eye_data(np.random.default_rng(15), 40, noise_deg=0.05)
    for found in (solve_ax_zb(a, b)[0], solve_ax_xb(*relative_motions(a, b))[0]):
        assert angle_deg(found, x) < 0.06
        assert np.linalg.norm(found[:3, 3] - x[:3, 3]) < 5e-4


def test_turns_about_one_axis_are_refused_by_name_or_solved_consistently():
    rng = np.random.default_rng(16)
    x, z = motion(rng), motion(rng)
    axis = np.array([0.0, 0.6, 0.8])
    a = np.tile(np.eye(4), (8, 1, 1))
    a[:, :3, :3] = Rotation.from_rotvec(np.linspace(-1, 1, 8)[:, None] * axis).as_matrix()
    b = np.linalg.inv(z) @ a @ x
    with pytest.raises(SurveyError, match=r"0\.600, \+0\.800|-0\.600, -0\.800"):
        solve_ax_zb(a, b)
    motions = relative_motions(a, b)
    with pytest.raises(SurveyError, match="one direction"):
        solve_ax_xb(*motions)
    found, _ = solve_ax_xb(*motions, minimum_norm=True)
    np.testing.assert_allclose(motions[0] @ found, found @ motions[1], atol=1e-8)
    with pytest.raises(SurveyError, match="largest of"):
        solve_ax_zb(a[:1].repeat(5, 0), b[:1].repeat(5, 0))


def test_intersection_with_gross_ray_and_without_parallax():
    rng = np.random.default_rng(17)
    truth = rng.normal(size=(4, 3)) + [0, 0, 5]
    origins = rng.normal(size=(6, 3))
    point_of = np.repeat(np.arange(3), 6)
    o = np.tile(origins, (3, 1))
    d = truth[point_of] - o
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    d[2] = rotation_exp(np.array([0.05, 0.02, 0])) @ d[2]
    o = np.vstack([o, [[0, 0, 0], [0, 0, 0.0]]])
    d = np.vstack([d, [[0, 0, 1], [0, 0, 1.0]]])
    found = intersect(o, d, np.append(point_of, [3, 3]), 5, iterations=30)
    np.testing.assert_allclose(found.x[:3], truth[:3], atol=1e-5)
    assert found.residual[2] > 0.04
    assert np.all(np.isnan(found.x[3:]))
    two = intersect(np.array([[0.0, 0, 0], [1, 0, 0]]), np.array([[0, 0, 1.0], [-0.6, 0, 0.8]]), np.zeros(2, int), 1)
    assert two.parallax[0] == pytest.approx(np.arctan2(0.6, 0.8))


def test_mean_pose_ignores_a_minority_and_picks_among_alternatives():
    rng = np.random.default_rng(18)
    truth = motion(rng)
    poses = np.array([truth @ motion(rng, 1e-3, 1e-3) for _ in range(9)] + [motion(rng) for _ in range(6)])
    mean, distance = mean_pose(poses, lever=1.0)
    assert pose_distance(mean, truth, 1.0) < 2e-3
    assert distance[9:].min() > 20 * distance[:9].max()
    # each observation offers the truth and something else, in either order
    both = np.array([m for i in range(8) for m in ((poses[i], motion(rng))[:: 1 if i % 2 else -1])])
    mean, _ = mean_pose(both, lever=1.0, members=np.repeat(np.arange(8), 2))
    assert pose_distance(mean, truth, 1.0) < 2e-3


@pytest.mark.parametrize("spread", [1e-3, 0.3])
@pytest.mark.parametrize("n", [1, 2, 9, 30])
def test_mean_pose_is_where_its_own_weights_leave_it(n, spread):
    """Once more in plain lines, with SciPy's rotation nearest to the weighted sum; as near as its steps settle."""
    rng, lever = np.random.default_rng(n), 1.3
    truth = motion(rng)
    poses = np.array([truth @ motion(rng, spread, spread) for _ in range(n)])
    mean, _ = mean_pose(poses, lever)
    turns = Rotation.from_matrix(poses[:, :3, :3])
    away = np.hypot(np.linalg.norm(poses[:, :3, 3] - mean[:3, 3], axis=1),
                    lever * (turns * Rotation.from_matrix(mean[:3, :3]).inv()).magnitude())  # fmt: skip
    scale = max(3.0 * np.median(away), 1e-12)
    weights = 1.0 / (1.0 + (away / scale) ** 2) ** 2
    again = np.linalg.norm(weights @ poses[:, :3, 3] / weights.sum() - mean[:3, 3])
    assert again <= 1e-3 * scale
    left = turns.mean(weights) * Rotation.from_matrix(mean[:3, :3]).inv()
    assert lever * left.magnitude() <= 1e-3 * scale + 1e-14


def test_zhang_does_not_take_one_view_seen_three_times_for_three():
    one = seen_homographies(np.random.default_rng(7), 1, tilt=0.6, noise=0.05)
    assert pinhole_from_homographies(np.repeat(one, 3, axis=0), SIZE).variant != "full"


@pytest.mark.slow
def test_four_points_in_space_have_the_true_pose_among_their_solutions():
    """Their square sum has several minima, of which one solution from all of them may be a wrong one."""
    rng = np.random.default_rng(5)
    for _ in range(100):
        m = rigid(rotation_exp(rng.normal(0.0, 0.5, 3)), np.array([0.0, 0.0, 3.0]))
        x = rng.uniform(-1.2, 1.2, (4, 3))
        p = transform(m, x)
        rays = np.column_stack([p[:, :2] / p[:, 2:] + rng.normal(0.0, 1.5e-4, (4, 2)), np.ones(4)])
        rays /= np.linalg.norm(rays, axis=1)[:, None]
        for order in ([0, 1, 2, 3], [0, 2, 3, 1], [3, 0, 1, 2], [1, 3, 2, 0]):
            found, _ = all_poses(x[order], rays[order])
            assert np.linalg.norm(found[:, :3, 3] - m[:3, 3], axis=1).min() < 0.05
