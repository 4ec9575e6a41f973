"""From the image files of a real stereo rig to an adjusted survey with a report, against OpenCV on the same corners."""

import csv
import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from survey.cli import main
from tests.data import data_folder

SIZE = (640, 480)
SQUARE = 0.025
SIDES = ("left", "right")
TOML = """format = 1
title = "OpenCV's stereo samples"
{cameras}
[stations.rig]
motion = "fixed"
world_from_station = {{ treatment = "held" }}

[targets.board]
kind = "checkerboard"
columns = 9
rows = 6
square_mm = 25.0
motion = "epoch"

[sigmas]
image_px = 0.15

[adjustment]
reject_points = {reject}
"""
CAMERA = """
[cameras.{side}]
station = "rig"
image_size_px = [640, 480]
{held}
[cameras.{side}.lens]
model = "brown"
free = ["fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3"]
"""
HELD = 'station_from_camera = { treatment = "held" }'


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A project with the real images, as a user would lay it out."""
    source, folder = data_folder("calibration", "opencv_samples"), tmp_path_factory.mktemp("stereo")
    for side in SIDES:
        (folder / "images" / side).mkdir(parents=True)
        for path in sorted(source.glob(f"{side}[0-9][0-9].jpg")):
            shutil.copy(path, folder / "images" / side / f"e{path.stem[-2:]}.jpg")
    _write_definition(folder, "true")
    return folder


def _write_definition(folder: Path, reject: str) -> None:
    cameras = "".join(CAMERA.format(side=side, held=HELD if side == "left" else "") for side in SIDES)
    (folder / "survey.toml").write_text(TOML.format(cameras=cameras, reject=reject))


def _solution(folder: Path) -> dict:
    return json.loads((folder / "results" / "solution.json").read_text())


def _corners(folder: Path) -> dict[tuple[str, str], np.ndarray]:
    with (folder / "observations" / "image_points.csv").open() as file:
        rows = list(csv.DictReader(file))
    found: dict[tuple[str, str], dict[tuple[int, int], tuple[float, float]]] = {}
    for row in rows:
        r, c = row["point_id"][1:].split("c")
        points = found.setdefault((row["camera_id"], row["epoch_id"]), {})
        points[int(r), int(c)] = float(row["u_px"]), float(row["v_px"])
    return {key: np.array([points[r, c] for r in range(6) for c in range(9)]) for key, points in found.items()}


def test_images_to_report(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["adjust", str(folder), "--quiet"]) in (0, 3)
    assert "sigma0" in capsys.readouterr().out
    solution = _solution(folder)
    assert solution["summary"]["converged"]
    assert len(_corners(folder)) == 26
    for side in SIDES:
        lens = solution["cameras"][side]["lens"]
        assert lens["sigma_fx_px"] > 0.0
        assert abs(lens["fx_px"] - 535.0) < 6.0  # OpenCV's own calibrations of these images: 534 to 536 px
    assert (folder / "results" / "report.html").stat().st_size > 50_000


def test_same_corners_with_equal_weights_give_opencvs_result(folder: Path) -> None:
    """Joint adjustment of both lenses, the pair and all boards: the minimum that stereoCalibrate looks for."""
    if not (folder / "observations" / "image_points.csv").exists():
        main(["detect", str(folder), "--quiet"])
    corners = _corners(folder)
    equal = folder.parent / "equal"
    shutil.copytree(folder, equal, dirs_exist_ok=True)
    _write_definition(equal, "false")
    with (equal / "observations" / "image_points.csv").open("w") as file:
        file.write("epoch_id,camera_id,target_id,point_id,u_px,v_px\n")
        for (side, epoch), uv in corners.items():
            for i, (u, v) in enumerate(uv):
                file.write(f"{epoch},{side},board,r{i // 9}c{i % 9},{float(u)!r},{float(v)!r}\n")
    main(["adjust", str(equal), "--quiet"])
    solution = _solution(equal)
    epochs = sorted({e for _, e in corners})
    board = np.array([(c * SQUARE, r * SQUARE, 0.0) for r in range(6) for c in range(9)], np.float32)
    left, right = ([corners[s, e].astype(np.float32) for e in epochs] for s in SIDES)
    start = [cv2.calibrateCamera([board] * len(epochs), uv, SIZE, None, None)[1:3] for uv in (left, right)]
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 500, 1e-15)
    _, k1, d1, k2, d2, r, t, *_ = cv2.stereoCalibrate(
        [board] * len(epochs), left, right, *start[0], *start[1], SIZE, flags=cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=criteria,
    )  # fmt: skip
    names = ("fx_px", "fy_px", "u0_px", "v0_px", "k1", "k2", "p1", "p2", "k3")
    for side, k, d in (("left", k1, d1), ("right", k2, d2)):
        lens = solution["cameras"][side]["lens"]
        theirs = np.array([k[0, 0], k[1, 1], k[0, 2], k[1, 2], *d.ravel()[:5]])
        ours = np.array([lens[name] for name in names])
        sigma = np.array([lens[f"sigma_{name}"] for name in names])
        assert np.abs((ours - theirs) / sigma).max() < 0.02  # corners reach OpenCV as float32, and it stops early
    pose = solution["cameras"]["right"]["station_from_camera"]
    left_from_right = -r.T @ t.ravel()
    assert np.allclose(pose["translation_mm"], 1e3 * left_from_right, atol=0.02 * max(pose["sigma_translation_mm"]))
