"""Changes that a diagnosis names, made in the files of a project: all or nothing, to the letter, and taken back."""

import json
import shutil
import tomllib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import (
    ChangeColumns,
    ChangeReadings,
    Edit,
    ExchangeColumns,
    Hypothesis,
    LeaveOut,
    Place,
    Rename,
    ScaleKey,
    SetKey,
    edit_told,
    told_edit,
)
from adjust.diagnosis.names.epochs import exchanged_cameras
from adjust.diagnosis.names.given import wrong_given
from adjust.diagnosis.names.points import exchanged_points
from adjust.diagnosis.time.forgotten_motion import forgotten_motion
from adjust.diagnosis.units.motions import CONVENTIONS, edits_of, mended
from adjust.diagnosis.units.pairs import misread_pairs
from adjust.diagnosis.units.readings import misread_readings
from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from survey.cli import main
from survey.folder.plain import plain
from survey.jobs.adjusting import trying
from survey.jobs.adjusting.edits import file_of, kept_name
from survey.jobs.adjusting.places import ProjectFiles
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.adjusting.trying import carried_out, try_job
from survey.jobs.adjusting.written import written_of
from survey.jobs.excluding import include_job
from survey.project import read
from survey.project.writing import write_project
from tests import labs
from tests.acceptance.planted_mistakes import MISTAKES, survey_of
from tests.labs import with_euler_angles

FORMED = {  # the family that forms the hypothesis, for a mistake in a kind of survey
    ("pairs inverted", "hand"): misread_pairs,
    ("unit of angles", "hall"): misread_readings,
    ("given points exchanged", "plane"): wrong_given,
    ("points exchanged", "plane"): exchanged_points,
    ("motion forgotten", "stereo"): forgotten_motion,
}


def contents(survey: Survey) -> dict[str, object]:
    """What edits can change, as numbers and words."""
    out: dict[str, object] = {}
    for b in survey.image_blocks:
        used = np.ones(len(b.uv), dtype=bool) if b.used is None else b.used
        out["image", b.camera_id, b.epoch_id, b.target_id] = np.column_stack([b.uv, b.cov.reshape(-1, 4), used])
    for p in survey.pairs:
        ends = p.a.frame_id, p.a.epoch_id, p.b.frame_id, p.b.epoch_id
        matrix = p.b_from_a.matrix()
        # which of two ends is called a is no matter: the other way round is the inverse motion
        forward = ends[:2] <= ends[2:]
        out["pair", p.pair_id] = (ends if forward else (*ends[2:], *ends[:2]), p.used)
        out["motion", p.pair_id] = matrix if forward else np.linalg.inv(matrix)
    for r in survey.readings:
        out["reading", r.reading_id] = (r.kind, str(r.to), str(r.second), r.used)
        turn = r.kind in ("direction", "azimuth", "angle", "zenith")
        out["value", r.reading_id] = np.array([np.cos(r.value), np.sin(r.value)] if turn else [r.value])
    for x in survey.points:
        out["point", x.point_id] = np.zeros(3) if x.x_in_world.value is None else np.asarray(x.x_in_world.value)
    out["motions"] = [(t.target_id, t.motion, t.warp is not None) for t in survey.targets]
    out["stations"] = [(s.station_id, s.motion) for s in survey.stations]
    return out


def assert_same(found: Survey, wanted: Survey) -> None:
    a, b = contents(found), contents(wanted)
    assert set(a) == set(b)
    for key, value in b.items():
        if isinstance(value, np.ndarray):
            np.testing.assert_allclose(a[key], value, rtol=1e-8, atol=1e-9, err_msg=str(key))
        else:
            assert a[key] == value, key


def files(folder: Path) -> dict[str, bytes]:
    return {p.relative_to(folder).as_posix(): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), FORMED)
def test_change_makes_the_survey_that_was_tried_and_is_taken_back(name: str, kind: str, tmp_path: Path) -> None:
    mistake = next(m for m in MISTAKES if m.name == name and kind in m.kinds)
    survey, truth = survey_of(kind, 3)
    lab = tmp_path / "lab"
    write_project(lab, mistake.plant(survey, truth, mistake.sizes[0]))
    before = files(lab)
    form: Callable = FORMED[name, kind]
    case = Case(read(lab).survey)
    found = next(h for h in form(case) if h.name == name)
    carried_out(lab, found)
    wanted = found.changed()
    assert wanted is not None
    assert_same(read(lab).survey, wanted)
    kept = {p.name: p.read_bytes() for p in (lab / "kept").iterdir()}
    assert set(kept) == {kept_name(tmp_path, file_of(edit)).removeprefix("kept/") for edit in found.edits}
    for path in (lab / "kept").iterdir():
        stem = path.stem.rpartition("-")[0] + path.suffix
        shutil.copy(path, lab / ("" if stem == "survey.toml" else "observations") / stem)
    shutil.rmtree(lab / "kept")
    assert files(lab) == before


@pytest.mark.parametrize("convention", [c for c in CONVENTIONS if c.columns is not None], ids=lambda c: c.said)
def test_conventions_of_pairs_as_columns(convention, tmp_path: Path) -> None:
    survey, _ = survey_of("poses", 3)
    lab = tmp_path / "lab"
    write_project(lab, survey)
    if convention.angles:
        with_euler_angles(lab / "observations" / "pairs.csv")
    project = read(lab)
    given, written = project.survey, written_of(project)
    rows = np.array([0, 3, 7])
    edits = edits_of(given, rows, convention)
    assert edits
    carried_out(lab, hypothesis(edits))
    assert_same(read(lab).survey, mended(given, rows, convention, written))


def hypothesis(edits: tuple[Edit, ...], place: Place | None = None) -> Hypothesis:
    return Hypothesis("planted", "it is wrong", "mend it", place or Place("camera", ("left",)), Survey(), edits)


@pytest.fixture
def lab(tmp_path: Path) -> Path:
    survey, _ = survey_of("stereo", 3)
    write_project(tmp_path / "lab", survey)
    return tmp_path / "lab"


def test_a_key_that_is_given_already_is_changed_and_the_rest_stays(lab: Path) -> None:
    path = lab / "survey.toml"
    text = path.read_text(encoding="utf-8").replace("[targets.board]", "[targets.board]  # of the shop\n# by hand", 1)
    path.write_text(text, encoding="utf-8")
    old = tomllib.loads(text)
    assert old["targets"]["board"]["motion"] == "epoch"
    carried_out(lab, hypothesis((SetKey(("targets", "board", "motion"), "fixed"),
                                 SetKey(("targets", "board", "warp", "free"), True),
                                 ScaleKey(("sigmas", "scale", "image"), 2.5))))  # fmt: skip
    new = path.read_text(encoding="utf-8")
    assert "[targets.board]  # of the shop\n# by hand" in new
    wanted = {**old, "sigmas": {**old.get("sigmas", {}), "scale": {"image": 2.5}}}
    wanted["targets"] = {"board": {**old["targets"]["board"], "motion": "fixed", "warp": {"free": True}}}
    assert tomllib.loads(new) == wanted
    assert (lab / "kept" / "survey-1.toml").read_text(encoding="utf-8") == text  # once, though three keys changed
    carried_out(lab, hypothesis((ScaleKey(("sigmas", "scale", "image"), 2.0),)))
    assert tomllib.loads(path.read_text(encoding="utf-8"))["sigmas"]["scale"] == {"image": 5.0}


@pytest.mark.parametrize(
    ("edits", "says"),
    [
        ((SetKey(("targets", "board", "warp", "free"), True), Rename("pairs", "a_id", {"a": "b"})), "no such table"),
        ((LeaveOut(("camera:left",)), Rename("image_points", "bogus", {"a": "b"})), "column 'bogus' is missing"),
        ((LeaveOut(("camera:left",)), SetKey(("targets", "board", "motion"), "often")), "nothing was changed: with"),
        ((LeaveOut(("camera:left", "camera:nobody")),), "nothing that was observed has the name"),
        ((SetKey(("targets", "board", "motion"), "fixed"), Rename("image_points", "camera_id", {"left": "other"})),
         "nothing was changed: with"),
        ((Rename("image_points", "camera_id", {"nobody": "left"}),), "nothing there is concerned"),
        ((ScaleKey(("targets", "board"), 2.0),), "points are in a file"),
    ],
)  # fmt: skip
def test_what_cannot_be_done_whole_is_not_begun(lab: Path, edits: tuple[Edit, ...], says: str) -> None:
    before = files(lab)
    with pytest.raises(SurveyError, match=says):
        carried_out(lab, hypothesis(edits))
    assert files(lab) == before


def test_exclusions_beside_a_change_are_taken_back_by_include(lab: Path) -> None:
    epochs = list(dict.fromkeys(b.epoch_id for b in read(lab).survey.image_blocks))
    names = tuple(f"image:left/{e}" for e in epochs[:2])
    edits = LeaveOut(names), LeaveOut(names[:1]), Rename("image_points", "epoch_id", {epochs[5]: "apart"})
    said = carried_out(lab, hypothesis(edits))
    assert "2 rows added; labsurvey include takes them back" in said
    assert "image_points.csv: changed; as it was: kept/image_points-1.csv" in said
    unused = [b.epoch_id for b in read(lab).survey.image_blocks if b.used is not None and not b.used.any()]
    assert unused == epochs[:2]
    carried_out(lab, hypothesis((LeaveOut(names), SetKey(("title",), "again"))))  # those are out: no second row
    include_job(lab, list(names), "was right")
    assert all(b.used is None or b.used.all() for b in read(lab).survey.image_blocks)


def test_images_turned_keep_their_covariances(lab: Path) -> None:
    """A quarter turn, at half the size so that the points stay in the image."""
    path = lab / "observations" / "image_points.csv"
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    head = rows[0][:6] + ["sigma_u_px", "sigma_v_px", "rho_uv"]
    rows = [head] + [[*r[:6], "0.1", "0.3", "0.5"] for r in rows[1:]]
    path.write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
    turn = np.array([[0.0, -0.5], [0.5, 0.0]])
    before = read(lab).survey.image_blocks
    carried_out(lab, hypothesis((ChangeColumns("image_points", ("u_px", "v_px"), turn, np.array([600.0, 0.0]),
                                               {"camera_id": ("left",)}),)))  # fmt: skip
    for old, new in zip(before, read(lab).survey.image_blocks, strict=True):
        A = turn if old.camera_id == "left" else np.eye(2)
        np.testing.assert_allclose(new.cov, A @ old.cov @ A.T, atol=1e-12)


def test_cameras_exchanged_from_an_epoch_on(lab: Path) -> None:
    survey = read(lab).survey
    epochs = tuple(dict.fromkeys(b.epoch_id for b in survey.image_blocks))[4:]
    other = {"left": "right", "right": "left"}
    carried_out(lab, hypothesis((Rename("image_points", "camera_id", other, {"epoch_id": epochs}),)))
    assert_same(read(lab).survey, exchanged_cameras(survey, "left", "right", epochs))


def line_of(folder: Path, name: str, *words: str) -> int:
    lines = (folder / name).read_text(encoding="utf-8").splitlines()
    return next(i for i, line in enumerate(lines, 1) if all(w in line for w in words))


def test_the_line_to_edit(tmp_path: Path) -> None:
    """Of what is changed: its first row, or its key; else of what is wrong."""
    survey, _ = survey_of("hand", 3)
    robot = tmp_path / "robot"
    write_project(robot, survey)
    epochs = [b.epoch_id for b in survey.image_blocks]
    pairs = tuple(p.pair_id for p in survey.pairs)
    shift = ChangeColumns("pairs", ("tx_mm", "ty_mm", "tz_mm"), np.eye(3), np.zeros(3), {"pair_id": pairs[3:]})
    pairs_csv, images_csv = "observations/pairs.csv", "observations/image_points.csv"
    n = sum(b.epoch_id == epochs[2] for b in survey.image_blocks) * len(survey.targets[0].point_ids)
    toml = ("survey.toml",)
    board = line_of(robot, *toml, "[targets.board]")
    for made, place, wanted in (
        ((shift,), None, f"{pairs_csv}:{line_of(robot, pairs_csv, pairs[3])} and {len(pairs) - 4} more rows"),
        ((LeaveOut((f"pairs:{pairs[5]}",)),), None, f"{pairs_csv}:{line_of(robot, pairs_csv, pairs[5])}"),
        ((LeaveOut((f"image:C/{epochs[2]}",)),), None,
         f"{images_csv}:{line_of(robot, images_csv, epochs[2])} and {n - 1} more rows"),
        ((ExchangeColumns("pairs", ("a_id", "b_id"), {"pair_id": pairs[:1]}),), None, f"{pairs_csv}:2"),
        ((SetKey(("targets", "board", "kind"), "x"),), None, f"survey.toml:{board + 1}"),
        ((SetKey(("targets", "board", "warp", "free"), True),), None, f"survey.toml:{board}"),
        ((SetKey(("nothing", "x"), "x"),), Place("camera", ("C",)), "survey.toml"),
        ((), Place("camera", ("C",)), f"survey.toml:{line_of(robot, *toml, '[cameras.C]')}"),
        ((), Place("camera", ("C",), "", (epochs[1],)),
         f"{images_csv}:{line_of(robot, images_csv, epochs[1])} and {n - 1} more rows"),
        ((), Place("station", ("hand",), "epoch"), f"{pairs_csv}:2 and {len(pairs) - 1} more rows"),
        ((), Place("station", ("hand",), "motion"), f"survey.toml:{line_of(robot, *toml, 'motion')}"),
        ((), Place("pair", ("all",)), f"{pairs_csv}:2 and {len(pairs) - 1} more rows"),
        ((), Place("pair", (pairs[1],)), f"{pairs_csv}:3"),
    ):
        assert ProjectFiles(robot).of(hypothesis(made, place)) == wanted


def test_the_line_of_a_reading(tmp_path: Path) -> None:
    """Readings by their ids, or by the number of their row; set-ups, points and given coordinates."""
    survey, _ = survey_of("hall", 3)
    hall = tmp_path / "hall"
    write_project(hall, survey)
    path = hall / "observations" / "terrestrial.csv"
    ids = [r.reading_id for r in survey.readings]
    where = path.relative_to(hall).as_posix()
    held = next(p.point_id for p in survey.points if p.x_in_world.treatment == "held")
    setup = survey.readings[-1].setup_id
    at = line_of(hall, where, ids[4])
    for made, place, wanted in (
        ((ChangeReadings((ids[4],), -1.0),), None, f"{where}:{at}"),
        ((), Place("reading", (ids[4],), "value"), f"{where}:{at}"),
        ((), Place("setup", (setup,), "value"), f"{where}:{line_of(hall, where, setup)} and "),
        ((), Place("reading", ("lengths",), "value"), f"{where}:2 and {len(ids) - 1} more rows"),
        ((), Place("point", (held,), "x"), f"survey.toml:{line_of(hall, 'survey.toml', f'{held} = ')}"),
    ):
        assert ProjectFiles(hall).of(hypothesis(made, place)).startswith(wanted)
    rows = [line.split(",") for line in path.read_text(encoding="utf-8").splitlines()]
    column = rows[0].index("reading_id")
    path.write_text("\n".join(",".join(c for i, c in enumerate(r) if i != column) for r in rows) + "\n",
                    encoding="utf-8")  # fmt: skip
    assert ProjectFiles(hall).of(hypothesis((ChangeReadings(("r12", "r7"), -1.0),))) == f"{where}:8 and 1 more rows"
    before = {r.reading_id: r.value for r in read(hall).survey.readings}
    carried_out(hall, hypothesis((ChangeReadings(("r7",), 1.0, 0.25),)))
    after = {r.reading_id: r.value for r in read(hall).survey.readings}
    assert {n for n in before if after[n] != before[n]} == {"r7"}
    assert after["r7"] - before["r7"] == pytest.approx(0.25)


@pytest.mark.parametrize("edit", [
    ScaleKey(("targets", "board", "square_mm"), 2.5), SetKey(("cameras", "L", "lens", "free"), ("k1", 0.1)),
    ChangeColumns("pairs", ("tx_mm", "ty_mm"), np.array([[0.0, 1.0], [0.1 + 0.2, 0.0]]), np.array([1.0, 2.0]),
                  {"pair_id": ("p1", "p2")}),
    ExchangeColumns("pairs", ("a_id", "b_id")), ChangeReadings(("r1", "r2"), -1.0, 1.0 / 3.0, "distances", "sigma"),
    Rename("image_points", "camera_id", {"L": "R", "R": "L"}, {"epoch_id": ("t1",)}), LeaveOut(("epoch:t1",)),
], ids=lambda e: type(e).__name__)  # fmt: skip
def test_an_edit_as_results_tell_it_is_the_same_edit(edit: Edit) -> None:
    again = edit_told(json.loads(json.dumps(plain(told_edit(edit)))))
    assert type(again) is type(edit)
    for name, value in vars(edit).items():
        np.testing.assert_array_equal(getattr(again, name), value)


@pytest.fixture(scope="module")
def adjusted_swapped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An adjusted project with a mistake, of which its results tell the cause."""
    lab = labs.example("relay", tmp_path_factory.mktemp("swapped") / "lab")
    labs.with_rows(lab / "observations" / "pairs.csv", lambda i, row: i % 3 == 0 and row.update(
        a_id=row["b_id"], b_id=row["a_id"]))  # fmt: skip
    assert main(["adjust", str(lab), "--quiet"]) == 3
    return lab


@pytest.fixture
def swapped(adjusted_swapped: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(adjusted_swapped, tmp_path / "lab"))


def counted(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What the project is called each time that it is adjusted for its diagnosis."""
    adjusted: list[str] = []
    monkeypatch.setattr(trying, "adjust_project", lambda project, progress: adjusted.append(
        project.folder.name) or adjust_project(project, progress))  # fmt: skip
    return adjusted


@pytest.mark.slow
def test_a_cause_that_results_tell_is_carried_out_at_once(
    swapped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As it is where they are not there, and the project is adjusted first."""
    adjusted, other = counted(monkeypatch), tmp_path / "other"
    shutil.copytree(swapped, other)
    shutil.rmtree(other / "results")
    said = [try_job(folder, 1) for folder in (swapped, other)]
    assert adjusted == ["other"]
    assert said[0] == said[1]
    assert files(swapped / "observations") == files(other / "observations")
    with pytest.raises(SurveyError, match="names no cause that it could change"):
        try_job(swapped, 1)  # its inputs are others by now
    assert adjusted == ["other", "lab"]


@pytest.mark.slow
@pytest.mark.parametrize("changed", [
    lambda edit, _: edit.update(table="../../pairs"), lambda edit, _: edit.update(edit="Survey"),
    lambda edit, _: edit.pop("columns"), lambda _, inputs: inputs["versions"].update(gtsam="0"),
], ids=["elsewhere", "no edit", "no columns", "other versions"])  # fmt: skip
def test_results_that_are_not_ours_are_not_carried_out(
    changed: Callable, swapped: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    adjusted, path = counted(monkeypatch), swapped / "results" / "solution.json"
    solution = json.loads(path.read_text(encoding="utf-8"))
    changed(solution["diagnosis"][0]["edits"][0], solution["inputs"])
    path.write_text(json.dumps(solution), encoding="utf-8")
    assert "pairs.csv: changed" in try_job(swapped, 1)
    assert adjusted == ["lab"]
