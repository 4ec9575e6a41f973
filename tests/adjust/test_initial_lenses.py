"""Start values of lenses of every kind, and the start of a real bundle with four control points."""

import cv2
import numpy as np
import pytest

from adjust.model.errors import SurveyError
from adjust.model.observations import ImageBlock
from adjust.model.survey import Camera, LensParameter, Point, PointParameter, PoseParameter, Station, Survey, Tie
from adjust.start import find_start
from adjust.start.lens import search
from adjust.start.lens.search import LensSearch
from adjust.start.lens.start import remembering, start_lens
from adjust.start.views import Sighting
from tests.adjust.test_initial import FREE, SIZE, TRUE, assert_near, board_views, grid, inv, looking_at, pixels
from tests.data import data_folder


def sightings(rng, n, project, noise=0.1, **options):
    return [
        Sighting(i, grid(), project(m) + rng.normal(0, noise, (88, 2)))
        for i, m in enumerate(board_views(rng, n, **options))
    ]


def project(m):
    return pixels(grid(), m)


def test_a_fisheye_is_found_from_boards_near_its_edge():
    rng = np.random.default_rng(1)
    K, D = np.array([[420.0, 0, 650], [0, 422, 500], [0, 0, 1]]), np.array([0.03, -0.01, 0.002, 0.0])

    def fish(m):
        p = grid() @ m[:3, :3].T + m[:3, 3]
        return cv2.fisheye.projectPoints(p[:, None], np.zeros(3), np.zeros(3), K, D)[0][:, 0]

    from scipy.spatial.transform import Rotation

    images = []
    for i, m in enumerate(board_views(rng, 15, 0.25)):
        aside = np.eye(4)
        aside[:3, :3] = Rotation.from_rotvec([*rng.uniform(-0.6, 0.6, 2), 0]).as_matrix()
        images.append(Sighting(i, grid(), fish(aside @ m) + rng.normal(0, 0.1, (88, 2))))
    camera = Camera("f", "s", SIZE, LensParameter("fisheye", ("fx", "fy", "u0", "v0", "k1", "k2", "k3", "k4")))
    found = start_lens(camera, images)
    np.testing.assert_allclose(found.values[[0, 1, 3, 4]], [420, 422, 650, 500], atol=3)
    np.testing.assert_allclose(found.values[5:7], D[:2], atol=0.01)
    assert found.excluded == {}


@pytest.mark.parametrize("model", ["brown_backward", "brown_backward_dbat"])
def test_a_photogrammetric_lens_is_found_in_millimetres(model):
    square = np.array([[1600.0, 0, 632], [0, 1600, 522], [0, 0, 1]])

    def project(m):
        return cv2.projectPoints(grid(), cv2.Rodrigues(m[:3, :3])[0], m[:3, 3], square, np.array([-0.13, 0.05, 0, 0]))[
            0
        ][:, 0]

    images = sightings(np.random.default_rng(2), 12, project)
    names = {"brown_backward": ("c", "xp", "yp"), "brown_backward_dbat": ("c", "px", "py")}[model]
    camera = Camera("m", "s", SIZE, LensParameter(model, (*names, "K1", "K2", "P1", "P2"), pixel_size_mm=0.005))
    found = start_lens(camera, images).values
    assert found[0] == pytest.approx(1600 * 0.005, abs=0.06)
    centre = np.array([632 - 639.5, 511.5 - 522]) if model == "brown_backward" else np.array([632, 522.0])
    np.testing.assert_allclose(found[1:3], centre * 0.005, atol=0.06)
    # the backward correction undoes a forward k1: K1 = -k1 / c^2 to first order
    k1 = found[3] if model == "brown_backward" else found[4]
    assert k1 == pytest.approx(0.13 / 8.0**2, rel=0.4)


def test_one_image_gives_a_focal_length_and_leaves_the_centre():
    rng = np.random.default_rng(3)
    m = board_views(rng, 1)[0]
    m[:3, :3] = cv2.Rodrigues(np.array([0.6, 0.4, 0.1]))[0]
    m[:3, 3] = [0, 0, 0.4] - m[:3, :3] @ [0.1, 0.07, 0]
    camera = Camera("c", "s", SIZE, LensParameter("brown", FREE))
    found = start_lens(camera, [Sighting(0, grid(), pixels(grid(), m))]).values
    np.testing.assert_allclose(found[:2], 1598, rtol=0.06)
    np.testing.assert_allclose(found[3:5], [639.5, 511.5])


def test_ties_and_priors_are_respected():
    images = sightings(np.random.default_rng(4), 10, project)
    lens = LensParameter("brown", ("fx", "u0", "v0", "k1"), ties=(Tie("fy", "fx", 0.996875),))
    found = start_lens(Camera("c", "s", SIZE, lens), images).values
    assert found[1] / found[0] == pytest.approx(0.996875, abs=1e-12)
    assert found[0] == pytest.approx(1600, abs=8)
    assert found[6] == 0.0


def test_known_points_in_space_give_a_focal_length_by_trial():
    rng = np.random.default_rng(5)
    x = rng.uniform([-1, -0.8, -0.6], [1, 0.8, 0.6], (15, 3))
    m = looking_at(np.array([0.3, 0.2, -4.0]), (0, 0, 0))
    camera = Camera("c", "s", SIZE, LensParameter("brown", ("fx", "fy", "k1")), PoseParameter(treatment="held"))
    with pytest.raises(SurveyError, match="u0 is held but has no value"):
        start_lens(camera, [])
    camera = Camera("c", "s", SIZE, LensParameter("brown", FREE), PoseParameter(treatment="held"))
    points = tuple(Point(f"B{i}", PointParameter(v, "held")) for i, v in enumerate(x))
    block = ImageBlock("c", "e", None, np.arange(15), pixels(x, inv(m)), np.tile(np.eye(2) * 0.01, (15, 1, 1)))
    start = find_start(Survey((camera,), (Station("s"),), points=points, image_blocks=(block,)))
    assert start.lenses["c"][0] == pytest.approx(1600, rel=0.05)
    assert_near(start.poses[("world_from_station", "s")], m, 1.0, 200)


def test_mis_ordered_images_do_not_spoil_the_lens():
    rng = np.random.default_rng(6)
    images = sightings(rng, 20, project)
    for i in (3, 8, 15):
        images[i] = Sighting(i, grid(), images[i].uv.reshape(8, 11, 2).swapaxes(0, 1).reshape(-1, 2))
    found = start_lens(Camera("c", "s", SIZE, LensParameter("brown", FREE)), images)
    assert set(found.excluded) == {3, 8, 15}
    np.testing.assert_allclose(found.values[[0, 1, 3, 4]], TRUE[:4], atol=8)


def camcal():
    """DBAT's camera calibration demo: 21 images of 100 points, of which 1001-1004 are control points."""
    folder = data_folder("calibration", "dbat_camcal", "camcaldemo")
    rows = np.array(
        [
            [float(v) for v in line.split(",")]
            for line in (folder / "measurements" / "markpts.txt").read_text().splitlines()
            if line.strip() and not line.startswith("#")
        ]
    )
    control = {1001: (0, 1, 0), 1002: (1, 1, 0), 1003: (0, 0, 0), 1004: (1, 0, 0)}
    ids = [int(i) for i in np.unique(rows[:, 1])]
    points = tuple(
        Point(str(i), PointParameter(np.array(control[i], dtype=float), "held") if i in control else PointParameter())
        for i in ids
    )
    blocks = []
    for image in np.unique(rows[:, 0]):
        mine = rows[rows[:, 0] == image]
        idx = np.searchsorted(ids, mine[:, 1].astype(int))
        blocks.append(
            ImageBlock("c", f"{int(image)}", None, idx, mine[:, 2:4], np.tile(np.eye(2) * 0.01, (len(idx), 1, 1)))
        )
    size, pixel = (2272, 1704), 5.43764 / 1704
    values = np.zeros(9)
    values[:3] = 7.5, size[0] / 2 * pixel, size[1] / 2 * pixel
    lens = LensParameter(
        "brown_backward_dbat", ("c", "px", "py", "as", "K1", "K2", "K3", "P1", "P2"), values, None, (), pixel
    )
    camera = Camera("c", "s", size, lens, PoseParameter(treatment="held"))
    return Survey((camera,), (Station("s", "epoch"),), points=points, image_blocks=tuple(blocks)), folder


def test_a_real_bundle_starts_from_four_control_points():
    survey, folder = camcal()
    start = find_start(survey)
    assert start.excluded_blocks == ()
    assert len(start.points) == 100
    published = np.loadtxt(folder / "result" / "camera_stations.txt", delimiter=",", usecols=(0, 2, 3, 4))
    for number, *position in published:
        found = start.poses[("world_from_station", "s", f"{int(number)}")].translation()
        assert np.linalg.norm(found - position) < 0.15  # of some 1.6 m: the start knows nothing of the distortion
    # the sheet is flat
    assert max(abs(x[2]) for x in start.points.values()) < 0.05
    assert max(start.block_rms_px) < 15


def test_the_same_images_are_searched_once(monkeypatch):
    """Also under other numbers, with what was left out by these; what finds nothing is not searched again either."""
    rng = np.random.default_rng(2)
    camera = Camera("c", "s", SIZE, LensParameter("brown", FREE))
    images = sightings(rng, 6, project)
    images[2] = Sighting(2, images[2].x, images[2].uv[::-1])
    plain, ran = start_lens(camera, images), []
    run = LensSearch.run
    monkeypatch.setattr(LensSearch, "run", lambda *a: ran.append(1) or run(*a))
    with remembering():
        for first in (0, 10, 20):
            found = start_lens(camera, [Sighting(first + s.block_idx, s.x, s.uv) for s in images])
            np.testing.assert_array_equal(found.values, plain.values)
            assert list(found.excluded) == [first + i for i in plain.excluded]
            found.values[:] = 0.0
        assert len(ran) == 1
        for _ in range(2):
            with pytest.raises(SurveyError):
                start_lens(camera, [])
        assert len(ran) == 2
    start_lens(camera, images)
    assert len(ran) == 3


def test_values_that_were_known_before_save_the_scan(monkeypatch):
    """Where no closed form misses little; they are refined by the images as others are."""
    rng = np.random.default_rng(3)
    camera, images = Camera("c", "s", SIZE, LensParameter("brown", FREE)), sightings(rng, 8, project)
    best = start_lens(camera, images).values

    def none(*_):
        raise SurveyError("no closed form")

    monkeypatch.setattr(search, "pinhole_from_homographies", none)
    near = best.copy()
    near[:2] *= 1.03
    found = start_lens(camera, images, near=near)
    assert "known before" in found.note
    np.testing.assert_allclose(found.values[:2], best[:2], rtol=2e-3)
