"""Mistakes of a laboratory whose beacons are spots: named although the spots are given their names by what is wrong."""

import csv
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from survey.cli import FAILED, main
from survey.examples.folders import MAKERS
from survey.project import read
from tests import labs

pytestmark = pytest.mark.slow
_PX = 0.02


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The full laboratory with what its images show."""
    folder = tmp_path_factory.mktemp("lab")
    _seen(folder, "full-lab")
    assert main(["adjust", str(folder), "--quiet"]) == 0
    return folder


def _seen(folder: Path, name: str) -> None:
    """An example with what its images show, by its truth and with noise: no image is rendered or searched."""
    draft, files = MAKERS[name](1)
    for path, text in files.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    survey, scene, rng = read(folder).survey, draft.scene(), np.random.default_rng(3)
    points, spots = list[list[Any]](), list[list[Any]]()
    for shot in draft.shots:
        own = shot.epoch_id, shot.camera_id
        for target in shot.target_ids:
            ids = survey.targets_by_id[target].point_ids
            for name, uv in zip(ids, scene.project(*own[::-1], scene.target_points(target, own[0])), strict=True):
                if scene.inside(own[1], uv[None], 5.0).all():
                    points.append([*own, target, name, *(uv + _PX * rng.standard_normal(2)), _PX, _PX])
        for number, uv in enumerate(scene.project(*own[::-1], scene.world_points())) if shot.beacons else ():
            if scene.inside(own[1], uv[None], 5.0).all():
                spots.append([*own, f"s{number}", *(uv + _PX * rng.standard_normal(2)), _PX, _PX])
    (folder / "observations").mkdir(exist_ok=True)
    _write(folder, "image_points", ("epoch_id", "camera_id", "target_id", "point_id"), points)
    _write(folder, "spots", ("epoch_id", "camera_id", "spot_id"), spots)


def _write(folder: Path, table: str, ids: tuple[str, ...], rows: list[list[Any]]) -> None:
    with (folder / "observations" / f"{table}.csv").open("w", newline="") as file:
        csv.writer(file).writerows([[*ids, "u_px", "v_px", "sigma_u_px", "sigma_v_px"], *rows])


Change = Callable[[int, dict[str, str]], object]


def scaled(factor: float, *columns: str) -> Change:
    return lambda _, row: row.update({c: repr(factor * float(row[c])) for c in columns})


def exchanged(a: str, b: str) -> Change:
    return lambda _, row: row.update({a: row[b], b: row[a]})


def renamed(names: dict[str, str], *columns: str) -> Change:
    return lambda _, row: row.update({c: names.get(row[c], row[c]) for c in columns})


def turned(_: int, row: dict[str, str]) -> None:
    """By a quarter about z."""
    row.update(x_mm=repr(-float(row["y_mm"])), y_mm=row["x_mm"])


def elsewhere(_: int, row: dict[str, str]) -> None:
    """Turned by 30 deg about z and shifted by metres; north first."""
    x, y = float(row["x_mm"]), float(row["y_mm"])
    east, north = 0.75**0.5 * x - 0.5 * y + 2000.0, 0.5 * x + 0.75**0.5 * y - 7000.0
    row.update(x_mm=repr(north), y_mm=repr(east), z_mm=repr(float(row["z_mm"]) + 100.0))


XYZ = ("x_mm", "y_mm", "z_mm")


@pytest.mark.parametrize(
    ("table", "change", "name", "said"),
    [
        ("coordinates", exchanged("x_mm", "y_mm"), "axes or unit of coordinates", "have x and y exchanged"),
        ("coordinates", scaled(-1.0, "z_mm"), "axes or unit of coordinates", "have z in the opposite direction"),
        ("coordinates", scaled(1.0 / 25.4, *XYZ), "axes or unit of coordinates", "are inches, read as millimetres"),
        ("coordinates", scaled(1.001, *XYZ), "scale of coordinates", "have a scale in common, by +1"),
        ("table_angles", exchanged("axis1_deg", "axis2_deg"), "table misread", "axis1 and axis2 are exchanged"),
        ("table_angles", scaled(1.0 / 0.9, "axis2_deg"), "table misread", "the readings of axis2 are in gon"),
        ("table_angles", renamed({"t05": "t06", "t06": "t05"}, "epoch_id"), "readings exchanged", "epochs t05 and t06"),
        ("coordinates", turned, "axes or unit of coordinates", "have other axes: (y, -x, z) of them are x, y and z"),
        ("coordinates", elsewhere, "frame of coordinates", "stand, with x and y exchanged, in another frame"),
        ("distances", scaled(1e-3, "value_mm"), "unit of lengths", "their values are metres, read as millimetres"),
        ("distances", renamed({"B06": "B07"}, "to_id"), "gross error", "distance B05-B06 contradicts all else by"),
        ("distances", renamed({"B01": "B03", "B03": "B01"}, "from_id", "to_id"), "points exchanged", "B01 and B03"),
    ],
)
def test_what_is_wrong_in_a_table_is_named_and_mended(
    table: str, change: Change, name: str, said: str, observed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Told as spots that "cannot be identified", as adjustments without end, as one distance in inches, or not.

    Distances that are metres off are left out at the start: there was no solution.
    """
    lab = Path(shutil.copytree(observed, tmp_path / "lab"))
    shutil.rmtree(lab / "results")
    labs.with_rows(lab / "observations" / f"{table}.csv", change)
    assert main(["adjust", str(lab), "--quiet"]) in (0, FAILED, 3)
    found = (lab / "results" / name for name in ("unsolved.json", "solution.json"))
    first, *_ = next(json.loads(path.read_text(encoding="utf-8"))["diagnosis"] for path in found if path.exists())
    assert (first["name"], said in first["cause"]) == (name, True), first["cause"]
    assert table != "distances" or (lab / "results" / "solution.json").exists()
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    assert "PASSED" in capsys.readouterr().out


def test_sigmas_of_few_coordinates_that_are_too_small_are_named(
    observed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Among thousands of image points they do not move sigma0: no cause was asked for."""
    lab = Path(shutil.copytree(observed, tmp_path / "lab"))
    labs.with_rows(lab / "observations" / "coordinates.csv", scaled(0.25, *(f"sigma_{x}" for x in XYZ)))
    assert main(["adjust", str(lab), "--quiet"]) == 3
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert "global test passed" in capsys.readouterr().out
    first, *_ = solution["diagnosis"]
    assert (first["name"], first["ids"]) == ("sigmas of a group", ["coordinates"])


def from_the_bottom(camera_id: str = "") -> Change:
    def change(_: int, row: dict[str, str]) -> None:
        if camera_id in ("", row["camera_id"]):
            row["v_px"] = repr(1023.0 - float(row["v_px"]))

    return change


def test_image_points_that_count_from_the_bottom_are_named_and_mended(
    observed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of it is a mirror image, which contradicts coordinates alone: they were said to have z upside down."""
    lab = Path(shutil.copytree(observed, tmp_path / "lab"))
    for table in ("image_points", "spots"):
        labs.with_rows(lab / "observations" / f"{table}.csv", from_the_bottom())
    assert main(["adjust", str(lab), "--quiet"]) == FAILED
    first, *_ = json.loads((lab / "results" / "unsolved.json").read_text(encoding="utf-8"))["diagnosis"]
    assert first["name"] == "images mirrored"
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    assert "PASSED" in capsys.readouterr().out


def test_a_camera_that_sees_targets_from_behind_is_named(observed: Path, tmp_path: Path, undiagnosed: None) -> None:
    """Nothing but the names of its spots contradicts: another place of the camera was named."""
    lab = Path(shutil.copytree(observed, tmp_path / "lab"))
    for table in ("image_points", "spots"):
        labs.with_rows(lab / "observations" / f"{table}.csv", from_the_bottom("R2"))
    assert main(["adjust", str(lab), "--quiet"]) != FAILED
    said = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert "images of R2 are mirrored" in said["warnings"][0]


def test_a_survey_whose_targets_show_their_backs_is_no_pass_without_a_word(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (lab := tmp_path / "lab").mkdir()
    _seen(lab, "stereo")
    assert main(["adjust", str(lab), "--quiet"]) == 0
    assert "PASSED" in capsys.readouterr().out
    labs.with_rows(lab / "observations" / "image_points.csv", from_the_bottom())
    assert main(["adjust", str(lab), "--quiet"]) == 0
    out = capsys.readouterr().out
    assert "NEEDS A LOOK" in out
    assert "24 images of flat targets that were looked at show them from behind" in out


def test_spots_that_count_from_the_corner_are_named_and_mended(
    observed: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Their images were left out until nothing saw a beacon any more; a camera was said to have been exchanged."""
    lab = Path(shutil.copytree(observed, tmp_path / "lab"))
    labs.with_rows(lab / "observations" / "spots.csv",
                   lambda _, row: row.update({c: repr(float(row[c]) + 0.5) for c in ("u_px", "v_px")}))  # fmt: skip
    assert main(["adjust", str(lab), "--quiet"]) in (FAILED, 3)
    found = (lab / "results" / name for name in ("unsolved.json", "solution.json"))
    first, *_ = next(json.loads(path.read_text(encoding="utf-8"))["diagnosis"] for path in found if path.exists())
    assert (first["name"], first["edits"][0]["table"]) == ("pixel origin", "spots")
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    assert "PASSED" in capsys.readouterr().out


def test_a_lens_may_change_where_its_camera_sees_spots_alone(observed: Path, tmp_path: Path) -> None:
    """Said to have no image there, as before the spots have names; the cause that was named could not be tried."""
    lab, definition = Path(shutil.copytree(observed, tmp_path / "lab")), tmp_path / "lab" / "survey.toml"
    text = definition.read_text(encoding="utf-8")
    definition.write_text(f"{text}\n[cameras.X.lens.crops.n01]\nleft_px = 0.5\ntop_px = 0.5\n", encoding="utf-8")

    def cropped(_: int, row: dict[str, str]) -> None:
        if row["camera_id"] == "X" and row["epoch_id"] >= "n01":
            row.update({c: repr(float(row[c]) - 0.5) for c in ("u_px", "v_px")})

    for table in ("image_points", "spots"):
        labs.with_rows(lab / "observations" / f"{table}.csv", cropped)
    assert main(["adjust", str(lab), "--quiet"]) == 0
    summary = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))["summary"]
    assert summary["sigma0"] < 1.05
