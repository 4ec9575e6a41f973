"""The declarations of ``survey.toml``: readers check what they name, page and schema follow from them."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from survey.cli import main
from survey.examples import EXAMPLES, write_example
from survey.project.declared.declarations import DECLARATIONS, declared
from survey.project.declared.keys import NOTHING, REQUIRED, Declared, Key
from survey.project.exclusions import EXCLUSIONS
from survey.project.project import DEMANDED
from survey.project.reading import read_definition
from survey.project.reference import reference_page, survey_schema
from survey.project.tables.column_texts import COLUMN_TEXTS, column_text
from survey.project.tables.layouts import LAYOUTS

jsonschema = pytest.importorskip("jsonschema")
ROOT = Path(__file__).parents[2]
PRIOR = {
    "treatment": "prior", "translation_mm": [0, 0, 0], "rotation_quaternion_wxyz": [1, 0, 0, 0],
    "sigma_translation_mm": 1.0, "sigma_rotation_deg": 1.0,
}  # fmt: skip
EVERYTHING: dict[str, Any] = {
    "format": 1,
    "stations": {
        "head": {"motion": "epoch", "world_from_station": PRIOR, "epochs": {"e1": PRIOR}},
        "carried": {"motion": "table", "table": "tt"},
    },
    "tables": {"tt": {"geometry": {"free": ["non_orthogonality", "axis_offset", "zero_1", "zero_2"]}, "clock": {}}},
    "cameras": {
        "X": {"station": "head", "image_size_px": [640, 480], "lens": {
            "model": "brown", "free": ["fx"], "values": {"fx": 1000, "fy": 1000, "u0": 320, "v0": 240},
            "prior": {"fx": {"value": 1000, "sigma": 1}}, "tie": {"fy": {"to": "fx"}},
            "drift": {"parameters": ["fx"], "begins": ["e2"], "sigma": {"fx": 0.1}},
            "shared": {"camera": "Y", "parameters": ["fx"]},
            "crops": {"e3": {"scale": 0.5, "left_px": 10, "free": ["scale"], "sigma": {"scale": 0.1}}},
        }, "clock": {}},
        "Y": {"station": "head", "image_size_px": [640, 480], "lens": {"model": "brown", "free": ["fx"], "values": {
            "fx": 1000, "fy": 1000, "u0": 320, "v0": 240}}},
    },
    "targets": {
        "board": {"kind": "checkerboard", "columns": 9, "rows": 6, "square_mm": 10, "warp": {"sigma_mm": 1.0}},
        "cha": {"kind": "charuco", "squares_x": 9, "squares_y": 6, "square_mm": 10, "marker_mm": 7,
                "dictionary": "DICT_4X4_50"},
        "grid": {"kind": "marker_grid", "columns": 3, "rows": 2, "marker_mm": 10, "gap_mm": 2,
                 "dictionary": "DICT_4X4_50"},
        "block": {"kind": "marker_block", "dictionary": "DICT_4X4_50",
                  "markers": {"7": [[0, 0, 0], [40, 0, 0], [40, -40, 0], [0, -40, 0]]}},
        "list": {"kind": "points", "file": "list.csv"},
    },
    "points": {"P1": {"x_mm": [1, 2, 3], "treatment": "prior", "sigma_mm": 1.0}},
    "datum": {"kind": "inner"},
    "sigmas": {"scale": {"distance": 2.0}},
    "adjustment": {"pairs": "closed"}, "vertical": {"free": ["tilt_1", "tilt_2"], "sigma": {"tilt_1_arcsec": 1.0}},
    "bearings": {}, "temperatures_degC": {"e1": 21.5}, "times_s": {"e1": 0.5},
    "spots": {"cameras": ["X"]},
    "instruments": {"ts": {"sigma_distance_mm": 1.0}},
    "setups": {"s1": {}},
    "beams": {"b1": {"mount": "tt"}},
    "surfaces": {"floor": {"kind": "plane"}, "rail": {"kind": "line"}, "ball": {"kind": "sphere"}},
    "align": {"a1": {"body": "target:board", "onto": "table:tt", "feet_mm": {"a": [0, 0], "b": [9, 0], "c": [0, 9]}}},
    "tolerances": {"t1": {"of": "lenses", "component": "fx", "tolerance_px": 1.0}},
    "identification": {"operator": "somebody"},
    "closures": {"plate": {"pairs": ["a-b", "b-a"], "sigma_arcsec": 10, "sigma_mm": 0.1}},
}  # fmt: skip
PLAIN = json.dumps(EVERYTHING)
PLACES: dict[str, tuple[str, ...]] = {
    "root": (), "camera": ("cameras", "X"), "lens": ("cameras", "X", "lens"),
    "lens_values": ("cameras", "X", "lens", "values"), "lens_prior": ("cameras", "X", "lens", "prior", "fx"),
    "lens_tie": ("cameras", "X", "lens", "tie", "fy"),
    "lens_drift": ("cameras", "X", "lens", "drift"), "lens_step": ("cameras", "X", "lens", "drift", "sigma"),
    "lens_shared": ("cameras", "X", "lens", "shared"), "lens_crops": ("cameras", "X", "lens", "crops"),
    "lens_crop": ("cameras", "X", "lens", "crops", "e3"),
    "station": ("stations", "carried"),
    "pose": ("stations", "head", "world_from_station"), "poses": ("stations", "head", "epochs"),
    "turntable": ("tables", "tt"), "turntable_geometry": ("tables", "tt", "geometry"),
    "turntable_sigma": ("tables", "tt", "geometry_sigma"),
    "harmonics": ("tables", "tt", "harmonics"), "target_checkerboard": ("targets", "board"),
    "target_charuco": ("targets", "cha"), "target_marker_grid": ("targets", "grid"),
    "target_marker_block": ("targets", "block"), "target_points": ("targets", "list"),
    "markers": ("targets", "block", "markers"), "warp": ("targets", "board", "warp"), "point": ("points", "P1"),
    "datum": ("datum",), "sigmas": ("sigmas",), "scale": ("sigmas", "scale"), "adjustment": ("adjustment",),
    "spots": ("spots",), "vertical": ("vertical",), "bearings": ("bearings",), "instrument": ("instruments", "ts"),
    "setup": ("setups", "s1"), "beam": ("beams", "b1"), "surface_plane": ("surfaces", "floor"),
    "surface_line": ("surfaces", "rail"), "surface_sphere": ("surfaces", "ball"),
    "vector_sigma": ("vertical", "sigma"), "align": ("align", "a1"), "feet": ("align", "a1", "feet_mm"),
    "tolerance": ("tolerances", "t1"), "identification": ("identification",),
    "temperatures": ("temperatures_degC",), "closure": ("closures", "plate"), "times": ("times_s",),
    "camera_clock": ("cameras", "X", "clock"), "clock": ("tables", "tt", "clock"),
}  # fmt: skip
NEED_MORE = {("station", "motion"), ("lens", "balance_radius_mm")}
KEYS = [(d, key) for d in DECLARATIONS for key in d.keys]
WRONG = {"text": 1, "choice": "wrong", "flag": "wrong", "whole": "wrong", "number": "wrong", "numbers": "wrong",
         "matrix": "wrong", "names": 1, "sigma": "wrong", "table": 1}  # fmt: skip


def _named(value: Any) -> str:
    return value.name if isinstance(value, Declared | Key) else ""


def _toml(values: dict[str, Any], path: tuple[str, ...] = ()) -> str:
    plain = {k: v for k, v in values.items() if not isinstance(v, dict)}
    lines = [f"[{'.'.join(path)}]"] if path else []
    lines += [f"{k} = {json.dumps(v)}" for k, v in plain.items()]
    below = [_toml(v, (*path, k)) for k, v in values.items() if isinstance(v, dict)]
    return "\n".join([*lines, *below])


def _project(folder: Path, change: dict[str, Any], place: tuple[str, ...] = ()) -> Any:
    values = json.loads(PLAIN)
    at = values
    for name in place:
        at = at.setdefault(name, {})
    at |= change
    (folder / "list.csv").write_text("point_id,x_mm,y_mm,z_mm\np,1,2,3\n")
    (folder / "survey.toml").write_text(_toml(values), encoding="utf-8")
    return values


@pytest.fixture(scope="module")
def validator() -> Any:
    schema = survey_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    return jsonschema.Draft202012Validator(schema)


def test_a_project_with_everything_is_read_and_fits_the_schema(tmp_path: Path, validator: Any) -> None:
    values = _project(tmp_path, {})
    read_definition(tmp_path)
    assert list(validator.iter_errors(values)) == []
    assert set(PLACES) == {d.name for d in DECLARATIONS}


@pytest.mark.slow
@pytest.mark.parametrize(("table", "key"), KEYS, ids=_named)
def test_every_declared_key_is_read_and_its_kind_checked_by_both(
    table: Declared, key: Key, tmp_path: Path, validator: Any
) -> None:
    values = _project(tmp_path, {key.name: WRONG[key.kind]}, PLACES[table.name])
    with pytest.raises(SurveyError) as found:
        read_definition(tmp_path)
    assert key.name in str(found.value)
    assert "unknown key" not in str(found.value)
    assert not validator.is_valid(values)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
def test_what_is_not_declared_is_refused_by_both(name: str, tmp_path: Path, validator: Any) -> None:
    if name in ("identification", "poses", "lens_crops"):
        pytest.skip("any name is allowed there")
    values = _project(tmp_path, {"nonsense": {}}, PLACES[name])
    with pytest.raises(SurveyError, match="nonsense"):
        read_definition(tmp_path)
    if name != "scale":
        assert not validator.is_valid(values)


def _said(folder: Path, change: dict[str, Any], place: tuple[str, ...] = ()) -> str:
    _project(folder, change, place)
    d = read_definition(folder)
    with np.printoptions(threshold=10_000):
        return repr((d.survey, d.options, d.sigmas, d.spots_request, d.title, d.tie_points, d.target_kinds))


@pytest.fixture(scope="module")
def unchanged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """A folder, and what is read in it where nothing is changed."""
    folder = tmp_path_factory.mktemp("unchanged")
    return folder, _said(folder, {})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("table", "key"), [(d, k) for d, k in KEYS if k.default not in (REQUIRED, NOTHING)], ids=_named
)
def test_a_declared_default_is_what_its_absence_means(
    table: Declared, key: Key, tmp_path: Path, unchanged: tuple[Path, str]
) -> None:
    at, there = EVERYTHING, True
    for name in PLACES[table.name]:
        there = there and name in at
        at = at.get(name, {})
    if key.name in at:
        pytest.skip("the project says something else")
    if (table.name, key.name) in NEED_MORE:
        pytest.skip("only with other keys beside it")
    if table.path == "surfaces.ID":
        pytest.skip("a surface of which nothing is said is wholly found by the program")
    folder, absent = unchanged if there else (tmp_path, _said(tmp_path, {}, PLACES[table.name]))
    assert absent == _said(folder, {key.name: key.default}, PLACES[table.name])


def test_choices_are_those_of_the_program() -> None:
    assert declared("lens").keys[0].choices == tuple(MODELS)
    assert next(k for k in declared("tolerance").keys if k.name == "of").choices == tuple(DEMANDED)


def test_the_page_is_what_the_command_prints(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["schema", "--markdown"]) == 0
    assert capsys.readouterr().out == reference_page()
    page = (ROOT / "docs" / "reference.md").read_text(encoding="utf-8")
    assert page == reference_page(), "run: labsurvey schema --markdown --out docs/reference.md"


def test_the_schema_is_what_the_command_writes(tmp_path: Path) -> None:
    assert main(["schema", "--out", str(tmp_path / "s.json")]) == 0
    assert json.loads((tmp_path / "s.json").read_text(encoding="utf-8")) == json.loads(json.dumps(survey_schema()))


def test_every_column_is_described_and_nothing_else() -> None:
    layouts = {**LAYOUTS, EXCLUSIONS.name: EXCLUSIONS}
    missing = {f"{n}.{c}" for n, layout in layouts.items() for c in layout.columns if not column_text(n, c)}
    assert missing == set()
    assert set(COLUMN_TEXTS) == set(layouts)
    assert {f"{n}.{c}" for n, (_, own) in COLUMN_TEXTS.items() for c in own if c not in layouts[n].columns} == set()


def test_a_demand_in_two_units_is_refused(tmp_path: Path) -> None:
    _project(tmp_path, {"tolerance_mm": 2.0}, PLACES["tolerance"])
    with pytest.raises(SurveyError, match="tolerance_mm is given too; keep one of the two"):
        read_definition(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_fits_the_schema(
    name: str, tmp_path: Path, validator: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("survey.examples.pictures.write_images", lambda *_: None)
    write_example(name, tmp_path / name, progress=False)
    values = tomllib.loads((tmp_path / name / "survey.toml").read_text(encoding="utf-8"))
    assert [e.message for e in validator.iter_errors(values)] == []
