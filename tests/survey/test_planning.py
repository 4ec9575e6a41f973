"""plan.toml, what is built from it, and the outcome: against simulation by other code, adjustments, and each other."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import AdjustOptions, adjust
from adjust.design import exact, expect, with_candidates
from adjust.model.errors import IndeterminateError, SurveyError
from survey.planning.building import build_plan
from survey.planning.errors import error_analysis_job
from survey.planning.job import PlanRequest, planning_job
from survey.planning.plan_file import read_plan
from survey.planning.wanted import wanted_components
from survey.project import read, write_project
from survey.report.charts import Series, chart
from survey.report.drawing import ticks
from survey.simulate import resample
from survey.simulate.scene import Scene
from tests.survey.planning_lab import PLAN, write_lab


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    folder = tmp_path_factory.mktemp("plan") / "lab"
    _, truth = write_lab(folder)
    project = read(folder)
    plan = read_plan(folder, project.survey)
    return folder, project, plan, build_plan(project, plan, None), truth


@pytest.fixture(scope="module")
def outcome(lab):
    return planning_job(lab[0], PlanRequest(add=2, navigation=True, place=10), progress=False)


def rewritten(lab, tmp_path, old, new, name="plan.toml"):
    """A copy of the lab with one change in its plan, or in another of its files."""
    folder = tmp_path / "lab"
    shutil.copytree(lab[0], folder)
    text = (folder / name).read_text()
    assert old in text
    (folder / name).write_text(text.replace(old, new, 1))
    return folder


@pytest.mark.slow
def test_predicted_images_are_opencvs(lab):
    _, _, _, planned, truth = lab
    survey = planned.survey
    here = dict(truth)
    for name, value in planned.start.vectors.items():
        here[name] = value
    for name, value in planned.start.poses.items():
        here[name] = value
    scene = Scene(survey, here)
    assert len(survey.image_blocks) > 40
    for block in survey.image_blocks:
        x = scene.world_points() if block.target_id is None else scene.target_points(block.target_id, block.epoch_id)
        uv = scene.project(block.camera_id, block.epoch_id, x)
        np.testing.assert_allclose(block.uv, uv[block.point_idx], atol=1e-8)
        inside = set(np.flatnonzero(scene.inside(block.camera_id, uv, 5.0)).tolist())
        assert set(block.point_idx.tolist()) <= inside


def test_hand_held_epochs_show_the_board_where_they_say(lab):
    _, _, plan, planned, truth = lab
    for moments in plan.planned.epochs[2:]:
        hand = moments.by_hand
        for m in moments.moments:
            seen = [b for b in planned.survey.image_blocks if (b.camera_id, b.epoch_id) == (hand.camera_id, m.epoch_id)]
            assert len(seen) == 1
            pose = planned.start.poses["world_from_station", "head", m.epoch_id]
            camera = pose * planned.start.poses["station_from_camera", hand.camera_id]
            middle = 0.5 * (planned.survey.targets[0].x_in_target.min(axis=0)
                            + planned.survey.targets[0].x_in_target.max(axis=0))  # fmt: skip
            board = np.asarray((camera.inverse() * truth["carrier_from_target", "board"]).transformFrom(middle))
            assert 0.5 <= board[2] <= 0.9


@pytest.mark.slow
def test_the_plan_is_the_covariance_of_adjusting_it(lab, outcome):
    """Simulated observations of the very same design, adjusted from their own start: to rounding at the truth."""
    _, _, _, planned, _ = lab
    ideal = exact(planned.survey, planned.start)
    solved = adjust(ideal, planned.start, AdjustOptions())
    assert solved.redundancy == outcome.expected.redundancy
    for name, estimate in outcome.expected.estimates.items():
        np.testing.assert_allclose(estimate.cov, solved.estimates[name].cov, rtol=1e-6, atol=1e-20)
    summary = outcome.summary()
    sigma = np.sqrt(np.diag(solved.estimates["station_from_camera", "Y"].cov))
    assert summary["sigmas"]["station_from_camera.Y"]["sigma_tz_mm"] == pytest.approx(1e3 * sigma[5], rel=1e-6)
    assert summary["sigmas"]["station_from_camera.Y"]["sigma_rx_arcsec"] == pytest.approx(
        np.degrees(sigma[0]) * 3600, rel=1e-6
    )


def test_what_is_chosen_is_what_measuring_it_would_bring(lab, outcome):
    _, _, _, planned, _ = lab
    chosen = [planned.candidates[g.candidate_idx] for g in outcome.selection.steps]
    again = expect(with_candidates(planned.survey, chosen), planned.start)
    by_text = {}
    for name in again.precision.graph.unknowns.by_name:
        e = again.estimates[name]
        by_text |= {".".join((*name, c)): s for c, s in zip(e.components, np.sqrt(np.diag(e.cov)), strict=True)}
    for c, sigma in zip(outcome.selection.wanted, outcome.selection.after, strict=True):
        assert sigma == pytest.approx(by_text[c.text], rel=1e-6)
    assert {c.name[0] for c in outcome.selection.wanted} == {"station_from_camera"}
    kinds = {g.kind for g in outcome.selection.first}
    assert kinds == {"epoch", "beacon", "distance"}


def test_existing_observations_count(lab, tmp_path):
    """Half of the plan measured: existing and planned together are the whole plan, at the adjusted values."""
    folder, _, plan, planned, truth = lab
    survey = planned.survey
    here = dict(truth) | dict(planned.start.vectors) | dict(planned.start.poses)
    measured = resample(survey, here, seed=4)
    by_hand = {m.epoch_id for moments in plan.planned.epochs[2:] for m in moments.moments}
    half = replace(measured, image_blocks=tuple(b for b in measured.image_blocks if b.epoch_id not in by_hand))
    half = replace(half, image_blocks=tuple(b for b in half.image_blocks if b.epoch_id[0] == "t"),
                   table_readings=tuple(r for r in half.table_readings if r.epoch_id[0] == "t"),
                   points=half.points, coordinates=measured.coordinates, distances=measured.distances)  # fmt: skip
    there = tmp_path / "lab"
    project = read(folder)
    write_project(there, half, title="half", sigmas=project.sigmas)
    text = (folder / "plan.toml").read_text()
    start = text.index("[[epochs]]")
    rest = text[text.index("[[epochs]]", start + 1) : text.index("[[coordinates]]")]
    (there / "plan.toml").write_text(text[:start] + rest)
    found = planning_job(there, PlanRequest(add=0), progress=False)
    whole = expect(survey, planned.start)
    # hand-held poses follow from the adjusted cameras: a corner at the border may come or go
    assert found.expected.n_observations == pytest.approx(whole.n_observations, abs=12)
    assert found.expected.n_unknowns == whole.n_unknowns
    summary = found.summary()
    assert summary["existing_images"] == len(half.image_blocks)
    ratio = [
        np.sqrt(np.diag(found.expected.estimates[n].cov) / np.diag(whole.estimates[n].cov))
        for n in (("station_from_camera", "X"), ("lens", "Z"), ("point", "B05"))
        if np.diag(whole.estimates[n].cov).all()
    ]
    assert np.abs(np.concatenate(ratio) - 1.0).max() < 0.05  # linearised at noisy values, not at the truth


def test_navigation_is_what_navigation_itself_expects(outcome):
    n = outcome.navigation
    assert len(n.precision) == 16
    assert min(len(e.beacon_ids) for e in n.precision) >= 3
    weight = 1 / (6 * np.array([n.plan.required_rotation] * 3 + [n.plan.required_translation] * 3) ** 2)
    worst = max(float(np.diag(e.cov) @ weight) for e in n.precision)
    assert n.placement.final == pytest.approx(worst, rel=1e-3)
    on_wall = np.isclose(np.abs(n.places), [1.5, 1.5, 1.2]).any(axis=1)
    assert on_wall.all()
    assert np.abs(n.simulated - 1.0).max() < 0.12  # 1000 trials: 2.2 % each, the farthest of 16 poses


def test_patterns_name_components(lab, outcome):
    e = outcome.expected
    assert {c.text for c in wanted_components(e, ["lens.X.fx", "point.B01.*"])} == {
        "lens.X.fx", "point.B01.x", "point.B01.y", "point.B01.z"
    }  # fmt: skip
    assert len(wanted_components(e, ["head.camera_Y"])) == 6
    assert len(wanted_components(e, ["everything"])) == len(wanted_components(e, []))
    with pytest.raises(SurveyError, match=r"'lens.x' names nothing unknown; .*lens.X"):
        wanted_components(e, ["lens.x"])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('name = "t"', 'nmae = "t"', r"plan.toml:\d+: .*unknown key"),
        ('table = "turntable"', 'table = "turntabel"', r"plan.toml:\d+: .*unknown table 'turntabel'"),
        ('targets = ["board"]', 'targets = ["bord"]', r"plan.toml:\d+: .*unknown target 'bord'"),
        ("[[-40, 40, 40], [-180, 120, 60]]", "[[40, -40, 40], [-180, 120, 60]]", r"expected \[from, to, step\]"),
        ('from = "B01"', 'from = "B99"', r"plan.toml:\d+: .*unknown point 'B99'"),
        ('id = "N1"', 'id = "B01"', r"is a point of the survey already"),
        ('name = "c"', 'name = "t"', r"epoch 't01' is there already"),
        ("sigma_rotation_deg = 0.02\nsigma_translation_mm = 0.15", "", r"a requirement needs a sigma"),
        ('of = "head.camera_*"', 'of = "head.camera_Q"', r"names nothing unknown"),
        ('station = "head"', 'station = "hed"', r"unknown station 'hed'"),
        ("image_sigma_px = 0.115", "image_sigma_px = -1", r"it must be positive"),
        ('table = "turntable"\nangles_deg', 'count = 3\ntable = "turntable"\nangles_deg', r"say what moves"),
    ],
)
def test_faults_in_the_plan_are_named(lab, tmp_path, old, new, match):
    folder = rewritten(lab, tmp_path, old, new)
    with pytest.raises(SurveyError, match=match):
        planning_job(folder, progress=False)


def test_a_missing_value_is_named(lab, tmp_path):
    text = (lab[0] / "survey.toml").read_text()
    x = re.search(r"B03 = \{ (x_mm = \[[^]]*\]) \}", text)[1]
    folder = rewritten(lab, tmp_path, x, "", "survey.toml")
    with pytest.raises(SurveyError, match="points without coordinates: B03"):
        planning_job(folder, progress=False)


def test_what_a_plan_leaves_open_is_named(lab, tmp_path):
    """With one epoch of the table alone two cameras see nothing."""
    text = (lab[0] / "plan.toml").read_text()
    first = re.search(r"angles_deg = \[(\[[^]]*\]).*\]", text)
    text = text.replace(first[0], f"angles_deg = [{first[1]}]", 1)
    cut, rest = text.index("[[epochs]]", text.index("[[epochs]]") + 1), text.index("[[coordinates]]")
    folder = tmp_path / "lab"
    shutil.copytree(lab[0], folder)
    (folder / "plan.toml").write_text(text[:cut] + text[rest : text.index("[[candidates")])
    with pytest.raises(IndeterminateError, match="nothing observes lens of camera Y, lens of camera Z") as caught:
        planning_job(folder, progress=False)
    assert caught.value.parameters


@pytest.mark.slow
def test_trials_of_a_plan(lab):
    found = planning_job(lab[0], PlanRequest(add=0, trials=24, workers=1), progress=False)
    t = found.summary()["monte_carlo"]
    assert t["passed"]
    assert t["trials"] == 24
    redundancy = found.expected.redundancy
    assert t["mean_omega"] == pytest.approx(redundancy, abs=5 * np.sqrt(2 * redundancy / 24))


def test_error_analysis(tmp_path):
    found = error_analysis_job(tmp_path, n_trials=10_000, seed=1)
    summary = found.summary()
    for number, slope, tolerance in (("4", 3.5417, 1.412), ("5", 3.5417, 1.412), ("6", 29.9171, 0.1671)):
        figure = summary["figures"][number]
        unit = "deg" if number == "6" else "mm"
        assert figure[f"slope_px_per_{unit}"] == pytest.approx(slope, rel=1e-4)
        assert figure["largest_deviation"] < 0.01
        assert figure[f"tolerance_{unit}"] == pytest.approx(tolerance, rel=1e-3)
        assert len(figure[f"sigma_{unit}"]) == 10
    assert (tmp_path / "figure_4.svg").read_text().startswith('<svg xmlns="http://www.w3.org/2000/svg"')
    assert "Figure 6" in (tmp_path / "error_analysis.html").read_text()
    # the paper's conclusion for several pixels, taken as five: less than 1 mm and 0.17 deg
    printed = summary["figures_without_nearest_depth"]
    assert printed["6"]["tolerance_deg"] == pytest.approx(0.17, rel=0.03)
    assert 0.6 < printed["5"]["tolerance_mm"] < 1.3
    with pytest.raises(SurveyError, match="must be positive"):
        error_analysis_job(rms_px=0.0)


def test_charts():
    np.testing.assert_allclose(ticks(0.0, 1.0), [0, 0.2, 0.4, 0.6, 0.8, 1.0][: len(ticks(0.0, 1.0))], atol=1e-12)
    assert len(ticks(0, 17)) <= 7
    drawn = chart([Series("a < b", np.array([0.0, 1.0]), np.array([0.0, 2.0]), "#000", line=True)], "t", "x", "y")
    assert "a &lt; b" in drawn
    assert drawn.count("<polyline") == 1
    assert PLAN.count("[[epochs]]") == 5


def test_a_chain_of_pairs_in_closed_form(tmp_path):
    """Equal pairs one after the other: the rotation's variance grows by one pair each; a pair to the end joins in."""
    lines = ["format = 1"]
    for i in range(5):
        held = 'treatment = "held", ' if i == 0 else ""
        place = f"translation_mm = [{2000 * i}, {500 * (i % 2)}, 0], rotation_euler_xyz_deg = [0, 0, {10 * i}]"
        lines += [f"[stations.S{i}]", 'motion = "fixed"', f"world_from_station = {{ {held}{place} }}"]
    (tmp_path / "survey.toml").write_text("\n".join(lines))
    sigmas = "sigma_rotation_arcsec = 20\nsigma_translation_mm = 0.5\n"
    chain = [f'[[pairs]]\na = "S{i}"\nb = "S{i + 1}"\n{sigmas}' for i in range(4)]
    more = [f'[[candidates.pairs]]\na = "S0"\nb = "S{j}"\n{sigmas}' for j in (2, 4)]
    (tmp_path / "plan.toml").write_text("".join(chain + more))
    found = planning_job(tmp_path, PlanRequest(wanted=("world_from_station.S4.r?",), add=1), progress=False)
    for k in range(1, 5):
        entry = found.summary()["sigmas"][f"world_from_station.S{k}"]
        assert entry["sigma_rx_arcsec"] == pytest.approx(20.0 * np.sqrt(k), rel=1e-9)
    best = found.selection.steps[0]
    assert best.name == "S0-S4"
    # rotations alone would give 1 / (1/4 + 1) of a pair's variance; the lever arms of the translations help a little
    after = np.degrees(best.sigmas) * 3600
    assert np.all(after < 20.0 * np.sqrt(0.8) + 1e-6)
    assert np.all(after > 20.0 * np.sqrt(0.5))
    assert found.summary()["network"]["measured_pairs"] == 4
    assert "network: 5 stations, 4 of 10 pairs, 0 conditions" in found.text()
