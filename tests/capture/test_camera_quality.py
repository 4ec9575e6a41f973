import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from capture.devices.camera import Frame
from capture.session.quality import edge_blur_px, image_quality
from survey.project.captured import Coverage
from survey.project.targets import Checkerboard
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render

BOARD = Checkerboard(11, 8, 0.02)
POSE = Pose3(Rot3.RzRyRx(0.3, 0.2, 0.4), [-0.1, -0.08, 0.7])
CAMERA = BrownCamera((640, 512), 800.0, 800.0, 320.0, 256.0)


def frame_of(image: np.ndarray, bits: int = 8) -> Frame:
    return Frame(image, 1, 0, 0, "S", bits)


def board(scale: int = 1, **imaging: float) -> np.ndarray:
    camera = BrownCamera((640 * scale, 512 * scale), 800.0 * scale, 800.0 * scale, 320.0 * scale, 256.0 * scale)
    return render(camera, [PlacedTarget(BOARD, POSE)], imaging=Imaging(**imaging))


@pytest.mark.slow
@pytest.mark.parametrize("blur_px", [0.8, 1.5, 3.0])
@pytest.mark.parametrize("noise", [0.0, 4.0])
@pytest.mark.parametrize("slope", [0.0, 0.3])
def test_blur_of_an_edge_by_opencv(blur_px: float, noise: float, slope: float) -> None:
    v, u = np.mgrid[0:1200, 0:1200].astype(np.float32)
    sharp = np.where(u - 600.0 + slope * (v - 600.0) > 0.0, 200.0, 40.0).astype(np.float32)
    fine = cv2.GaussianBlur(sharp, (0, 0), 4.0 * blur_px)  # in quarters of a pixel, then whole ones by the mean
    gray = cv2.resize(fine, (300, 300), interpolation=cv2.INTER_AREA)
    gray += np.random.default_rng(1).normal(0.0, noise, gray.shape).astype(np.float32)
    expected = np.sqrt(blur_px**2 + 1.0 / 12.0)  # a pixel is a mean over its width
    assert edge_blur_px(gray) == pytest.approx(expected, rel=0.08)


def test_blur_ranks_images_of_a_board() -> None:
    found = [image_quality(frame_of(board(blur_px=b))).blur_px for b in (0.6, 0.9, 1.5, 2.5)]
    assert found == pytest.approx([0.6, 0.9, 1.5, 2.5], rel=0.2)


def test_no_edges_no_blur() -> None:
    noise = np.random.default_rng(1).normal(100.0, 4.0, (200, 300)).astype(np.float32)
    assert np.isnan(edge_blur_px(noise))
    assert np.isnan(edge_blur_px(np.full((200, 300), 7.0, np.float32)))


@pytest.mark.parametrize(("bits", "kind"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_light(bits: int, kind: type) -> None:
    full = 2**bits - 1
    image = np.full((100, 200), full // 5, kind)
    image[:10, :50] = full
    quality = image_quality(frame_of(image, bits))
    assert quality.saturated == pytest.approx(0.025)
    assert quality.brightness == pytest.approx(0.2 * 0.975 + 0.025, abs=1e-2)
    assert quality.peak == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1, 2])
def test_the_target_is_found_where_it_is(scale: int) -> None:
    other = Checkerboard(14, 10, 0.02)
    quality = image_quality(frame_of(board(scale, blur_px=0.9 * scale)), {"board": BOARD, "other": other})
    assert [target_id for target_id, uv in quality.points.items() if len(uv)] == ["board"]
    x = POSE.transformFrom(np.ascontiguousarray(BOARD.points()[1].T)).T
    expected = (CAMERA.project(x) + 0.5 if scale == 1 else CAMERA.project(x) * scale + 0.5) - 0.5
    np.testing.assert_allclose(quality.points["board"], expected, atol=0.3 * scale)
    assert len(quality.points["other"]) == 0


def test_coverage_counts_cells() -> None:
    coverage = Coverage((100, 80), (10, 8))
    more = coverage.with_points(np.array([[-0.5, -0.5], [9.4, 9.4], [9.6, 0.0], [99.4, 79.4], [200.0, 3.0]]))
    assert more.hit == {(0, 0), (1, 0), (9, 7)}
    assert more.share == pytest.approx(3 / 80)
    assert more.with_points(np.array([[1.0, 1.0]])) == more
    assert coverage.share == 0.0
