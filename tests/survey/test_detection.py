import dataclasses

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.model.errors import SurveyError
from adjust.native.vision import corner_rows, count_crossings, find_grid, refine_corners
from survey.detection import detect_image, markers
from survey.detection.batch import detect_targets
from survey.detection.corners import CROSSING_FLOOR_PX, MARKER_FLOOR_PX
from survey.detection.gray import gray_values, reduced, saturation_level
from survey.project.dictionaries import charuco_board
from survey.project.targets import Charuco, Checkerboard, MarkerBlock, MarkerGrid
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render
from tests.data import data_folder

pytestmark = pytest.mark.slow

CAMERA = BrownCamera((960, 720), 1200.0, 1200.0, 479.5, 359.5, (-0.2, 0.05, 1e-3, -5e-4))
BOARD = Checkerboard(8, 5, 0.02)
CHARUCO = Charuco(9, 6, 0.02, 0.015, "4X4_50")
ARUCO = MarkerGrid(4, 3, 0.03, 0.01, "4X4_50")
APRIL = MarkerGrid(4, 3, 0.03, 0.01, "APRILTAG_36h11", first_id=20)
SHARP, NORMAL, NOISY = Imaging(0.5, 1.0), Imaging(0.7, 2.0), Imaging(0.9, 8.0)
VIEWS = ((0.0, 0.0, 0.0), (0.3, 0.25, 0.2), (-0.5, 0.4, -0.4))


def placed(target, turn, z=0.35):
    x = target.points()[1]
    R = Rot3.Rx(turn[0]) * Rot3.Ry(turn[1]) * Rot3.Rz(turn[2])
    return PlacedTarget(target, Pose3(R, np.array([0.005, -0.003, z]) - R.matrix() @ x.mean(0)))


def true_uv(view):
    # OpenCV's projection, not the renderer's rays
    pose, x = view.camera_from_target, view.target.points()[1]
    matrix = np.array([[CAMERA.fx, 0, CAMERA.cx], [0, CAMERA.fy, CAMERA.cy], [0, 0, 1]])
    R = cv2.Rodrigues(pose.rotation().matrix())[0]
    return cv2.projectPoints(x, R, pose.translation(), matrix, np.array(CAMERA.distortion))[0].reshape(-1, 2)


def errors(target, imaging):
    e, cov = [], []
    for seed, turn in enumerate(VIEWS):
        view = placed(target, turn)
        found = detect_image(render(CAMERA, [view], imaging=imaging, seed=seed), target)
        assert len(found) > 0.9 * len(target.points()[0]), found.reason
        e.append(found.uv - true_uv(view)[found.point_idx])
        cov.append(found.cov)
    return np.concatenate(e), np.concatenate(cov)


# twice what is measured now (0.002, 0.005, 0.021 on checkerboards), so that a worse fit fails and luck does not
LIMITS = {
    "board": (BOARD, (0.004, 0.009, 0.035)),
    "charuco": (CHARUCO, (0.006, 0.009, 0.035)),
    "aruco": (ARUCO, (0.009, 0.016, 0.065)),
    "april": (APRIL, (0.009, 0.016)),
}


@pytest.mark.parametrize("name", LIMITS)
def test_points_are_where_opencv_projects_them_and_as_good_as_their_covariance_says(name):
    target, limits = LIMITS[name]
    for imaging, limit in zip((SHARP, NORMAL, NOISY), limits, strict=False):
        e, cov = errors(target, imaging)
        assert np.sqrt((e**2).mean()) < limit
        # no finder's pixel origin shines through: the mean error of all points is far below half a pixel
        assert np.abs(e.mean(0)).max() < 0.15 * limit + 5e-4
        q = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)
        # 2 is honest; the documented floor of the model makes good images look a little worse than they are
        assert 0.8 < q.mean() < 2.6
        assert np.mean(q > chi2.ppf(0.999, 2)) < 0.01


@pytest.mark.parametrize(("target", "floor"), [(BOARD, CROSSING_FLOOR_PX), (ARUCO, MARKER_FLOOR_PX)])
def test_without_noise_the_stated_floor_holds(target, floor):
    # 16 bits: the steps of 8, without noise to blur them, displace edges along the pixels by 0.001 px
    e, cov = errors(target, Imaging(0.7, 0.0, samples=377, oversampling=5, bits=16))
    assert np.sqrt((e**2).mean()) < floor
    assert np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e).mean() < 2.0


@pytest.mark.parametrize("crossing", [True, False])
def test_the_fits_derivatives_are_those_of_its_grey_value(crossing):
    p = np.array([0.2, -0.3, 0.3, 1.6, 100.0, -60.0, 0.1, 0.5, -0.4])
    xy = np.array([[0.0, 1.0], [-1.5, 0.4], [2.2, -2.0], [0.2, -0.3]])
    _, rows = corner_rows(xy, p, crossing)
    for k in range(9):
        h = 1e-5 * np.eye(9)[k]
        up, down = (corner_rows(xy, p + s * h, crossing)[0] for s in (1, -1))
        np.testing.assert_allclose(rows[:, k], (up - down) / 2e-5, atol=1e-5)


def test_the_fits_grey_value_is_a_blurred_wedge_at_any_angle():
    p = np.array([0.0, 0.0, 0.2, 1.2, 0.0, 1.0, np.log(1.3), 0.0, 0.0])
    rng = np.random.default_rng(0)
    for x, y in ((0.5, 0.5), (-1.0, 1.5)):
        z = np.array([x, y]) + 1.3 * rng.standard_normal((400_000, 2))
        angle = np.arctan2(z[:, 1], z[:, 0])
        inside = ((angle > 0.2) & (angle < 1.2)).mean()
        assert corner_rows(np.array([[x, y]]), p, False)[0][0] == pytest.approx(inside, abs=3e-3)
        opposite = ((angle + np.pi > 0.2) & (angle + np.pi < 1.2)).mean()
        assert corner_rows(np.array([[x, y]]), p, True)[0][0] == pytest.approx(2 * (inside + opposite) - 1, abs=6e-3)


@pytest.mark.parametrize("roll", np.deg2rad([0, 120, 179, 300]))
def test_the_colours_of_a_board_fix_its_order_however_it_is_turned(roll):
    view = placed(BOARD, (0.2, -0.2, roll))
    found = detect_image(render(CAMERA, [view]), BOARD)
    assert np.abs(found.uv - true_uv(view)[found.point_idx]).max() < 0.05


@pytest.mark.parametrize(("columns", "rows", "turns"), [(8, 6, 2), (7, 5, 2), (6, 6, 4), (5, 5, 2)])
def test_a_board_that_looks_the_same_after_a_turn_starts_at_the_upper_left(columns, rows, turns):
    board = Checkerboard(columns, rows, 0.02)
    for roll in np.deg2rad([10, 280]):
        view = placed(board, (0.2, -0.2, roll))
        found = detect_image(render(CAMERA, [view]), board)
        assert len(found) == columns * rows
        grid = true_uv(view).reshape(rows, columns, 2)
        orders = [grid, grid[::-1, ::-1]]
        if turns == 4:
            orders += [grid.transpose(1, 0, 2)[:, ::-1], grid.transpose(1, 0, 2)[::-1]]
        close = [np.abs(found.uv - order.reshape(-1, 2)).max() < 0.05 for order in orders]
        assert sum(close) == 1
        first = [order[0, 0].sum() for order in orders]
        assert close[int(np.argmin(first))]


def test_all_real_boards_are_found_in_one_order_and_fit_a_camera_better_than_the_saddle_points():
    board = Checkerboard(9, 6, 0.025)
    x = board.points()[1].astype(np.float32)
    for side in ("left", "right"):
        names = sorted(data_folder("calibration", "opencv_samples").glob(f"{side}[0-9][0-9].jpg"))
        assert len(names) == 13
        found = [detect_image(cv2.imread(str(name)), board) for name in names]
        assert [len(f) for f in found] == [54] * 13
        saddles = np.load(names[0].parent / f"{side}_corners.npz")["corners"].reshape(13, 54, 2)
        for f, saddle in zip(found, saddles, strict=True):
            distance = np.linalg.norm(f.uv[:, None] - saddle[None], axis=2).min(1)
            assert np.median(distance) < 0.3
        points = [f.uv.astype(np.float32) for f in found]
        rms = cv2.calibrateCamera([x] * 13, points, (640, 480), None, None)[0]
        # 0.1955 and 0.2070 px with the corners that cornerSubPix gave (the data's own), 0.158 and 0.156 here
        assert rms < {"left": 0.17, "right": 0.17}[side]


def test_several_kinds_in_one_image_and_parts_of_a_board():
    z = 0.8
    views = [
        PlacedTarget(BOARD, Pose3(Rot3(), np.array([-0.27, -0.16, z]))),
        PlacedTarget(CHARUCO, Pose3(Rot3.Rz(0.1), np.array([0.2, -0.15, z]))),
        PlacedTarget(APRIL, Pose3(Rot3.Rz(-0.1), np.array([-0.2, 0.1, z]))),
    ]
    image = render(CAMERA, views)
    for view in views:
        found = detect_image(image, view.target)
        # the Charuco board leaves the image on the right
        assert len(found) > (20 if view.target is CHARUCO else len(view.target.points()[0]) - 1)
        assert np.abs(found.uv - true_uv(view)[found.point_idx]).max() < 0.15
    assert len(detect_image(image, CHARUCO)) < 40


def test_a_marker_block_gives_its_front_faces_and_a_marker_seen_twice_is_left_out():
    h = 0.04
    front = np.array([[-h, -h, -h], [h, -h, -h], [h, h, -h], [-h, h, -h]])
    right = front @ np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    block = MarkerBlock(
        {9: 0.7 * right + [0.3 * h, 0, 0], 3: 0.7 * front - [0, 0, 0.3 * h], 5: front + [0, 0, 1.0]}, "5X5_50"
    )
    view = PlacedTarget(block, Pose3(Rot3.Ry(0.6), np.array([0.0, 0.0, 0.4])))
    found = detect_image(render(CAMERA, [view]), block)
    ids = [block.points()[0][k] for k in found.point_idx]
    assert ids == [f"m3.{c}" for c in range(4)] + [f"m9.{c}" for c in range(4)]
    assert np.abs(found.uv - true_uv(view)[found.point_idx]).max() < 0.1
    twice = [PlacedTarget(ARUCO, Pose3(Rot3(), np.array([x, -0.05, 0.6]))) for x in (-0.2, 0.03)]
    nothing = detect_image(render(CAMERA, twice), ARUCO)
    assert len(nothing) == 0
    assert "more than once" in nothing.reason


def test_sixteen_bits_colour_and_dim_images_give_the_same_points():
    view = placed(BOARD, VIEWS[1])
    image = render(CAMERA, [view], imaging=SHARP)
    uv = detect_image(image, BOARD).uv
    deep = render(CAMERA, [view], imaging=Imaging(0.5, 1.0, bits=12))
    dim = (image // 8).astype(np.uint8)
    for other, limit in (
        (cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), 1e-3),
        (deep, 0.03),
        (dim, 0.1),
        (image / 255.0, 1e-3),
    ):
        found = detect_image(other, BOARD)
        assert np.abs(found.uv - uv).max() < limit
    assert gray_values(np.array([[[10, 20, 30]]], np.uint8))[0, 0] == pytest.approx(
        0.114 * 10 + 0.587 * 20 + 0.299 * 30
    )
    assert (saturation_level(image), saturation_level(deep)) == (255.0, 4095.0)


def test_nothing_found_is_no_error_and_says_what_was_looked_for():
    empty = render(CAMERA)
    for target, word in ((BOARD, "8 x 5"), (CHARUCO, "0 corners"), (ARUCO, "none of the 12 markers")):
        found = detect_image(empty, target)
        assert len(found) == 0
        assert word in found.reason
    with pytest.raises(SurveyError, match="does not fit"):
        detect_image(empty, Charuco(5, 4, 0.01, 0.02, "4X4_50"))
    with pytest.raises(SurveyError, match="shape"):
        detect_image(np.zeros((2, 2, 2, 2)), BOARD)


@pytest.mark.parametrize("size", [(2600, 1951), (2599, 1300), (1801, 900), (901, 700)])
def test_reduced_images_say_where_their_pixels_were(size):
    # a straight line fits the centres of bright spots, whatever is cut off at odd sizes
    image = np.zeros(size[::-1], np.uint8)
    spots = np.array([[40.0, 50.0], [size[0] - 60.0, 90.0], [size[0] / 2, size[1] - 70.0]]).round()
    for u, v in spots.astype(int):
        image[v - 16 : v + 17, u - 16 : u + 17] = 255
    small, factor = reduced(image, 900)
    assert max(small.shape) <= 900
    for u, v in spots:
        a, b = (int((x + 0.5) / f - 0.5) for x, f in zip((u, v), factor, strict=True))
        near = small[max(b - 25, 0) : b + 26, max(a - 25, 0) : a + 26].astype(float)
        rows, columns = np.indices(near.shape)
        place = np.array([(columns * near).sum(), (rows * near).sum()]) / near.sum()
        place += [max(a - 25, 0), max(b - 25, 0)]
        assert (place + 0.5) * factor - 0.5 == pytest.approx([u, v], abs=0.05)


@pytest.mark.parametrize("target", [BOARD, CHARUCO, ARUCO])
def test_large_images_are_searched_reduced_and_measured_in_full(target):
    image = render(CAMERA, [placed(target, VIEWS[1])], imaging=NORMAL)
    alone = detect_image(image, target)
    # three times as large, of odd size: the same points three times as far apart
    large = cv2.resize(image, None, fx=3.0, fy=3.0, interpolation=cv2.INTER_CUBIC)[:-1, :-1]
    found = detect_image(large, target)
    assert found.point_idx.tolist() == alone.point_idx.tolist()
    # 0.03 px and 0.07 px of the small image: with the enlarged noise, and at markers with edges bent a little
    assert np.abs(found.uv - ((alone.uv + 0.5) * 3.0 - 0.5)).max() < (0.2 if target is ARUCO else 0.1)
    # a small part of a large image, where a reduced one shows too little: the very same points
    wide = np.full((2200, 2900), 120, np.uint8)
    wide[1300 : 1300 + image.shape[0], 500 : 500 + image.shape[1]] = image
    found = detect_image(wide, target)
    assert found.point_idx.tolist() == alone.point_idx.tolist()
    assert np.abs(found.uv - alone.uv - [500, 1300]).max() < 1e-3


def test_targets_of_one_dictionary_share_the_search_for_its_markers(monkeypatch):
    view = PlacedTarget(ARUCO, Pose3(Rot3.Rx(0.2), np.array([-0.08, -0.06, 0.4])))
    image = render(CAMERA, [view])
    targets = {"grid": ARUCO, "other": dataclasses.replace(ARUCO, first_id=20), "board": BOARD}
    alone = {name: detect_image(image, target) for name, target in targets.items()}
    asked = []
    search = markers._markers_in

    def counted(gray8, names, first):
        asked.extend(names)
        return search(gray8, names, first)

    monkeypatch.setattr(markers, "_markers_in", counted)
    together = detect_targets(image, targets)
    assert asked == [ARUCO.dictionary]
    assert list(together) == list(targets)
    assert len(together["grid"]) > 0 == len(together["other"])
    for name, detection in together.items():
        assert np.array_equal(detection.uv, alone[name].uv)
        assert np.array_equal(detection.cov, alone[name].cov)
        assert detection.reason == alone[name].reason


@pytest.mark.parametrize("aside", [0.0, 0.07])
def test_one_look_finds_of_a_charuco_board_what_all_thresholds_do(monkeypatch, aside):
    at = placed(CHARUCO, VIEWS[1])
    view = PlacedTarget(CHARUCO, Pose3(Rot3(), np.array([aside, 0.0, 0.0])) * at.camera_from_target)
    image, looks, look = render(CAMERA, [view]), [], markers.board_corners
    monkeypatch.setattr(markers, "board_corners", lambda *given: looks.append(look(*given)) or looks[-1])
    found = detect_image(image, CHARUCO)
    assert len(looks) == 1
    every = look(cv2.aruco.CharucoDetector(charuco_board(CHARUCO)), image)[0]
    assert set(found.point_idx) == set(every)
    assert (len(every) == len(CHARUCO.points()[0])) == (aside == 0.0)
    image[np.ix_(*(range(int(x) - 40, int(x) + 40) for x in found.uv[len(found) // 2, ::-1]))] = 128  # a marker or two
    assert len(detect_image(image, CHARUCO)) < len(found)
    assert len(looks) == 3  # it might be there after all


@pytest.mark.parametrize("crossing", [True, False])
@pytest.mark.parametrize("turn", [0.4, 1.3, 1.9])
def test_a_fit_to_its_own_grey_values_gives_back_what_they_were_made_with(crossing, turn):
    """The fit evaluates pixels side by side, ``corner_rows`` one after the other; both are the same function."""
    p = np.array([20.3, 19.8, 0.3, 0.3 + turn, 60.0, 90.0, np.log(0.9), 0.2, -0.1])
    v, u = np.mgrid[:41, :41]
    value, _ = corner_rows(np.stack([u.ravel() - 20.0, v.ravel() - 20.0], axis=1), p - [20, 20, *[0] * 7], crossing)
    image = value.reshape(41, 41).astype(np.float32)
    angles, none = p[None, 2:4] + 0.03, np.zeros(1)
    edges, free = 17.0 * np.stack([np.cos(angles), np.sin(angles)], axis=2), np.full(1, np.inf if crossing else 8.0)
    uv, cov, blur, contrast, good, angles, _ = refine_corners(
        image, p[None, :2] + 0.2, edges, free, crossing, 0.0, none, none
    )
    assert good[0]
    assert np.sqrt(np.abs(cov)).max() < 1e-5  # grey values of single precision
    assert np.abs(np.concatenate([uv[0], angles[0]]) - p[:4]).max() < 1e-4
    assert contrast[0] == pytest.approx(p[5] * (1.0 + crossing), abs=1e-3)
    assert blur[0] == pytest.approx(np.sqrt(0.9**2 - 1.0 / 12.0), abs=1e-4)


@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 45.0, 100.0])
def test_a_whole_board_is_glimpsed_where_it_is_and_no_part_of_one(turn_deg):
    squares = np.indices((5, 8)).sum(0) % 2
    flat = np.pad(np.kron(squares, np.full((20, 20), 200.0)) + 20.0, 70, constant_values=220.0).astype(np.float32)
    M = cv2.getRotationMatrix2D((150.0, 120.0), turn_deg, 1.0)
    turned = cv2.warpAffine(flat, M, (300, 240), borderValue=220.0)
    image = np.rint(cv2.GaussianBlur(turned, (0, 0), 0.8)).astype(np.uint8)
    v, u = np.meshgrid(89.5 + 20.0 * np.arange(4), 89.5 + 20.0 * np.arange(7), indexing="ij")
    truth = np.stack([u, v, np.ones_like(u)], axis=2) @ M.T
    grid = find_grid(image, 7, 4)
    assert grid is not None
    away = [np.abs(g - truth).max() for g in (grid, grid[::-1], grid[:, ::-1], grid[::-1, ::-1])]
    assert min(away) < 0.7
    assert find_grid(image, 4, 7).shape == (7, 4, 2)
    assert find_grid(image, 6, 4) is None
    u, v = truth[1, 3].round().astype(int)
    assert find_grid(cv2.circle(image, (int(u), int(v)), 8, 128, -1), 7, 4) is None


def test_places_like_corners_are_counted_above_the_noise():
    flat = np.pad(np.kron(np.indices((5, 8)).sum(0) % 2, np.full((20, 20), 40.0)) + 80.0, 70, constant_values=100.0)
    noise = np.random.default_rng(1).normal(0.0, 1.0, flat.shape)
    board, empty = (np.rint(image + noise).astype(np.uint8) for image in (flat, np.full_like(flat, 100.0)))
    assert count_crossings(board, 10.0) == 28
    assert count_crossings(board, 60.0) == 0
    assert count_crossings(empty, 10.0) == 0
    assert count_crossings(empty[:10], 0.0) == 0


@pytest.mark.parametrize("noise", [1.0, 5.0, 20.0])
def test_where_nothing_looks_like_corners_no_finder_looks_longer(monkeypatch, noise):
    def asked(*given, **options):
        raise AssertionError("asked")

    monkeypatch.setattr("survey.detection.checkerboard.cv2.findChessboardCorners", asked)
    monkeypatch.setattr("survey.detection.checkerboard.cv2.findChessboardCornersSB", asked)
    ramp = np.linspace(100.0, 120.0, 640) + np.random.default_rng(1).normal(0.0, noise, (512, 640))
    found = detect_image(np.clip(np.rint(ramp), 0.0, 255.0).astype(np.uint8), BOARD)
    assert not len(found)
    assert found.reason == "no complete board of 8 x 5 inner corners"


@pytest.mark.parametrize(
    ("z", "tilt", "blur_px", "noise"), [(2.2, 0.0, 0.4, 1.0), (0.5, 1.1, 0.7, 4.0), (0.6, 0.3, 4.0, 2.0)]
)
def test_small_tilted_and_blurred_boards_are_still_looked_for(z, tilt, blur_px, noise):
    image = render(CAMERA, [placed(BOARD, (tilt, 0.1, 0.3), z)], imaging=Imaging(blur_px, noise), seed=1)
    low = np.rint(100.0 + 0.1 * image).astype(np.uint8)
    assert len(detect_image(image, BOARD)) > 30
    assert len(detect_image(low, BOARD)) > 30
