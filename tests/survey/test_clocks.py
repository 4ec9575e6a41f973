"""Clocks of cameras, tables and robots: from survey.toml to solution, report and terminal, and back."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import survey as labsurvey
from adjust.model.errors import SurveyError
from adjust.model.survey import LensDrift, Survey, VectorParameter, VectorPrior
from survey.cli import main
from survey.jobs.adjusting.job import adjust_job
from survey.jobs.adjusting.warm_start import WARM, survey_start, warm_adjustment
from survey.jobs.converting import convert_job
from survey.project import read, write_project
from survey.report.page import report_html
from survey.report.terminal import summary_text
from survey.solution.earlier.previous import read_previous
from tests.adjust.moving import board_before_cameras, camera_on_hand, clock, head_on_moving_table
from tests.data import data_folder
from tests.survey.test_files import differences

RIGHT = ("camera_clock", "right")


def with_rows() -> Survey:
    """A camera that is late, reads its rows in turn and wavers from epoch to epoch."""
    survey, _ = board_before_cameras(
        8, {"right": clock(2e-3, offset=0.02, drift=1e-3, line_time=2e-5)}, {RIGHT: np.array([0.02, 1e-3, 2e-5])}
    )
    (left, right), prior = survey.cameras, VectorPrior(("drift",), np.zeros(1), np.array([[1e-4]]))
    late = right.clock
    assert late is not None
    return replace(survey, cameras=(left, replace(right, clock=replace(
        late, parameters=replace(late.parameters, prior=prior)))))  # fmt: skip


MADE = {
    "camera": with_rows,
    "table": lambda: head_on_moving_table(
        8, {"turntable": clock(offset=0.01)}, {("table_clock", "turntable"): np.array([0.01])})[0],
    "robot": lambda: camera_on_hand(
        8, {"hand": clock(offset=0.01, drift=0.0)}, {("pose_clock", "hand"): np.array([0.01, 0.0])})[0],
    "evenly spaced": lambda: replace(with_rows(), times={}, epoch_interval=0.2),
}  # fmt: skip


@pytest.mark.parametrize("kind", list(MADE))
def test_a_project_says_what_its_clocks_are(tmp_path: Path, kind: str) -> None:
    survey = MADE[kind]()
    write_project(tmp_path / "a", survey)
    again = read(tmp_path / "a")
    for name in ("cameras", "tables", "stations"):
        for one, other in zip(getattr(again.survey, name), getattr(survey, name), strict=True):
            assert differences(one.clock, other.clock) == []
    assert (again.survey.times, again.survey.epoch_interval) == (survey.times, survey.epoch_interval)
    write_project(tmp_path / "b", again.survey, target_kinds=again.target_kinds)
    assert (tmp_path / "b" / "survey.toml").read_text() == (tmp_path / "a" / "survey.toml").read_text()


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('clock = { free = ["offset"], offset_ms = 3 }', r"clock\.offset_ms: the times of the epochs are not known"),
        ('clock = { free = ["offset"], jitter_ms = 3 }', r"clock\.jitter_ms: the times of the epochs are not known"),
        ('clock = { free = ["ofset"] }', "unknown parameter 'ofset'"),
        ("clock = { jitter_intervals = -1 }", "found -1; a sigma is not negative"),
        ("clock = { offset_s = 1 }", "unknown key"),
    ],
)
def test_clocks_that_cannot_be_meant_are_refused(tmp_path: Path, table: str, said: str) -> None:
    survey, _ = board_before_cameras(6)
    write_project(tmp_path, replace(survey, times={}))
    path = tmp_path / "survey.toml"
    path.write_text(path.read_text().replace("[cameras.right]", f"[cameras.right]\n{table}"))
    with pytest.raises(SurveyError, match=rf"survey\.toml:\d+: .*{said}"):
        read(tmp_path)


def test_times_are_said_once(tmp_path: Path) -> None:
    write_project(tmp_path, board_before_cameras(6)[0])
    path = tmp_path / "survey.toml"
    path.write_text("epoch_interval_s = 0.2\n" + path.read_text())
    with pytest.raises(SurveyError, match="times_s is given too"):
        read(tmp_path)


@pytest.mark.slow
def test_clocks_reach_result_report_and_terminal(tmp_path: Path) -> None:
    write_project(tmp_path, with_rows())
    solution = labsurvey.adjust(tmp_path)
    entry = solution.as_dict["cameras"]["right"]["clock"]
    assert entry["line_time_us"] == pytest.approx(20.0, abs=5.0 * entry["sigma_line_time_us"])
    assert entry["offset_ms"] == pytest.approx(20.0, abs=5.0 * entry["sigma_offset_ms"])
    assert set(entry["significance"]) == {"clock_offset", "clock_drift", "clock_line_time", "clock_jitter"}
    assert entry["significance"]["clock_line_time"]["significant"]
    assert all(own["sigma_jitter_ms"] > 0.0 for own in entry["epochs"].values())
    assert "Clock" in report_html(solution.adjustment, solution.run)
    assert "eigene Zeiten" in report_html(solution.adjustment, solution.run, None, None, "de")
    found = solution.precision.consistency
    assert found is not None
    (epoch,) = (part for part in found.parts if (part.kind, part.name) == ("epoch", "e04"))
    assert epoch.n == 2 * 54 * 2
    assert epoch.redundancy < epoch.n
    assert not epoch.fails
    text = summary_text(solution.adjustment, solution.run)
    assert "clock line time" in text
    assert "clock offset" in text


@pytest.mark.slow
def test_without_times_clocks_count_intervals(tmp_path: Path) -> None:
    survey, _ = board_before_cameras(10, {"right": clock(offset=0.02)}, {RIGHT: np.array([0.02])})
    write_project(tmp_path, replace(survey, times={}))
    entry = labsurvey.adjust(tmp_path).as_dict["cameras"]["right"]["clock"]
    assert entry["offset_intervals"] == pytest.approx(0.1, abs=5.0 * entry["sigma_offset_intervals"])


@pytest.mark.slow
@pytest.mark.usefixtures("undiagnosed")
def test_what_was_found_before_is_where_the_next_search_begins(tmp_path: Path) -> None:
    """Clocks, warps and lenses that change: the values of the last solution, not those of survey.toml."""
    survey, _ = board_before_cameras(14, {"right": clock(1e-3, offset=0.03)}, {RIGHT: np.array([0.03])})
    left, right = survey.cameras
    drift = LensDrift(("fx", "u0"), ("e06",))
    warp = VectorParameter(("warp_x", "shear"), np.array([0.0, 1e-3]), ("warp_x",))
    survey = replace(survey, cameras=(replace(left, lens=replace(left.lens, drift=drift)), right),
                     targets=(replace(survey.targets[0], warp=warp),))  # fmt: skip
    write_project(tmp_path, survey)
    adjust_job(tmp_path, progress=False)
    found = labsurvey.adjust(tmp_path).adjustment.estimates
    project = read(tmp_path)
    previous = read_previous(project)
    start = survey_start(project.survey, previous)
    assert start is not None
    names = [n for n in found if n[0] in ("camera_clock", "warp", "lens_drift")]
    assert {n[0] for n in names} == {"camera_clock", "warp", "lens_drift"}
    for name in names:
        np.testing.assert_allclose(start.vectors[name], np.asarray(found[name].value), rtol=1e-9, atol=1e-15)
    warm, how = warm_adjustment(project, previous, False)
    assert how == WARM
    assert warm.iterations <= 2


@pytest.mark.slow
def test_free_running_cameras_are_named_and_remedied(tmp_path: Path) -> None:
    """Cause named first, keys written, and the misfit a tenth of what it was, with more images."""
    folder = Path(shutil.copytree(data_folder("calibration", "unsynchronised"), tmp_path / "session"))

    def solution() -> dict:
        return json.loads((folder / "results" / "solution.json").read_text(encoding="utf-8"))

    assert main(["adjust", str(folder), "--quiet"]) == 3
    before = solution()
    first = before["diagnosis"][0]
    assert (first["name"], first["ids"]) == ("cameras not simultaneous", ["cam1"])
    assert first["can_be_tried"]
    assert main(["adjust", str(folder), "--quiet", "--try", "1"]) == 3
    after = solution()
    assert after["summary"]["sigma0"] < 0.2 * before["summary"]["sigma0"]
    late = after["cameras"]["cam1"]["clock"]
    assert abs(late["offset_intervals"] + 0.116 * 6.0) < 2.0 * late["sigma_offset_intervals"]
    assert late["significance"]["clock_offset"]["significant"]
    assert after["cameras"]["cam1"]["rms_residual_px"] < 0.15


@pytest.mark.parametrize("format", ["kalibr", "tum", "opencv"])
def test_exports_say_that_they_hold_no_clock(tmp_path: Path, format: str) -> None:
    write_project(tmp_path / "lab", MADE["robot"]())
    assert main(["adjust", str(tmp_path / "lab"), "--quiet"]) in (0, 3)
    said = convert_job(tmp_path / "lab", tmp_path / "out", format=format).left_out
    assert "the poses of station hand: its clock (offset, drift) is not written: poses are those at the epochs" in said
