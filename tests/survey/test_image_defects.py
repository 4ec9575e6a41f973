"""Raw mosaics, interlaced fields and motion are measured in rendered images, told with a number, and else never."""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.diagnosis.hypothesis import LeaveOut
from adjust.model.errors import SurveyError
from survey.cli import main
from survey.detection import detect_image
from survey.detection.defects import bayer_mosaic, image_defect, interlaced_fields, motion_blur
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.detecting.image_defects import blurred
from survey.jobs.detecting.job import detect_job
from survey.planning.checking import check_job
from survey.project.detected import DetectedImage
from survey.project.targets import Charuco, Checkerboard
from survey.report.language import message, speaking
from survey.simulate import stereo
from survey.simulate.rendering import BrownCamera, Imaging, PlacedTarget, render
from tests.data import data_folder

CAMERA = BrownCamera((400, 300), 500.0, 500.0, 199.5, 149.5, (-0.25, 0.06, 1e-3, -5e-4))
BOARD = Checkerboard(8, 5, 0.02)
PX = 0.42 / 500.0  # m at the board
VIEWS = [(0.2, -0.25, 0.3), (0.0, 0.0, 0.0), (-0.4, 0.3, 0.8)]


def image_of(turn=VIEWS[0], by=(0.0, 0.0), seed=0, blur=0.7, noise=2.0, board=BOARD):
    """(300, 400) of a board moved by so many px."""
    R = Rot3.RzRyRx(*turn)
    at = np.array([by[0] * PX, by[1] * PX, 0.42]) - R.matrix() @ board.points()[1].mean(0)
    return render(CAMERA, [PlacedTarget(board, Pose3(R, at))], imaging=Imaging(blur, noise), seed=seed)


def mosaic(image, red, blue):
    """As a sensor gives it whose red and blue pixels are so much darker than the green ones."""
    out = image.astype(np.float32)
    out[::2, ::2] *= red
    out[1::2, 1::2] *= blue
    return np.rint(out)


def fields(shift, turn=VIEWS[0]):
    """Odd rows of a later moment, by so many px."""
    out = image_of(turn, seed=1).astype(np.float32)
    out[1::2] = image_of(turn, shift, seed=2)[1::2]
    return out


def moving(length, angle_deg, turn=VIEWS[0], noise=2.0):
    """Exposed while the board moved."""
    along = length * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    clear = np.mean([image_of(turn, t * along, noise=0.0) for t in np.linspace(-0.5, 0.5, 13)], axis=0)
    return np.rint(clear + noise * np.random.default_rng(5).standard_normal(clear.shape)).astype(np.float32)


@pytest.mark.parametrize(("red", "blue"), [(0.92, 0.95), (0.8, 0.9), (0.5, 0.7)])
@pytest.mark.parametrize("turn", VIEWS)
def test_a_mosaic_is_measured(red, blue, turn):
    found = bayer_mosaic(mosaic(image_of(turn), red, blue))
    assert found.kind == "bayer mosaic"
    assert found.size == pytest.approx((1.0 - min(red, blue)) / (2.0 + red + blue) * 2.0, rel=0.05)
    assert found.p < 1e-20


@pytest.mark.parametrize("shift", [(0.5, 0.0), (2.0, 0.0), (9.0, 0.0), (0.0, 0.5)])
@pytest.mark.parametrize("turn", VIEWS)
def test_the_shift_between_fields_is_measured(shift, turn):
    found = interlaced_fields(fields(shift, turn))
    assert found.size == pytest.approx(np.hypot(*shift), rel=0.1, abs=5.0 * found.sigma)
    assert image_defect(fields(shift, turn)).kind == "interlaced"


@pytest.mark.parametrize("length", [4.0, 7.0, 11.0])
@pytest.mark.parametrize("along", [0, 90])
def test_motion_along_the_edges_is_measured(length, along):
    turn = (0.1, -0.2, 0.0)
    found = motion_blur(moving(length, along, turn))
    assert found.size == pytest.approx(length, rel=0.15)
    angle = float(re.search(r"along (\d+) deg", found.text).group(1))
    assert abs((angle - along + 90.0) % 180.0 - 90.0) < 5.0


@pytest.mark.parametrize("board", [BOARD, Charuco(9, 6, 0.02, 0.015, "4X4_50")])
@pytest.mark.parametrize("blur", [0.5, 1.0, 2.5])
def test_good_images_are_not_blamed(board, blur):
    for i, turn in enumerate(VIEWS):
        assert image_defect(image_of(turn, blur=blur, seed=i, board=board).astype(np.float32)) is None


@pytest.mark.slow
@pytest.mark.parametrize("lamps", [0, 4])
def test_images_of_noise_and_a_few_lamps_are_not_blamed(lamps):
    """Rows of noise fit others no better anywhere: whole pixels between fields are found where something is seen."""
    dark = np.full((640, 640), 40.0)
    for at in ((120, 200), (121, 420), (402, 311), (533, 100))[:lamps]:
        cv2.circle(dark, at, 6, 230.0, -1)
    lit = cv2.GaussianBlur(dark, (0, 0), 1.0)
    for seed in range(12):
        image = np.rint(lit + np.random.default_rng(seed).normal(0.0, 2.0, lit.shape)).astype(np.float32)
        assert image_defect(image) is None


def test_real_photographs_are_not_blamed():
    folder = data_folder("calibration", "opencv_samples")
    for path in sorted(folder.glob("*0[1-5].jpg")):
        assert image_defect(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE).astype(np.float32)) is None


@pytest.mark.parametrize("gains", [np.ones((2, 2)), [[1.0, 1.06], [1.0, 1.06]], [[1.0, 1.0], [1.06, 1.06]]])
def test_patterns_of_columns_and_rows_are_no_mosaic(gains):
    """Those of amplifiers: other than two greens."""
    noise = np.random.default_rng(4).standard_normal((200, 200))
    gray = (120.0 + 8.0 * noise) * np.tile(gains, (100, 100))
    assert bayer_mosaic(gray.astype(np.float32)) is None


def test_what_they_do_to_corners():
    """Those of fields lie between; those of a mosaic are half as good, and of a stronger one are not found."""
    good, half = detect_image(image_of(), BOARD), detect_image(fields((2.0, 0.0)), BOARD)
    assert (half.uv - good.uv)[:, 0].mean() == pytest.approx(1.0, abs=0.25)
    spoilt = detect_image(mosaic(image_of(), 0.8, 0.9).astype(np.uint8), BOARD)
    assert np.median(spoilt.cov[:, 0, 0]) > 2.0 * np.median(good.cov[:, 0, 0])
    assert len(detect_image(mosaic(image_of(), 0.5, 0.7).astype(np.uint8), BOARD)) == 0


PROJECT = """
format = 1
[cameras.c]
station = "tripod"
image_size_px = [400, 300]
lens = { model = "brown", free = ["fx", "fy", "u0", "v0"] }
station_from_camera = { treatment = "held" }
[stations.tripod]
world_from_station = { treatment = "held" }
[targets.board]
kind = "checkerboard"
columns = 8
rows = 5
square_mm = 20
motion = "epoch"
"""


def project(folder, images):
    (folder / "images" / "c").mkdir(parents=True)
    (folder / "survey.toml").write_text(PROJECT)
    for i, image in enumerate(images):
        cv2.imwrite(str(folder / "images" / "c" / f"e{i + 1}.png"), np.asarray(image, np.uint8))
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(("make", "kind", "number"), [
    (lambda turn: mosaic(image_of(turn), 0.7, 0.85), "bayer mosaic", "17 %"),
    (lambda turn: fields((2.0, 0.0), turn), "interlaced", "(+"),
])  # fmt: skip
def test_told_by_detect_check_and_adjust(tmp_path, make, kind, number):
    turns = [*VIEWS, (0.4, -0.1, 0.1), (-0.1, -0.45, -0.2)]
    lab = project(tmp_path / "lab", [make(turn) for turn in turns])
    found = detect_job(lab, jobs=1, progress=False)
    (line,) = found.defects
    assert line.startswith("images/c/e1: ")
    assert kind in line.lower()
    assert number in line
    assert "alike: c/e2" in line
    assert line in found.summary()["warnings"]
    (finding,) = [f for f in check_job(lab).beforehand.findings if f.kind == kind]
    assert finding.ids == tuple(f"c/e{i + 1}" for i in range(len(turns)))
    assert f"detection: {line}" in adjust_job(lab, progress=False).adjustment.warnings


@pytest.mark.slow
def test_told_where_nothing_can_be_found(tmp_path):
    """A comb that leaves no corner."""
    lab = project(tmp_path / "lab", [fields((18.0, 0.0), (0.0, 0.0, 0.0))])
    with pytest.raises(SurveyError, match="interlaced"):
        detect_job(lab, jobs=1, progress=False)


@pytest.mark.slow
def test_blurred_images_are_left_out_and_taken_back(tmp_path, capsys):
    """One of six: offered by number, a row of exclusions.csv, offered no more; of most of them it is no remedy."""
    turns = [(0.1, -0.2, 0.0), *VIEWS, (0.4, -0.1, 0.1), (-0.1, -0.45, -0.2)]
    good = [image_of(turn, noise=0.5, seed=i) for i, turn in enumerate(turns)]
    lab = project(tmp_path / "lab", [moving(5.0, 0, turns[0]), *good[1:]])

    def told():
        main(["adjust", str(lab), "--quiet"])
        lines = capsys.readouterr().out.splitlines()
        return [line.partition("  #")[0] for line in lines if "! detection: " in line]

    (line,) = told()
    number = re.search(r"--try (\d+)$", line).group(1)
    with speaking("de"):
        assert message(line.strip("! ")).endswith(f"wo die anderen genügen; --try {number}")
    main(["adjust", str(lab), "--quiet", "--try", number])
    assert "image,c/e1,excluded" in (lab / "observations" / "exclusions.csv").read_text()
    capsys.readouterr()
    assert not any("--try" in line for line in told())
    main(["include", str(lab), "image:c/e1", "--reason", "again"])
    capsys.readouterr()
    assert told() == [line]


def test_what_leaves_no_camera_is_not_offered():
    survey, _ = stereo(3, n_pairs=3)
    keys = [(b.camera_id, b.epoch_id) for b in survey.image_blocks if b.camera_id == "left"]
    texts = {k: DetectedImage("", "", 0, 0, 0, defect="motion blur: wide" if k in keys[:2] else "") for k in keys}
    assert not blurred(survey, texts)
    assert blurred(survey, {k: texts[k] for k in keys[1:]})[0].edits == (LeaveOut((f"image:left/{keys[1][1]}",)),)
    mosaics = {keys[0]: replace(texts[keys[0]], defect="a raw Bayer mosaic")}
    assert not blurred(survey, mosaics)
