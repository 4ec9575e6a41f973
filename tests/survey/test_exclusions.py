"""What people leave out: named by id, kept in a file of its own, obeyed by every command, taken back."""

import csv
import json
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from gtsam import Pose3

from adjust.adjustment import AdjustOptions
from adjust.graph.solver import SolveOptions
from adjust.model.errors import SurveyError
from survey.cli import main
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.adjusting.warm_start import WARM, survey_start, warm_adjustment
from survey.jobs.excluding import exclude_job, include_job
from survey.jobs.navigating.task import NavigateRequest, observed_epochs
from survey.jobs.removing import remove_job
from survey.project import read
from survey.project.exclusions import Exclusion, Name
from survey.project.observed import Observed
from survey.project.reading import leaving_out, read_all
from survey.solution.earlier.previous import read_previous

pytestmark = pytest.mark.slow


@pytest.fixture
def mine(lab, tmp_path):
    """A copy of the head of two cameras before a board and beacons, adjusted."""
    return shutil.copytree(lab[0], tmp_path / "lab")


def table(folder):
    return (folder / "observations/exclusions.csv").read_text()


def solution(folder):
    return json.loads((folder / "results/solution.json").read_text())


def test_every_kind_of_name_means_what_it_says(mine):
    survey = read(mine).survey
    seen = Observed(survey, ())
    of_left = [b for b in survey.image_blocks if b.camera_id == "left"]
    first = next(b for b in of_left if b.target_id == "board")
    place = f"left/{first.epoch_id}"
    assert seen.hits(Name("image_point", f"{place}/board/r1c1")).n_image_points == 1
    at_epoch = [b for b in of_left if b.epoch_id == first.epoch_id]
    assert seen.hits(Name("image", place)).n_image_points == sum(len(b.uv) for b in at_epoch)
    assert seen.hits(Name("target", f"{place}/board")).n_image_points == len(first.uv)
    assert seen.hits(Name("camera", "left")).n_image_points == sum(len(b.uv) for b in of_left)
    assert seen.hits(Name("point", "board/r1c1")).n_image_points == sum(
        int((b.point_idx == first.point_idx[list(first.point_idx).index(7)]).sum())
        for b in survey.image_blocks if b.target_id == "board"
    )  # fmt: skip
    assert str(seen.find(place)) == f"image:{place}"
    assert str(seen.find("r1c1")) == "point:board/r1c1"
    assert str(seen.find("left")) == "camera:left"
    assert str(seen.find(first.epoch_id)) == f"epoch:{first.epoch_id}"
    with pytest.raises(SurveyError, match="did you mean 'r1c1'"):
        seen.find("r11c1")


def test_excluded_adjusted_listed_and_taken_back(mine, capsys, monkeypatch):
    monkeypatch.setenv("LABSURVEY_AUTHOR", "A. Smith")
    before = solution(mine)
    epoch = read(mine).survey.image_blocks[0].epoch_id
    said = "motion blur, clearly"
    assert main(["exclude", str(mine), f"left/{epoch}", "r1c1", "--reason", said, "--quiet"]) == 0
    assert f"left out: image:left/{epoch}" in capsys.readouterr().out
    assert main(["adjust", str(mine), "--quiet"]) in (0, 3)
    assert said in capsys.readouterr().out
    after = solution(mine)
    assert [(e["name"], e["reason"], e["author"]) for e in after["exclusions"]] == [
        (f"image:left/{epoch}", said, "A. Smith"), ("point:board/r1c1", said, "A. Smith")
    ]  # fmt: skip
    left = after["left_out"]["by_people"]
    assert left == read(mine).n_left_out == sum(int((~b.used).sum()) for b in read(mine).survey.image_blocks
                                                if b.used is not None)  # fmt: skip
    assert after["left_out"]["in_files"] == after["left_out"]["in_this_run"] == 0
    assert after["summary"]["n_observations"] == before["summary"]["n_observations"] - 2 * left
    assert after["exclusions"][1]["largest_standardized_residual"] < 6.0
    assert not any("not used" in w or "gross" in w for w in after["warnings"])
    assert 'id="excluded"' in (mine / "results/report.html").read_text()
    assert main(["include", str(mine), f"left/{epoch}", "point:board/r1c1", "--quiet"]) == 0
    adjust_job(mine, progress=False)
    again = solution(mine)
    assert again["summary"]["n_observations"] == before["summary"]["n_observations"]
    assert again["exclusions"] == []
    assert len(table(mine).splitlines()) == 5


def test_rows_are_only_added_and_comments_stay(mine):
    path = mine / "observations/exclusions.csv"
    path.write_text('# by hand\nid,what,reason\nr1c1,point,\n\n"board/r1c1",point,"looks, odd"\n')
    text = path.read_text()
    exclude_job(mine, ["r2c2"], "x", author="me")
    first = text.replace("id,what,reason\n", "id,what,reason,author,time\n")
    assert path.read_text().startswith(first + "board/r2c2,point,x,me,2")
    assert [one.exclusion.line for one in read(mine).left_out] == [3, 5, 6]
    include_job(mine, ["r2c2"])
    assert path.read_text().startswith(first.replace("author,time\n", "author,time,state\n"))
    assert [one.exclusion.line for one in read(mine).left_out] == [3, 5]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("epok,e1,,", "3: what: unknown 'epok'; did you mean 'epoch'?"),
        ("image,e1,,", "3: id: found 'e1'; image is written camera/epoch"),
        ("image,left/e1,out,", "3: state: found 'out'"),
        ("image,left/e1,excluded,a, b", "put a reason that holds a comma into quotes"),
        ('image,"left/e1', "not a CSV line"),
    ],
)
def test_a_malformed_row_is_an_error_with_its_line(mine, row, message):
    (mine / "observations/exclusions.csv").write_text(f"# x\nwhat,id,state,reason\n{row}\n")
    with pytest.raises(SurveyError) as caught:
        read(mine)
    assert message in str(caught.value)
    assert "exclusions.csv:3" in str(caught.value)


def test_a_stale_row_is_a_warning_with_the_nearest_name(mine):
    (mine / "observations/exclusions.csv").write_text("what,id\npoint,board/r1c11\n")
    outcome = adjust_job(mine, progress=False)
    (note,) = (w for w in outcome.adjustment.warnings if "nothing has that name" in w)
    assert "exclusions.csv:2: point:board/r1c11" in note
    assert "did you mean 'board/r1c1'" in note
    assert solution(mine)["left_out"]["by_people"] == 0
    include_job(mine, ["board/r1c11"])
    assert read(mine).notes == ()


def test_what_cannot_be_excluded_or_included_says_why(mine, capsys):
    epoch = read(mine).survey.image_blocks[0].epoch_id
    exclude_job(mine, [f"epoch:{epoch}"], "x")
    before = table(mine)
    for command, name, message in (
        ("exclude", f"epoch:{epoch}", "exclusions.csv:2: "),
        ("exclude", f"left/{epoch}", "is left out already"),
        ("include", f"left/{epoch}", f"is left out by epoch:{epoch}; take that back"),
        ("include", "r1c1", "point:board/r1c1 is not excluded"),
    ):
        more = ["--reason", "y"] if command == "exclude" else []
        assert main([command, str(mine), name, *more, "--quiet"]) == 1
        assert message in capsys.readouterr().err
    assert table(mine) == before
    with pytest.raises(SystemExit):
        main(["exclude", str(mine), "r1c1"])


def _only_image(mine):
    """An epoch that one image shows, when its other image is excluded."""
    epoch = read(mine).survey.image_blocks[0].epoch_id
    exclude_job(mine, [f"left/{epoch}", f"right/{epoch}"], "both blurred")
    return epoch


def test_the_only_images_of_an_epoch_take_its_pose_with_them(mine):
    epoch = _only_image(mine)
    outcome = adjust_job(mine, progress=False)
    assert any(f"every observation of it is left out, or too many are: world_from_station head {epoch}" in w
               or f"{epoch}" in w for w in outcome.adjustment.warnings)  # fmt: skip
    assert not any(n[0] == "world_from_station" and n[-1] == epoch for n in outcome.adjustment.estimates)


def test_used_false_on_all_of_an_epoch_does_the_same(mine):
    path = mine / "observations/image_points.csv"
    epoch = read(mine).survey.image_blocks[0].epoch_id
    rows = list(csv.DictReader(path.read_text().splitlines()))
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, [*rows[0], "used"])
        writer.writeheader()
        writer.writerows({**row, "used": "false" if row["epoch_id"] == epoch else "true"} for row in rows)
    outcome = adjust_job(mine, progress=False)
    n = sum(row["epoch_id"] == epoch for row in rows)
    assert outcome.solution["left_out"] == {"by_people": 0, "in_files": n, "in_this_run": 0}


def test_a_camera_goes_with_all_its_images(mine):
    exclude_job(mine, ["camera:right"], "lens was loose")
    found = adjust_job(mine, progress=False).adjustment
    assert ("lens", "right") not in found.estimates
    assert ("lens", "left") in found.estimates


def test_remove_names_images_epochs_and_points(mine):
    epoch = read(mine).survey.image_blocks[0].epoch_id
    outcome = remove_job(mine, [f"left/{epoch}", "r1c1"], progress=False, reason="test")
    assert outcome.summary()["removed"] == [f"image:left/{epoch}", "point:board/r1c1"]
    assert outcome.start == WARM
    assert [e["reason"] for e in solution(mine)["exclusions"]] == ["test", "test"]
    assert solution(mine)["inputs"]["command"].endswith("--reason test")


def _worst(a, b):
    """Largest difference of two solutions in sigmas."""
    worst = 0.0
    assert set(a.estimates) == set(b.estimates)
    for name, e in a.estimates.items():
        v, w = e.value, b.estimates[name].value
        d = np.asarray(Pose3.Logmap(v.between(w))) if isinstance(v, Pose3) else np.asarray(w) - np.asarray(v)
        sigma = np.sqrt(np.diag(e.cov))
        worst = max(worst, float(np.abs(d[sigma > 0] / sigma[sigma > 0]).max(initial=0.0)))
    return worst


def test_warm_is_cold_with_spots_exclusions_and_rows_not_used(mine, monkeypatch):
    _only_image(mine)
    adjust_job(mine, progress=False)
    exclude_job(mine, ["r2c2"], "x")
    project = read_all(mine)
    previous = read_previous_of(mine)
    exclusions = [one.exclusion for one in read(mine).left_out]
    project = leaving_out(_beacons_as_spots(project), exclusions)
    assert project.spots
    # until rounding ends it: to its usual limit, 1e-6 sigmas, each run stops somewhere else
    exact = partial(AdjustOptions, solve=SolveOptions(max_step=1e-9))
    monkeypatch.setattr("survey.jobs.adjusting.steps.AdjustOptions", exact)
    cold = adjust_project(project, False)
    warm, how = warm_adjustment(project, previous, False)
    assert how == WARM
    assert warm.iterations < cold.iterations
    assert _worst(cold, warm) < 1e-9


def read_previous_of(folder):
    """The last solution, though exclusions were added since."""
    project = read(folder)
    recorded = json.loads((folder / "results/solution.json").read_text())["inputs"]["hashes"]
    return read_previous(replace(project, inputs=recorded))


def _beacons_as_spots(project):
    """The beacons' image points without their names, and coordinates by which they are found again."""
    from adjust.model.observations import Coordinates, PositionRef
    from survey.project import SpotBlock
    from tests.survey.camera_lab import BEACONS

    blocks = [b for b in project.survey.image_blocks if b.target_id is None]
    assert blocks
    spots = tuple(
        SpotBlock(b.camera_id, b.epoch_id, tuple(f"s{i}" for i in range(len(b.uv))), b.uv, b.cov) for b in blocks
    )
    rough = tuple(Coordinates((PositionRef(p.point_id),), x[None] + 1e-4, 1e-6 * np.eye(3))
                  for p, x in zip(project.survey.points, BEACONS, strict=True))  # fmt: skip
    survey = replace(project.survey, coordinates=rough,
                     image_blocks=tuple(b for b in project.survey.image_blocks if b.target_id is not None))  # fmt: skip
    return replace(project, survey=survey, spots=spots)


def test_a_warm_start_tests_anew_what_a_blunder_had_screened_out(mine):
    path = mine / "observations/distances.csv"
    ids = [p.point_id for p in read(mine).survey.points][:2]
    a, b = (np.array([solution(mine)["points"][i][f"{x}_mm"] for x in "xyz"]) for i in ids)
    length = float(np.linalg.norm(a - b)) + 20.0
    path.write_text(f"distance_id,from_id,to_id,value_mm,sigma_mm\ntape,{ids[0]},{ids[1]},{length},0.01\n")
    toml = mine / "survey.toml"
    toml.write_text(toml.read_text().replace("reject_pairs = true", "reject_pairs = false"))
    blundered = adjust_job(mine, progress=False)
    assert blundered.adjustment.n_screened > 0
    outcome = remove_job(mine, ["tape"], progress=False, reason="misread")
    assert outcome.start == WARM
    assert outcome.outcome.adjustment.n_screened == 0
    assert outcome.outcome.solution["left_out"] == {"by_people": 1, "in_files": 0, "in_this_run": 0}


def test_a_spot_is_found_again_by_where_it_was(mine):
    project = _beacons_as_spots(read_all(mine))
    spot = project.spots[0]
    u, v = spot.uv[1].tolist()
    name = Name("spot", f"{spot.camera_id}/{spot.epoch_id}/s0")  # numbered anew since
    left = leaving_out(project, [Exclusion(name, at=(u + 0.5, v))])
    assert left.spots[0].spot_ids == tuple(s for s in spot.spot_ids if s != "s1")
    gone = leaving_out(project, [Exclusion(name, at=(u + 9.0, v + 9.0), line=4)])
    assert any("nothing has that name" in note for note in gone.notes)


def test_survey_start_takes_lenses_and_poses_of_before(mine):
    project = read(mine)
    start = survey_start(project.survey, read_previous(project))
    fx = solution(mine)["cameras"]["left"]["lens"]["fx_px"]
    assert start.lenses["left"][0] == pytest.approx(fx, abs=1e-9)


def test_navigation_does_not_see_what_is_left_out(mine):
    project = read_all(mine)
    block = next(b for b in project.survey.image_blocks if b.target_id is None)
    names = [project.survey.points[int(i)].point_id for i in block.point_idx]
    out = Exclusion(Name("image_point", f"{block.camera_id}/{block.epoch_id}/{names[0]}"))
    station = project.survey.stations[0].station_id
    seen = [
        sum(len(s.uv) for epoch in observed_epochs(p, station, [block.epoch_id], None, NavigateRequest(), set(names))
            for s in epoch.spots)
        for p in (project, leaving_out(project, [out]))
    ]
    assert seen[1] == seen[0] - 1
