"""Values in another unit, and table readings under another epoch: told by `check`, named and mended by `adjust`."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.units.heights import doubtful_heights
from adjust.diagnosis.weights.impossible import doubtful_sigmas
from survey.cli import FAILED, main
from survey.examples import write_example
from survey.project import read
from survey.solution.verdict import warnings_with
from tests import labs

Row = dict[str, str]
Change = Callable[[Row], object]


def planted(folder: Path, example: str, table: str, change: Change) -> Path:
    """A ready project with the rows of one table changed."""
    labs.example(example, folder)
    labs.with_rows(folder / "observations" / f"{table}.csv", lambda _, row: change(row))
    return folder


def scaled(column: str, factor: float, chosen: Callable[[Row], bool] = lambda _: True) -> Change:
    return lambda row: chosen(row) and row[column] and row.update({column: f"{factor * float(row[column]):.9g}"})


def of_degrees(row: Row) -> None:
    """The instrument's 0.5 mgon, as degrees in the column of arcseconds."""
    if row["kind"] in ("direction", "zenith"):
        row["sigma_arcsec"] = f"{0.5 * 0.9e-3:.6f}"


def with_own_sigmas(rotation: float, shift: float) -> Change:
    """Those that there are times a factor; in place of covariances 6 arcsec and 0.15 mm times it."""

    def change(row: Row) -> None:
        row.update({name: "" for name in row if name.startswith("cov_")})
        turn, length = float(row["sigma_rotation_arcsec"] or 6.0), float(row["sigma_translation_mm"] or 0.15)
        row.update(sigma_rotation_arcsec=f"{turn * rotation:.9g}", sigma_translation_mm=f"{length * shift:.9g}")

    return change


def of_turns(column: str, unit: float) -> Change:
    """The arcseconds that there are, in another unit and column."""

    def change(row: Row) -> None:
        arcsec = row.pop("sigma_rotation_arcsec")
        row[column] = repr(unit * float(arcsec)) if arcsec else ""

    return change


def of_angles(column: str, unit: float) -> Change:
    """Two arcseconds for all angles, in another unit and column."""
    return lambda row: row.update({column: repr(2.0 * unit) if row["value_gon"] else ""})


CASES: dict[str, tuple[str, str, Change, str, str]] = {
    "heights in m": ("total-station", "terrestrial", scaled("instrument_height_mm", 1e-3), "suspicious unit",
                     "unit of heights"),
    "of one set-up": ("total-station", "terrestrial", scaled("instrument_height_mm", 1e-3,
                      lambda row: row["setup_id"] == "S2a"), "suspicious unit", "unit of heights"),
    "angles in degrees": ("total-station", "terrestrial", of_degrees, "suspicious sigma", "unit of sigmas"),
    "turns in degrees": ("relay", "pairs", with_own_sigmas(1 / 3600, 1.0), "suspicious sigma", "unit of sigmas"),
    "shifts in m": ("relay", "pairs", with_own_sigmas(1.0, 1e-3), "suspicious sigma", "unit of sigmas"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_another_unit_is_told_named_and_mended(
    name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    example, table, change, kind, cause = CASES[name]
    lab = planted(tmp_path / "lab", example, table, change)
    assert main(["check", str(lab), "--json"]) == 3
    assert kind in {f["kind"] for f in json.loads(capsys.readouterr().out)["findings"] if f["level"] == "problem"}
    assert main(["adjust", str(lab), "--quiet"]) == 3
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert solution["diagnosis"][0]["name"] == cause
    assert solution["summary"]["fit"] == "does_not_fit"
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    assert main(["check", str(lab), "--quiet"]) == 0


def diagnosis_of(lab: Path) -> list[dict[str, Any]]:
    """Of its solution, or of its adjustment that failed."""
    found = (lab / "results" / name for name in ("solution.json", "unsolved.json"))
    told = next(json.loads(path.read_text(encoding="utf-8"))["diagnosis"] for path in found if path.exists())
    return list(told)


EULER = {
    "gon": (10.0 / 9.0, 59, "have Euler angles in gon, read as degrees", "by 0.9"),
    "radians": (math.pi / 180.0, 59, "have Euler angles in radians, read as degrees", "by 57.2957795"),
}


@pytest.mark.slow
@pytest.mark.parametrize("chosen", [lambda _: True, lambda i: i % 3 == 0, lambda i: i < 4],
                         ids=["all", "third", "four"])  # fmt: skip
@pytest.mark.parametrize("unit", EULER)
def test_euler_angles_of_pairs_in_another_unit(unit: str, chosen: Callable[[int], bool], tmp_path: Path) -> None:
    """Beyond half a turn of gon the rotation as it was read no longer says which angles stand there."""
    factor, n, said, by = EULER[unit]
    lab = labs.example("relay", tmp_path / "lab")
    labs.with_euler_angles(lab / "observations" / "pairs.csv", factor, chosen)
    assert main(["adjust", str(lab), "--quiet"]) in (FAILED, 3)
    (first, *_) = diagnosis_of(lab)
    assert (first["name"], said in first["cause"], by in first["change"]) == ("unit of Euler angles", True, True)
    wrong = sum(chosen(i) for i in range(n))
    assert first["where"] == f"observations/pairs.csv:2 and {wrong - 1} more rows"
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0


SIGMAS = {
    "radians as degrees, of turns": ("relay", "pairs", of_turns("sigma_rotation_deg", math.pi / 648000.0),
                                     "radians, read as degrees", "by 57.2958"),
    "radians as arcseconds, of turns": ("relay", "pairs", of_turns("sigma_rotation_arcsec", math.pi / 648000.0),
                                        "radians, read as arcseconds", "by 206265"),
    "radians as milligon": ("total-station", "terrestrial", of_angles("sigma_mgon", math.pi / 648000.0),
                            "radians, read as milligon", "by 63662"),
    "radians as cc": ("total-station", "terrestrial", of_angles("sigma_cc", math.pi / 648000.0),
                      "radians, read as cc", "by 636620"),
    "gon as milligon": ("total-station", "terrestrial", of_angles("sigma_mgon", 1.0 / 3240.0),
                        "gon, read as milligon", "by 1000"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", SIGMAS)
def test_sigmas_are_named_in_the_unit_of_their_column(name: str, tmp_path: Path) -> None:
    example, table, change, said, by = SIGMAS[name]
    lab = planted(tmp_path / "lab", example, table, change)
    assert main(["adjust", str(lab), "--quiet"]) == 3
    (first, *_) = diagnosis_of(lab)
    assert (first["name"], said in first["cause"], by in first["change"]) == ("unit of sigmas", True, True)


@pytest.mark.slow
@pytest.mark.parametrize("setup_id", ["", "S1a"])
@pytest.mark.parametrize(("factor", "unit"), [(1e3, "millimetres"), (1e6, "micrometres")])
def test_lengths_in_a_column_of_metres(factor: float, unit: str, setup_id: str, tmp_path: Path) -> None:
    """Those of the set-up that the start begins with give all others their scale."""
    lab = planted(tmp_path / "lab", "total-station", "terrestrial", scaled(
        "value_m", factor, lambda row: setup_id in ("", row["setup_id"])))  # fmt: skip
    assert main(["adjust", str(lab), "--quiet"]) == FAILED
    (first, *_) = diagnosis_of(lab)
    assert (first["name"], setup_id in first["cause"]) == ("unit of lengths", True)
    assert f"are {unit}, read as metres" in first["cause"]
    assert f"multiply them by {1.0 / factor:g}" in first["change"]


QUATERNION = ("qw", "qx", "qy", "qz")
ROWS = {
    "unit of shifts": ("relay", "pairs", lambda i, row: i % 3 == 0 and row.update(
        {name: f"{float(row[name]) / 1e3:.9f}" for name in ("tx_mm", "ty_mm", "tz_mm")}),
                       "and 14 more have shifts in metres, read as millimetres", "multiply tx, ty, tz by 1000"),
    "order of quaternions": ("relay", "pairs", lambda i, row: i % 3 == 0 and row.update(
        zip(QUATERNION, [row[name] for name in (*QUATERNION[1:], "qw")], strict=True)),
                             "and 14 more have quaternions in the order x y z w, read as w x y z",
                             "put the last of the four numbers first"),
    "sense of rotation": ("total-station", "terrestrial", lambda i, row: row["kind"] == "direction"
                          and row["setup_id"] == "S1a" and row.update(
                              value_gon=f"{(400.0 - float(row['value_gon'])) % 400.0:.5f}"),
                          "of set-up S1a: their values count the other way round", "give them the other sign"),
    "unit of angles": ("total-station", "terrestrial", lambda i, row: row["kind"] == "direction"
                       and row["setup_id"] == "S1a" and row.update(value_gon=f"{0.9 * float(row['value_gon']):.5f}"),
                       "of set-up S1a: their values are degrees, read as gon", "multiply them by 1.111111111"),
    "pairs inverted": ("relay", "pairs", lambda i, row: i % 3 == 0 and row.update(a_id=row["b_id"], b_id=row["a_id"]),
                       "are a_from_b, read as b_from_a", "exchange a_id and b_id"),
    "directions of the second face": ("total-station", "terrestrial", lambda i, row: i % 2 and row["setup_id"] == "S2a"
                                      and row["kind"] == "direction" and row.update(
                                          value_gon=f"{(float(row['value_gon']) + 200.0) % 400.0:.5f}"),
                                      "set-up S2a: directions r46, r52", "turn them by 200 gon"),
    "angles from another zero": ("total-station", "terrestrial", lambda i, row: row["kind"] == "zenith"
                                 and row["setup_id"] == "S3a" and row.update(
                                     value_gon=f"{200.0 - float(row['value_gon']):.5f}"),
                                 "of set-up S3a: their values are nadir angles", "give them as zenith angles"),
    "kind of distances": ("total-station", "terrestrial", lambda i, row: row["kind"] == "slope_distance"
                          and row.update(kind="horizontal_distance"),
                          "the horizontal distances are slope distances", "call them slope_distance"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", ROWS)
def test_rows_that_are_written_as_others_are_read(name: str, tmp_path: Path) -> None:
    example, table, change, said, remedy = ROWS[name]
    lab = labs.example(example, tmp_path / "lab")
    labs.with_rows(lab / "observations" / f"{table}.csv", change)
    assert main(["adjust", str(lab), "--quiet"]) in (FAILED, 3)
    (first, *_) = diagnosis_of(lab)
    assert (first["name"], said in first["cause"], remedy in first["change"]) == (name, True, True)
    assert first["explained"] > 0.95
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0


@pytest.mark.slow
def test_height_differences_of_the_other_sign_are_named_without_a_search(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Among what they contradict nothing can be left out: each try takes the more steps the less it explains."""
    lab = planted(tmp_path / "lab", "total-station", "terrestrial", scaled(
        "value_m", -1.0, lambda row: row["kind"] == "height_difference"))  # fmt: skip
    monkeypatch.delattr("adjust.statistics.screened_adjustment.search_outliers")
    assert main(["adjust", str(lab), "--quiet"]) == 3
    first, *more = diagnosis_of(lab)
    assert (first["name"], first["probability"] > 0.99, more) == ("sign of height differences", True, [])
    assert first["change"] == "in terrestrial.csv give them the other sign, or exchange from_id and to_id"


def test_a_sigma_that_cannot_be_is_told_where_everything_fits(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A caliper's 0.05 mm as metres: six distances, that nothing contradicts."""
    lab = planted(tmp_path / "lab", "total-station", "distances", scaled("sigma_mm", 1e-3))
    assert main(["adjust", str(lab), "--quiet"]) == 0
    shown = capsys.readouterr().out
    assert "NEEDS A LOOK" in shown
    assert "no instrument has a sigma of 5e-05 mm: these sigmas are metres, read as millimetres" in shown


def test_doubtful_values_stand_first_whatever_their_words(tmp_path: Path) -> None:
    lab = labs.example("total-station", tmp_path / "lab")
    found = replace(adjust(read(lab).survey), warnings=("left out", "a height of 2 mm", "cautious"))
    assert warnings_with(found, None) == found.warnings
    doubtful = replace(found, doubtful=("a height of 2 mm",))
    assert warnings_with(doubtful, None) == ("a height of 2 mm", "left out", "cautious")


def test_what_a_survey_may_have_is_not_told(tmp_path: Path) -> None:
    """An instrument on its point, a target of a millimetre, a tower; 0.1 arcsec, a tenth of a micrometre and more."""
    write_example("total-station", tmp_path / "lab")
    survey = read(tmp_path / "lab").survey
    for height in (0.0, 0.1, 90.0):
        least = {"direction": 5e-7, "zenith": 5e-7, "slope_distance": 2e-6, "height_difference": 2e-6}
        readings = tuple(replace(r, instrument_height=height, sigma=least[r.kind]) for r in survey.readings)
        assert not list(doubtful_heights(replace(survey, readings=readings)))
        assert not list(doubtful_sigmas(replace(survey, readings=readings, distances=tuple(
            replace(d, sigma=1.01e-7) for d in survey.distances))))  # fmt: skip
    thin = tuple(replace(r, target_height=1e-3) for r in survey.readings)
    (only,) = doubtful_heights(replace(survey, readings=thin))
    assert only.place.kind == "point"


def test_a_table_reading_of_another_epoch_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = planted(tmp_path / "lab", "head", "table_angles",
                  lambda row: row["epoch_id"] == "tX03" and row.update(epoch_id="tX30x"))  # fmt: skip
    assert main(["adjust", str(lab), "--quiet"]) == 0
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    (told,) = (w for w in solution["warnings"] if "table readings without images" in w)
    assert ": tX30x; check the names" in told
    assert told.endswith("(for tX30x perhaps tX03)")
    shown = capsys.readouterr().out
    assert "NEEDS A LOOK" in shown
    assert told in shown


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_distances_in_metres_among_millimetres_are_left_out_and_named(
    count: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """With them in, 200 steps lead nowhere; without them, two do."""
    names = [f"c{i + 1}" for i in range(count)]
    lab = planted(tmp_path / "lab", "total-station", "distances",
                  scaled("value_mm", 1e-3, lambda row: row["distance_id"] in names))  # fmt: skip
    assert main(["check", str(lab)]) == 3
    said = "distance c1: it is in another unit: 0.570043 mm, by what the rest says 570.043 mm"
    assert said in capsys.readouterr().out
    assert main(["adjust", str(lab), "--quiet"]) == 0
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert sorted(c["ids"][0] for c in solution["diagnosis"]) == names
    assert {c["cause"].partition(": ")[2] for c in solution["diagnosis"]} == {
        "its values are metres, read as millimetres"
    }
    assert solution["summary"]["iterations"] < 5
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    left = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8")).get("diagnosis", [])
    assert len(left) == count - 1


def in_other_unit(**factors: float) -> Change:
    """Sigmas of rotations in degrees and of shifts in mm, in place of all that there are, and values, times factors."""

    def change(row: Row) -> None:
        with_own_sigmas(1.0, 1.0)(row)
        row["sigma_rotation_deg"] = repr(float(row.pop("sigma_rotation_arcsec")) / 3600.0)
        for name, factor in factors.items():
            row[name] = repr(float(row[name]) * factor)

    return change


PARTS = {
    "arcsec as deg": ({"sigma_rotation_deg": 3600.0}, 0, "rotation of the pairs of group pair are about 3600 times too "
                      "large: they are arcseconds, read as degrees"),
    "mgon as deg": ({"sigma_rotation_deg": 1.0 / 9e-4}, 0, "1111 times too large: they are milligon, read as degrees"),
    "um as mm": ({"sigma_translation_mm": 1e3}, 0, "1000 times too large: they are micrometres, read as millimetres"),
    "shifts in m": (dict.fromkeys(("tx_mm", "ty_mm", "tz_mm"), 1e-3), 3, "they are metres, read as millimetres"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", PARTS)
def test_a_part_of_pairs_in_another_unit_is_named_though_the_other_part_fits(name: str, tmp_path: Path) -> None:
    """As one group they are only cautious."""
    factors, code, said = PARTS[name]
    lab = planted(tmp_path / "lab", "relay", "pairs", in_other_unit(**factors))
    assert main(["adjust", str(lab), "--quiet"]) == code
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert said in solution["warnings"][0]
    assert said in solution["diagnosis"][0]["cause"]


def test_pairs_in_their_units_are_not_told(tmp_path: Path) -> None:
    lab = planted(tmp_path / "lab", "relay", "pairs", in_other_unit())
    assert main(["adjust", str(lab), "--quiet"]) == 0
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert "diagnosis" not in solution
    assert solution["summary"]["fit"] == "fits"


@pytest.mark.slow
def test_sigmas_of_a_table_in_degrees_are_named_before_what_they_bend(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The readings win against the images: then board, lens and axes seem to have moved."""
    lab = planted(tmp_path / "lab", "head", "table_angles", lambda row: row.update(
        {name: repr(float(row[name]) / 3600.0) for name in ("sigma_axis1_arcsec", "sigma_axis2_arcsec")}))  # fmt: skip
    assert main(["check", str(lab), "--json"]) == 3
    told = [f["kind"] for f in json.loads(capsys.readouterr().out)["findings"] if f["level"] == "problem"]
    assert told == ["suspicious sigma"]
    assert main(["adjust", str(lab), "--quiet"]) == 3
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert "the angles of table turntable at" in solution["warnings"][0]
    assert "these sigmas are degrees, read as arcseconds" in solution["warnings"][0]


@pytest.mark.slow
def test_what_pulls_a_survey_apart_ends_in_words(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Laser spots in micrometres: with some of them out, only rounding controls the next."""
    lab = planted(tmp_path / "lab", "alignment", "laser_spots", lambda row: row.update(
        {name: repr(1e3 * float(row[name])) for name in ("x_mm", "y_mm")}))  # fmt: skip
    assert main(["adjust", str(lab), "--quiet"]) in (1, 3)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.slow
def test_few_height_differences_of_the_other_sign_are_named_and_mended(tmp_path: Path) -> None:
    """Six of 138 observations: among all of them their misfit is soon lost."""
    lab = planted(tmp_path / "lab", "total-station", "terrestrial",
                  scaled("value_m", -1.0, lambda row: row["kind"] == "height_difference"))  # fmt: skip
    assert main(["adjust", str(lab), "--quiet"]) == 3
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert solution["diagnosis"][0]["name"] == "sign of height differences"
    assert solution["warnings"][0].startswith("probable cause: all readings of kind height_difference")
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0


@pytest.mark.slow
@pytest.mark.parametrize(("factor", "said"), [
    (1e3, "are millimetres, read as metres"), (1e-3, "are metres, read as millimetres"),
    (1.0 / 25.4, "are inches, read as millimetres"),
])  # fmt: skip
def test_all_distances_in_another_unit_have_one_cause(
    factor: float, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Micrometres took a minute and a half, and were told as sigmas that no instrument has."""
    lab = planted(tmp_path / "lab", "total-station", "distances", scaled("value_mm", factor))
    assert main(["adjust", str(lab), "--quiet"]) == 0
    shown = capsys.readouterr().out
    assert "NEEDS A LOOK" in shown
    assert f"probable cause: all distances: their values {said}" in shown
    assert "no instrument has" not in shown
    assert main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert (solution["summary"]["fit"], solution["warnings"]) == ("fits", [])
