"""The Python interface: public names, the five steps, data frames, covariances and plots by name, the notebook."""

import doctest
import json
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from gtsam import Pose3

import adjust
import survey
from survey.notebook import covariance as covariance_module
from survey.notebook.plots import PLOTS
from survey.simulate import head_on_table

ROOT = Path(__file__).resolve().parents[2]
ARCSEC = np.degrees(1.0) * 3600.0


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("api") / "head"
    simulated, _ = head_on_table(seed=1, n_cameras=2, n_table_epochs=5, n_free_epochs=3)
    survey.write_project(place, simulated, title="Head <b>")
    return place


@pytest.fixture(scope="module")
def solution(folder: Path) -> survey.Solution:
    return survey.solve(survey.problem(survey.read(folder)))


@pytest.mark.parametrize("package", [survey, adjust])
def test_public_names_are_there_and_documented(package: object) -> None:
    names = package.__all__
    assert sorted(names) == list(names) == dir(package)
    text = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
    for name in names:
        assert getattr(package, name).__doc__, name
        assert f"`{name}`" in text, name
    with pytest.raises(AttributeError, match="nonsense"):
        package.nonsense  # noqa: B018  # that it raises is the test


def test_importing_the_packages_loads_nothing_heavy() -> None:
    code = (
        "import sys, adjust, survey; heavy = {'numpy', 'gtsam', 'cv2', 'scipy', 'pandas', 'tqdm'};"
        "print(sorted(heavy & set(sys.modules)))"
    )
    found = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60)
    assert found.stdout.strip() == "[]"


@pytest.mark.slow
def test_the_api_gives_what_the_command_line_writes(solution: survey.Solution, folder: Path, tmp_path: Path) -> None:
    from survey.cli import main

    assert main(["adjust", str(folder), "--quiet"]) in (0, 3)
    paths = solution.report(tmp_path)
    ours, theirs = (json.loads((f / "results" / "solution.json").read_text()) for f in (tmp_path, folder))
    ours["inputs"].pop("date")
    theirs["inputs"].pop("date")
    assert (ours["inputs"].pop("command"), theirs["inputs"].pop("command")) == ("", f"labsurvey adjust {folder.name}")
    assert ours == theirs
    for name in ("residuals.csv", "residuals_other.csv", "covariance.npz"):
        assert paths[name].read_bytes() == (folder / "results" / name).read_bytes()


def test_frames_hold_the_numbers_of_the_result_files(solution: survey.Solution, tmp_path: Path) -> None:
    paths = solution.report(tmp_path)
    value = json.loads(paths["solution.json"].read_text())
    lens = value["cameras"]["X"]["lens"]
    assert solution.lenses.loc[("X", "fx"), "value"] == lens["fx_px"]
    assert solution.lenses.loc[("X", "fx"), "sigma"] == pytest.approx(lens["sigma_fx_px"], rel=1e-14)
    pose = value["cameras"]["Y"]["station_from_camera"]
    row = solution.cameras.loc["Y"]
    assert [row[f"{c}_mm"] for c in "xyz"] == pose["translation_mm"]
    assert [row[f"sigma_{c}_mm"] for c in "xyz"] == pose["sigma_translation_mm"]
    assert row["rms_px"] == pytest.approx(value["cameras"]["Y"]["rms_residual_px"], rel=1e-12)
    mount = value["stations"]["head"]["mount_from_station"]
    assert solution.stations.loc[("mount_from_station", "head", ""), "sigma_rx_arcsec"] == pytest.approx(
        mount["sigma_rotation_arcsec"][0]
    )
    geometry = value["tables"]["turntable"]["geometry"]
    assert solution.tables.loc[("turntable", "axis_offset"), "value"] == geometry["axis_offset_mm"]
    import pandas as pd  # here: not in the processes that only collect

    written = pd.read_csv(paths["residuals.csv"])
    frame = solution.image_residuals
    assert list(frame["point_id"]) == list(written["point_id"])
    np.testing.assert_allclose(frame["residual_u_px"], written["residual_u_px"], atol=6e-7)
    np.testing.assert_allclose(frame["redundancy_v"], written["redundancy_v"], atol=6e-6)
    other = pd.read_csv(paths["residuals_other.csv"])
    np.testing.assert_allclose(solution.readings["residual"], other["residual"], rtol=1e-10)
    assert solution.groups["redundancy"].sum() == pytest.approx(solution.redundancy, abs=1e-6)
    assert len(solution.reliability) == len(frame) + len(solution.adjustment.other_residuals)
    assert (solution.reliability["mdb_sigmas"].loc[lambda s: np.isfinite(s)] > 2).all()
    shares = solution.budget.groupby(["result", "component"])["share"].sum()
    np.testing.assert_allclose(shares, 1.0, atol=1e-6)


def test_frames_are_copies(solution: survey.Solution) -> None:
    before = solution.lenses.loc[("X", "fx"), "value"]
    frame = solution.lenses
    frame.loc[("X", "fx"), "value"] = -1.0
    residuals = solution.image_residuals
    residuals["residual_u_px"] = 0.0
    residuals.loc[:, "test"] = 0.0
    assert solution.lenses.loc[("X", "fx"), "value"] == before
    assert solution.image_residuals["test"].abs().sum() > 0.0


def test_without_pandas_it_is_said_what_to_install(solution: survey.Solution, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(survey.SurveyError, match=r"pip install 'labsurvey\[notebook\]'"):
        _ = solution.points
    assert solution.covariance("X").sigmas.all()  # needs none


def test_covariances_by_name(solution: survey.Solution) -> None:
    factor = solution.scale.factor**2
    cov = solution.covariance("head", "X")
    # head: where it was held by hand, epoch by epoch (on the table it is held); X: its lens and more
    kinds = list(dict.fromkeys(name for name, _ in cov.components))
    assert kinds[0][:2] == ("world_from_station", "head")
    assert len(kinds[0]) == 3
    assert ("lens", "X") in kinds
    # the blocks on the diagonal are those of the estimates, which other code put together
    for kind in kinds:
        rows = [i for i, (name, _) in enumerate(cov.components) if name == kind]
        e = solution.adjustment.estimates[kind]
        mine = [e.components.index(c) for name, c in cov.components if name == kind]
        np.testing.assert_allclose(
            cov.matrix[np.ix_(rows, rows)], factor * e.cov[np.ix_(mine, mine)], rtol=1e-7, atol=1e-18
        )
    assert np.linalg.eigvalsh(cov.correlation).min() > -1e-9
    one = solution.covariance("lens/X/fx")
    assert one.labels == ("lens/X/fx",)
    at = cov.labels.index("lens/X/fx")
    assert np.asarray(one)[0, 0] == pytest.approx(cov.matrix[at, at])
    assert solution.covariance(("lens", "X", "fx")).matrix == one.matrix
    prior = solution.covariance("lens/X/fx", sigmas="a_priori")
    assert prior.matrix * factor == pytest.approx(one.matrix, rel=1e-12)
    assert solution.covariance("X", "X").labels == solution.covariance("X").labels
    assert list(cov.frame.columns) == list(cov.labels)


@pytest.mark.slow
def test_joint_covariance_agrees_with_the_scatter_of_solutions() -> None:
    """Two cameras' focal lengths over fresh noise: d' inv(C) d is chi-square with two degrees of freedom."""
    from survey.simulate import resample, stereo

    simulated, truth = stereo(seed=1, n_pairs=4)
    true = np.array([truth["lens", c][0] for c in ("left", "right")])
    found = []
    for seed in range(12):
        a = adjust.solve(resample(simulated, truth, seed))
        made = survey.Solution(None, a, type("Run", (), {"sigmas": "a_priori"})())
        cov = made.covariance("lens/left/fx", "lens/right/fx")
        d = np.array([a.estimates["lens", c].value[0] for c in ("left", "right")]) - true
        found.append(float(d @ np.linalg.solve(cov.matrix, d)))
    # chi-square with 24 degrees of freedom: outside of these limits once in a thousand
    assert 7.45 < sum(found) < 54.0


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("Xx",), "nothing of that name"),
        (("lens/X/fy2",), "did you mean"),
        ((), "of what"),
    ],
)
def test_wrong_names_are_told_with_the_nearest(
    solution: survey.Solution, names: tuple[str, ...], message: str
) -> None:
    with pytest.raises(survey.SurveyError, match=message):
        solution.covariance(*names)


def test_what_is_held_has_no_covariance(solution: survey.Solution) -> None:
    held = next(n for n, e in solution.adjustment.estimates.items() if set(e.status) == {"held"})
    with pytest.raises(survey.SurveyError, match="it is held"):
        solution.covariance(held)


@pytest.mark.parametrize("name", PLOTS)
def test_every_plot_is_a_picture_of_its_own(solution: survey.Solution, name: str, tmp_path: Path) -> None:
    chosen = {"camera": "X"} if name in ("residuals", "mean_residuals", "histogram") else {}
    chosen |= {"group": "image"} if name == "quantiles" else {}
    plot = solution.plot(name, **chosen)
    root = ET.fromstring(plot.save(tmp_path / f"{name}.svg").read_text(encoding="utf-8"))
    assert root.tag == "{http://www.w3.org/2000/svg}svg"
    assert len(list(root.iter())) > 5
    assert plot._repr_svg_() == plot.svg


@pytest.mark.parametrize(
    ("name", "chosen", "message"),
    [
        ("residual", {}, "did you mean 'residuals'"),
        ("residuals", {}, "no camera is named"),
        ("residuals", {"camera": "Q"}, "no camera 'Q'"),
        ("map", {"camera": "X"}, "it takes nothing more"),
        ("quantiles", {"group": "images"}, "did you mean 'image'"),
    ],
)
def test_wrong_plots_are_told(solution: survey.Solution, name: str, chosen: dict[str, str], message: str) -> None:
    with pytest.raises(survey.SurveyError, match=message):
        solution.plot(name, **chosen)
    with pytest.raises(survey.SurveyError, match=r"\.svg"):
        solution.plot("map").save("map.png")


def test_everything_shows_itself_shortly_and_escaped(solution: survey.Solution, folder: Path) -> None:
    project = survey.read(folder)
    problem = survey.problem(project)
    for value in (project, problem, solution, solution.covariance("X"), solution.adjustment):
        assert 20 < len(repr(value)) < 3000
    for value in (problem, solution, solution.covariance("X")):
        html = value._repr_html_()
        assert "<table" in html
        assert "<b>Head" not in html
    assert "Head &lt;b&gt;" in solution._repr_html_()


def test_a_step_changes_nothing_before_it(folder: Path) -> None:
    problem = survey.problem(folder)
    other = problem.with_options(alpha=0.01)
    assert (problem.options.alpha, other.options.alpha) == (0.05, 0.01)
    assert other.survey is problem.survey
    with pytest.raises(survey.SurveyError, match="did you mean 'alpha'"):
        problem.with_options(alfa=0.01)


def test_nothing_observed_is_told(folder: Path, tmp_path: Path) -> None:
    for path in (p for p in folder.iterdir() if p.is_file()):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    with pytest.raises(survey.SurveyError, match="nothing is observed yet"):
        survey.adjust(tmp_path)


def test_poses_of_the_frame_are_those_of_the_estimates(solution: survey.Solution) -> None:
    estimate = solution.adjustment.estimates["station_from_camera", "Y"]
    assert isinstance(estimate.value, Pose3)
    row = solution.poses.loc[("station_from_camera", "Y", "")]
    # turned into the frame on the left by another road than the code's: cov of R dt
    R = estimate.value.rotation().matrix()
    expected = 1e3 * solution.scale.factor * np.sqrt(np.diag(R @ estimate.cov[3:, 3:] @ R.T))
    np.testing.assert_allclose([row[f"sigma_{c}_mm"] for c in "xyz"], expected, rtol=1e-12)
    unknown = solution.unknowns.loc[("station_from_camera", "Y", "", "rx")]
    assert unknown["sigma"] * ARCSEC == pytest.approx(row["sigma_rx_arcsec"], rel=1e-12)


def test_doctests_of_the_interface() -> None:
    found = doctest.testmod(covariance_module)
    assert found.attempted > 3
    assert found.failed == 0


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # of Jupyter
def test_notebooks_run(tmp_path: Path) -> None:
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    paths = sorted((ROOT / "examples" / "notebooks").glob("*.ipynb"))
    assert paths
    for path in paths:
        notebook = nbformat.read(path, as_version=4)
        assert not any(cell.get("outputs") for cell in notebook.cells)  # kept without outputs
        nbclient.NotebookClient(notebook, timeout=240, resources={"metadata": {"path": str(tmp_path)}}).execute()
        shown = [set(o["data"]) for c in notebook.cells for o in c.get("outputs", []) if "data" in o]
        assert sum("image/svg+xml" in kinds for kinds in shown) >= 3
        assert sum("text/html" in kinds for kinds in shown) >= 4
