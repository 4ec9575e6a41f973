"""What detection claims against what images of known noise scatter."""

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from survey.detection import SpotOptions, checkerboard, detect_image, detect_spots, markers
from survey.detection.corners import CornerFit, unbent
from survey.project.targets import Charuco, Checkerboard, MarkerGrid
from survey.simulate.rendering import Beacons, BrownCamera, Imaging, PlacedTarget, render

pytestmark = pytest.mark.slow

CAMERA = BrownCamera((640, 480), 800.0, 800.0, 319.5, 239.5, (-0.2, 0.05, 1e-3, -5e-4))
BOARD = Checkerboard(8, 5, 0.02)
CHARUCO = Charuco(8, 6, 0.02, 0.014, "4X4_50")
MARKERS = MarkerGrid(4, 3, 0.03, 0.01, "APRILTAG_36h11")
LEVELS = [(0.35, 1.0, 220.0), (0.6, 1.0, 220.0), (0.6, 4.0, 220.0), (0.9, 2.0, 90.0), (1.4, 2.0, 220.0)]
N = 6


def clean_view(target, turn, blur, bright=220.0, z=0.32):
    """Grey values without noise or digits, and OpenCV's projection of the points."""
    x = target.points()[1]
    R = Rot3.RzRyRx(*turn)
    pose = Pose3(R, np.array([0.004, -0.003, z]) - R.matrix() @ x.mean(0))
    image = render(CAMERA, [PlacedTarget(target, pose, 30.0, bright)], imaging=Imaging(blur, 0.0, bits=16))
    matrix = np.array([[800.0, 0, 319.5], [0, 800.0, 239.5], [0, 0, 1]])
    turned = cv2.Rodrigues(R.matrix())[0]
    uv = cv2.projectPoints(x, turned, pose.translation(), matrix, np.array(CAMERA.distortion))[0].reshape(-1, 2)
    return image / 257.0, uv


def with_noise(clean, noise, rng):
    return np.clip(np.rint(clean + noise * rng.standard_normal(clean.shape)), 0, 255).astype(np.uint8)


def in_band(q):
    """Whether squared standardised errors of image points are chi-square with two degrees each (3.5 sigma)."""
    low, high = chi2.ppf([2.3e-4, 1.0 - 2.3e-4], 2 * len(q))
    return low < np.sum(q) < high


@pytest.mark.parametrize("target", [BOARD, CHARUCO, MARKERS], ids=["board", "charuco", "markers"])
def test_errors_of_corners_are_as_large_as_their_covariance_says(target):
    rng, every = np.random.default_rng(3), []
    for blur, noise, bright in LEVELS:
        clean, uv = clean_view(target, (0.25, 0.2, 0.15), blur, bright)
        q = []
        for _ in range(N):
            found = detect_image(with_noise(clean, noise, rng), target)
            assert len(found) > 0.8 * len(uv)
            e = found.uv - uv[found.point_idx]
            q.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.cov), e))
        assert in_band(np.concatenate(q)), (blur, noise, bright, np.concatenate(q).mean() / 2)
        every += q
    assert in_band(np.concatenate(every)), np.concatenate(every).mean() / 2


def test_sharp_edges_along_the_pixels_are_known_less_well_and_say_so():
    q, sigma = [], {}
    for turn in (0.0, 0.25):
        for shift in range(8):
            clean, uv = clean_view(BOARD, (0.0, 0.0, turn), 0.3, z=0.32 + 0.004 * shift)
            found = detect_image(clean, BOARD)
            e = found.uv - uv[found.point_idx]
            sigma[turn] = np.sqrt(np.trace(found.cov, axis1=1, axis2=2).mean() / 2)
            if turn == 0.0:
                q.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.cov), e))
            else:
                assert np.sqrt((e**2).mean()) < 1e-3
    # the displacements are those of a sine, the same along a row: no chi-square band, but no tenth of it either
    assert 1.6 < np.concatenate(q).mean() < 2.4
    assert sigma[0.0] > 6 * sigma[0.25]


@pytest.mark.parametrize("target", [BOARD, CHARUCO, MARKERS], ids=["board", "charuco", "markers"])
def test_what_the_lens_bends_is_not_in_the_corners(target, monkeypatch):
    clean, uv = clean_view(target, (0.25, 0.2, 0.15), 0.8, z=0.27)

    def rms():
        found = detect_image(clean, target)
        return np.sqrt(((found.uv - uv[found.point_idx]) ** 2).mean())

    freed = rms()
    for module in (checkerboard, markers):
        monkeypatch.setattr(module, "unbent", lambda fit, xy, keep: fit)
    assert freed < 1e-3
    assert freed < 0.5 * rms()


def test_bending_that_a_few_corners_cannot_tell_is_stated_instead():
    n = 5
    xy = np.random.default_rng(0).uniform(0, 5, (n, 2))
    fit = CornerFit(
        20.0 * xy, np.tile(1e-6 * np.eye(2), (n, 1, 1)), np.ones(n), np.ones(n), np.ones(n, bool),
        np.tile([0.0, 1.6], (n, 1)), np.full((n, 2), 20.0), 0.002,
    )  # fmt: skip
    left = unbent(fit, xy, fit.good)
    assert np.array_equal(left.uv, fit.uv)
    assert left.cov[0, 0, 0] == pytest.approx(1e-6 + 0.002**2)


def test_errors_of_spots_are_as_large_as_their_covariance_says():
    rng = np.random.default_rng(5)
    gu, gv = np.meshgrid(np.linspace(-0.3, 0.3, 9), np.linspace(-0.2, 0.2, 7))
    x = np.stack([gu.ravel(), gv.ravel(), np.full(gu.size, 1.0)], 1)
    x[:, :2] += rng.uniform(-0.01, 0.01, (len(x), 2))
    uv, every = CAMERA.project(x), []
    for diameter_px, blur, noise in ((3.0, 0.8, 1.0), (3.0, 1.2, 2.0), (6.0, 0.8, 1.0), (6.0, 1.0, 3.0)):
        lit = Beacons(x, diameter_px / 800.0, 190.0)
        clean = render(CAMERA, beacons=lit, imaging=Imaging(blur, 0.0, 30.0, bits=16)) / 257.0
        q = []
        for _ in range(6):
            found = detect_spots(with_noise(clean, noise, rng), SpotOptions((1.5, 14.0)))
            assert len(found) == len(x)
            e = found.uv - uv[np.linalg.norm(found.uv[:, None] - uv[None], axis=2).argmin(1)]
            q.append(np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.cov), e))
        assert in_band(np.concatenate(q)), (diameter_px, blur, noise, np.concatenate(q).mean() / 2)
        every += q
    assert in_band(np.concatenate(every)), np.concatenate(every).mean() / 2
