"""The other jobs of a resident project: each the command of its name, with what of it is drawn in space."""

import shutil

import numpy as np
import pytest

from adjust.model.errors import SurveyError
from survey.examples import write_example
from survey.jobs.adjusting.steps import adjust_project
from survey.planning.job import PlanRequest
from survey.project import read, write_project
from survey.report.language import speaking
from survey.simulate import Scene, beacons
from survey.workbench.session import Workbench
from tests import labs
from tests.survey.planning_lab import write_lab

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """A project of images in which nothing was looked for yet."""
    folder = tmp_path_factory.mktemp("camera") / "lab"
    labs.example("one-camera", folder)
    for name in sorted((folder / "images").glob("*/*"))[6:]:
        name.unlink()
    return folder


def test_images_are_detected_one_by_one_and_the_project_is_adjusted(pictures, tmp_path):
    folder = shutil.copytree(pictures, tmp_path / "lab")
    bench = Workbench(folder)
    with pytest.raises(SurveyError):
        bench.adjust()
    reports = []
    told = bench.detect(told=reports.append)
    assert {(r.camera_id, r.epoch_id) for r in reports} == set(read(folder).images)
    assert told.summary["image_points"] == sum(len(d) for r in reports for d in r.detections.values())
    assert told.summary["image_points"] == len(bench.rows.used) > 100
    assert bench.adjustment.sigma0 < 2
    assert bench.changed_files() == ()
    again = []
    assert bench.detect(told=again.append).summary["images_unchanged"] == len(reports)
    assert again == []


def test_another_project_is_begun_beside_this_one_and_found_again(pictures, tmp_path):
    folder = shutil.copytree(pictures, tmp_path / "lab")
    (tmp_path / "recordings").mkdir()
    some = sorted((folder / "images").glob("*/*"))[:2]
    for path in some:
        shutil.copy(path, tmp_path / "recordings" / path.name)
    bench = Workbench(folder)
    told = bench.start("recordings", "new")
    assert told.summary["folder"] == str(tmp_path / "new")
    assert set(read(tmp_path / "new").images) == {("recordings", p.stem) for p in some}
    assert bench.show("new").summary == {"folder": str(tmp_path / "new")}
    with pytest.raises(SurveyError, match="name the folder of the new project"):
        bench.start("recordings", " ")
    with pytest.raises(SurveyError, match="nowhere"):
        bench.start("nowhere", "other")
    with pytest.raises(SurveyError, match=r"recordings: holds no survey\.toml"):
        bench.show("recordings")
    with pytest.raises(SurveyError, match="reading only"):
        Workbench(folder, read_only=True).start("recordings", "third")


def test_a_plan_draws_what_it_chose_where_it_would_be(tmp_path):
    folder = tmp_path / "lab"
    write_lab(folder)
    bench = Workbench(folder)
    with speaking("de"):  # a page of another language than that of plan.html
        told = bench.plan(PlanRequest(add=2))
        said = told.as_dict()["text"]
    assert "Beobachtungen" in said.splitlines()[0]
    assert {"erwartete Sigmas (a priori)", "geforderte Genauigkeit"} <= {line.strip() for line in said.splitlines()}
    drawn = told.drawn
    assert len(drawn.cameras) + len(drawn.points) + len(drawn.lines) >= 2
    inside = np.array([pose.translation() for pose in drawn.cameras.values()] + [x for _, x, _ in drawn.points])
    assert np.abs(inside).max() < 20.0
    assert drawn.as_dict()["cameras"].keys() == drawn.cameras.keys()
    (folder / "plan.toml").unlink()
    with pytest.raises(SurveyError, match=r"plan\.toml: there is no such file"):
        bench.plan()


def test_epochs_are_compared_and_adjusted_side_by_side(tmp_path):
    folders = [tmp_path / "first", tmp_path / "second"]
    for seed, folder in enumerate(folders):
        write_example("relay", folder, seed=seed)
    bench = Workbench(folders[1])
    told = bench.compare_with(folders[0].name)
    assert told.summary["folders"] == [str(tmp_path / folders[0].name), str(folders[1])]
    assert len(told.drawn.lines) >= 25
    for k, folder in enumerate(folders):
        values = {"/".join(n): e.value for n, e in adjust_project(read(folder), False).estimates.items()}
        for name, ends in told.drawn.lines:
            np.testing.assert_allclose(ends[k], values[name].translation(), atol=1e-6)
    assert sorted(p.split("/")[-1] for p in bench.batch().summary["folders"]) == sorted(f.name for f in folders)
    with pytest.raises(SurveyError, match="there is no such folder"):
        bench.compare_with("nowhere")


def test_nothing_is_written_where_the_project_is_only_read(pictures):
    bench = Workbench(pictures, read_only=True)
    for job in (bench.detect, bench.plan, bench.navigate, bench.batch, lambda: bench.add(pictures)):
        with pytest.raises(SurveyError, match="reading only"):
            job()
    assert not (pictures / "observations").exists() or not (pictures / "observations/image_points.csv").exists()


def test_a_path_is_drawn_with_its_covariances_in_the_world(tmp_path):
    survey, truth = beacons(seed=4, n_table_epochs=5, n_free_epochs=4, n_night_epochs=4)
    write_project(tmp_path / "lab", survey)
    told = Workbench(tmp_path / "lab").navigate()
    beside = {spot["id"]: spot["x"] for spot in told.as_dict()["drawn"]["scene"]["spots"]}  # there is no solution
    assert len(beside) >= 3
    for name, x in beside.items():
        np.testing.assert_allclose(x, truth["point", name], atol=0.01)
    scene = Scene(survey, truth)
    assert len(told.drawn.path) == told.summary["epochs"] == 4
    for epoch, x, cov, status in told.drawn.path:
        d = x - scene.world_from_station("head", epoch)[:3, 3]
        assert status == "fixed"
        assert d @ np.linalg.solve(cov, d) < 16.3  # chi-square of three at 0.1 %


def test_a_network_grows_and_is_adjusted_again(tmp_path):
    write_example("relay", tmp_path / "lab")
    path = tmp_path / "lab/observations/pairs.csv"
    lines = path.read_text().splitlines(keepends=True)
    new = tmp_path / "new"
    (new / "observations").mkdir(parents=True)
    (new / "observations/pairs.csv").write_text(lines[0] + lines[-1])
    path.write_text("".join(lines[:-1]))
    bench = Workbench(tmp_path / "lab")
    bench.adjust()
    before = bench.adjustment.redundancy
    told = bench.add("new")
    assert told.summary["redundancy_after"] == bench.adjustment.redundancy > before
    assert bench.changed_files() == ()
