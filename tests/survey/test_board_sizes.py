"""Boards that are not of the size that was declared."""

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.native.vision import of_neighbours
from survey.detection import detect_image
from survey.detection.corners import grown
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.detecting.job import detect_job
from survey.project.targets import Checkerboard
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render
from tests.data import data_folder

pytestmark = pytest.mark.slow

CAMERA = BrownCamera((640, 480), 800.0, 800.0, 319.5, 239.5, (-0.25, 0.06, 1e-3, -5e-4))
SMALL = BrownCamera((400, 300), 500.0, 500.0, 199.5, 149.5, CAMERA.distortion)
PROJECT = """
format = 1
[cameras.c]
station = "tripod"
image_size_px = [400, 300]
lens = { model = "brown", free = ["fx", "fy", "u0", "v0"] }
[stations.tripod]
world_from_station = { treatment = "held" }
[targets.board]
kind = "checkerboard"
columns = COLUMNS
rows = ROWS
square_mm = 20
motion = "epoch"
"""


def placed(board, turn=(0.2, -0.25, 0.3), at=(0.0, 0.0, 0.42)):
    R = Rot3.RzRyRx(*turn)
    return PlacedTarget(board, Pose3(R, np.array(at) - R.matrix() @ board.points()[1].mean(0)))


def image_of(*views, seed=0, background=128.0, camera=CAMERA):
    return render(camera, views, imaging=Imaging(0.7, 2.0, background), seed=seed)


@pytest.mark.parametrize("declared", [(7, 6), (9, 5), (5, 4), (8, 6)])
@pytest.mark.parametrize("name", ["left01.jpg", "left06.jpg", "right09.jpg"])
def test_a_part_of_a_larger_board_is_not_taken_for_the_board(name, declared):
    image = cv2.imread(str(data_folder("calibration", "opencv_samples") / name))
    found = detect_image(image, Checkerboard(*declared, 0.025))
    assert len(found) == 0
    if found.other_size is not None:
        assert "goes on" in found.reason


@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.3, 0.4, -0.5), (-0.4, 0.1, 1.4)])
def test_a_grid_is_continued_to_the_edge_of_its_board_and_not_beyond(turn):
    board = Checkerboard(9, 6, 0.02)
    view = placed(board, turn)
    image = image_of(view).astype(np.float32)
    uv = CAMERA.project(np.array([view.camera_from_target.transformFrom(p) for p in board.points()[1]]))
    grid = uv.reshape(6, 9, 2)
    for part in (grid, grid[1:5, 2:6], grid[:3, :4], grid[2:, 3:]):
        whole = grown(image, part, 190.0)
        assert whole.shape == grid.shape
        assert np.abs(whole - grid).max() < 0.5
        assert of_neighbours(image, part, 190.0)
    assert not of_neighbours(image, grid[::2], 190.0)
    assert not of_neighbours(image, np.stack([[grid[j + i, 2 * i] for i in range(4)] for j in range(3)]), 190.0)


def test_what_stands_beside_a_board_does_not_make_it_larger():
    board = Checkerboard(8, 5, 0.02)
    alone = detect_image(image_of(placed(board, (0, 0, 0.1))), board)
    # a board of another pitch and one half a square off touch it; a striped and a noisy wall are behind it
    others = [
        placed(Checkerboard(5, 8, 0.015), (0, 0, 0.1), (0.155, 0.01, 0.421)),
        placed(Checkerboard(9, 2, 0.02), (0, 0, 0.1), (0.005, 0.1, 0.421)),
    ]
    crowded = image_of(placed(board, (0, 0, 0.1)), *others)
    assert len(detect_image(crowded, board)) == len(alone) == 40
    u = np.arange(640)
    for wall in (
        127 + 100 * np.sign(np.sin(u / 8.0))[None, :] + np.zeros((480, 1)),
        np.random.default_rng(0).uniform(0, 255, (480, 640)),
    ):
        image = image_of(placed(board, (0, 0, 0.1)), background=-1e4)
        mixed = np.where(image == 0, wall, image).astype(np.uint8)
        found = detect_image(mixed, board)
        assert len(found) == 40
        assert found.other_size is None


def test_the_board_looked_for_is_found_beside_a_larger_one():
    small, large = Checkerboard(6, 3, 0.02), Checkerboard(9, 4, 0.02)
    views = placed(large, (0, 0, 0), (0.0, -0.08, 0.5)), placed(small, (0, 0, 0.05), (0.0, 0.09, 0.5))
    found = detect_image(image_of(*views), small)
    assert len(found) == 18
    assert found.uv[:, 1].min() > 240


def test_columns_and_rows_interchanged_are_the_same_board_turned():
    image = image_of(placed(Checkerboard(9, 6, 0.02)))
    a, b = (detect_image(image, Checkerboard(c, r, 0.02)) for c, r in ((9, 6), (6, 9)))
    assert len(a) == len(b) == 54
    distance = np.linalg.norm(a.uv[:, None] - b.uv[None], axis=2)
    assert distance.min(1).max() < 1e-3
    # right-handed both: one order is the other turned, not mirrored
    grid = b.uv.reshape(9, 6, 2)
    assert np.linalg.det([grid[0, 1] - grid[0, 0], grid[1, 0] - grid[0, 0]]) > 0


def project(folder, columns, rows, n=2):
    (folder / "images" / "c").mkdir(parents=True)
    (folder / "survey.toml").write_text(PROJECT.replace("COLUMNS", str(columns)).replace("ROWS", str(rows)))
    for k in range(n):
        view = placed(Checkerboard(9, 6, 0.02), (0.3 * (k % 2), 0.2 * (k // 2), 0.1 * k))
        cv2.imwrite(str(folder / "images" / "c" / f"e{k}.png"), image_of(view, seed=k, camera=SMALL))
    return folder


@pytest.mark.parametrize(
    ("columns", "rows", "says"),
    [(10, 7, (9, 6)), (7, 10, (6, 9)), (8, 5, (9, 6)), (9, 7, (9, 6)), (9, 5, (9, 6)), (8, 6, (9, 6)), (8, 7, (9, 6))],
)
def test_a_wrong_size_is_said_once_with_the_keys_to_change(tmp_path, columns, rows, says):
    with pytest.raises(SurveyError) as error:
        detect_job(project(tmp_path / "lab", columns, rows, 3 if columns == 8 else 1), jobs=1, progress=False)
    assert str(error.value).count("\n") == 0
    assert f"[targets.board] says columns = {columns}, rows = {rows}" in str(error.value)
    assert f"set columns = {says[0]}, rows = {says[1]}" in str(error.value)


def test_a_second_board_of_another_size_is_no_wrong_size(tmp_path):
    lab = project(tmp_path / "lab", 9, 6, 1)
    with open(lab / "survey.toml", "a") as file:
        file.write('[targets.part]\nkind = "checkerboard"\ncolumns = 7\nrows = 6\nsquare_mm = 20\nmotion = "epoch"\n')
    outcome = detect_job(lab, jobs=1, progress=False)
    assert outcome.wrong_sizes == {}
    assert outcome.summary()["image_points"] == 54


def test_a_wrong_size_is_said_at_every_adjustment(tmp_path):
    """Where another board was found, the images are not looked at again."""
    lab = project(tmp_path / "lab", 9, 6)
    held = 'station_from_camera = { treatment = "held" }\n[stations'
    toml = (lab / "survey.toml").read_text().replace("[stations", held)
    (lab / "survey.toml").write_text(toml)
    with open(lab / "survey.toml", "a") as file:
        file.write('[targets.small]\nkind = "checkerboard"\ncolumns = 7\nrows = 5\nsquare_mm = 20\nmotion = "epoch"\n')
    view = placed(Checkerboard(7, 4, 0.02), (0.1, 0.2, 0.1))
    cv2.imwrite(str(lab / "images" / "c" / "s1.png"), image_of(view, camera=SMALL))
    text = "survey.toml: [targets.small] says columns = 7, rows = 5, but the images show a board of 7 x 4 inner corners"
    for _ in range(2):
        said = [w for w in adjust_job(lab, progress=False).adjustment.warnings if w.startswith("detection")]
        assert len(said) == 1
        assert text in said[0]
