"""Kernels of the core against other code: rays of image points, influences through a tree, the profile of a corner."""

import cv2
import numpy as np
import pytest
from scipy.special import erf

from adjust.native.lenses import BROWN, FISHEYE, N_LENS, Lens, Newton, image_points_of, rays_of
from adjust.native.library import instruction_sets
from adjust.native.trees import TreeArrays, row_influences
from adjust.native.vision import _corner_rows

_K = np.array([[800.0, 0.0, 320.0], [0.0, 810.0, 240.0], [0.0, 0.0, 1.0]])
_DISTORTIONS = {BROWN: [-0.1, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.005], FISHEYE: [0.01, -0.02, 0.003, 0.001]}


def _by_opencv(kind, tangents):
    """Image points (n, 2) px, as OpenCV projects them, and the lens's parameters in our order."""
    distortion = np.array(_DISTORTIONS[kind])
    x, none = np.column_stack([tangents, np.ones(len(tangents))])[:, None], np.zeros(3)
    project = cv2.projectPoints if kind == BROWN else cv2.fisheye.projectPoints
    uv = project(x, none, none, _K, distortion)[0].reshape(-1, 2)
    return uv, np.array([_K[0, 0], _K[1, 1], 0.0, _K[0, 2], _K[1, 2], *distortion])


@pytest.mark.parametrize("kind", [BROWN, FISHEYE])
@pytest.mark.parametrize("n", [1, 35, 6001])
def test_rays_are_those_that_opencv_projects(kind, n):
    tangents = np.random.default_rng(1).uniform(-0.4, 0.4, (n, 2))
    uv, values = _by_opencv(kind, tangents)
    lens, newton = Lens(kind, values, np.zeros(4)), Newton(50, 1e-8)
    expected = np.column_stack([tangents, np.ones(n)]) / np.sqrt(1.0 + (tangents**2).sum(axis=1))[:, None]
    for start in (None, tangents + 0.01):
        found, solved = rays_of(lens, uv, newton, 0.6, start)
        np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-13)
        assert solved.all()
    assert rays_of(lens, uv, newton, 0.2)[1].tolist() == (np.linalg.norm(tangents, axis=1) <= 0.2).tolist()
    again, solved = image_points_of(lens, expected, newton, 800.0, np.zeros((n, 2)))
    np.testing.assert_allclose(again, uv, rtol=0.0, atol=1e-10)
    assert solved.all()


def test_rays_that_were_not_found_are_told():
    tangents = np.random.default_rng(2).uniform(-0.3, 0.3, (10, 2))
    uv, values = _by_opencv(BROWN, tangents)
    lens, constants = Lens(BROWN, values, np.zeros(4)), np.zeros(4)
    assert not rays_of(lens, uv, Newton(2, 1e-8), np.inf)[1].any(), "two steps are not enough"
    folding = np.zeros(N_LENS[BROWN])
    folding[[0, 1, 3, 4, 5]] = 800.0, 800.0, 320.0, 240.0, -1.0  # r (1 - r^2) comes back to 0 at r = 1
    uv = np.array([[320.0 + 800.0 * 0.9 * (1 - 0.81), 240.0]] * 2)
    start = np.array([[0.9, 0.0], [0.15, 0.0]])
    found, solved = rays_of(Lens(BROWN, folding, constants), uv, Newton(50, 1e-8), np.inf, start)
    assert solved.tolist() == [False, True], "beyond r = 0.577 the image is turned over"
    tangent = found[1, 0] / found[1, 2]
    assert abs(tangent * (1.0 - tangent**2) - 0.9 * (1 - 0.81)) < 1e-13


def _tree():
    """Keys of 3, 2 and 2 unknowns: a root of the first two, below it the third beside the second; and Q of all."""
    rng = np.random.default_rng(3)
    A = rng.normal(size=(12, 7))
    A[:6, 5:] = 0.0  # no row has both the first and the third key
    A[6:, :3] = 0.0
    Q = np.linalg.inv(A.T @ A)
    ints = [np.array(a, np.int64) for a in ([0, 0, 1], [0, 2, 4], [0, 1, 2, 1], [3, 2, 2], [5, 2], [5, 4], [0, 25])]
    below = np.hstack([Q[5:, 5:], Q[5:, 3:5]])
    return TreeArrays(*ints, np.concatenate([Q[:5, :5].ravel(), below.ravel()])), Q


def test_influences_of_rows_are_those_of_the_whole_covariance():
    tree, Q = _tree()
    first, rng = np.array([0, 3, 5, 7]), np.random.default_rng(4)
    chunks = [([1, 0], 3), ([2, 1], 1), ([1, 2], 4), ([2], 2)]
    pieces, expected = [], []
    for keys, rows in chunks:
        A = np.zeros((rows, 7))
        for k in keys:
            A[:, first[k] : first[k + 1]] = piece = rng.normal(size=(rows, first[k + 1] - first[k]))
            pieces.append(piece.ravel())
        expected += list(np.diag(A @ Q @ A.T))
    starts = np.cumsum([0, *(sum(rows * (first[k + 1] - first[k]) for k in keys) for keys, rows in chunks)])[:-1]
    row_ptr, key_ptr = (np.cumsum([0, *n]) for n in ([r for _, r in chunks], [len(k) for k, _ in chunks]))
    key = np.concatenate([k for k, _ in chunks])
    found, lost = row_influences(row_ptr, key_ptr, key, starts, np.concatenate(pieces), tree)
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert not lost.any()


def test_rows_over_keys_that_share_no_clique_are_told():
    tree, Q = _tree()
    row_ptr, key_ptr, key = np.array([0, 1, 2]), np.array([0, 2, 3]), np.array([0, 2, 2])
    found, lost = row_influences(row_ptr, key_ptr, key, np.array([0, 5]), np.ones(7), tree)
    assert lost.tolist() == [True, False]
    assert found[1] == pytest.approx(Q[5:, 5:].sum(), rel=1e-12)


@pytest.mark.parametrize("instructions", instruction_sets())
def test_the_profile_of_a_perpendicular_crossing_is_a_product_of_error_functions(instructions):
    """Closed form (each edge alone blurred by a Gaussian), far beyond where either edge is seen."""
    xy, blur = np.random.default_rng(5).uniform(-9.0, 9.0, (400, 2)), 0.7
    p = np.array([0.2, -0.3, 0.4, 0.4 + np.pi / 2, 100.0, 80.0, np.log(blur), 0.1, -0.2])
    value, rows = np.empty(400), np.empty((400, 9))
    _corner_rows.using(instructions)(xy, p, True, value, rows)
    d = xy - p[:2]
    h = (np.cos(p[2]) * d[:, 1] - np.sin(p[2]) * d[:, 0]) / blur
    k = (np.sin(p[3]) * d[:, 0] - np.cos(p[3]) * d[:, 1]) / blur
    shape = erf(h / np.sqrt(2.0)) * erf(k / np.sqrt(2.0))
    expected = p[4] + p[5] * shape + xy @ p[7:]
    np.testing.assert_allclose(value, expected, rtol=0.0, atol=1e-10)
    np.testing.assert_allclose(rows[:, 5], shape, rtol=0.0, atol=2e-12)
