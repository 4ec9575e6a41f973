"""What is left of an adjustment that failed: its state, gradient and culprits beside the message, and who they are."""

import json
import shutil
import tomllib
from pathlib import Path

import gtsam
import numpy as np
import pytest

import survey.jobs.adjusting.steps as steps
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.solver import SolveOptions, solve
from adjust.model.errors import GivenUpError, NotConvergedError, SurveyError
from adjust.model.result import Adjustment
from adjust.model.stopped import Stopped, UnknownState
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned
from survey.cli import main
from survey.jobs.adjusting.probable_causes import adjusted_or_explained
from survey.project import read
from survey.project.writing import write_project
from survey.simulate import stereo
from tests.acceptance.planted_mistakes import MISTAKES, survey_of
from tests.adjust import helpers as h


def stopped() -> tuple[NotConvergedError, gtsam.Values, AdjustmentGraph]:
    """An adjustment given up after its second step, its start, and its graph."""
    survey, truth = stereo(1, n_pairs=5)
    graph = h.build(survey, h.shaken(h.start_at(truth), 1, 0.05))
    with pytest.raises(NotConvergedError) as raised:
        solve(graph, SolveOptions(max_iterations=2))
    return raised.value, graph.start, graph


@pytest.mark.usefixtures("undiagnosed")
def test_what_nothing_explains_is_not_given_up(tmp_path: Path) -> None:
    """It is gone through once more, to the end."""
    survey, _ = stereo(1, n_pairs=5)
    write_project(tmp_path / "lab", survey)
    hopes: list[float] = []

    def run(how: CleanOptions) -> Adjustment:
        hopes.append(how.adjust.solve.hopeless)
        if np.isfinite(hopes[-1]):
            raise GivenUpError("too far off")
        return adjust_cleaned(survey, how)

    assert adjusted_or_explained(survey, read(tmp_path / "lab"), CleanOptions(), run).global_test.passed
    components = sum(2 * b.n_used for b in survey.image_blocks)
    assert hopes == [1e5 * components, np.inf]


def pull_of(graph: AdjustmentGraph, values: gtsam.Values, unknown: UnknownState) -> float:
    """Slope of half of chi-square over the root of its curvature, by differences: the largest of any component."""
    key, out = graph.unknowns.by_name[unknown.name].key, []
    for i, name in enumerate(unknown.components):
        step = 1e-3 if name[0] in "fuv" else 1e-6
        sums = []
        for side in (-1.0, 0.0, 1.0):
            moved, new = gtsam.Values(values), np.array(unknown.value, dtype=float)
            new[i] += side * step
            moved.update(key, new)
            sums.append(0.5 * float(graph.whitened_squares(moved).sum()))
        slope, bend = (sums[2] - sums[0]) / (2 * step), (sums[2] - 2 * sums[1] + sums[0]) / step**2
        out.append(abs(slope) / np.sqrt(bend))
    return max(out)


def test_the_gradient_is_that_of_the_square_sum() -> None:
    """Against differences of chi-square; at its minimum nothing pulls."""
    error, start, graph = stopped()
    found = error.stopped
    assert isinstance(found, Stopped)
    assert found.iterations == 2
    at = {u.name: u for u in found.unknowns}
    lens = next(u for n, u in at.items() if n[0] == "lens")
    assert not np.allclose(np.asarray(lens.start), np.asarray(lens.value))
    values = gtsam.Values(start)
    for u in found.unknowns:
        key = graph.unknowns.by_name[u.name].key
        values.update(key, u.value)
    pull = {p.kind: p for p in found.gradient}
    best = max(pull_of(graph, values, u) for n, u in at.items() if n[0] == "lens")
    assert pull["lens"].largest[1] == pytest.approx(best, rel=0.3)
    assert set(pull) == {"lens", "station_from_camera", "carrier_from_target"}
    (group,) = found.groups
    assert group.n > 0
    assert group.at_start > group.where_stopped


@pytest.mark.slow
def test_failure_is_written_beside_what_was_there_and_goes_with_the_next_solution(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lab = tmp_path / "lab"
    write_project(lab, survey_of("stereo", 3)[0])
    assert main(["adjust", str(lab), "--quiet"]) == 0
    solved = (lab / "results" / "solution.json").read_bytes()
    real, error = steps.adjust_project, stopped()[0]

    def failing(*_: object, **__: object) -> None:
        raise SurveyError("it does <not> fit") from error

    monkeypatch.setattr(steps, "adjust_project", failing)
    assert main(["adjust", str(lab)]) == 1
    said = capsys.readouterr().err
    assert "it does <not> fit" in said
    assert f"written: {lab / 'results' / 'unsolved.html'}" in said
    assert (lab / "results" / "solution.json").read_bytes() == solved
    found = json.loads((lab / "results" / "unsolved.json").read_text(encoding="utf-8"))
    assert found["summary"]["converged"] is False
    assert found["summary"]["iterations"] == 2
    assert found["message"] == "it does <not> fit"
    state = found["state"]["station_from_camera/right"]
    assert set(state) == {"start", "value"}
    assert len(state["value"]["rotation_quaternion_wxyz"]) == 4
    assert found["gradient"][0]["largest_sigmas"] >= found["gradient"][-1]["largest_sigmas"]
    page = (lab / "results" / "unsolved.html").read_text(encoding="utf-8")
    assert "it does &lt;not&gt; fit" in page
    assert "lens of camera" in page
    assert main(["report", str(lab), "--quiet", "--language", "de"]) == 1
    assert "Beim Abbruch" in (lab / "results" / "unsolved.html").read_text(encoding="utf-8")
    monkeypatch.setattr(steps, "adjust_project", real)
    assert main(["adjust", str(lab), "--quiet"]) == 0
    assert not list((lab / "results").glob("unsolved*"))


def planted(name: str, kind: str, size: float, folder: Path, title: str = "") -> Path:
    mistake = next(m for m in MISTAKES if m.name == name and kind in m.kinds and m.title.startswith(title))
    survey, truth = survey_of(kind, 3)
    write_project(folder, mistake.plant(survey, truth, size))
    return folder


@pytest.mark.slow
def test_forgotten_motion_is_named_with_its_line_and_mended(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A board carried about by hand that is said to stand still: the beginner's first failure."""
    lab = planted("motion forgotten", "stereo", 12.0, tmp_path / "lab")
    lines = (lab / "survey.toml").read_text(encoding="utf-8").splitlines()
    line = lines.index('motion = "fixed"', lines.index("[targets.board]")) + 1
    assert main(["adjust", str(lab), "--quiet"]) == 1
    said = capsys.readouterr().err
    first = said.splitlines()[1]
    assert first.startswith("  - target board moves between epochs, but is said to stand still")
    assert f"; survey.toml:{line}; --try 1)" in first
    found = json.loads((lab / "results" / "unsolved.json").read_text(encoding="utf-8"))["diagnosis"][0]
    assert (found["name"], found["where"], found["can_be_tried"]) == ("motion forgotten", f"survey.toml:{line}", True)
    page = (lab / "results" / "unsolved.html").read_text(encoding="utf-8")
    assert "labsurvey adjust lab --try 1" in page
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    assert tomllib.loads((lab / "survey.toml").read_text(encoding="utf-8"))["targets"]["board"]["motion"] == "epoch"
    shutil.copy(lab / "kept" / "survey-1.toml", lab / "survey.toml")
    assert main(["adjust", str(lab), "--quiet"]) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("size", "title"), [(0.1, "of a coordinate"), (10.0, "of a reading")])
def test_a_slipped_decimal_is_named_with_its_line_and_mended(
    size: float, title: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """570.043 written as 57.0043, of a given coordinate or of a distance."""
    lab = planted("slipped decimal", "plane", size, tmp_path / "lab", title)
    main(["adjust", str(lab), "--quiet"])
    said = capsys.readouterr()
    first = next(line for line in (said.out + said.err).splitlines() if "slipped" in line)
    assert "has slipped" in first
    assert ("survey.toml:" if size == 0.1 else "observations/terrestrial.csv:") in first
    assert "--try 1" in first
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("column", "row", "factor", "says"),
    [("value_m", "slope_distance2-1", 0.1, "reading slope_distance2-1: its decimal point has slipped"),
     ("value_deg", "direction1-3", 0.9, "reading direction1-3: its values are gon, read as degrees")],
)  # fmt: skip
def test_a_single_reading_that_is_left_out_is_named_as_it_was_meant(
    column: str, row: str, factor: float, says: str, tmp_path: Path
) -> None:
    """The search for gross errors leaves it out; what it was meant to be is told, and done by --try."""
    lab = tmp_path / "lab"
    write_project(lab, survey_of("hall", 3)[0])
    table = lab / "observations" / "terrestrial.csv"
    rows = [line.split(",") for line in table.read_text(encoding="utf-8").splitlines()]
    at = rows[0].index(column)
    (line,) = (i for i, r in enumerate(rows) if row in r)
    before = float(rows[line][at])
    rows[line][at] = repr(before / factor)
    table.write_text("\n".join(map(",".join, rows)) + "\n", encoding="utf-8")
    main(["adjust", str(lab), "--quiet"])
    said = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert said["warnings"][0].startswith(f"probable cause: {says}")
    assert said["diagnosis"][0]["where"] == f"observations/terrestrial.csv:{line + 1}"
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    after = [r.split(",") for r in table.read_text(encoding="utf-8").splitlines()]
    assert float(after[line][at]) == pytest.approx(before, rel=1e-10)
