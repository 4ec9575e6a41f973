"""The resident session: decided, adjusted, taken back; what is kept in memory is what the files say."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from gtsam import Pose3

import survey
from adjust.diagnosis.diagnosis import Candidate, Diagnosis
from adjust.diagnosis.hypothesis import Hypothesis, LeaveOut, Place
from adjust.diagnosis.trial import Misfit
from adjust.model.errors import DiagnosedError, SurveyError
from survey.cli import main
from survey.examples import write_example
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.excluding import exclude_job
from survey.project import read
from survey.report.anchors import anchors_in
from survey.solution.earlier.changes import Snapshot, solution_changes
from survey.solution.earlier.runs import MOST, list_runs, load_run
from survey.workbench import deciding
from survey.workbench.pictures import picture
from survey.workbench.rows import BY_PEOPLE, IN_USE, columns, point_rows
from survey.workbench.session import Workbench
from survey.workbench.situation import CancelledError, ChangedError
from tests import labs
from tests.survey.adjusted_benches import adjusted_bench

pytestmark = pytest.mark.slow


@pytest.fixture
def mine(lab, tmp_path):
    return shutil.copytree(lab[0], tmp_path / "lab")


@pytest.fixture
def bench(mine):
    return adjusted_bench(mine)


def exclusions(folder):
    path = folder / "observations/exclusions.csv"
    return path.read_text().splitlines()[1:] if path.exists() else []


def wrong_point(folder, by_px=6.0):
    """Move one image point of the tables; its id."""
    path = folder / "observations/image_points.csv"
    lines = path.read_text().splitlines()
    header = lines[0].split(",")
    cells = lines[200].split(",")
    u = header.index("u_px")
    cells[u] = repr(float(cells[u]) + by_px)
    path.write_text("\n".join([*lines[:200], ",".join(cells), *lines[201:]]) + "\n")
    row = dict(zip(header, cells, strict=True))
    return "/".join(x for x in (row["camera_id"], row["epoch_id"], row["target_id"], row["point_id"]) if x)


def same(a, b):
    changes = solution_changes(Snapshot(a.estimates, {}), Snapshot(b.estimates, {}))
    assert not changes.new
    assert not changes.gone
    return max((c.sigmas for c in changes.components if np.isfinite(c.sigmas)), default=0.0)


def test_a_decision_gives_what_the_command_line_gives(bench, mine):
    epoch = bench.situation.survey.image_blocks[0].epoch_id
    bench.exclude(f"left/{epoch}", reason="motion blur")
    assert bench.situation.mode == "warm"
    assert same(bench.adjustment, adjust_project(read(mine), False)) < 1e-5  # two ends of one convergence
    assert "motion blur" in exclusions(mine)[-1]


def test_parameters_have_the_angles_of_the_results(bench):
    columns = bench.parameters()["columns"]
    texts = {k: [columns[k]["texts"][i] for i in columns[k]["codes"]] for k in ("name", "component", "unit")}
    rows = list(zip(*texts.values(), columns["value"], strict=True))
    wanted = bench.statistics_part("solution")["solution"]["cameras"]["right"]["station_from_camera"]
    found = [row[2:] for row in rows if row[0] == "station_from_camera/right"]
    assert [unit for unit, _ in found] == [*(3 * ["deg"]), *(3 * ["mm"])]
    expected = [*wanted["rotation_euler_xyz_deg"], *wanted["translation_mm"]]
    assert [value for _, value in found] == pytest.approx(expected, rel=1e-12, abs=1e-12)
    assert all(value is not None for value in columns["value"])


@pytest.mark.parametrize("most_kept", [0, 300_000])
def test_undone_is_as_before_and_redone_as_decided(bench, mine, monkeypatch, most_kept):
    """Adjusted again, or as it was there already."""
    monkeypatch.setattr(deciding, "_MOST_KEPT", most_kept)
    first = bench.adjustment
    epoch = bench.situation.survey.image_blocks[0].epoch_id
    bench.exclude(f"epoch:{epoch}", reason="table was touched")
    decided = bench.adjustment
    assert bench.undo() is not None
    assert (bench.adjustment is first) == (most_kept > 0)
    assert same(first, bench.adjustment) < 1e-5
    bench.redo()
    assert (bench.adjustment is decided) == (most_kept > 0)
    assert same(decided, bench.adjustment) < 1e-5
    assert [line.split(",")[2] for line in exclusions(mine)] == ["excluded", "included", "excluded"]
    assert exclusions(mine)[-1].split(",")[3] == "table was touched"
    with pytest.raises(SurveyError, match="nothing to redo"):
        bench.redo()


def test_undone_is_adjusted_where_the_solution_of_before_rests_on_other_files(bench):
    first = bench.adjustment
    bench.exclude(f"epoch:{bench.situation.survey.image_blocks[0].epoch_id}", reason="table was touched")
    there = bench.done[-1].beyond
    files = {**there.everything.inputs, "survey.toml": "another"}
    bench.done[-1] = replace(bench.done[-1], beyond=replace(there, everything=replace(there.everything, inputs=files)))
    bench.undo()
    assert bench.adjustment is not first
    assert same(first, bench.adjustment) < 1e-5


def test_a_planted_mistake_is_found_left_out_and_back(mine):
    name = wrong_point(mine)
    bench = adjusted_bench(mine)
    worst = bench.findings()["findings"][0]
    assert worst["id"] == f"image_point:{name}"
    assert worst["share"] > 1.0
    change = worst["remedies"][0]["changes"][0]
    bench.exclude(change["name"], reason="reflection")
    assert all(f["id"] != worst["id"] for f in bench.findings()["findings"])
    row = next(i for i in np.flatnonzero(bench.rows.why == BY_PEOPLE))
    assert bench.rows.id_of(int(row)) == name
    assert np.isfinite(bench.rows.residuals[row]).all()  # predicted still: it can be invited back
    bench.undo()
    assert bench.findings()["findings"][0]["id"] == worst["id"]


def test_a_camera_left_out_can_still_be_seen_and_come_back(bench):
    n = len(bench.rows.why)
    bench.exclude("camera:right", reason="another lens")
    assert len(bench.rows.why) == n
    assert (bench.rows.why == BY_PEOPLE).any()
    bench.include("camera:right")
    assert (bench.rows.why == IN_USE).all()


def test_what_cannot_be_solved_is_not_recorded(bench, mine):
    before = bench.version
    with pytest.raises(SurveyError):
        bench.exclude("camera:left", reason="the station is not tied to the other")
    assert not exclusions(mine)
    assert bench.version == before
    assert not bench.undoable


def test_older_decisions_and_foreign_changes_are_refused(bench, mine):
    base, other = bench.version, survey.Workbench(mine)
    other.adjust()
    blocks = bench.situation.survey.image_blocks
    points = list(dict.fromkeys(f"left/{b.epoch_id}" for b in blocks if b.camera_id == "left"))
    other.exclude(points[0], reason="seen elsewhere")
    assert bench.changed_files() == ("observations/exclusions.csv",)
    with pytest.raises(ChangedError, match="changed meanwhile"):
        bench.exclude(points[1], reason="blur")
    assert len(exclusions(mine)) == 1
    bench.reload()
    with pytest.raises(ChangedError, match="solution has changed"):
        bench.exclude(points[1], reason="blur", base=base)
    bench.exclude(points[1], reason="blur", base=bench.version)
    assert len(exclusions(mine)) == 2


def test_read_only_writes_nothing(mine):
    before = {p: p.read_bytes() for p in mine.rglob("*") if p.is_file()}
    bench = adjusted_bench(mine, read_only=True)
    for act in (lambda: bench.exclude("camera:right", reason="x"), bench.undo, bench.save, lambda: bench.restore(1)):
        with pytest.raises(SurveyError, match="reading only"):
            act()
    assert before == {p: p.read_bytes() for p in mine.rglob("*") if p.is_file()}


def test_cancelled_at_its_next_step_the_solution_of_before_stays(bench, mine):
    before = bench.adjustment
    bench.watch = lambda *_: bench.cancel()
    with pytest.raises(CancelledError):
        bench.exclude("camera:right", reason="x")
    assert bench.adjustment is before
    assert not exclusions(mine)


def test_saved_as_adjust_saves_and_kept_as_a_run(bench, mine):
    n = len(list_runs(mine))
    epoch = bench.situation.survey.image_blocks[0].epoch_id
    bench.exclude(f"left/{epoch}", reason="blur")
    assert bench.n_unsaved == 1
    bench.save()
    assert bench.n_unsaved == 0
    saved = json.loads((mine / "results/solution.json").read_text())
    assert saved["exclusions"][0]["name"] == f"image:left/{epoch}"
    assert main(["adjust", str(mine), "--quiet"]) in (0, 3)
    again = json.loads((mine / "results/solution.json").read_text())
    assert saved["inputs"]["hashes"] == again["inputs"]["hashes"]
    assert saved["summary"]["sigma0"] == pytest.approx(again["summary"]["sigma0"], rel=1e-9)
    runs = list_runs(mine)
    assert len(runs) > n
    assert runs[-1].exclusions[0].reason == "blur"


def test_a_run_comes_back_as_it_was(bench, mine, capsys):
    bench.save()
    first = list_runs(mine)[-1].number
    before = bench.adjustment
    assert same(before, replace_estimates(before, load_run(mine, first))) < 1e-9
    bench.exclude("camera:right", reason="x")
    bench.save()
    assert main(["runs", str(mine), "compare", str(first), str(first + 1), "--quiet"]) == 0
    assert "lens/right" in capsys.readouterr().out
    assert main(["runs", str(mine), "pin", str(first)]) == 0
    assert "*" in capsys.readouterr().out
    assert bench.compare(first).largest
    bench.reload()
    assert bench.restore(first) == ()
    assert same(before, bench.adjustment) < 1e-5
    assert not read(mine).left_out
    assert main(["runs", str(mine), "restore", "99"]) == 1
    assert "there is no run 99" in capsys.readouterr().err


def replace_estimates(adjustment, kept):
    return replace(adjustment, estimates=kept.estimates)


def test_the_same_again_is_no_new_run_and_old_ones_go(bench, mine):
    bench.save()
    n = list_runs(mine)[-1].number
    bench.save()
    assert list_runs(mine)[-1].number == n
    for k in range(n + 1, n + MOST + 2):
        shutil.copytree(mine / f"runs/{n:04d}", mine / f"runs/{k:04d}")
    (mine / f"runs/{n + MOST + 1:04d}/run.json").write_text(
        (mine / f"runs/{n:04d}/run.json").read_text().replace('"fingerprint": "', '"fingerprint": "0')
    )
    bench.save()
    kept = [r.number for r in list_runs(mine)]
    assert len(kept) == MOST
    assert kept[-1] == n + MOST + 2
    assert not (mine / f"runs/{n:04d}").exists()


def test_changes_are_in_sigmas_of_before(bench):
    a = bench.situation.solved.snapshot
    name = next(n for n in a.estimates if n[0] == "lens")
    e = a.estimates[name]
    sigma = np.sqrt(np.diag(e.cov))
    k = int(np.argmax(sigma))
    moved = replace(e, value=np.asarray(e.value) + 2.0 * sigma[k] * np.eye(len(sigma))[k], cov=4.0 * e.cov)
    b = replace(a, estimates={**a.estimates, name: moved})
    largest = solution_changes(a, b).largest[0]
    assert largest.name == "/".join((*name, e.components[k]))
    assert largest.sigmas == pytest.approx(2.0)
    assert largest.ratio == pytest.approx(2.0)
    station = next(n for n, x in a.estimates.items() if isinstance(x.value, Pose3) and x.cov.any())
    e = a.estimates[station]
    step = np.array([0, 0, 0, 1e-3, 0, 0])
    c = replace(a, estimates={**a.estimates, station: replace(e, value=e.value * Pose3.Expmap(step))})
    found = next(x for x in solution_changes(a, c).components if x.name == "/".join((*station, "tx")))
    assert found.difference == pytest.approx(1.0, rel=1e-6)
    assert found.unit == "mm"


def test_columns_say_what_the_rows_say(bench):
    data = columns(bench.rows, 4.0, 7)
    n = int.from_bytes(data[:4], "little")
    header = json.loads(data[4 : 4 + n])
    found, at = {}, 4 + n
    for column in header["columns"]:
        found[column["name"]] = np.frombuffer(data, "<" + column["type"], header["n"], at)
        at += found[column["name"]].nbytes
    assert at == len(data)
    assert header["version"] == 7
    np.testing.assert_allclose(found["du"], bench.rows.residuals[:, 0], rtol=1e-6)
    np.testing.assert_allclose(found["w"] ** 2, bench.rows.test, rtol=1e-5)
    block = header["blocks"][found["block"][5]]
    point = header["points"][block["target"] or ""][found["point"][5]]
    parts = (block["camera"], block["epoch"], block["target"], point)
    assert "/".join(p for p in parts if p) == bench.rows.id_of(5)


def test_rows_are_joined_by_pixel_where_points_were_lost(bench):
    """The adjustment leaves points out, renumbers the others, and orders blocks in its own way."""
    adjusted, s = bench.adjustment, bench.situation.survey
    order = list(range(len(s.image_blocks)))[::-1]
    ptr, images = adjusted.image_residuals.block_ptr, adjusted.image_residuals
    rows = np.concatenate([np.arange(ptr[i] + 1, ptr[i + 1]) for i in order])  # the first point of each block is lost
    blocks = tuple(
        replace(b, uv=b.uv[1:], point_idx=b.point_idx[1:], cov=b.cov[1:], used=None if b.used is None else b.used[1:])
        for b in (adjusted.survey.image_blocks[i] for i in order)
    )
    sizes = [len(b.uv) for b in blocks]
    fewer = replace(
        adjusted, survey=replace(adjusted.survey, image_blocks=blocks),
        image_residuals=replace(images, block_ptr=np.cumsum([0, *sizes]), residuals=images.residuals[rows],
                                test=images.test[rows], redundancy=images.redundancy[rows], used=images.used[rows]),
    )
    whole, part = bench.rows, point_rows(s, s, fewer)
    there = np.isfinite(part.test)
    assert there.sum() == len(rows)
    np.testing.assert_array_equal(part.residuals[there], whole.residuals[there])


def test_preview_says_what_goes(bench):
    epoch = bench.situation.survey.image_blocks[0].epoch_id
    both = [f"{c}/{epoch}" for c in ("left", "right")]
    found = bench.preview(*both)
    assert found["epochs_lost"] == [epoch]
    assert set(found["images_lost"]) == set(both)
    with pytest.raises(SurveyError, match="nothing that was observed"):
        bench.preview("nowhere")


def test_pictures_are_looked_up_and_no_links_are_followed(tmp_path):
    image = np.full((300, 400), 1000, np.uint16)
    image[10:20] = 4000
    cv2.imwrite(str(tmp_path / "a.png"), image)
    (tmp_path / "b.png").symlink_to(tmp_path / "a.png")
    images = {("X", "a"): tmp_path / "a.png", ("X", "b"): tmp_path / "b.png"}
    data, kind = picture(images, ("X", "a"), 100)
    assert kind == "image/jpeg"
    small = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert small.shape == (75, 100)
    assert small.max() > 200 > 50 > small.min()
    assert picture(images, ("X", "a"), None)[1] == "image/png"
    with pytest.raises(SurveyError, match="is a link"):
        picture(images, ("X", "b"), 100)
    with pytest.raises(KeyError):
        picture(images, ("X", "../a"), 100)


def test_exclusions_of_another_command_are_those_of_the_next_session(bench, mine):
    epoch = bench.situation.survey.image_blocks[0].epoch_id
    exclude_job(mine, [f"left/{epoch}"], "by hand")
    bench.reload()
    assert [str(n) for n in bench.situation.exclusions] == [f"image:left/{epoch}"]
    assert bench.state()["exclusions"][0]["reason"] == "by hand"


def definition(folder):
    return (folder / "survey.toml").read_text()


def test_decisions_in_the_definition_keep_its_comments_and_come_back(mine):
    (mine / "survey.toml").write_text("# my laboratory\n" + definition(mine) + "\n# the end\n")
    bench = adjusted_bench(mine)
    before, first = definition(mine), bench.adjustment
    bench.set_sigma_scale("image", 2.0)
    assert bench.adjustment.omega < first.omega
    bench.set_treatment("lens/right/k1", "held")
    held = bench.adjustment.estimates["lens", "right"]
    k = held.components.index("k1")
    assert held.status[k] == "held"
    assert held.value[k] == pytest.approx(first.estimates["lens", "right"].value[k], abs=1e-4)
    text = definition(mine)
    assert text.startswith("# my laboratory\n")
    assert text.rstrip().endswith("# the end") or "# the end" in text
    bench.undo()
    bench.undo()
    assert definition(mine) == before
    assert same(first, bench.adjustment) < 1e-5
    bench.redo()
    assert "image = 2.0" in definition(mine)
    with pytest.raises(SurveyError, match="no parameter"):
        bench.set_treatment("lens/nobody", "held")
    with pytest.raises(SurveyError, match="sigmas"):
        bench.set_sigma_scale("no-such-group", 2.0)
    assert "no-such-group" not in definition(mine)


def test_a_pose_held_where_it_was_adjusted_gives_the_same(bench, mine):
    first = bench.adjustment
    bench.set_treatment("station_from_camera/right", "held")
    e = bench.adjustment.estimates["station_from_camera", "right"]
    assert set(e.status) == {"held"}
    assert e.value.equals(first.estimates["station_from_camera", "right"].value, 1e-9)
    assert bench.adjustment.omega == pytest.approx(first.omega, rel=1e-6)
    bench.set_treatment("station_from_camera/right", "free")
    assert same(first, bench.adjustment) < 1e-4


def test_a_damaged_run_stops_nobody(bench, mine, capsys):
    bench.save()
    n = list_runs(mine)[-1].number
    (mine / f"runs/{n:04d}/run.json").write_text("{")
    bench.exclude("camera:right", reason="x")
    bench.save()
    assert main(["runs", str(mine)]) == 1
    assert "remove its folder" in capsys.readouterr().err
    shutil.rmtree(mine / f"runs/{n:04d}")
    assert list_runs(mine)[-1].number == n + 1


def mirrored(folder, camera, first, width=1280):
    """The images of a camera from an epoch on mirrored, in the table of image points."""
    path = folder / "observations/image_points.csv"
    lines = path.read_text().splitlines()
    at = {name: k for k, name in enumerate(lines[0].split(","))}
    for i, line in enumerate(lines[1:], start=1):
        cells = line.split(",")
        if cells[at["camera_id"]] == camera and cells[at["epoch_id"]] >= first:
            cells[at["u_px"]] = repr(width - 1 - float(cells[at["u_px"]]))
            lines[i] = ",".join(cells)
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture
def spoilt(tmp_path):
    """A head on a table of which some images are mirrored, and its table of image points as it is then."""
    labs.example("head", tmp_path / "lab")
    mirrored(tmp_path / "lab", "Y", "tY01")
    return tmp_path / "lab", (tmp_path / "lab/observations/image_points.csv").read_bytes()


def test_a_remedy_is_carried_out_by_one_call_and_taken_back_by_undo_unless_others_changed_the_table(spoilt):
    folder, before = spoilt
    bench = adjusted_bench(folder)
    table = folder / "observations/image_points.csv"
    found = bench.findings()["remedies"]
    assert "mirrored" in found[0]["cause"]
    assert found[0]["possible"]
    assert 0.9 < found[0]["explained"] <= 1.0
    assert found[0]["statistic"] > found[0]["critical"]
    n_used = int(bench.adjustment.image_residuals.used.sum())
    bench.apply_remedy(1)
    assert bench.remedies == ()
    assert int(bench.adjustment.image_residuals.used.sum()) > n_used
    assert same(bench.adjustment, adjust_project(read(folder), False)) < 1e-5
    assert table.read_bytes() != before
    assert (folder / "kept/image_points-1.csv").read_bytes() == before
    bench.undo()
    assert table.read_bytes() == before
    assert len(bench.remedies) == len(found)
    bench.redo()
    assert bench.remedies == ()
    with pytest.raises(SurveyError, match="no cause that it could change"):
        bench.apply_remedy(1)
    table.write_text(table.read_text() + "# seen\n")
    with pytest.raises(ChangedError):
        bench.undo()
    assert table.read_text().endswith("# seen\n")


def test_what_cannot_be_adjusted_has_its_remedies_too(mine, monkeypatch):
    """The diagnosis of an adjustment that failed; what mends it is taken back to where there was no solution."""
    import survey.jobs.adjusting.steps as steps

    epoch = read(mine).survey.image_blocks[0].epoch_id
    real = steps.adjust_project
    cause = Hypothesis("moved", "epoch moved", "leave it out", Place("epoch", (epoch,)), read(mine).survey,
                       (LeaveOut((f"epoch:{epoch}",)),))  # fmt: skip

    def failing(project, *given, **named):
        if any(b.epoch_id == epoch and (b.used is None or b.used.any()) for b in project.survey.image_blocks):
            candidates = (Candidate(cause, 0.99, 500.0, 30.0, 1.0, 1.02),)
            raise DiagnosedError("nothing fits", Diagnosis(candidates, ("moved",), Misfit(1.0, 1.0, 0, 1)))
        return real(project, *given, **named)

    monkeypatch.setattr(steps, "adjust_project", failing)
    bench = Workbench(mine)
    with pytest.raises(SurveyError):
        bench.adjust()
    said = bench.findings()
    assert (said["verdict"], said["reason"], said["findings"]) == ("failed", "nothing fits", [])
    assert said["remedies"][0]["anchor"] == f"#epoch={epoch}"
    assert bench.state()["failure"] == "nothing fits"
    assert len(bench.points()) > 1000
    bench.apply_remedy(1)
    assert bench.failure is None
    assert bench.adjustment.sigma0 < 2
    assert "tried: epoch moved" in exclusions(mine)[-1]
    bench.undo()
    assert bench.state()["failure"] == "nothing fits"
    assert len(bench.remedies) == 1
    bench.redo()
    assert bench.adjustment.sigma0 < 2


def test_the_network_of_readings_is_where_the_solution_is(tmp_path):
    """A caliper's line is as long as its adjusted distance; a reading that was spoilt is the one beyond the limit."""
    write_example("total-station", tmp_path / "lab")
    path = tmp_path / "lab/observations/distances.csv"
    lines = path.read_text().splitlines()
    at = lines[0].split(",").index("value_mm")
    cells = lines[2].split(",")
    wrong, cells[at] = f"distances:{cells[0]}", repr(float(cells[at]) + 3.0)
    path.write_text("\n".join([*lines[:2], ",".join(cells), *lines[3:]]) + "\n")
    bench = adjusted_bench(tmp_path / "lab")
    found = bench.network()
    assert found["n_nowhere"] == 0
    adjusted = {o.ids[0]: o.adjusted[0] for o in bench.adjustment.other_residuals if o.kind == "distance"}
    ends = {x["id"].split(":")[1]: np.array(x["x"]) for x in found["lines"] if x["table"] == "distances"}
    assert adjusted.keys() == ends.keys()
    for name, (a, b) in ends.items():
        assert np.linalg.norm(b - a) == pytest.approx(adjusted[name], abs=1e-9)
    assert [x["id"] for x in found["lines"] if (x["share"] or 0) > 1] == [wrong]
    readings = bench.situation.everything.survey.readings
    assert {s["id"]: s["n"] for s in found["setups"]} == {k: sum(r.setup_id == k for r in readings)
                                                        for k in {r.setup_id for r in readings}}  # fmt: skip


@pytest.mark.parametrize(("said", "places"), [
    ("detection: images/R4/q01: blurred", ["#image=R4/q01"]),
    ("detection: images/R4/5.12.png: failed: lab/images/R4/5.12.png: no image", ["#image=R4/5.12"]),
    ("camera 'X', epoch 'hX05': half of its points do not fit", ["#image=X/hX05"]),
    ("table turntable, epoch t09: read twice", ["#reading=table_angles:turntable/t09"]),
])  # fmt: skip
def test_a_message_leads_to_the_place_it_names(said, places):
    assert anchors_in(said) == places
