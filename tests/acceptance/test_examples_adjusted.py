"""Whole jobs on example folders, through the command line, against the truth that stands beside them."""

import json
import runpy
import shutil
from pathlib import Path

import numpy as np
import pytest

from survey.cli import main
from tests import labs

COMPARE = runpy.run_path(str(Path(__file__).resolve().parents[2] / "examples" / "compare_with_truth.py"))


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """The example with two cameras, adjusted once."""
    folder = labs.example("stereo", tmp_path_factory.mktemp("jobs") / "stereo")
    assert main(["--quiet", "adjust", str(folder)]) == 0
    return folder


def _errors(folder, results=None):
    solution = json.loads(((results or folder / "results") / "solution.json").read_text())
    truth = json.loads((folder / "truth.json").read_text())["parameters"]
    return np.concatenate([errors for _, errors in COMPARE["compared"](solution, truth)])


def test_all_results_are_written(lab):
    assert (lab / "observations" / "image_points.csv").is_file()
    found = {path.name for path in (lab / "results").iterdir()}
    assert {"solution.json", "covariance.npz", "residuals.csv", "report.html"} <= found
    assert not [path for path in lab.rglob("*") if path.name.endswith(".tmp")]


def test_errors_are_what_the_sigmas_say(lab):
    errors = _errors(lab)
    assert len(errors) == 2 * 8 + 6
    # the numbers of one lens hang together, so their mean square scatters more than 22 independent ones would
    assert np.sqrt(np.mean(errors**2)) < 2.0
    assert np.abs(errors).max() < 4.5


def test_sigmas_are_small_enough_to_be_of_use(lab):
    solution = json.loads((lab / "results" / "solution.json").read_text())
    right = solution["cameras"]["right"]
    assert max(right["station_from_camera"]["sigma_translation_mm"]) < 1.0
    assert max(right["lens"][f"sigma_{name}_px"] for name in ("fx", "fy", "u0", "v0")) < 3.0
    assert 0.5 < solution["summary"]["sigma0"] < 1.5


def test_the_same_folder_gives_the_same_bytes(lab, tmp_path):
    assert main(["--quiet", "adjust", str(lab), "--out", str(tmp_path / "other")]) == 0
    before = lab / "results"
    after = next(path.parent for path in (tmp_path / "other").rglob("solution.json"))
    for name in ("residuals.csv", "residuals_other.csv"):
        assert (before / name).read_bytes() == (after / name).read_bytes()
    solutions = [json.loads((folder / "solution.json").read_text()) for folder in (before, after)]
    for solution in solutions:
        del solution["inputs"]  # holds date and durations
        # the first run detected and warns of nothing; both must say the same
    assert solutions[0] == solutions[1]


def test_json_holds_the_summary(lab, tmp_path, capsys):
    assert main(["--json", "--quiet", "adjust", str(lab), "--out", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert json.loads(out)["summary"]["converged"] is True


def test_detect_says_what_it_found(lab, capsys):
    assert main(["--quiet", "detect", str(lab), "--all"]) == 0
    out = capsys.readouterr().out
    assert "24 of 24 images" in out
    assert out.endswith(f"Next: labsurvey adjust {lab}\n")


def test_a_batch_with_a_broken_project_still_does_the_other(lab, tmp_path, capsys):
    broken = tmp_path / "broken"
    shutil.copytree(lab, broken, ignore=shutil.ignore_patterns("images", "results"))
    text = (broken / "survey.toml").read_text().replace("image_size_px", "image_size_pix", 1)
    (broken / "survey.toml").write_text(text)
    (lab / "results" / "solution.json").unlink()
    assert main(["--quiet", "adjust", str(broken), str(lab)]) == 1
    table = capsys.readouterr().out.splitlines()
    assert table[1].split()[:2] == [str(broken), "error"]
    assert table[2].split()[:2] == [str(lab), "done"]
    assert (lab / "results" / "solution.json").is_file()


def test_a_misspelt_key_is_named_with_its_line(lab, tmp_path, capsys):
    folder = tmp_path / "misspelt"
    shutil.copytree(lab, folder, ignore=shutil.ignore_patterns("images", "results"))
    text = (folder / "survey.toml").read_text().replace("square_mm", "square_m", 1)
    (folder / "survey.toml").write_text(text)
    assert main(["adjust", str(folder)]) == 1
    err = capsys.readouterr().err
    assert "survey.toml:" in err
    assert "did you mean 'square_mm'?" in err
