"""Mistakes of one table, one set-up, one axis: each is named as that part's, and mended by `--try`."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from adjust.diagnosis.hypothesis import SetKey, split_setup
from adjust.model.survey import Setup, Survey
from survey.cli import FAILED, main
from tests import labs


def named(lab: Path) -> list[dict[str, Any]]:
    """The candidates of its diagnosis, whether it was adjusted or not."""
    assert main(["adjust", str(lab), "--quiet"]) in (FAILED, 3)
    found = (lab / "results" / name for name in ("unsolved.json", "solution.json"))
    told = next(json.loads(path.read_text(encoding="utf-8"))["diagnosis"] for path in found if path.exists())
    return list(told)


def mends(lab: Path) -> bool:
    return main(["adjust", str(lab), "--quiet", "--try", "1"]) == 0


def change(lab: Path, table: str, by: Any) -> None:
    labs.with_rows(lab / "observations" / f"{table}.csv", by)


def exchanged(lab: Path, table: str, a: str, b: str) -> None:
    other = {a: b, b: a}
    change(lab, table, lambda _, row: row.update({end: other.get(row[end], row[end]) for end in ("from_id", "to_id")}))


def hold(lab: Path, *points: str) -> None:
    """The points at their true places."""
    truth = json.loads((lab / "truth.json").read_text(encoding="utf-8"))["parameters"]
    text = (lab / "survey.toml").read_text(encoding="utf-8")
    for name in points:
        x_mm = [1e3 * x for x in truth[f"point/{name}"]]
        text = text.replace(f"\n{name} = {{}}\n", f'\n{name} = {{ x_mm = {x_mm}, treatment = "held" }}\n')
    text = text.partition("[datum]")[0] + '[datum]\nkind = "given"\n'
    (lab / "survey.toml").write_text(text, encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(("a", "b"), [("B01", "B12"), ("B03", "B07")])
def test_points_exchanged_in_all_rows_of_a_table_are_named_not_what_they_contradict(
    a: str, b: str, tmp_path: Path
) -> None:
    """Two distances of the caliper were left out, and nothing else said; in the one table or in the other is alike."""
    lab = labs.example("total-station", tmp_path / "lab")
    exchanged(lab, "terrestrial", a, b)
    first, *_ = named(lab)
    assert (first["name"], first["ids"]) == ("points exchanged", [a, b])
    assert "in all rows of terrestrial.csv (or in all rows of distances.csv: what was observed cannot" in first["cause"]
    assert mends(lab)
    solution = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))
    assert (solution["summary"]["fit"], solution["warnings"]) == ("fits", [])


@pytest.mark.slow
def test_another_exchange_that_explains_as_much_is_told_beside_it(tmp_path: Path) -> None:
    """Calipers of the same length: the first end of one under the name of the second end of the other."""
    lab = labs.example("total-station", tmp_path / "lab")
    exchanged(lab, "terrestrial", "B05", "B10")
    assert {tuple(c["ids"]) for c in named(lab)} == {("B05", "B10"), ("B06", "B09")}


@pytest.mark.slow
@pytest.mark.parametrize(("tables", "name"), [
    (["terrestrial"], "points exchanged"), (["terrestrial", "distances"], "given points exchanged"),
])  # fmt: skip
def test_points_exchanged_against_given_coordinates(tables: list[str], name: str, tmp_path: Path) -> None:
    lab = labs.example("total-station", tmp_path / "lab")
    hold(lab, "B01", "B05", "B10", "B12")
    for table in tables:
        exchanged(lab, table, "B05", "B10")
    first, *more = named(lab)
    assert (first["name"], first["ids"], more) == (name, ["B05", "B10"], [])
    assert mends(lab)


def test_names_that_only_names_contradict_are_not_blamed(tmp_path: Path) -> None:
    """Exchanged in every table, or between points that no other table tells apart; one distance may be any other's."""
    for i, (tables, a, b) in enumerate([
        (("terrestrial", "distances"), "B03", "B07"), (("terrestrial",), "S1", "S2"), (("terrestrial",), "S1", "B05"),
    ]):  # fmt: skip
        lab = labs.example("total-station", tmp_path / f"lab{i}")
        for table in tables:
            exchanged(lab, table, a, b)
        assert main(["adjust", str(lab), "--quiet"]) == 0
        assert "diagnosis" not in json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))


@pytest.mark.slow
@pytest.mark.parametrize("setup_id", ["S1a", "S2a"])
def test_scale_of_the_distances_of_one_setup(setup_id: str, tmp_path: Path) -> None:
    """300 ppm: told as an error that the distances of every set-up have in common, each its own."""
    lab = labs.example("total-station", tmp_path / "lab")
    change(lab, "terrestrial", lambda _, row: row["setup_id"] == setup_id and row["value_m"] and row.update(
        value_m=f"{1.0003 * float(row['value_m']):.7f}"))  # fmt: skip
    first, *_ = named(lab)
    assert (first["name"], first["ids"]) == ("scale of distances", [setup_id])
    assert mends(lab)


@pytest.mark.slow
@pytest.mark.parametrize(("setup_id", "height", "missing"), [("S1a", 1612.0, "0"), ("S2a", 1547.0, ""),
                                                             ("S3a", 1583.0, "0")])  # fmt: skip
def test_forgotten_height_of_an_instrument(setup_id: str, height: float, missing: str, tmp_path: Path) -> None:
    """Sights to the instrument's point were left out, and nothing said; of the last one there was no solution."""
    lab = labs.example("total-station", tmp_path / "lab")
    change(lab, "terrestrial", lambda _, row: row["setup_id"] == setup_id and row.update(instrument_height_mm=missing))
    first, *_ = named(lab)
    assert (first["name"], first["ids"]) == ("instrument height", [setup_id])
    assert "it stands there as 0, and was forgotten" in first["cause"]
    assert mends(lab)
    heights: list[float] = []
    change(lab, "terrestrial", lambda _, row: row["setup_id"] == setup_id and row["kind"] != "direction"
           and heights.append(float(row["instrument_height_mm"])))  # fmt: skip
    assert heights == [pytest.approx(height, abs=1.0)] * len(heights)


@pytest.mark.slow
@pytest.mark.parametrize(("turn_gon", "first_late"), [(0.05, 7), (0.05, 10), (50.0, 7)])
def test_circle_turned_within_a_setup(turn_gon: float, first_late: int, tmp_path: Path) -> None:
    """Located only, or four directions left out, or no solution: the set is split."""
    lab, seen = labs.example("total-station", tmp_path / "lab"), list[int]()

    def turned(_: int, row: dict[str, str]) -> None:
        if row["setup_id"] == "S2a" and row["kind"] == "direction":
            seen.append(1)
            if len(seen) > first_late:
                row["value_gon"] = f"{(float(row['value_gon']) + turn_gon) % 400.0:.5f}"

    change(lab, "terrestrial", turned)
    first, *_ = named(lab)
    assert (first["name"], first["ids"]) == ("set-up turned", ["S2a"])
    assert mends(lab)
    text = (lab / "observations" / "terrestrial.csv").read_text(encoding="utf-8")
    assert text.count(",S2a-2,") == len(seen) - first_late
    assert '[setups.S2a-2]\ninstrument = "total_station"' in (lab / "survey.toml").read_text(encoding="utf-8")


@pytest.mark.slow
@pytest.mark.parametrize(("axis", "since", "by_deg"), [(1, 11, 0.5), (1, 20, 0.5), (2, 20, 0.5), (1, 20, 0.01)])
def test_zero_of_an_axis_that_is_another_one_from_an_epoch_on(
    axis: int, since: int, by_deg: float, tmp_path: Path
) -> None:
    """Told as a board, a station or a camera that was moved; a small one, which many images dilute, not asked for."""
    lab, column = labs.example("head", tmp_path / "lab"), f"axis{axis}_deg"
    change(lab, "table_angles", lambda i, row: i >= since and row.update({column: repr(float(row[column]) + by_deg)}))
    assert main(["adjust", str(lab), "--quiet"]) in (0, 3)
    first, *_ = json.loads((lab / "results" / "solution.json").read_text(encoding="utf-8"))["diagnosis"]
    assert (first["name"], len(first["epochs"])) == ("zero of an axis", 33 - since)
    assert f"the zero of axis{axis} is another one" in first["cause"]
    assert "was turned about that axis: what was observed cannot tell" in first["cause"]
    assert mends(lab)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("of", "name", "said"),
    [
        (lambda x: [x[1], x[0], x[2]], "axes or unit of coordinates", "have x and y exchanged (north first"),
        (lambda x: [x[0], x[2], x[1]], "axes or unit of coordinates", "have y and z exchanged"),
        (lambda x: [v / 25.4 for v in x], "axes or unit of coordinates", "are inches, read as millimetres"),
        (lambda x: [1.0005 * v for v in x], "scale of coordinates", "have a scale in common, by +5"),
    ],
)
def test_coordinates_of_control_points(
    of: Callable[[list[float]], list[float]], name: str, said: str, tmp_path: Path
) -> None:
    """Told as other bearings, or not; of a scale three of five were left out, and what was left passed.

    Of y and z exchanged so much was left out that the rest was not determined.
    """
    lab = labs.example("total-station", tmp_path / "lab")
    hold(lab)
    truth = json.loads((lab / "truth.json").read_text(encoding="utf-8"))["parameters"]
    rows = [",".join([n, *(repr(v) for v in of([1e3 * x for x in truth[f"point/{n}"]])), "0.3,0.3,0.3"])
            for n in ("B01", "B03", "B06", "B09", "B11")]  # fmt: skip
    head = "point_id,x_mm,y_mm,z_mm,sigma_x_mm,sigma_y_mm,sigma_z_mm"
    (lab / "observations" / "coordinates.csv").write_text("\n".join([head, *rows, ""]), encoding="utf-8")
    told = [
        (c["name"], said in c["cause"]) for c in named(lab)[:2]
    ]  # mirrored: directions may count the other way round
    assert (name, True) in told
    assert "y and z" not in said or (lab / "results" / "solution.json").exists()
    assert main(["adjust", str(lab), "--quiet", "--try", str(told.index((name, True)) + 1)]) == 0


@pytest.mark.slow
def test_table_to_be_added_that_has_a_header_only_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its stations were blamed, which no pair tied to the rest."""
    lab = labs.example("relay", tmp_path / "lab")
    assert main(["adjust", str(lab), "--quiet"]) == 0
    table = lab / "more" / "observations" / "pairs.csv"
    table.write_text(table.read_text(encoding="utf-8").splitlines()[0] + "\n", encoding="utf-8")
    assert main(["add", str(lab), str(lab / "more"), "--quiet"]) == FAILED
    assert f"{table}: no row below its header" in capsys.readouterr().err


def test_a_part_of_a_setup_without_instrument_is_listed_as_well() -> None:
    """A set-up that nothing lists is none: the table would not be read."""
    survey = Survey((), (), (), (), setups=(Setup("S"), Setup("S-2")))
    assert split_setup(survey, "S", ["r7"])[1] == SetKey(("setups", "S-3", "levelled"), True)
