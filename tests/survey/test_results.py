import csv
import io
import json
from collections.abc import Iterable
from dataclasses import replace
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from pyarrow import parquet
from scipy.spatial.transform import Rotation

from adjust.adjustment import adjust
from adjust.model.observations import FrameRef
from adjust.model.result import Adjustment, Estimate, GlobalTest
from adjust.native.text import NUMBERS, TEXT, WORD, Words, number_rows, record_rows
from survey.project import AdjustmentOptions
from survey.report.language import ReportOptions
from survey.report.results import write_results
from survey.simulate import head_on_table
from survey.solution.covariances import covariance_npz, read_estimates
from survey.solution.dictionary import RunInfo, solution_dict
from survey.solution.frames import AdjustedFrames, table_from_mount
from survey.solution.quantities import ellipsoid, key_of, pose_columns, scale_of, vector_entry
from survey.solution.records import Form, Records, sections, solution_json
from survey.solution.residual_tables import image_residuals_csv, image_residuals_parquet, other_residuals_csv
from survey.solution.statistics import statistics_of
from survey.solution.unknowns import correlated
from survey.solution.verdict import suspects, verdict
from tests.survey.adjustments import POSE_COMPONENTS, POSE_UNITS, Lab, correlate, lab_adjustment

RUN = RunInfo("lab", "A lab", {"survey.toml": "12ab"}, {"alpha": 0.05}, {"labsurvey": "0.1.0"}, "2026-01-02T03:04:05Z")
ARCSEC = np.pi / 180 / 3600


@pytest.fixture(scope="module")
def adjustment() -> Adjustment:
    return lab_adjustment(Lab(n_epochs=6, blunders=4), ("Point B2 is weak.",))


def numbers(value: Any, path: str = "") -> dict[str, float]:
    """Every number of a solution by its path."""
    if isinstance(value, dict):
        return {k: v for key, x in value.items() for k, v in numbers(x, f"{path}/{key}").items()}
    if isinstance(value, list):
        return {k: v for i, x in enumerate(value) for k, v in numbers(x, f"{path}/{i}").items()}
    return {path: value} if isinstance(value, float) else {}


def pose_estimate(pose: Pose3, sigmas: list[float]) -> Estimate:
    cov = np.diag(np.square(sigmas))
    return Estimate(("world_from_station", "s"), pose, POSE_COMPONENTS, POSE_UNITS, cov, ("free",) * 6)


def test_sigmas_of_a_translation_are_turned_into_the_left_frame(adjustment: Adjustment) -> None:
    estimate = pose_estimate(
        Pose3(Rot3.Rz(np.pi / 2), (1, 2, 3)), [1 * ARCSEC, 2 * ARCSEC, 3 * ARCSEC, 1e-3, 2e-3, 3e-3]
    )
    entry = pose_columns([estimate], scale_of(adjustment, "a_priori")).entry(estimate.name)
    # x of the station points along y of the world: its 1 mm becomes the sigma of y
    np.testing.assert_allclose(entry["sigma_translation_mm"], (2, 1, 3), rtol=1e-12)
    np.testing.assert_allclose(entry["sigma_rotation_arcsec"], (1, 2, 3), rtol=1e-12)
    np.testing.assert_allclose(entry["translation_mm"], (1000, 2000, 3000))


@pytest.mark.parametrize(
    "xyz_deg", [(100.0, -40.0, 170.0), (10.0, 20.0, -30.0), (179.0, 5.0, -100.0), (-150.0, 30.0, 2.0)]
)
def test_quaternion_and_euler_angles_agree_with_scipy(adjustment: Adjustment, xyz_deg: tuple[float, ...]) -> None:
    # z, y, x intrinsic: R = Rz Ry Rx
    expected = Rotation.from_euler("ZYX", xyz_deg[::-1], degrees=True)
    estimate = pose_estimate(Pose3(Rot3(expected.as_matrix()), np.zeros(3)), [1.0] * 6)
    entry = pose_columns([estimate], scale_of(adjustment, "a_priori")).entry(estimate.name)
    np.testing.assert_allclose(entry["rotation_euler_xyz_deg"], xyz_deg, atol=1e-9)
    xyzw = expected.as_quat(canonical=True)
    np.testing.assert_allclose(entry["rotation_quaternion_wxyz"], xyzw[[3, 0, 1, 2]], atol=1e-12)


def test_units_are_part_of_the_key() -> None:
    assert key_of("fx", "px") == "fx_px"
    assert key_of("k1", "") == "k1"
    assert key_of("K1", "1/mm^2") == key_of("K1", "mm^-2") == "K1_per_mm2"
    assert key_of("P1", "1/mm") == key_of("P1", "mm^-1") == "P1_per_mm"


def test_table_geometry_and_angles_have_their_units(adjustment: Adjustment) -> None:
    scale = scale_of(adjustment, "a_priori")
    geometry = Estimate(
        ("table_geometry", "t"), np.array([10 * ARCSEC, 2e-3]), ("non_orthogonality", "axis_offset"), ("rad", "m"),
        np.diag([ARCSEC**2, 1e-8]), ("free", "prior"),
    )  # fmt: skip
    entry = vector_entry(geometry, scale)
    assert entry["non_orthogonality_arcsec"] == pytest.approx(10)
    assert entry["sigma_non_orthogonality_arcsec"] == pytest.approx(1)
    assert entry["axis_offset_mm"] == pytest.approx(2)
    assert entry["sigma_axis_offset_mm"] == pytest.approx(0.1)
    assert entry["status"] == {"non_orthogonality": "free", "axis_offset": "prior"}
    angle = Estimate(
        ("table_angles", "t", "e"), np.array([np.pi / 6]), ("axis1",), ("rad",), np.eye(1) * ARCSEC**2, ("free",)
    )
    entry = vector_entry(angle, scale)
    assert set(entry) == {"axis1_deg", "sigma_axis1_arcsec", "status"}
    assert (entry["axis1_deg"], entry["sigma_axis1_arcsec"]) == pytest.approx((30, 1))


def test_ellipsoid_of_a_known_covariance(adjustment: Adjustment) -> None:
    cov = np.diag([4.0, 9.0, 1.0])
    axes, directions = ellipsoid(cov, scale_of(adjustment, "a_priori"))
    # 7.8147: chi-square table, 3 degrees of freedom, 95 %
    np.testing.assert_allclose(axes, np.sqrt(7.8147) * np.array([3, 2, 1]), rtol=1e-5)
    np.testing.assert_allclose(directions, [[0, 1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)


def test_ellipsoid_of_an_estimated_sigma0_uses_the_f_distribution(adjustment: Adjustment) -> None:
    few = replace(adjustment, redundancy=4, sigma0=2.0)
    # 6.591: table of F for 3 and 4 degrees of freedom, 95 %
    assert ellipsoid(np.eye(3), scale_of(few, "a_posteriori"))[0] == pytest.approx(2 * np.sqrt(3 * 6.591), rel=1e-4)


def test_all_sigmas_scale_with_sigma0_and_nothing_else_does(adjustment: Adjustment) -> None:
    factor = 3.0
    large = replace(adjustment, sigma0=factor, redundancy=10**7)
    prior = numbers({k: v for k, v in solution_dict(large, replace(RUN, sigmas="a_priori")).items() if k != "summary"})
    posterior = numbers({k: v for k, v in solution_dict(large, RUN).items() if k != "summary"})
    scaled = [k for k, v in prior.items() if v and posterior[k] != pytest.approx(v)]
    # sigma_scale is of observations
    sigma_keys = [k for k, v in prior.items() if v and ("/sigma_" in k or "semi_axes" in k) and "sigma_scale" not in k]
    ratios = [k for k in prior if "value_over_sigma" in k]
    assert set(scaled) == set(sigma_keys) | set(ratios)
    assert len(sigma_keys) > 100
    for k in sigma_keys:
        assert posterior[k] == pytest.approx(factor * prior[k], rel=1e-5), k
    for k in ratios:
        assert posterior[k] == pytest.approx(prior[k] / factor), k


def test_without_redundancy_sigmas_stay_a_priori(adjustment: Adjustment) -> None:
    summary = solution_dict(replace(adjustment, redundancy=0, sigma0=float("nan"), global_test=None), RUN)["summary"]
    assert summary["sigmas"] == "a_priori"
    assert summary["sigma_factor"] == 1.0
    assert summary["sigma0"] is None
    assert summary["verdict"] == "check"


def test_solution_has_the_documented_keys(adjustment: Adjustment) -> None:
    s = solution_dict(adjustment, RUN)
    assert {
        "summary",
        "cameras",
        "stations",
        "points",
        "tables",
        "targets",
        "pairs",
        "groups",
        "warnings",
        "inputs",
    } <= set(s)
    point = adjustment.estimates["point", "B3"]
    assert s["points"]["B3"]["x_mm"] == pytest.approx(1e3 * np.asarray(point.value)[0])
    sigma = 1e3 * adjustment.sigma0 * np.sqrt(point.cov[2, 2])
    assert s["points"]["B3"]["sigma_z_mm"] == pytest.approx(sigma)
    lens = s["cameras"]["X"]["lens"]
    assert lens["fx_px"] == pytest.approx(np.asarray(adjustment.estimates["lens", "X"].value)[0])
    assert lens["status"]["fx"] == "free"
    assert lens["status"]["k3"] == "held"
    assert lens["sigma_k3"] == 0.0
    assert "e03" in s["tables"]["turntable"]["epochs"]
    assert s["inputs"]["hashes"] == {"survey.toml": "12ab"}
    assert s["warnings"] == ["Point B2 is weak."]


def test_rms_of_a_camera_counts_used_points_only(adjustment: Adjustment) -> None:
    found, blocks = adjustment.image_residuals, adjustment.survey.image_blocks
    assert not found.used.all()
    camera = np.repeat([b.camera_id for b in blocks], np.diff(found.block_ptr))
    for camera_id, entry in solution_dict(adjustment, RUN)["cameras"].items():
        mine = found.residuals[(camera == camera_id) & found.used]
        assert entry["rms_residual_px"] == pytest.approx(np.sqrt(np.mean(mine**2)))
        assert entry["n_image_points"] == len(mine)
        assert sum(i["n_image_points"] for i in entry["images"].values()) == len(mine)


def test_json_is_strict_and_the_same_every_time(adjustment: Adjustment) -> None:
    group = replace(adjustment.groups[0], redundancy=0.0)  # its factor is nan
    broken = replace(adjustment, groups=(group,), max_step=float("inf"))

    def refuse(word: str) -> None:
        raise AssertionError(word)

    text = solution_json(solution_dict(broken, RUN))
    read = json.loads(text, parse_constant=refuse)
    assert read == solution_dict(broken, RUN)
    assert read["groups"]["image"]["variance_factor"] is None
    assert read["summary"]["last_step_sigmas"] is None
    assert text == solution_json(solution_dict(broken, RUN))
    later = solution_json(solution_dict(broken, replace(RUN, date="later", seconds={"solve": 1.0})))
    assert later != text
    assert later.replace('"later"', f'"{RUN.date}"') == text


def test_correlated_components_are_named(adjustment: Adjustment) -> None:
    lens = correlate(adjustment.estimates["lens", "Z"], "k1", "k2", -0.97)
    strong = correlated(lens)
    assert [(p["a"], p["b"]) for p in strong] == [("k1", "k2")]
    assert strong[0]["correlation"] == pytest.approx(-0.97)
    assert correlated(correlate(lens, "k1", "k2", 0.9)) == []


def test_a_parameter_that_may_be_zero_is_named(adjustment: Adjustment) -> None:
    lens = adjustment.estimates["lens", "X"]
    values, sigmas = np.array(lens.value, dtype=float), np.sqrt(np.diag(lens.cov))
    values[5], values[8] = 1.9 * sigmas[5], 2.0 * sigmas[8]
    changed = replace(adjustment, estimates={**adjustment.estimates, ("lens", "X"): replace(lens, value=values)})
    weak = solution_dict(changed, replace(RUN, sigmas="a_priori"))["cameras"]["X"]["lens"]["not_significant"]
    assert "k1" in weak
    assert "p2" not in weak


def test_pairs_give_the_adjusted_rotation(adjustment: Adjustment) -> None:
    pair = solution_dict(adjustment, RUN)["pairs"]["relay-board"]
    relay = adjustment.estimates["world_from_station", "relay"].value
    board = adjustment.estimates["carrier_from_target", "board"].value
    assert isinstance(relay, Pose3)
    assert isinstance(board, Pose3)
    relay_from_board = relay.rotation().matrix().T @ board.rotation().matrix()
    expected = Rotation.from_matrix(relay_from_board).as_euler("ZYX", degrees=True)[::-1]
    np.testing.assert_allclose(pair["adjusted"]["rotation_euler_xyz_deg"], expected, atol=1e-9)
    assert "translation_mm" not in pair["adjusted"]
    assert (pair["a"], pair["b"]) == ("target:board", "station:relay")


def test_motion_of_a_table_is_the_formula_of_the_model() -> None:
    def turn(axis: str, angle: float) -> np.ndarray:
        out = np.eye(4)
        out[:3, :3] = Rotation.from_euler(axis, angle).as_matrix()
        return out

    shift = np.eye(4)
    shift[1, 3] = 0.01
    expected = reduce(np.matmul, (turn("x", 0.3 + 0.01), shift, turn("y", 0.02), turn("z", -0.5 + 0.03)))
    geometry = {"non_orthogonality": 0.02, "axis_offset": 0.01, "zero_1": 0.01, "zero_2": 0.03}
    (got,) = table_from_mount(("x", "z"), geometry, np.array([[0.3, -0.5]]))
    np.testing.assert_allclose(got.matrix(), expected, atol=1e-14)
    np.testing.assert_allclose(
        table_from_mount(("z",), {"zero_1": 0.1}, np.array([[0.2]]))[0].matrix(), turn("z", 0.3), atol=1e-14
    )


def test_frames_follow_the_table_and_its_adjusted_angles(adjustment: Adjustment) -> None:
    frames, e = AdjustedFrames(adjustment), adjustment.estimates
    estimate = e["table_geometry", "turntable"]
    geometry = dict(zip(estimate.components, np.asarray(estimate.value).tolist(), strict=True))
    angles = np.asarray(e["table_angles", "turntable", "e02"].value)
    (motion,) = table_from_mount(("x", "z"), geometry, angles[None])
    mount = adjustment.survey.stations[0].mount_from_station.value
    table, camera = e["world_from_table", "turntable"].value, e["station_from_camera", "Y"].value
    assert isinstance(table, Pose3)
    assert isinstance(camera, Pose3)
    assert mount is not None
    expected = table * motion * mount * camera
    got = frames.world_from(FrameRef("camera", "Y", "e02"))
    assert got is not None
    assert got.equals(expected, 1e-12)
    assert frames.world_from(FrameRef("station", "head", "by hand")) is None
    assert frames.world_from(FrameRef("station", "nowhere")) is None


def test_covariances_come_back_as_they_were(adjustment: Adjustment, tmp_path: Path) -> None:
    path = tmp_path / "covariance.npz"
    path.write_bytes(covariance_npz(adjustment))
    back = read_estimates(path)
    assert list(back) == list(adjustment.estimates)
    for name, e in adjustment.estimates.items():
        np.testing.assert_allclose(back[name].cov, e.cov, rtol=1e-14)
        assert (back[name].components, back[name].units, back[name].status) == (e.components, e.units, e.status)
        if isinstance(e.value, Pose3):
            assert back[name].value.equals(e.value, 0.0)
        else:
            np.testing.assert_array_equal(back[name].value, e.value)
    with np.load(path) as found:
        relay = np.flatnonzero(found["parameters"] == "world_from_station/relay")[0]
        np.testing.assert_allclose(
            found["covariance"][found["block"][relay] : found["block"][relay + 1]].reshape(6, 6),
            adjustment.sigma0**2 * adjustment.estimates["world_from_station", "relay"].cov, rtol=1e-14,
        )  # fmt: skip
        assert "table_angles/turntable/e01/axis2" in found["names"]
        assert str(found["sigmas"]) == "a_posteriori"
        assert "tangent" in " ".join(found["README"]).lower()
        assert len(found["names"]) == len(found["units"]) == found["start"][-1]
    assert covariance_npz(adjustment) == covariance_npz(adjustment)


def rows_of(pieces: Iterable[bytes | memoryview]) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(b"".join(pieces).decode(), newline="")))


def test_residuals_are_written_row_by_row(adjustment: Adjustment) -> None:
    rows, found = rows_of(image_residuals_csv(adjustment)), adjustment.image_residuals
    assert len(rows) == len(found.test)
    block_idx = len(adjustment.survey.image_blocks) // 2
    block, first = adjustment.survey.image_blocks[block_idx], int(found.block_ptr[block_idx])
    row = rows[first + 1]
    target = next((t for t in adjustment.survey.targets if t.target_id == block.target_id), None)
    names = target.point_ids if target else [p.point_id for p in adjustment.survey.points]
    assert (row["epoch_id"], row["camera_id"], row["target_id"]) == (
        block.epoch_id,
        block.camera_id,
        block.target_id or "",
    )
    assert row["point_id"] == names[block.point_idx[1]]
    assert float(row["v_px"]) == pytest.approx(block.uv[1, 1], abs=1e-4)
    for column, values in (
        ("residual_u_px", found.residuals[:, 0]),
        ("redundancy_v", found.redundancy[:, 1]),
        ("test", found.test),
    ):
        np.testing.assert_allclose([float(r[column]) for r in rows], values, atol=1e-4)
    np.testing.assert_allclose([float(r["sigma_u_px"]) for r in rows], 0.115, atol=1e-6)
    assert [r["used"] for r in rows] == ["1" if u else "0" for u in found.used]


def test_names_with_commas_and_numbers_that_are_missing(adjustment: Adjustment) -> None:
    survey = adjustment.survey
    board = replace(survey.targets[0], point_ids=tuple(f'r,"{i}" é' for i in range(88)))
    found = adjustment.image_residuals
    test = found.test.copy()
    test[3] = np.nan
    changed = replace(
        adjustment,
        survey=replace(survey, targets=(board, *survey.targets[1:])),
        image_residuals=replace(found, test=test),
    )
    rows = rows_of(image_residuals_csv(changed))
    assert rows[3]["test"] == ""
    assert {r["point_id"] for r in rows if r["target_id"] == "board"} <= set(board.point_ids)


@pytest.mark.slow
def test_numbers_in_full_are_what_python_prints() -> None:
    rng = np.random.default_rng(1)
    bits = rng.integers(0, 2**63 - 1, 20_000, dtype=np.int64).view(np.float64)  # every exponent
    powers = np.ldexp(1.0, np.arange(-1074, 1024))  # the next smaller double is nearer than the next larger
    tens = np.array([float(f"1e{k}") for k in range(-320, 309)])
    few = [0.0, 5e-324, 1e15, 1e16, 1e17, 9007199254740993.0, 1e-4, 1e-5, 0.1 + 0.2, 100.0, 1.7976931348623157e308]
    near = np.nextafter(powers, 1.0)
    values = np.concatenate([bits[np.isfinite(bits)], powers, near, tens, few, rng.normal(size=999)])
    values = np.concatenate([values, -values])
    none = np.zeros((len(values), 0), dtype=np.int64)
    lines = Words.of(["null", "\n"])
    made, ends = record_rows(lines, none, values[:, None], [(NUMBERS, 1), (TEXT, 1)])
    assert bytes(made).decode().split() == list(map(repr, values.tolist()))
    assert ends[-1] == len(made)
    some = values[np.abs(values) > 1e-300]
    twelve = bytes(record_rows(lines, none[: len(some)], some[:, None], [(NUMBERS, 1), (TEXT, 1)], 12)[0]).split()
    assert [float(x) for x in twelve] == pytest.approx(some, rel=5.000001e-12)
    some = rng.normal(size=5000) * 10.0 ** rng.integers(-20, 20, 5000)
    twelve = bytes(record_rows(lines, none[:5000], some[:, None], [(NUMBERS, 1), (TEXT, 1)], 12)[0]).split()
    assert twelve == [f"{x:.12g}".encode() for x in some.tolist()]


def test_records_are_written_part_by_part() -> None:
    words, word = Words.of(["null", "[", "]", "a", "é"]), np.array([[4, 3], [3, 3]])
    values = np.array([[1.0, np.nan, 3.5], [np.inf, -2.0, 0.0]])
    parts = [(WORD, 0), (TEXT, 1), (NUMBERS, 2), (TEXT, 2), (NUMBERS, 1), (WORD, 1)]
    made, ends = record_rows(words, word, values, parts)
    assert bytes(made).decode() == "é[1.0, null]3.5aa[null, -2.0]0.0a"
    assert ends.tolist() == [len("é[1.0, null]3.5a".encode()), len(made)]
    for wrong in ([(WORD, 2)], [(TEXT, 5)], [(NUMBERS, 4)]):
        with pytest.raises(IndexError):
            record_rows(words, word, values, wrong)


def test_entries_by_columns_are_those_one_by_one() -> None:
    x = np.array([1.5, np.nan])
    tree = {"word": ["a", 'say "b"'], "n": np.array([3, 4]), "yes": np.array([True, False]), "x": x,
            "inner": {"list": np.array([[1.0, np.inf], [2.5, -0.0]])}}  # fmt: skip
    records = Records(["p", "q", "r", "s"], [Form(np.array([2, 0]), tree), Form(np.array([3]), {"x": x[:1]})],
                      {"q": {"x": None}})  # fmt: skip
    one, two = ({"word": 'say "b"', "n": 4, "yes": False, "x": None, "inner": {"list": [2.5, -0.0]}},
                {"word": "a", "n": 3, "yes": True, "x": 1.5, "inner": {"list": [1.0, None]}})  # fmt: skip
    assert list(records) == ["p", "q", "r", "s"]
    assert records == {"p": one, "q": {"x": None}, "r": two, "s": {"x": 1.5}}
    assert solution_json({"all": records, "none": Records([], [])}) == solution_json({"all": dict(records), "none": {}})
    with pytest.raises(KeyError):
        records["t"]


def test_sections_of_a_solution_are_those_of_the_whole() -> None:
    """Of what another program has laid out anew too; what stands deeper under the same name is not meant."""
    whole = {"summary": {"title": 'a\n "inputs": 1'}, "empty": {}, "stations": {"summary": {"inputs": [1.5, 2.0]}},
             "list": ["inputs", {"summary": 3}], "inputs": {"hashes": {"a": "b"}}}  # fmt: skip
    wanted = {"summary": whole["summary"], "inputs": whole["inputs"]}
    text = solution_json(whole)
    assert sections(text.encode(), "summary", "inputs") == wanted
    for indent in (None, 0, 1, 4):
        found = sections(json.dumps(whole, indent=indent).encode(), "summary", "inputs")
        assert {name: found[name] for name in wanted} == wanted
    assert "inputs" not in sections(text.replace('"inputs": {', '"other": {').encode(), "summary", "inputs")
    with pytest.raises(ValueError, match=r"delimiter|value|property name"):
        sections(text[: len(text) // 2].encode(), "summary", "inputs")


@pytest.mark.parametrize("decimals", [0, 2, 6])
def test_fixed_numbers_are_what_python_prints(decimals: int) -> None:
    rng = np.random.default_rng(1)
    values = np.concatenate(
        [rng.normal(0, 10.0**k, 50) for k in range(-7, 8)]
        + [[0.0, -0.0, -1e-9, 9.9999999, 99.5, 1e30, np.nan, -np.inf]]
    )
    zero, none = np.zeros(len(values), dtype=np.int64), Words.of([""])
    assert number_rows(none, zero, none, zero, values[:, None], [decimals]) is None  # 1e30
    for part in (values[~np.isfinite(values) | (np.abs(values) < 1e9)], np.array([-3.0]), np.empty(0)):
        found = number_rows(none, zero[: len(part)], none, zero[: len(part)], part[:, None], [decimals])
        assert found is not None
        words = [line.removeprefix(",") for line in found.decode().splitlines()]
        for word, value in zip(words, part, strict=True):
            if not np.isfinite(value):
                assert word == ""
            else:
                assert float(word) == pytest.approx(value, abs=0.5000001 * 10.0**-decimals)
                assert not word.startswith("-") or float(word) < 0
                assert len(word.partition(".")[2]) == decimals
    with pytest.raises(IndexError):
        number_rows(none, zero + 1, none, zero, values[:, None], [decimals])


def test_parquet_has_what_the_csv_has(adjustment: Adjustment) -> None:
    """Its numbers in full."""
    columns = parquet.read_table(io.BytesIO(image_residuals_parquet(adjustment))).to_pydict()
    rows, found = rows_of(image_residuals_csv(adjustment)), adjustment.image_residuals
    assert list(columns) == list(rows[0])
    for name in ("epoch_id", "camera_id", "target_id", "point_id"):
        assert columns[name] == [row[name] for row in rows]
    np.testing.assert_array_equal(columns["residual_v_px"], found.residuals[:, 1])
    np.testing.assert_array_equal(columns["used"], found.used)
    for name in list(columns)[4:-1]:
        written = np.array([float(row[name]) if row[name] else np.nan for row in rows])
        np.testing.assert_allclose(np.array(columns[name], dtype=float), written, atol=6e-5)


def test_parquet_is_written_on_request_and_then_never_old(adjustment: Adjustment, tmp_path: Path) -> None:
    assert "residuals.parquet" not in write_results(tmp_path, adjustment, RUN)
    asked = write_results(tmp_path, adjustment, RUN, options=ReportOptions(parquet=True))
    asked["residuals.parquet"].write_bytes(b"of another run")
    again = write_results(tmp_path, adjustment, RUN)["residuals.parquet"]
    assert again.read_bytes() == image_residuals_parquet(adjustment)
    again.unlink()
    assert "residuals.parquet" not in write_results(tmp_path, adjustment, RUN)


def test_numbers_too_large_for_fixed_decimals_are_written_in_full(adjustment: Adjustment) -> None:
    found = adjustment.image_residuals
    residuals = found.residuals.copy()
    residuals[1] = 1e30, np.nan
    rows = rows_of(image_residuals_csv(replace(adjustment, image_residuals=replace(found, residuals=residuals))))
    assert (float(rows[1]["residual_u_px"]), rows[1]["residual_v_px"], rows[1]["used"]) == (1e30, "", "1")
    assert [r["point_id"] for r in rows] == [r["point_id"] for r in rows_of(image_residuals_csv(adjustment))]
    assert float(rows[0]["u_px"]) == adjustment.survey.image_blocks[0].uv[0, 0]


def test_other_residuals_have_units_for_people(adjustment: Adjustment) -> None:
    rows = rows_of(other_residuals_csv(adjustment))
    assert len(rows) == sum(len(o.components) for o in adjustment.other_residuals)
    table = next(o for o in adjustment.other_residuals if o.kind == "table")
    assert rows[0]["value_unit"] == "deg"
    assert rows[0]["residual_unit"] == "arcsec"
    assert float(rows[0]["observed"]) == pytest.approx(np.degrees(table.observed[0]))
    assert float(rows[0]["residual"]) == pytest.approx(table.residual[0] / ARCSEC)
    assert float(rows[0]["sigma"]) == pytest.approx(8.0)
    distance = next(r for r in rows if r["kind"] == "distance")
    assert (distance["value_unit"], distance["residual_unit"], distance["ids"]) == ("mm", "mm", "d1 B1 B2")
    assert float(distance["sigma"]) == pytest.approx(0.3)


def test_suspects_are_counted_at_a_common_level(adjustment: Adjustment) -> None:
    found = suspects(adjustment)
    # four blunders of more than 7 sigma: two are not used, the others suspect
    assert (found.n_image, found.n_other, found.n_not_used) == (2, 0, 2)
    image = adjustment.image_residuals
    one = replace(
        adjustment, other_residuals=(),
        image_residuals=replace(image, used=np.arange(len(image.used)) == 0, test=np.full(len(image.used), 5.0)),
    )  # fmt: skip
    one = replace(one, global_test=None)
    # a single test at 5 %: the tables of chi-square (2) and of the normal distribution
    assert suspects(one).image_limit == pytest.approx(5.9915, abs=1e-4)
    assert suspects(one).w_limit == pytest.approx(1.95996, abs=1e-4)
    assert suspects(one).n_image == 0
    # sigma0 = 3, far too large: the limits grow with it
    loose = replace(one, sigma0=3.0, global_test=GlobalTest(900.0, 100, 0.05, 74.2, 129.6))
    assert suspects(loose).image_limit == pytest.approx(9 * 5.9915, abs=1e-3)
    assert suspects(loose).w_limit == pytest.approx(3 * 1.95996, abs=1e-3)


@pytest.mark.parametrize(
    ("change", "level", "word"),
    [
        ({}, "passed", "agree"),
        ({"converged": False}, "failed", "converge"),
        ({"global_test": GlobalTest(200.0, 100, 0.05, 74.2, 129.6)}, "failed", "times what"),
        ({"global_test": GlobalTest(50.0, 100, 0.05, 74.2, 129.6)}, "passed", "cautious"),
        ({"global_test": None}, "check", "redundant"),
        ({"warnings": ("Look.",)}, "check", "warnings"),
    ],
)
def test_verdict(change: dict[str, Any], level: str, word: str) -> None:
    test = GlobalTest(100.0, 100, 0.05, 74.2, 129.6)
    adjusted = replace(lab_adjustment(Lab(n_epochs=3)), global_test=test)
    changed = replace(adjusted, **change)
    got, reason = verdict(changed, replace(suspects(changed), n_image=0, n_other=0))
    assert got == level
    assert word in reason
    if level == "passed":
        assert verdict(changed, replace(suspects(changed), n_image=1))[0] == "check"


def test_results_are_written_whole(adjustment: Adjustment, tmp_path: Path) -> None:
    paths = write_results(tmp_path, adjustment, RUN)
    expected = {"solution.json", "covariance.npz", "residuals.csv", "residuals_other.csv", "report.html"}
    assert {p.name for p in (tmp_path / "results").iterdir()} == expected == set(paths)
    first = {name: path.read_bytes() for name, path in paths.items()}
    assert json.loads(first["solution.json"])["summary"]["n_unknowns"] == adjustment.n_unknowns
    again = write_results(tmp_path, adjustment, replace(RUN, date="another day", seconds={"solve": 2.0}))
    for name, path in again.items():
        assert path.read_bytes().replace(b"another day", RUN.date.encode()) == first[name], name


def test_json_is_one_line_for_an_entry_and_for_a_list_of_numbers():
    solution = {"a": {"x": 1.5, "n": 3, "ok": True, "no": None, "ä\n": []}, "m": [[1.0, 2], [1e-300]], "w": ["é", {}]}
    text = solution_json(solution)
    assert json.loads(text) == solution
    assert '  "x": 1.5,\n  "n": 3,\n  "ok": true,' in text
    assert ' "m": [[1.0, 2], [1e-300]],\n "w": [\n  "é",\n  {}\n ]' in text
    for nothing in (float("nan"), [float("inf"), 1.0]):
        with pytest.raises(ValueError, match="JSON compliant"):
            solution_json({"x": nothing})


@pytest.mark.slow
def test_files_are_the_same_for_any_number_of_threads(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Statistics and files that are made beside each other."""
    adjusted = adjust(head_on_table(2, n_cameras=2, n_table_epochs=6, n_free_epochs=4)[0])
    files = {}
    for threads in "13":
        monkeypatch.setenv("LABSURVEY_THREADS", threads)
        found = statistics_of(adjusted, AdjustmentOptions(), scale_of(adjusted, "a_posteriori"))
        paths = write_results(tmp_path / threads, adjusted, RUN, found, ReportOptions(parquet=True))
        files[threads] = {name: path.read_bytes() for name, path in paths.items()}
    assert len(files["1"]) == 6
    assert files["1"] == files["3"]
    (tmp_path / "usual").touch()
    usual = (tmp_path / "usual").stat().st_mode
    assert {(tmp_path / "3" / "results" / name).stat().st_mode for name in files["3"]} == {usual}
