"""Two halves of the epochs: what they share out, that sigmas are met, and that a lens which changed is named."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

import survey
from adjust.model.errors import SurveyError
from survey.cli import main
from survey.examples import write_example
from survey.jobs.cross_validation import halves
from tests import labs
from tests.survey.camera_lab import LENSES, write_lab

pytestmark = pytest.mark.usefixtures("undiagnosed")


def touched(folder: Path, camera: str, epochs: set[str], factor: float) -> None:
    """The focal length of a camera is another one at these epochs: its points move away from the principal point."""
    path, lens = folder / "observations" / "image_points.csv", LENSES[camera]
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    for row in rows:
        if row["camera_id"] == camera and row["epoch_id"] in epochs:
            for column, centre in (("u_px", lens["u0"]), ("v_px", lens["v0"])):
                row[column] = repr(centre + factor * (float(row[column]) - centre))
    with path.open("w", newline="") as stream:
        out = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        out.writeheader()
        out.writerows(rows)


def test_epochs_of_a_sort_take_turns_and_the_only_one_of_its_sort_is_in_both(tmp_path: Path) -> None:
    labs.example("head", tmp_path / "lab")
    project = survey.read(tmp_path / "lab")
    seen: dict[str, set[str]] = {}
    for block in project.survey.image_blocks:
        seen.setdefault(block.epoch_id, set()).add(block.camera_id)
    first, second = map(set, halves(project.survey))
    assert first | second == set(seen)
    sorts: dict[frozenset[str], set[str]] = {}
    for epoch, cameras in seen.items():
        sorts.setdefault(frozenset(cameras), set()).add(epoch)
    for epochs in sorts.values():
        assert abs(len(epochs & first) - len(epochs & second)) <= 1
        assert bool(epochs & first & second) == (len(epochs) == 1)


@pytest.mark.slow
@pytest.mark.parametrize("distance", [np.inf, 2.0])
def test_differences_are_as_large_as_the_covariances_expect(tmp_path: Path, distance: float) -> None:
    """The statistics of all cameras and repetitions together follow chi-square; so do the shifts, roughly."""
    found = []
    for seed in range(5):
        write_lab(tmp_path / str(seed), seed=seed)
        found += survey.cross_validate(tmp_path / str(seed), distance).cameras
    n = sum(len(c.components) for c in found)
    low, high = chi2.ppf([0.0005, 0.9995], n)
    assert low < sum(c.statistic for c in found) < high
    assert 0.5 < np.sqrt(np.mean([(c.rms_px / c.expected_px) ** 2 for c in found])) < 2.0


@pytest.mark.slow
def test_a_lens_that_changed_is_named(tmp_path: Path) -> None:
    folder = tmp_path / "lab"
    write_lab(folder)
    _, second = halves(survey.read(folder).survey)
    touched(folder, "right", set(second), 1.006)
    found = survey.cross_validate(folder)
    worst, other = found.cameras
    assert (worst.camera_id, other.camera_id) == ("right", "left")
    assert worst.p_value < 1e-6 < 1e-4 < other.p_value
    by = dict(zip(worst.components, worst.in_sigmas, strict=True))
    assert min(by["fx"], by["fy"]) > 3.0


@pytest.mark.slow
def test_the_command_says_it_as_text_and_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_lab(tmp_path / "lab")
    before = sorted(p for p in (tmp_path / "lab").rglob("*"))
    assert main(["cross-validate", str(tmp_path / "lab"), "--quiet"]) == 0
    assert "the motion of the camera taken out" in capsys.readouterr().out
    assert main(["cross-validate", str(tmp_path / "lab"), "--distance", "2", "--json", "--quiet"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["distance_m"] == 2.0
    assert {c["camera"] for c in said["cameras"]} == set(LENSES)
    assert sorted(p for p in (tmp_path / "lab").rglob("*")) == before


def test_what_has_no_halves_says_so(tmp_path: Path) -> None:
    write_example("total-station", tmp_path / "lab")
    with pytest.raises(SurveyError, match="there are no two halves"):
        survey.cross_validate(tmp_path / "lab")
    write_example("relay-station", tmp_path / "relay")
    with pytest.raises(SurveyError, match="its lens is held"):
        survey.cross_validate(tmp_path / "relay")
    with pytest.raises(SurveyError, match="larger than zero"):
        survey.cross_validate(tmp_path / "relay", -1.0)
