"""Capture plans: poses, limits, time, mistakes; boards that cover images, projected by OpenCV."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from capture.cli import main
from capture.devices.turntable import LimitError
from capture.devices.turntables.dialect import read_dialect
from capture.plan.plan import check_plan_limits, estimate, read_plan
from survey.project import write_project
from survey.project.targets import Checkerboard
from survey.simulate.labs import head_on_table
from survey.simulate.scene import Scene
from tests.capture.session_runs import write_plan


def edited(tmp_path, *changes, **keywords):
    plan = write_plan(tmp_path, **keywords)
    text = plan.read_text()
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    plan.write_text(text)
    return plan


def test_grid_turns_back_and_forth(tmp_path):
    plan = read_plan(write_plan(tmp_path))
    angles = np.degrees([pose.angles for pose in plan.poses])
    assert np.allclose(angles, [(-12, -12), (-12, 0), (-12, 12), (12, 12), (12, 0), (12, -12)])
    assert [pose.pose_id for pose in plan.poses] == ["t01", "t02", "t03", "t04", "t05", "t06"]


def test_repeats_are_epochs_of_their_own(tmp_path):
    plan = read_plan(write_plan(tmp_path, options="repeats = 2"))
    assert [shot.epoch_id for shot in plan.shots][:3] == ["t01-1", "t01-2", "t02-1"]


def test_list(tmp_path):
    plan = edited(tmp_path, ("[poses.t]", '[poses.a]\nkind = "list"\nangles_deg = [[1, 2], [3, 4]]\n[poses.t]'))
    poses = read_plan(plan).poses
    assert [pose.pose_id for pose in poses[:3]] == ["a01", "a02", "t01"]
    assert np.allclose(np.degrees(poses[1].angles), [3, 4])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("[capture]", "[capture]\nrepeat = 2", r"capture\.repeat: unknown key; did you mean 'repeats'"),
        ("project =", "projekt =", r"did you mean 'project'"),
        ("sigma_arcsec", "sigma_arcsecs", r"table\.sigma_arcsecs: unknown key; did you mean 'sigma_arcsec'"),
        ("limits_deg", "limit_deg", r"table\.axes\.axis1\.limit_deg: unknown key; did you mean 'limits_deg'"),
        ('driver = "simulated"', 'driver = "simulate"', r"did you mean 'simulated'"),
        ('kind = "grid"', 'kind = "gird"', r"did you mean 'grid'"),
        ("axis2_deg", "axis3_deg", r"axis3_deg: unknown key; did you mean 'axis1_deg'|axis2_deg"),
        ("ExposureTime = 500.0", "ExposureTime = [1]", r"a feature is a number"),
        ("limits_deg = [-60, 60]", "limits_deg = [60, -60]", r"the lower limit comes first"),
        ("window_s = 0.01", "window_s = -1", r"must be positive"),
        ("[capture]", '[capture]\ntrigger = "hard"', r"did you mean 'hardware'"),
        ("[capture]", "[capture]\nwait_s = -1", r"cannot be negative"),
        ("count = 2", "count = 0", r"at least 1"),
        ("format = 1", "format = 2", r"reads format 1"),
    ],
)
def test_mistakes_are_named_with_their_line(tmp_path, old, new, message):
    plan = edited(tmp_path, (old, new))
    with pytest.raises(SurveyError, match=message) as caught:
        read_plan(plan)
    assert str(caught.value).startswith(f"{plan}:")


def test_two_poses_of_one_name(tmp_path):
    plan = edited(tmp_path, ("[poses.t]", '[poses.T]\nkind = "list"\nangles_deg = [[1, 2]]\n[poses.t]'))
    with pytest.raises(SurveyError, match="two sections give a pose"):
        read_plan(plan)


def test_limits_name_the_pose(tmp_path):
    plan = read_plan(edited(tmp_path, ("from = -12, to = 12, count = 3", "from = -12, to = 72, count = 3")))
    with pytest.raises(LimitError, match=r"pose 't03': axis 'axis2': 72\.0000 deg is outside its limits -60\.0000"):
        check_plan_limits(plan)


def test_time_has_its_closed_form(tmp_path):
    """Five moves: 12 deg four times, 24 once, by the slower axis; 6 windows; 6 sets of the longer exposure."""
    plan = read_plan(edited(tmp_path, ("[capture]", "[capture]\noverhead_s = 0.25\nwait_s = 0.5"), n=(2, 3)))
    ramp = 200.0**2 / 4000.0  # deg, below which the top speed is not reached
    twelve = 12 / 200 + 200 / 4000 if ramp < 12 else 2 * math.sqrt(12 / 4000)
    twenty_four = 24 / 200 + 200 / 4000
    found = estimate(plan)
    assert found.moving_s == pytest.approx(4 * twelve + twenty_four)
    assert found.waiting_s == pytest.approx(6 * (0.01 + 0.5))
    assert found.imaging_s == pytest.approx(6 * (500e-6 + 0.25))


def test_dry_run_prints_and_moves_nothing(tmp_path, capsys):
    plan = write_plan(tmp_path)
    assert main(["run", str(plan), "--dry-run"]) == 0
    out = capsys.readouterr().out
    for part in ("t06", "6 poses x 1 repeats x 2 cameras = 12", f"Next: labcapture run {plan}"):
        assert part in out
    assert main(["run", str(plan), "--dry-run", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary["poses"]["t04"] == [12.0, 12.0]
    assert summary["images"] == 12
    assert not (tmp_path / "lab").exists()


def test_dry_run_beyond_a_limit_fails(tmp_path, capsys):
    plan = edited(tmp_path, ("from = -12, to = 12, count = 3", "from = -12, to = 72, count = 3"))
    assert main(["run", str(plan), "--dry-run"]) == 1
    assert "outside its limits" in capsys.readouterr().err


def test_help_opens_with_a_real_command(capsys):
    for command in ([], ["run"], ["cameras"], ["table"], ["view"], ["export"]):
        with pytest.raises(SystemExit) as caught:
            main([*command, "--help"])
        assert caught.value.code == 0
        assert capsys.readouterr().out.startswith("usage: labcapture ")


@pytest.fixture(scope="module")
def known_survey():
    """A survey whose approximate values are the truth, and the scene that OpenCV projects."""
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=1, n_free_epochs=1)
    cameras = tuple(
        replace(
            c,
            lens=replace(c.lens, values=truth["lens", c.camera_id]),
            station_from_camera=replace(c.station_from_camera, value=truth["station_from_camera", c.camera_id]),
        )
        for c in survey.cameras
    )
    (table,) = survey.tables
    geometry = replace(table.geometry, values=truth["table_geometry", table.table_id])
    world_from_table = replace(table.world_from_table, value=truth["world_from_table", table.table_id])
    table = replace(table, geometry=geometry, world_from_table=world_from_table)
    return replace(survey, cameras=cameras, tables=(table,)), truth


def covering_plan(folder, survey, extra=""):
    """A plan that covers camera Y's image with the board, on a template of that survey."""
    kinds = {t.target_id: Checkerboard(*_board_size(t)) for t in survey.targets}
    write_project(folder / "template", replace(survey, image_blocks=(), table_readings=()), target_kinds=kinds)
    (folder / "plan.toml").write_text(
        'format = 1\nproject = "lab"\nsurvey = "template/survey.toml"\n[table]\nid = "turntable"\n'
        'driver = "simulated"\naxes.axis1 = { limits_deg = [-180, 180] }\naxes.axis2 = { limits_deg = [-180, 180] }\n'
        '[cameras.Y]\naddress = "simulated:Y"\n'
        f'[poses.c]\nkind = "cover"\ncameras = ["Y"]\ntarget = "board"\ncount = 12\n{extra}\n'
    )
    return folder / "plan.toml"


def _board_size(target):
    rows, columns = (max(int(p[1:].split("c")[k]) for p in target.point_ids) + 1 for k in (0, 1))
    x = target.x_in_target
    return columns, rows, float(np.linalg.norm(x[1] - x[0]))


@pytest.mark.slow
def test_board_covers_the_image(tmp_path, known_survey):
    """Every pose shows the whole board, by OpenCV's projection; together they reach nearly every part of the image."""
    survey, truth = known_survey
    plan = read_plan(covering_plan(tmp_path, survey))
    assert len(plan.poses) == 12
    scene = Scene(survey, dict(truth) | {("table_angles", "turntable", p.pose_id): p.angles for p in plan.poses})
    width, height = next(c.image_size for c in survey.cameras if c.camera_id == "Y")
    seen = np.zeros((8, 10), bool)
    for pose in plan.poses:
        uv = scene.project("Y", pose.pose_id, scene.target_points("board"))
        assert (uv > 11.9).all()
        assert (uv < np.array([width, height]) - 12.9).all()
        seen[(uv[:, 1] * 8 / height).astype(int), (uv[:, 0] * 10 / width).astype(int)] = True
    assert seen.mean() > 0.9
    check_plan_limits(plan)


def test_cover_needs_approximate_values(tmp_path, known_survey):
    survey, _ = known_survey
    (table,) = survey.tables
    unknown = replace(survey, tables=(replace(table, world_from_table=replace(table.world_from_table, value=None)),))
    with pytest.raises(SurveyError, match=r"world_from_table of 'turntable' has no approximate value"):
        read_plan(covering_plan(tmp_path, unknown))


def test_cover_that_cannot_be(tmp_path, known_survey):
    survey, _ = known_survey
    with pytest.raises(SurveyError, match=r"camera 'Y' never sees 'board' whole"):
        read_plan(covering_plan(tmp_path, survey, "margin_px = 500"))


def test_plan_and_dialect_of_the_manual(tmp_path):
    """What docs/capture.md shows can be used as it stands, but for the poses that need a survey."""
    text = (Path(__file__).resolve().parents[2] / "docs" / "capture.md").read_text()
    plan, dialect = (block.split("```")[0] for block in text.split("```toml\n")[1:])
    plan = plan[: plan.index("[poses.c]")].replace("survey =", "# survey =")
    (tmp_path / "plan.toml").write_text(plan)
    found = read_plan(tmp_path / "plan.toml")
    assert len(found.poses) == 17
    check_plan_limits(found)
    (tmp_path / "mine.toml").write_text(dialect)
    assert read_dialect("mine.toml", tmp_path).texts == {"3": "beyond the controller's own limits"}
