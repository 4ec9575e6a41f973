"""DBAT's scripts and AICON's files: what becomes free, held and seen."""

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.interop.photogrammetry.aicon import SIGMA_MM, read_aicon
from survey.interop.photogrammetry.dbat import read_dbat
from survey.project import read
from tests.acceptance.published import dbat_survey
from tests.data import data_folder
from tests.survey.interop_samples import AICON, DBAT, DBAT_FILES


def _dbat(tmp_path, text=DBAT, **files):
    (tmp_path / "net.xml").write_text(text, encoding="utf-8")
    for name, content in (DBAT_FILES | {f"{k}.txt": v for k, v in files.items()}).items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    return read_dbat(tmp_path / "net.xml")


def _aicon(tmp_path, **files):
    for name, content in (AICON | {f"net.{k}": v for k, v in files.items()}).items():
        (tmp_path / name).write_text(content, encoding="utf-8")
    return read_aicon(tmp_path / "net.phc")


def test_dbat_script(tmp_path):
    network = _dbat(tmp_path)
    survey = network.survey
    assert survey.cameras[0].lens.free == ("c", "as", "K1", "K2")
    assert survey.cameras[0].lens.pixel_size_mm == pytest.approx(0.004)
    np.testing.assert_allclose(survey.cameras[0].lens.values[:3], [8, 3.2, 2.4])
    points = {p.point_id: p.x_in_world for p in survey.points}
    # point 9 is seen once; control point 2 is not seen
    assert list(points) == ["1", "7"]
    assert points["1"].treatment == "held"
    assert [b.epoch_id for b in survey.image_blocks] == ["one", "two"]
    np.testing.assert_allclose(survey.image_blocks[0].uv, [[100.5, 200.25], [300, 400]])
    np.testing.assert_allclose(survey.image_blocks[0].cov[1], np.eye(2) * 0.04)
    assert "fewer than 2 images: 1" in network.notes[0]


def test_dbats_calibration_is_the_one_of_the_published_inputs():
    folder = data_folder("calibration", "dbat_camcal")
    ours, known = read_dbat(folder / "camcaldemo/camcaldemo.xml").survey, dbat_survey(folder)
    assert ours.cameras[0].lens.free == known.cameras[0].lens.free
    np.testing.assert_allclose(ours.cameras[0].lens.values, known.cameras[0].lens.values, rtol=1e-14)
    seen = [{(b.epoch_id, s.points[i].point_id): tuple(uv) for b in s.image_blocks
             for i, uv in zip(b.point_idx, b.uv, strict=True)} for s in (ours, known)]  # fmt: skip
    assert seen[0] == seen[1]
    held = [{p.point_id: tuple(p.x_in_world.value) for p in s.points if p.x_in_world.treatment == "held"}
            for s in (ours, known)]  # fmt: skip
    assert held[0] == held[1]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (">points.txt<", ">../points.txt<", "line 7.*is not inside the script's folder"),
        ("<model>3</model>", "<model>5</model>", "only lens model 3"),
        ('format="im,id,x,y,sxy"', 'format="im,id,x,y"', "points.txt, line 1: found 5 fields, the format has 4"),
        ("<sensor>auto,4.8</sensor>", "<sensor>auto,auto</sensor>", "gives no square pixels"),
        ("<skew>false</skew>", "<skew>true</skew>", "skew is to be estimated"),
    ],
)
def test_bad_scripts_are_named(tmp_path, old, new, message):
    assert DBAT.count(old) == 1
    with pytest.raises(SurveyError, match=message):
        _dbat(tmp_path, DBAT.replace(old, new))


def test_aicon_files(tmp_path):
    network = _aicon(tmp_path)
    survey = network.survey
    assert [p.point_id for p in survey.points] == ["5", "8"]
    np.testing.assert_allclose(survey.points[0].x_in_world.value, [0.573, -0.0494, -0.1217])
    camera = survey.cameras[0]
    assert (camera.image_size, camera.lens.balance_radius_mm) == ((9000, 6000), 13.5)
    assert camera.lens.free == ("ck", "xh", "yh", "A1", "A2", "B1", "B2")
    # 7.2 mm right and 3.6 mm up of the centre, with pixels of 4 micrometres
    block = survey.image_blocks[0]
    np.testing.assert_allclose(block.uv[0], [4499.5 + 1800, 2999.5 - 900])
    np.testing.assert_allclose(block.cov[0], np.eye(2) * (SIGMA_MM / 0.004) ** 2)
    assert (survey.distances[0].value, survey.distances[0].sigma) == pytest.approx((1.389688, 1e-5))
    # the axis of the camera points to the scene: -z of the photogrammetrist's frame
    R = survey.stations[0].epochs["1"].value.rotation().matrix()
    omega, phi = 1.38, 0.65
    np.testing.assert_allclose(R[:, 2], [-np.sin(phi), np.sin(omega) * np.cos(phi), -np.cos(omega) * np.cos(phi)])
    assert survey.datum.kind == "inner"
    assert not network.reject
    assert "no report" in network.notes[0]


@pytest.mark.parametrize(
    ("ending", "text", "message"),
    [
        ("ior", "1 -999 28.8 0 0 0 0 13\n0\n0 0\n0 0\n36 24 9000 6000\n", "ck is negative"),
        ("ior", "1 -999 -28.8 0 0 0 0 13\n0\n0 0\n", "found 3 lines; a camera has five"),
        ("eor", "1 2 0 0 0 0 0 0\n", "line 1: camera 2 is not in the .ior file"),
        ("scale", "0 bar 5 8 1.0 0.1\n", "line 1: expected a number"),
        ("scale", '0 "bar" 5 77 1.0 0.1\n', "line 1: point '77' has no image points"),
        ("phc", "1 5 7.2\n", "line 1: found 3 words"),
    ],
)
def test_bad_aicon_files_are_named(tmp_path, ending, text, message):
    with pytest.raises(SurveyError, match=message):
        _aicon(tmp_path, **{ending: text})


def test_the_balance_radius_stands_in_the_project(tmp_path):
    from survey.cli import main

    _aicon(tmp_path)
    assert main(["convert", str(tmp_path / "net.phc"), str(tmp_path / "lab")]) == 0
    lens = read(tmp_path / "lab").survey.cameras[0].lens
    assert (lens.balance_radius_mm, lens.model) == (13.5, "aicon")
