"""Detection belongs to its images: what is new or changed is looked at, what people wrote stays."""

import json
import os
import shutil

import cv2
import numpy as np
import pytest

from survey.batch.cache import unchanged_solution
from survey.cli import main
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.detecting.job import detect_job
from survey.jobs.network import add_job
from survey.project import read
from survey.project.detected import read_detected

TOML = """format = 1
[cameras.C]
station = "S"
image_size_px = [400, 300]
station_from_camera = { treatment = "held" }
[cameras.C.lens]
model = "brown"
free = []
values = { fx = 420.0, fy = 420.0, u0 = 199.5, v0 = 149.5 }
[stations.S]
world_from_station = { treatment = "held" }
[targets.board]
kind = "checkerboard"
columns = 6
rows = 5
square_mm = 20.0
motion = "epoch"
"""


def draw(path, turn):
    """A board of 7 x 6 squares of 20 mm, 0.45 m before the camera, turned about an oblique axis by ``turn`` rad."""
    size = 40
    board = 255 * (1 - np.indices((6, 7)).sum(axis=0) % 2).astype(np.uint8)
    board = cv2.copyMakeBorder(
        np.kron(board, np.ones((size, size), np.uint8)), 40, 40, 40, 40, cv2.BORDER_CONSTANT, None, 255
    )
    R = cv2.Rodrigues(turn * np.array([0.8, 0.5, 0.1]))[0]
    K = np.array([[420.0, 0, 199.5], [0, 420.0, 149.5], [0, 0, 1]])
    metres = np.array([[0.02 / size, 0, -0.09], [0, 0.02 / size, -0.08], [0, 0, 1]])
    H = K @ np.column_stack([R[:, 0], R[:, 1], [0.0, 0.0, 0.45]]) @ metres
    big = cv2.warpPerspective(board, np.diag([4.0, 4.0, 1.0]) @ H, (1600, 1200), borderValue=255, flags=cv2.INTER_AREA)
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), cv2.GaussianBlur(cv2.resize(big, (400, 300), interpolation=cv2.INTER_AREA), (3, 3), 0.7))


@pytest.fixture(scope="module")
def ready(tmp_path_factory):
    folder = tmp_path_factory.mktemp("detecting") / "lab"
    for i, turn in enumerate((0.2, 0.4, -0.3), 1):
        draw(folder / f"images/C/e{i}.png", turn)
    (folder / "survey.toml").write_text(TOML)
    adjust_job(folder, progress=False)
    return folder


@pytest.fixture
def lab(ready, tmp_path):
    return shutil.copytree(ready, tmp_path / "lab")


def points(folder):
    return folder / "observations/image_points.csv"


def rows_of(folder, epoch):
    return [line for line in points(folder).read_text().splitlines() if line.startswith(f"{epoch},")]


def solution(folder):
    return json.loads((folder / "results/solution.json").read_text())


def test_results_trace_to_images_and_command(lab):
    inputs = solution(lab)["inputs"]
    known = read_detected(lab / "observations")
    assert set(inputs["images"]) == {"C/e1", "C/e2", "C/e3"}
    assert inputs["images"]["C/e2"]["sha256"] == known["C", "e2"].sha256
    assert inputs["images"]["C/e2"]["n_image_points"] == 30
    assert inputs["command"] == "labsurvey adjust lab"
    page = (lab / "results/report.html").read_text()
    assert known["C", "e2"].sha256 in page
    assert "labsurvey adjust lab" in page


def test_new_and_changed_images_are_looked_at_and_others_are_not(lab):
    before = {epoch: rows_of(lab, epoch) for epoch in ("e1", "e2", "e3")}
    shutil.copy(lab / "images/C/e1.png", lab / "images/C/e9.png")
    draw(lab / "images/C/e2.png", -0.45)
    assert any("C/e9 were never looked at" in note for note in read(lab).image_notes)
    assert any("C/e2 have changed" in note for note in read(lab).image_notes)
    outcome = adjust_job(lab, progress=False)
    assert [rows_of(lab, e) == before[e] for e in ("e1", "e2", "e3")] == [True, False, True]
    assert len(rows_of(lab, "e9")) == 30
    assert {b.epoch_id for b in outcome.adjustment.survey.image_blocks} == {"e1", "e2", "e3", "e9"}
    assert not any("images:" in w for w in outcome.adjustment.warnings)


def test_a_touched_image_is_the_same_image(lab):
    os.utime(lab / "images/C/e2.png")
    assert read(lab).to_detect == ()
    os.truncate(lab / "images/C/e2.png", 100)
    assert read(lab).to_detect == (("C", "e2"),)


def test_an_image_of_the_same_size_and_nearly_the_same_time_is_read(lab):
    path = lab / "images/C/e2.png"
    detect_job(lab, progress=False, everything=True)
    data, stamp = bytearray(path.read_bytes()), path.stat()
    data[-20] ^= 1
    path.write_bytes(data)  # may well get the time stamp of the first one, where those are coarse
    now = read_detected(lab / "observations")["C", "e2"].seen_ns
    os.utime(path, ns=(stamp.st_atime_ns, now - 1_000_000))
    assert read(lab).to_detect == (("C", "e2"),)


def test_what_is_gone_is_said_and_its_points_stay(lab):
    (lab / "images/C/e3.png").unlink()
    outcome = adjust_job(lab, progress=False)
    assert any("C/e3 are gone" in w for w in outcome.adjustment.warnings)
    assert len(rows_of(lab, "e3")) == 30
    assert any("gone" in note for note in detect_job(lab, progress=False).notes)


def test_a_renamed_image_is_not_counted_twice(lab):
    (lab / "images/C/e3.png").rename(lab / "images/C/e7.png")
    outcome = adjust_job(lab, progress=False)
    assert {b.epoch_id for b in outcome.adjustment.survey.image_blocks} == {"e1", "e2", "e7"}
    (lab / "images/C/e7.png").unlink()
    again = detect_job(lab, progress=False, everything=True)
    assert any("C/e7 is gone, and its points" in note for note in again.notes)
    assert rows_of(lab, "e7") == []


@pytest.mark.slow
def test_what_is_added_brings_its_images_and_exclusions(lab, tmp_path):
    new = tmp_path / "new"
    shutil.copytree(lab / "images", new / "images")
    (new / "observations").mkdir()
    for i in (1, 2, 3):
        (new / f"images/C/e{i}.png").rename(new / f"images/C/f{i}.png")
    header, *rows = points(lab).read_text().splitlines()
    points(new).write_text("\n".join([header, *("f" + row[1:] for row in rows)]) + "\n")
    (new / "observations/exclusions.csv").write_text("what,id,reason\nimage,C/f2,blurred\n")
    outcome = add_job(lab, new, progress=False)
    assert not any("images:" in w for w in outcome.outcome.adjustment.warnings)
    assert set(solution(lab)["inputs"]["images"]) == {f"C/{x}{i}" for x in "ef" for i in (1, 2, 3)}
    assert [e["name"] for e in solution(lab)["exclusions"]] == ["image:C/f2"]
    assert solution(lab)["inputs"]["command"] == "labsurvey add lab new"
    adjust_job(lab, progress=False)
    assert unchanged_solution(lab) is not None


def test_edits_of_people_stay_unless_the_image_changes(lab):
    text = points(lab).read_text()
    kept = [line for line in text.splitlines() if not line.startswith("e2,") or "r0c0" not in line]
    points(lab).write_text("\n".join(kept) + "\n")
    shutil.copy(lab / "images/C/e1.png", lab / "images/C/e9.png")
    adjust_job(lab, progress=False)
    assert len(rows_of(lab, "e2")) == 29
    assert any("C/e2" in note for note in detect_job(lab, progress=False, everything=True).notes)
    assert len(rows_of(lab, "e2")) == 29
    draw(lab / "images/C/e2.png", -0.45)
    assert any("replaced: C/e2" in note for note in detect_job(lab, progress=False).notes)
    assert len(rows_of(lab, "e2")) == 30


def test_used_false_becomes_an_exclusion_when_its_row_is_replaced(lab, capsys):
    lines = points(lab).read_text().splitlines()
    out = ["false" if x.startswith("e1,") and ",r2c3," in x else "" for x in lines[1:]]
    marked = [lines[0] + ",used", *(f"{x},{flag}" for x, flag in zip(lines[1:], out, strict=True))]
    points(lab).write_text("\n".join(marked) + "\n")
    draw(lab / "images/C/e1.png", 0.25)
    assert main(["detect", str(lab), "--quiet"]) == 0
    assert "stay left out: observations/exclusions.csv" in capsys.readouterr().out
    project = read(lab)
    assert [str(one.exclusion.name) for one in project.left_out] == ["image_point:C/e1/board/r2c3"]
    assert project.n_left_out == 1
    assert project.n_unused_in_files == 0
    (block,) = (b for b in project.survey.image_blocks if b.epoch_id == "e1")
    assert (~block.used).sum() == 1


@pytest.mark.slow
def test_points_without_images_and_points_that_were_given_stay(lab):
    (lab / "observations/detected.json").unlink()
    given = points(lab).read_text()
    assert adjust_job(lab, progress=False).adjustment.n_screened == 0
    assert points(lab).read_text() == given
    assert {e.status for e in read_detected(lab / "observations").values()} == {"given"}
    draw(lab / "images/C/e2.png", -0.45)
    assert read(lab).to_detect == (("C", "e2"),)
    shutil.rmtree(lab / "images")
    (lab / "observations/detected.json").unlink()
    adjust_job(lab, progress=False)
    assert points(lab).read_text() == given


def test_a_batch_adjusts_again_where_an_image_is_another_one(lab):
    assert unchanged_solution(lab) is not None
    os.utime(lab / "images/C/e2.png")
    assert unchanged_solution(lab) is not None
    draw(lab / "images/C/e2.png", -0.45)
    assert unchanged_solution(lab) is None


def test_images_are_searched_again_for_another_target(lab):
    path = lab / "survey.toml"
    path.write_text(path.read_text().replace("square_mm = 20.0", "square_mm = 20.1"))
    assert len(read(lab).to_detect) == 3
    assert len(detect_job(lab, progress=False).reports) == 3
    assert read(lab).to_detect == ()


def test_a_damaged_list_of_images_is_refused_with_advice(lab, capsys):
    (lab / "observations/detected.json").write_text('{"format": 1, "images": {"C/e1": {}}}')
    assert main(["adjust", str(lab), "--quiet"]) == 1
    assert "remove it: the points in the tables stay" in capsys.readouterr().err
