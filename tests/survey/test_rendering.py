import time

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from survey.project.targets import Charuco, Checkerboard, MarkerBlock, MarkerGrid
from survey.simulate.rendering import Beacons, BrownCamera, Imaging, PlacedTarget, render

CAMERA = BrownCamera((320, 240), 400.0, 400.0, 159.5, 119.5)
BOARD = Checkerboard(5, 4, 0.02)
CLEAN = Imaging(blur_px=0.0, noise_gray=0.0)


def facing(x, y, z):
    return Pose3(Rot3(), np.array([x, y, z]))


def test_edges_fall_on_their_exact_share_of_a_pixel():
    # squares of 20 px; the corner r0c0 lies 0.3 px right of the centre of pixel (100, 80), covering 0.2 of that
    z = 0.4
    placed = PlacedTarget(BOARD, facing((100.3 - 159.5) * z / 400, (80.0 - 119.5) * z / 400, z), 0.0, 250.0)
    image = render(CAMERA, [placed], imaging=CLEAN)
    row = image[85]  # the square between r0c0 and r1c1 is dark, the one to its left bright
    assert row[90:100].tolist() == [250] * 10
    assert row[100] == pytest.approx(0.8 * 250, abs=3)
    assert row[101:120].tolist() == [0] * 19
    assert row[120] == pytest.approx(0.2 * 250, abs=3)


def test_grey_values_agree_with_a_texture_warped_by_opencv():
    camera = BrownCamera((320, 240), 400.0, 410.0, 155.0, 118.0, (-0.25, 0.1, 2e-3, -1e-3))
    pose = Pose3(Rot3.Expmap(np.array([0.5, -0.3, 0.4])), np.array([-0.05, -0.04, 0.3]))
    image = render(camera, [PlacedTarget(BOARD, pose, 0.0, 200.0)], imaging=Imaging(1.0, 0.0, 100.0))
    matrix = np.array([[400.0, 0, 155.0], [0, 410.0, 118.0], [0, 0, 1]])
    grid = np.stack(np.meshgrid(np.arange(320.0), np.arange(240.0)), -1).reshape(-1, 1, 2)
    xy = cv2.undistortPoints(grid, matrix, np.array(camera.distortion))
    ray = np.column_stack([xy.reshape(-1, 2), np.ones(320 * 240)])
    q = ray @ np.linalg.inv(np.column_stack([pose.rotation().matrix()[:, :2], pose.translation()])).T
    i, j = np.floor(q[:, 0] / q[:, 2] / 0.02), np.floor(q[:, 1] / q[:, 2] / 0.02)
    inner = (i >= -1) & (i <= 4) & (j >= -1) & (j <= 3)
    bright = (i + j) % 2 == 1
    expected = np.where(bright, 200.0, 0.0).reshape(240, 320)
    # far from any edge the values must be equal; the mask is eroded by the reach of the point spread
    edges = cv2.morphologyEx(expected.astype(np.uint8), cv2.MORPH_GRADIENT, np.ones((9, 9)))
    sure = (edges == 0) & cv2.erode(inner.reshape(240, 320).astype(np.uint8), np.ones((9, 9))).astype(bool)
    assert sure.sum() > 1000
    assert np.array_equal(image[sure], expected[sure].astype(np.uint8))


def test_the_nearer_target_hides_the_farther_one_in_any_order_and_its_beacons():
    near, far = (
        PlacedTarget(BOARD, facing(-0.03, -0.03, 0.4), 0, 0),
        PlacedTarget(BOARD, facing(-0.03, -0.03, 0.5), 9, 9),
    )
    beacon = Beacons(np.array([[0.0, 0.0, 0.6], [0.2, 0.0, 0.6]]), 0.004, 200.0)
    image = render(CAMERA, [near, far], beacon, CLEAN)
    assert np.array_equal(image, render(CAMERA, [far, near], beacon, CLEAN))
    assert image[119, 159] == 0
    u, v = CAMERA.project(np.array([[0.2, 0.0, 0.6]]))[0].round().astype(int)
    assert image[v, u] > 250


def test_a_target_seen_from_behind_shows_a_plain_back():
    image = render(
        CAMERA, [PlacedTarget(BOARD, Pose3(Rot3.Ry(np.pi), np.array([0.05, -0.03, 0.4])), 0, 200)], imaging=CLEAN
    )
    assert set(np.unique(image)) == {100, 128}


@pytest.mark.parametrize("legacy", [False, True])
def test_charuco_is_opencvs_own_picture(legacy):
    target = Charuco(5, 6, 0.02, 0.0144, "4X4_50", legacy)
    z, scale = 0.4, 2.5  # px a mm
    camera = BrownCamera((400, 400), 1000.0, 1000.0, -0.5, -0.5)
    image = render(camera, [PlacedTarget(target, facing(0.06, 0.06, z), 0, 255)], imaging=CLEAN)
    board = cv2.aruco.CharucoBoard((5, 6), 0.02, 0.0144, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    board.setLegacyPattern(legacy)
    own = board.generateImage((int(100 * scale), int(120 * scale)))
    # the outer corner of the board is 20 mm before the inner corner 0, at (40, 40) mm which is pixel (100, 100)
    part = image[100:400, 100:350]
    assert np.mean(np.abs(own.astype(int) - part)) < 2.0
    assert np.corrcoef(own.ravel(), part.ravel())[0, 1] > 0.98


def test_marker_blocks_and_grids_show_the_same_marker():
    m = 0.06
    corners = np.array([[0, 0, 0], [m, 0, 0], [m, m, 0], [0, m, 0]], float)
    pose = Pose3(Rot3.Expmap(np.array([0.2, 0.1, 0.3])), np.array([-0.03, -0.03, 0.3]))
    block = render(CAMERA, [PlacedTarget(MarkerBlock({7: corners}, "APRILTAG_36h11"), pose)], imaging=CLEAN)
    grid = render(CAMERA, [PlacedTarget(MarkerGrid(1, 1, m, m / 8, "apriltag_36h11", 7), pose)], imaging=CLEAN)
    differ = np.abs(block.astype(int) - grid) > 2
    outside = cv2.dilate((grid > 200).astype(np.uint8), np.ones((3, 3))).astype(bool)
    assert not np.any(differ & ~outside)
    assert differ.mean() < 0.1


def test_a_spots_light_is_its_area_times_its_radiance_wherever_it_stands():
    camera = BrownCamera((320, 240), 400.0, 400.0, 159.5, 119.5, (-0.2, 0.05))
    x = np.array([[0.013, 0.021, 1.0], [-0.25, 0.15, 0.8]])
    for profile, area in (("disc", np.pi / 4), ("gaussian", 2 * np.pi / 16)):
        for point in x:
            beacon = Beacons(point[None], 0.01, 150.0, profile)
            # 16 bit: no rounding to speak of
            image = render(camera, beacons=beacon, imaging=Imaging(0.7, 0.0, 0.0, bits=16)) * (255.0 / 65535.0)
            v, u = np.mgrid[:240, :320]
            centre = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
            assert centre == pytest.approx(camera.project(point[None])[0], abs=3e-3)
            h = 1e-5
            across = np.linalg.norm(point) * np.array(
                [[1, 0, -point[0] / point[2]], [0, 1, -point[1] / point[2]]]
            )  # first-order: directions orthogonal to the ray, not normalised
            basis = np.linalg.qr(np.column_stack([point, *across]))[0][:, 1:].T
            D = np.stack(
                [(camera.project((point + h * b)[None]) - camera.project((point - h * b)[None]))[0] for b in basis]
            )
            px2 = abs(np.linalg.det(D / (2 * h))) * area * 0.01**2
            assert image.sum() == pytest.approx(150.0 * px2, rel=2e-3)


def test_noise_blur_gradient_and_seed():
    image = render(CAMERA, imaging=Imaging(0.0, 3.0, 100.0), seed=1)
    assert image.std() == pytest.approx(np.sqrt(9 + 1 / 12), rel=0.02)
    assert np.array_equal(image, render(CAMERA, imaging=Imaging(0.0, 3.0, 100.0), seed=1))
    assert not np.array_equal(image, render(CAMERA, imaging=Imaging(0.0, 3.0, 100.0), seed=2))
    slope = render(CAMERA, imaging=Imaging(0.0, 0.0, 100.0, (0.4, 0.0)))
    assert int(slope[0, -1]) - int(slope[0, 0]) == pytest.approx(40, abs=1)
    deep = render(CAMERA, imaging=Imaging(0.0, 0.0, 100.0, bits=12))
    assert deep.dtype == np.uint16
    assert deep[0, 0] == round(100 / 255 * 4095)


def test_a_board_image_takes_a_fraction_of_a_second():
    camera = BrownCamera((1280, 1024), 1600.0, 1600.0, 639.5, 511.5, (-0.2, 0.05))
    placed = [PlacedTarget(Checkerboard(11, 8, 0.02), facing(-0.1, -0.07, 0.4))]
    render(camera, placed)
    start = time.process_time()
    render(camera, placed, seed=1)
    assert time.process_time() - start < 1.0


def test_wrong_input_is_named():
    with pytest.raises(SurveyError, match="samples: 50"):
        render(CAMERA, [PlacedTarget(BOARD, facing(0, 0, 1))], imaging=Imaging(samples=50))
    with pytest.raises(SurveyError, match="9 coefficients"):
        render(BrownCamera((20, 20), 1, 1, 0, 0, (0.0,) * 9), [PlacedTarget(BOARD, facing(0, 0, 1))])
    with pytest.raises(SurveyError, match=r"'4X4_51': unknown.*4X4_50"):
        render(CAMERA, [PlacedTarget(MarkerGrid(1, 1, 0.1, 0.1, "4X4_51"), facing(0, 0, 1))])
    with pytest.raises(SurveyError, match="marker 60: dictionary '4X4_50' holds 0 to 49"):
        render(CAMERA, [PlacedTarget(MarkerGrid(1, 1, 0.1, 0.1, "4X4_50", 60), facing(0, 0, 1))])
