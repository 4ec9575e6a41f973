"""Observations taken out of a project: the same as never having had them, reversible, all or nothing."""

import json
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import Coordinates, Distance, FrameRef, Pair, PositionRef
from adjust.model.survey import Point, PoseParameter, Station, Survey
from survey.cli import main
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.excluding import include_job
from survey.jobs.removing import remove_job
from survey.project import read, write_project

SIGMAS = np.array([1e-4] * 3 + [1e-3] * 3)
ENDS = ((0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (3, 4))


def _survey(seed=1):
    rng = np.random.default_rng(seed)
    poses = [Pose3()] + [Pose3(Rot3.Expmap(rng.normal(0, 1, 3)), rng.uniform(-5, 5, 3)) for _ in range(4)]
    pairs = tuple(
        Pair(f"p{i}-{j}", FrameRef("station", f"S{i}"), FrameRef("station", f"S{j}"),
             poses[j].between(poses[i]).retract(SIGMAS * rng.standard_normal(6)), np.diag(SIGMAS**2))
        for i, j in ENDS
    )  # fmt: skip
    held = PoseParameter(Pose3(), "held")
    return Survey(stations=tuple(Station(f"S{i}", world_from_station=held if i == 0 else PoseParameter())
                                 for i in range(5)), pairs=pairs)  # fmt: skip


def _state(folder):
    return {p.relative_to(folder): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.fixture
def lab(tmp_path):
    write_project(tmp_path / "lab", _survey(), title="ring with a tail")
    adjust_job(tmp_path / "lab", progress=False)
    return tmp_path / "lab"


def test_without_a_pair_is_as_if_it_had_not_been_measured(lab, tmp_path, capsys):
    survey = _survey()
    write_project(tmp_path / "less", replace(survey, pairs=tuple(p for p in survey.pairs if p.pair_id != "p0-2")))
    wanted = adjust_job(tmp_path / "less", progress=False).adjustment
    assert main(["remove", str(lab), "p0-2", "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["removed"] == ["pairs:p0-2"]
    assert (said["redundancy_before"], said["redundancy_after"]) == (12, 6)
    assert {m["name"] for m in said["moved"]} == {"S1", "S2", "S3", "S4"}
    assert not (lab / ".adding").exists()
    assert not (lab / ".before").exists()
    found = json.loads((lab / "results/solution.json").read_text())["stations"]
    for i in range(5):
        x = wanted.estimates["world_from_station", f"S{i}"].value.translation()
        np.testing.assert_allclose(found[f"S{i}"]["world_from_station"]["translation_mm"], 1e3 * x, atol=1e-5)
    assert {p.pair_id for p in read(lab).survey.pairs if not p.used} == {"p0-2"}


def test_moves_are_counted_in_the_sigmas_of_before(lab):
    before = json.loads((lab / "results/solution.json").read_text())["stations"]
    outcome = remove_job(lab, ["p0-2"], progress=False)
    after = json.loads((lab / "results/solution.json").read_text())["stations"]
    for move in outcome.moved:
        was, now = (np.array(s[move.name]["world_from_station"]["translation_mm"]) for s in (before, after))
        assert move.mm == pytest.approx(np.linalg.norm(now - was), rel=1e-6, abs=1e-9)
        assert move.sigmas > 0.0
    assert "sigmas" in outcome.text()
    assert "labsurvey include FOLDER pairs:p0-2" in outcome.text()


def test_taken_back_all_is_as_before(lab):
    solution = json.loads((lab / "results/solution.json").read_text())["stations"]
    remove_job(lab, ["p0-2", "p1-2"], progress=False)
    assert "false" not in (lab / "observations/pairs.csv").read_text()
    include_job(lab, ["p0-2", "pairs:p1-2"])
    adjust_job(lab, progress=False)
    again = json.loads((lab / "results/solution.json").read_text())["stations"]
    for station, entry in solution.items():
        x = again[station]["world_from_station"]["translation_mm"]
        np.testing.assert_allclose(x, entry["world_from_station"]["translation_mm"], atol=1e-6)


@pytest.mark.parametrize(
    ("ids", "message"),
    [
        (["p3-4"], "cannot do without pairs:p3-4"),
        (["p0-1", "p1-2"], "cannot do without pairs:p0-1, pairs:p1-2"),
        (["p0-22"], "did you mean 'p0-2'"),
        (["distances:p0-2"], "none is known here"),
    ],
)
def test_what_is_refused_leaves_the_folder_as_it_was(lab, ids, message, capsys):
    before = _state(lab)
    assert main(["remove", str(lab), *ids, "--quiet"]) == 1
    assert message in capsys.readouterr().err
    assert _state(lab) == before
    assert sorted(p.name for p in lab.iterdir()) == ["observations", "results", "runs", "survey.toml"]


def test_undetermined_names_the_station(lab):
    with pytest.raises(IndeterminateError, match="S4"):
        remove_job(lab, ["p3-4"], progress=False)


def test_out_leaves_the_project_alone(lab, tmp_path):
    before = _state(lab)
    remove_job(lab, ["p0-2"], out=tmp_path / "other", progress=False)
    assert _state(lab) == before
    assert [p.pair_id for p in read(tmp_path / "other").survey.pairs if not p.used] == ["p0-2"]
    assert (tmp_path / "other/results/solution.json").is_file()


def test_a_project_that_was_not_adjusted_is_adjusted_without_comparison(tmp_path):
    write_project(tmp_path / "lab", _survey())
    outcome = remove_job(tmp_path / "lab", ["p0-2"], progress=False)
    assert outcome.moved == ()
    assert "not adjusted yet" in outcome.why
    assert (tmp_path / "lab/results/solution.json").is_file()
    with pytest.raises(SurveyError, match="is left out already"):
        remove_job(tmp_path / "lab", ["p0-2"], progress=False)


def _with_points(folder):
    """Two points and the origin of S1, observed twice over; ``twice`` names a pair and a distance."""
    survey = _survey()
    at = {"A": np.array([1.0, 2.0, 0.5]), "B": np.array([3.0, -1.0, 0.2]), "C": np.array([-2.0, 1.0, 1.0])}
    cov = 1e-6 * np.eye(3)
    ref = {name: PositionRef(name) for name in at}
    both = Coordinates((ref["A"], ref["B"]), np.array([at["A"], at["B"]]), 1e-6 * (np.eye(6) + 0.1))
    single = Coordinates((ref["C"],), at["C"][None], cov)
    pair = replace(survey.pairs[0], pair_id="twice")
    length = float(np.linalg.norm(at["A"] - at["B"])) + 0.001
    distances = (Distance("twice", ref["A"], ref["B"], length, 1e-3),)
    survey = replace(survey, points=tuple(Point(n) for n in at), coordinates=(both, single),
                     pairs=(*survey.pairs, pair), distances=distances)  # fmt: skip
    write_project(folder, survey)
    adjust_job(folder, progress=False)
    return folder


def test_distances_and_sets_of_coordinates(tmp_path):
    lab = _with_points(tmp_path / "lab")
    with pytest.raises(SurveyError, match="stands for pairs:twice and distances:twice"):
        remove_job(lab, ["twice"], progress=False)
    with pytest.raises(SurveyError, match="name the set by its id"):
        remove_job(lab, ["coordinates:A"], progress=False)
    with pytest.raises(SurveyError, match="cannot do without coordinates:C"):
        remove_job(lab, ["C"], progress=False)
    outcome = remove_job(lab, ["distances:twice"], progress=False)
    assert outcome.summary()["removed"] == ["distances:twice"]
    survey = read(lab).survey
    assert not survey.distances[0].used
    assert all(p.used for p in survey.pairs)
    # without the distance A and B are where their coordinates say
    points = json.loads((lab / "results/solution.json").read_text())["points"]
    assert [points["A"][f"{a}_mm"] for a in "xyz"] == pytest.approx([1000.0, 2000.0, 500.0], abs=1e-6)
    assert max(m.mm for m in outcome.moved) > 0.1
