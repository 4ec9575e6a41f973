"""Boards that deviate, temperatures and harmonics of tables: from survey.toml to the report, and back."""

import tomllib
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import survey as labsurvey
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.survey import (
    CROP,
    TABLE_GEOMETRY,
    ImageCrop,
    LensDrift,
    LensSharing,
    Survey,
    Table,
    VectorParameter,
    VectorPrior,
)
from adjust.model.tables import harmonic_names
from survey.jobs.adjusting.edits import changed_files
from survey.jobs.adjusting.steps import adjust_project
from survey.jobs.adjusting.trying import try_job
from survey.project import read, write_project
from survey.report.page import report_html
from survey.report.terminal import summary_text
from survey.simulate import Truth, head_on_table, resample, stereo
from tests.survey.test_files import differences

WAVES = (*harmonic_names("angle", 1, 2), *harmonic_names("radial", 1, 1))
BENT = ("warp_x", "warp_y", "shear", "expansion")


@cache
def uneven() -> tuple[Survey, Truth]:
    """A head on a table with an eccentric encoder, before a board that is bent and leans, at two temperatures."""
    survey, truth = head_on_table(5, n_cameras=2, n_table_epochs=9, n_free_epochs=4)
    (table,), (board,) = survey.tables, survey.targets
    given = table.geometry
    prior = VectorPrior(WAVES[-1:], np.zeros(1), np.array([[1e-8]]))
    geometry = replace(given, names=(*given.names, *WAVES), values=np.append(given.values, np.zeros(len(WAVES))),
                       free=(*given.free, *WAVES), prior=prior)  # fmt: skip
    warp = VectorParameter(BENT, np.array([0.0, 0.0, 0.0, 23e-6]), BENT[:3],
                           VectorPrior(BENT[:1], np.zeros(1), np.array([[1e-6]])))  # fmt: skip
    epochs = dict.fromkeys(b.epoch_id for b in survey.image_blocks)
    survey = replace(survey, tables=(replace(table, geometry=geometry),),
                     targets=(replace(board, warp=warp, reference_temperature=18.5),),
                     temperatures={e: 20.0 + i % 2 for i, e in enumerate(epochs)})  # fmt: skip
    key = ("table_geometry", table.table_id)
    waves = [3e-4, -2e-4, 0.0, 0.0, 0.0, 0.0]
    truth = truth | {key: np.append(np.asarray(truth[key]), waves),
                     ("warp", "board"): np.array([3e-4, 0.0, -4e-4, 23e-6])}  # fmt: skip
    made = resample(survey, truth, 1)
    return replace(made, tables=survey.tables, targets=survey.targets), truth  # priors at the values that are written


DRIFTS = (
    LensDrift(("fx", "v0"), ("e03", "e05")),
    LensDrift(("fx", "v0"), ("e03",), np.array([0.5, 0.1])),
    LensDrift(("u0",), (), None, 21.5),
)


def changing(drift: LensDrift) -> Survey:
    survey, _ = stereo(3, n_pairs=8)
    camera = survey.cameras[1]
    return replace(survey, cameras=(survey.cameras[0], replace(camera, lens=replace(camera.lens, drift=drift))),
                   temperatures={b.epoch_id: 15.0 + int(b.epoch_id[1:]) for b in survey.image_blocks})  # fmt: skip


@pytest.mark.parametrize("drift", DRIFTS, ids=["blocks", "walk", "temperature"])
def test_lenses_that_change_are_written_and_reported(tmp_path: Path, drift: LensDrift) -> None:
    survey = changing(drift)
    write_project(tmp_path, survey)
    assert differences(read(tmp_path).survey.cameras[1].lens.drift, drift) == []
    solution = labsurvey.adjust(tmp_path)
    entry = solution.as_dict["cameras"]["right"]["lens_drift"]
    assert set(entry["changes"]) == (set(drift.begins) or {"per_kelvin"})
    unit = "px_per_K" if drift.reference_temperature is not None else "px"
    for change in entry["changes"].values():
        assert all(change[f"sigma_{name}_{unit}"] > 0.0 for name in drift.parameters)
    assert not entry["significance"]["lens_drift"]["significant"]
    page = report_html(solution.adjustment, solution.run)
    assert ("Change per kelvin" if drift.reference_temperature is not None else "Change from epoch e03 on") in page
    assert "lens drift" in summary_text(solution.adjustment, solution.run)


CROPS = {
    "given": ImageCrop(VectorParameter(CROP, np.array([0.5, 100.0, 60.0])), (500, 420)),
    "free": ImageCrop(VectorParameter(CROP, np.array([0.5, 100.0, 60.0]), CROP, VectorPrior(
        ("scale",), np.array([0.5]), np.array([[1e-4]])))),
}


@pytest.mark.parametrize("kind", list(CROPS))
def test_cropped_images_are_written_and_reported(tmp_path: Path, kind: str) -> None:
    survey, truth = stereo(3, n_pairs=8)
    crop, right = CROPS[kind], survey.cameras[1]
    survey = replace(survey, cameras=(survey.cameras[0], replace(right, lens=replace(right.lens, crops={"e05": crop}))))
    survey = resample(survey, truth, 1)
    write_project(tmp_path, survey)
    assert differences(read(tmp_path).survey.cameras[1].lens.crops, {"e05": crop}) == []
    solution = labsurvey.adjust(tmp_path)
    entry = solution.as_dict["cameras"]["right"]["lens_crop"]
    found = entry["crops"]["e05"]
    if kind == "given":
        assert (found["scale"], found["left_px"], found["sigma_top_px"]) == (0.5, 100.0, 0.0)
        assert entry["significance"] == {}
        return
    assert abs(found["left_px"] - 100.0) < 5.0 * found["sigma_left_px"]
    assert abs(found["scale"] - 0.5) < 5.0 * found["sigma_scale"]
    assert not entry["significance"]["lens_crop"]["significant"]  # as given
    assert "Images cropped from epoch e05 on" in report_html(solution.adjustment, solution.run)
    assert "lens crop" in summary_text(solution.adjustment, solution.run)


@pytest.mark.slow
@pytest.mark.parametrize("same", [True, False], ids=["same", "another"])
def test_shared_lenses_are_written_and_tested(tmp_path: Path, same: bool) -> None:
    survey, truth = stereo(3, n_pairs=8)
    left, right = survey.cameras
    shared = LensSharing("left", ("fx", "fy", "k1"))
    survey = replace(survey, cameras=(left, replace(right, lens=replace(right.lens, shared=shared))))
    lens = np.array(truth["lens", "right"])
    at = [MODELS["brown"].names.index(x) for x in shared.parameters]
    lens[at] = np.asarray(truth["lens", "left"])[at] + (0.0 if same else np.array([30.0, 30.0, 0.0]))
    write_project(tmp_path, resample(survey, truth | {("lens", "right"): lens}, 1))
    assert read(tmp_path).survey.cameras[1].lens.shared == shared
    solution = labsurvey.adjust(tmp_path)
    left_entry, right_entry = (solution.as_dict["cameras"][c] for c in ("left", "right"))
    assert right_entry["lens"]["fx_px"] == left_entry["lens"]["fx_px"]
    assert right_entry["lens"]["sigma_fx_px"] == pytest.approx(left_entry["lens"]["sigma_fx_px"], rel=1e-9)
    entry = right_entry["lens_shared"]
    assert entry["camera"] == "left"
    assert entry["significance"]["lens_shared"]["significant"] != same
    found, text = entry["differences"], summary_text(solution.adjustment, solution.run)
    if same:
        assert "lens shared               holds" in text
        return
    assert "lens shared               does not hold" in text
    assert "does not hold" in report_html(solution.adjustment, solution.run)
    assert abs(found["fx_px"] - 30.0) < 4.0 * found["sigma_fx_px"] + 1.5  # linear at the tied solution
    diagnosis = adjust_project(read(tmp_path), False).diagnosis
    assert diagnosis is not None
    assert diagnosis.candidates[0].hypothesis.name == "lens not shared"
    assert "fx +" in diagnosis.candidates[0].hypothesis.cause
    try_job(tmp_path, 1)
    again = labsurvey.adjust(tmp_path)
    assert again.adjustment.global_test is not None
    assert again.adjustment.global_test.passed
    assert "lens_shared" not in again.as_dict["cameras"]["right"]


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('shared = { camera = "right" }', "unknown camera"),
        ('shared = { camera = "left", parameters = ["k3"] }', "unknown free parameter 'k3'"),
        ("crops.e03 = { scale = 0 }", "the scale must be positive"),
        ('crops.e03 = { free = ["zoom"] }', "unknown parameter 'zoom'"),
        ("crops.e03 = { size_px = [0, 10] }", "expected whole numbers"),
        ("crops.e03 = { left_px = 5000 }", "leaves nothing of the image"),
        ('drift = { parameters = ["k3"], begins = ["e03"] }', "unknown free parameter 'k3'"),
        ('drift = { parameters = ["fx"] }', "name the epochs at which a new block begins"),
        ('drift = { parameters = ["fx"], begins = ["e03"], with_temperature = true }', "has no blocks"),
        ('drift = { parameters = ["fx"], begins = ["e03"], sigma = { u0 = 1 } }', "unknown key"),
        ('drift = { parameters = [], begins = ["e03"] }', "names no parameter"),
    ],
)
def test_lenses_that_cannot_be_meant_are_refused(tmp_path: Path, table: str, said: str) -> None:
    write_project(tmp_path, stereo(3, n_pairs=8)[0])
    path = tmp_path / "survey.toml"
    path.write_text(path.read_text().replace("[cameras.right.lens]", f"[cameras.right.lens]\n{table}"))
    key = table.split(" ")[0].split(".")[0]
    with pytest.raises(SurveyError, match=rf"survey\.toml:\d+: cameras\.right\.lens\.{key}.*{said}"):
        read(tmp_path)


@pytest.mark.slow
def test_a_project_says_what_deviates(tmp_path: Path) -> None:
    survey, _ = uneven()
    write_project(tmp_path / "a", survey)
    again = read(tmp_path / "a")
    for name in ("tables", "targets", "temperatures"):
        assert differences(getattr(again.survey, name), getattr(survey, name)) == []
    write_project(tmp_path / "b", again.survey, target_kinds=again.target_kinds)
    assert (tmp_path / "b" / "survey.toml").read_text() == (tmp_path / "a" / "survey.toml").read_text()


def test_harmonics_up_to_an_order_are_all_their_components(tmp_path: Path) -> None:
    survey, _ = uneven()
    write_project(tmp_path, survey)
    path = tmp_path / "survey.toml"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("geometry")]
    path.write_text("\n".join(lines).replace("[tables.turntable]", "[tables.turntable]\nharmonics.tilt_2 = 2"))
    (table,) = read(tmp_path).survey.tables
    assert table.geometry.names == (*TABLE_GEOMETRY, *harmonic_names("tilt", 1, 2))
    assert table.geometry.free == (*TABLE_GEOMETRY[:2], *harmonic_names("tilt", 1, 2))


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("[tables.turntable]", "[tables.turntable]\nharmonics.tilt_3 = 2", r"tilt_3: unknown key"),
        ("[tables.turntable]", "[tables.turntable]\nharmonics.tilt_2 = 9", r"tilt_2: found 9; .* up to order 8"),
        ('"shear"', '"sheer"', r"free.*unknown parameter 'sheer'.*shear"),
        ("shear_ppm = 0.0", "sheer_ppm = 0.0", r"sheer_ppm: unknown key.*shear_ppm"),
    ],
)
def test_what_there_is_not_is_refused(tmp_path: Path, old: str, new: str, said: str) -> None:
    survey, _ = uneven()
    write_project(tmp_path, survey)
    path = tmp_path / "survey.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(SurveyError, match=rf"survey\.toml:\d+: .*{said}"):
        read(tmp_path)


@pytest.mark.slow
def test_an_epoch_without_a_temperature_is_named(tmp_path: Path) -> None:
    survey, _ = uneven()
    first = next(iter(survey.temperatures))
    write_project(tmp_path, replace(survey, temperatures={e: t for e, t in survey.temperatures.items() if e != first}))
    with pytest.raises(SurveyError, match=f"target 'board' expands, but epoch '{first}' has no temperature"):
        labsurvey.adjust(tmp_path)


@pytest.mark.slow
def test_values_and_tests_reach_result_and_report(tmp_path: Path) -> None:
    survey, _ = uneven()
    write_project(tmp_path, survey)
    solution = labsurvey.adjust(tmp_path)
    warp, geometry = (solution.as_dict[kind][owner][key] for kind, owner, key in (
        ("targets", "board", "warp"), ("tables", "turntable", "geometry")))  # fmt: skip
    assert abs(warp["shear_ppm"] + 400.0) < 4.0 * warp["sigma_shear_ppm"]
    assert warp["expansion_ppm_per_K"] == pytest.approx(23.0)
    assert warp["significance"]["bend"]["significant"]
    assert warp["significance"]["stretch"]["components"] == ["shear"]
    wanted = 3e-4 * 180 * 3600 / np.pi
    assert abs(geometry["angle_2_cos_1_arcsec"] - wanted) < 4.0 * geometry["sigma_angle_2_cos_1_arcsec"]
    assert geometry["significance"]["angle_2_order_1"]["significant"]
    for language, said in (("en", "not significant"), ("de", "nicht signifikant")):
        page = report_html(solution.adjustment, solution.run, None, None, language)
        assert "angle 2 order 1" in page
        assert said in page
    text = summary_text(solution.adjustment, solution.run)
    assert "target board" in text
    assert "angle 2 order 1" in text


def test_keys_of_remedies_are_written_where_they_belong(tmp_path: Path) -> None:
    """Several keys of one table after each other; below the innermost header; into a table in one line."""
    survey, _ = stereo(3, n_pairs=8)
    write_project(tmp_path, replace(survey, tables=(Table("turntable"),)))
    path = tmp_path / "survey.toml"

    def edited(place: tuple[str, ...], value: object) -> str:
        chosen = Hypothesis("", "", "", Place("", ()), survey, (SetKey(place, value),))
        return changed_files(tmp_path, chosen)[0].after

    for place, value in (
        (("tables", "turntable", "harmonics", "angle_2"), 2),
        (("tables", "turntable", "harmonics", "tilt_2"), 1),
        (("cameras", "right", "lens", "drift", "parameters"), ("fx", "u0")),
        (("cameras", "right", "lens", "drift", "begins"), ("e03",)),
        (("targets", "board", "warp", "free"), ("scale_x",)),
    ):
        path.write_text(edited(place, value))
    again = read(tmp_path).survey
    assert set(again.tables[0].geometry.free) >= {"angle_2_sin_2", "tilt_2_im_m1"}
    assert again.cameras[1].lens.drift is not None
    assert again.cameras[1].lens.drift.parameters == ("fx", "u0")
    assert again.targets[0].warp is not None
    assert again.targets[0].warp.free == ("scale_x",)
    definition = path.read_text().replace("[tables.turntable.harmonics]\nangle_2 = 2\ntilt_2 = 1\n", "")
    path.write_text(definition.replace("[tables.turntable]\n", "[tables.turntable]\nharmonics = { angle_2 = 2 }\n"))
    after = edited(("tables", "turntable", "harmonics", "tilt_2"), 1)
    assert "\nharmonics = {" in after
    assert tomllib.loads(after)["tables"]["turntable"]["harmonics"] == {"angle_2": 2, "tilt_2": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "shift", "said", "free"),
    [
        (1.0, (40.0, -20.0), "another crop of the sensor", ("left", "top")),
        (0.8, (0.0, 0.0), "times the size", ("scale",)),
        (1.0, (3.0, -1.5), "another crop of the sensor", ("left", "top")),
    ],
)
def test_a_crop_that_the_diagnosis_names_becomes_keys(
    tmp_path: Path, scale: float, shift: tuple[float, float], said: str, free: tuple[str, ...]
) -> None:
    survey, _ = stereo(3, n_pairs=14)
    mine = [b.epoch_id for b in survey.image_blocks if b.camera_id == "right"]
    later = mine[6:]
    blocks = tuple(
        replace(b, uv=scale * (b.uv + 0.5) - 0.5 + shift) if b.camera_id == "right" and b.epoch_id in later else b
        for b in survey.image_blocks
    )
    write_project(tmp_path, replace(survey, image_blocks=blocks))
    assert said in try_job(tmp_path, 1)
    camera = read(tmp_path).survey.cameras[1]
    ((since, crop),) = camera.lens.crops.items()
    assert since == later[0]
    assert crop.parameters.free == free
    solution = labsurvey.adjust(tmp_path)
    assert solution.adjustment.global_test is not None
    assert solution.adjustment.global_test.status != "failed"
    found = solution.as_dict["cameras"]["right"]["lens_crop"]["crops"][since]
    assert found["scale"] == pytest.approx(scale, abs=5 * found["sigma_scale"] + 1e-12)
    assert solution.as_dict["cameras"]["right"]["lens_crop"]["significance"]
