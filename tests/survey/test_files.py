"""A project folder read and written: values, units, order, formats."""

import csv
import dataclasses
import math
import threading
import time
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.observations import Coordinates, FrameRef, ImageBlock, Pair, PositionRef
from adjust.model.survey import (
    Camera,
    LensParameter,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Target,
    VectorPrior,
)
from adjust.model.survey import Point as WorldPoint
from survey import project as files
from survey.folder import ahead as reading_ahead
from survey.folder.units import from_si, to_si
from survey.project.declared.toml_text import key_lines, read_tables
from survey.project.tables import files as table_reading
from survey.project.tables import reading as tables
from survey.project.tables.layouts import IMAGE_POINTS
from survey.project.tables.pairs import pair_columns
from survey.project.targets import Charuco, Checkerboard, MarkerBlock, MarkerGrid, PointList
from survey.simulate import full_lab
from tests.survey.faults import write_good_project

COLUMNS = ("epoch_id", "camera_id", "target_id", "point_id", "u_px", "v_px", "sigma_u_px", "sigma_v_px", "rho_uv")


@pytest.fixture
def good(tmp_path: Path) -> Path:
    folder = tmp_path / "good"
    write_good_project(folder)
    return folder


def differences(a: Any, b: Any, at: str = "") -> list[str]:
    """Where two values differ by more than the rounding of a change of units (a few bits)."""
    if dataclasses.is_dataclass(a) and type(a) is type(b):
        fields = [field.name for field in dataclasses.fields(a)]
        return [d for name in fields for d in differences(getattr(a, name), getattr(b, name), f"{at}.{name}")]
    if isinstance(a, Mapping) and isinstance(b, Mapping) and set(a) == set(b):
        return [d for key in a for d in differences(a[key], b[key], f"{at}[{key}]")]
    if isinstance(a, tuple) and isinstance(b, tuple) and len(a) == len(b):
        return [d for i, (x, y) in enumerate(zip(a, b, strict=True)) for d in differences(x, y, f"{at}[{i}]")]
    if isinstance(a, Pose3 | Rot3) and type(a) is type(b):
        return [] if np.allclose(a.matrix(), b.matrix(), rtol=0, atol=3e-15) else [f"{at}: {a} {b}"]
    if isinstance(a, np.ndarray | float) and isinstance(b, np.ndarray | float):
        same = np.shape(a) == np.shape(b) and np.allclose(a, b, rtol=1e-15, atol=0, equal_nan=True)
        return [] if same else [f"{at}: {a} {b}"]
    return [] if type(a) is type(b) and a == b else [f"{at}: {a!r} {b!r}"]


def rewrite(project: files.Project, folder: Path, **changes: Any) -> files.Project:
    names = ("title", "target_kinds", "tie_points", "options", "sigmas", "spots_request", "spots")
    files.write_project(folder, project.survey, **{name: getattr(project, name) for name in names}, **changes)
    return files.read(folder)


def test_definition(good: Path) -> None:
    definition = files.read_definition(good)
    survey = definition.survey
    assert definition.title == "Small lab"
    assert definition.options == files.AdjustmentOptions(alpha=0.01, reject_blocks=True)
    assert definition.spots_request == files.SpotsRequest(("X", "Y"), ("n1",), (2.0, 12.0), 15.0)
    assert [station.motion for station in survey.stations] == ["table", "epoch", "fixed"]
    assert survey.cameras[0].image_size == (1280, 1024)
    assert survey.datum.points == ("B1", "B2")
    assert survey.image_blocks == ()
    kinds = [type(kind) for kind in definition.target_kinds.values()]
    assert kinds == [Checkerboard, MarkerBlock, MarkerGrid, Charuco, PointList]
    images = [(camera, epoch, path.name) for (camera, epoch), path in definition.images.items()]
    assert images == [("X", "e1", "e1.png"), ("X", "e2", "e2.JPG"), ("X", "e10", "e10.png"), ("Y", "e1", "e1.tif")]


def test_units_and_frames(good: Path) -> None:
    survey = files.read(good).survey
    lens = survey.cameras[0].lens
    assert lens.values is not None
    assert lens.values[:7].tolist() == [1600.0, 0.0, 0.0, 639.5, 511.5, -0.1, 0.0]
    pose = survey.cameras[1].station_from_camera
    assert pose.value is not None
    assert pose.prior_cov is not None
    # 90 deg about y takes the camera's z to the station's x
    np.testing.assert_allclose(pose.value.rotation().matrix() @ [0, 0, 1], [1, 0, 0], atol=1e-15)
    np.testing.assert_array_equal(pose.value.translation(), [0.01, 0.0, 0.005])
    sigmas = np.sqrt(np.diagonal(pose.prior_cov))
    np.testing.assert_allclose(sigmas, [math.pi / 180, math.pi / 180, np.inf, 0.002, 0.002, 0.002], rtol=1e-15)
    assert survey.tables[0].geometry.values[1] == 0.0001
    reading = survey.table_readings[1]
    assert (reading.table_id, reading.epoch_id) == ("turntable", "e1")
    np.testing.assert_allclose(reading.angles, np.deg2rad([10, 20]), rtol=1e-15)
    np.testing.assert_allclose(np.sqrt(np.diagonal(reading.cov)), 8 / 206264.80624709636, rtol=1e-14)
    assert survey.distances[0].value == 1.5005
    assert survey.distances[0].sigma == pytest.approx(0.0001, rel=1e-15)  # the group's scale of 2 is in it


def test_euler_angles_turn_about_x_then_y_then_z(good: Path) -> None:
    text = (good / "survey.toml").read_text().replace("[0.0, 90.0, 0.0]", "[10.0, 20.0, 30.0]")
    (good / "survey.toml").write_text(text)
    pose = files.read_definition(good).survey.cameras[1].station_from_camera.value
    assert pose is not None
    (sx, sy, sz), (cx, cy, cz) = np.sin(np.deg2rad([10, 20, 30])), np.cos(np.deg2rad([10, 20, 30]))
    x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    np.testing.assert_allclose(pose.rotation().matrix(), z @ y @ x, atol=1e-15)


def test_image_blocks(good: Path) -> None:
    project = files.read(good)
    blocks = project.survey.image_blocks
    keys = [(block.camera_id, block.epoch_id, block.target_id) for block in blocks]
    assert keys == [
        ("X", "e1", "board"),
        ("X", "e2", "board"),
        ("X", "e10", "board"),
        ("Y", "e1", "sheet"),
        ("Y", "e1", None),
    ]
    assert blocks[0].point_idx.tolist() == [0, 1]
    np.testing.assert_allclose(blocks[0].cov[1], [[0.01, 0.01], [0.01, 0.04]], rtol=1e-15)
    np.testing.assert_allclose(blocks[2].cov[0], 0.01 * np.eye(2), rtol=1e-15)  # image_px
    assert project.spots[0].spot_ids == ("s1", "s2")


def test_pairs_and_joint_coordinates(good: Path) -> None:
    survey = files.read(good).survey
    pose, rotation = survey.pairs
    assert isinstance(pose.b_from_a, Pose3)
    assert isinstance(rotation.b_from_a, Rot3)
    assert (pose.a, pose.b) == (FrameRef("station", "pillar"), FrameRef("station", "relay", "e1"))
    np.testing.assert_allclose(np.sqrt(np.diagonal(pose.cov))[3:], 0.0001, rtol=1e-15)
    # a quaternion of (cos, sin) = (0.6, 0.8) about x turns by twice that angle
    assert rotation.b_from_a.matrix()[1, 1] == pytest.approx(0.6**2 - 0.8**2)
    alone, joint = survey.coordinates
    assert len(alone.positions) == 1
    assert [p.point_id for p in joint.positions] == ["B1", "B2"]
    assert joint.cov[0, 3] == joint.cov[3, 0] == pytest.approx(2e-9)
    assert joint.cov[3, 4] == pytest.approx(0.5e-8)


def test_scales_multiply_the_sigmas_of_their_group(good: Path) -> None:
    before = files.read(good).survey
    text = (good / "survey.toml").read_text()
    scales = "{ image = 3.0, table = 4.0, pair = 5.0, distance = 2.0, coordinates = 6.0 }"
    (good / "survey.toml").write_text(text.replace("{ distance = 2.0 }", scales))
    after = files.read(good).survey
    for name, scale in {"image_blocks": 3, "table_readings": 4, "pairs": 5, "coordinates": 6}.items():
        for a, b in zip(getattr(before, name), getattr(after, name), strict=True):
            np.testing.assert_allclose(b.cov, scale**2 * a.cov, rtol=1e-14)


def test_inputs_are_hashed(good: Path) -> None:
    before = files.read(good).inputs
    assert set(before) == {"survey.toml", "sheet_points.csv"} | {
        f"observations/{path.name}" for path in (good / "observations").iterdir()
    }
    with (good / "sheet_points.csv").open("a") as stream:
        stream.write("p4,1,2,3\n")
    after = files.read(good).inputs
    assert [name for name in before if before[name] != after[name]] == ["sheet_points.csv"]


def test_order_of_rows_changes_nothing(good: Path) -> None:
    before = files.read(good)
    for path in (good / "observations").iterdir():
        head, *rows = path.read_text().splitlines()
        path.write_text("\n".join([head, *reversed(rows)]) + "\n")
    after = files.read(good)
    assert differences(before.survey, after.survey) == []
    assert differences(before.spots, after.spots) == []


@pytest.mark.parametrize("parquet", [False, True])
def test_written_project_reads_the_same(good: Path, tmp_path: Path, parquet: bool) -> None:
    project = files.read(good)
    again = rewrite(project, tmp_path / "copy", parquet=parquet)
    assert differences(project.survey, again.survey) == []
    assert differences(project.target_kinds, again.target_kinds) == []
    assert differences(project.spots, again.spots) == []
    assert (again.title, again.options, again.spots_request) == (project.title, project.options, project.spots_request)
    assert again.sigmas.image_px == project.sigmas.image_px
    for a, b in zip(project.survey.image_blocks, again.survey.image_blocks, strict=True):
        np.testing.assert_array_equal(a.uv, b.uv)


def test_writing_is_stable(good: Path, tmp_path: Path) -> None:
    first = rewrite(files.read(good), tmp_path / "first")
    second = rewrite(first, tmp_path / "second")
    assert first.inputs == second.inputs


def test_what_only_programs_write(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)

    def cov(k: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        factor = rng.normal(size=(k, k))
        return 1e-6 * (factor @ factor.T + np.eye(k))

    vague = cov(6)
    vague[0, :] = vague[:, 0] = 0.0
    vague[0, 0] = np.inf
    pose = Pose3(Rot3.Expmap(rng.normal(size=3)), rng.normal(size=3))
    held = PoseParameter(pose, "held")
    lens = LensParameter(
        "brown", ("fx", "k1"), rng.normal(size=13), VectorPrior(("fx", "k1"), np.array([1600.0, -0.1]), cov(2))
    )
    block = ImageBlock(
        "C", "e 1", "odd name", np.array([0, 1]), np.array([[1 / 3, 2.0], [-0.5, 9.5]]),
        np.stack([cov(2), cov(2)]), np.array([True, False]), "left",
    )  # fmt: skip
    survey = Survey(
        (Camera("C", "S", (10, 10), lens, PoseParameter(pose, "prior", vague)),),
        (Station("S", "epoch", epochs={"e 1": PoseParameter(pose, "prior", cov(6)), "e2": held}),),
        targets=(Target("odd name", ("p 1", "ü"), rng.normal(size=(2, 3)), motion="epoch", epochs={"e2": held}),),
        points=(WorldPoint("P", PointParameter(rng.normal(size=3), "prior", cov(3))),),
        image_blocks=(block,),
        pairs=(Pair("a", FrameRef("world"), FrameRef("station", "S", "e2"), pose, cov(6), "laser", False),),
        coordinates=tuple(
            Coordinates(
                (PositionRef("P"), PositionRef(None, FrameRef("camera", "C", "e2"))), rng.normal(size=(2, 3)), cov(6),
                set_id=f"set{i}",
            )
            for i in (1, 2)
        ),
    )  # fmt: skip
    files.write_project(tmp_path, survey)
    again = files.read(tmp_path).survey
    assert differences(survey, again) == []


@pytest.mark.slow
def test_simulated_lab_returns_in_canonical_order(tmp_path: Path) -> None:
    survey, _ = full_lab(1)
    files.write_project(tmp_path, survey)
    again = files.read(tmp_path).survey
    for name in ("cameras", "stations", "tables", "targets", "points", "datum"):
        assert differences(getattr(survey, name), getattr(again, name), name) == []
    for name, ids in {
        "image_blocks": ("camera_id", "epoch_id", "target_id"),
        "table_readings": ("table_id", "epoch_id"),
        "distances": ("distance_id",),
        "coordinates": ("positions",),
    }.items():
        before = {tuple(getattr(x, key) for key in ids): x for x in getattr(survey, name)}
        after = {tuple(getattr(x, key) for key in ids): x for x in getattr(again, name)}
        assert differences(before, after, name) == []


def test_existing_project_is_not_overwritten_by_chance(good: Path) -> None:
    project = files.read(good)
    with pytest.raises(SurveyError, match=r"survey\.toml: there is a project already"):
        files.write_project(good, project.survey)
    files.write_project(good, Survey(), overwrite=True)
    assert list((good / "observations").iterdir()) == []


def test_tables_without_rows_observe_nothing(good: Path) -> None:
    for path in (good / "observations").iterdir():
        path.write_text(path.read_text().partition("\n")[0])
    survey = files.read(good).survey
    assert survey.image_blocks == survey.pairs == survey.coordinates == survey.distances == survey.table_readings == ()


def test_tie_points_become_free_points(good: Path) -> None:
    text = (good / "survey.toml").read_text().replace("format = 1", "format = 1\ntie_points = true")
    text = text.replace('points = ["B1", "B2"]', 'points = ["B1", "T9"]')
    (good / "survey.toml").write_text(text)
    with (good / "observations" / "image_points.csv").open("a") as stream:
        stream.write("e2,X,,T10,5,5,,,\ne2,X,,T9,6,6,,,\n")
    with (good / "observations" / "distances.csv").open("a") as stream:
        stream.write("d3,T9,T11,5,1\n")
    survey = files.read(good).survey
    assert [point.point_id for point in survey.points] == ["B1", "B2", "B3", "T9", "T10", "T11"]
    block = next(b for b in survey.image_blocks if b.epoch_id == "e2" and b.target_id is None)
    np.testing.assert_array_equal(block.uv, [[6, 6], [5, 5]])
    assert block.point_idx.tolist() == [3, 4]


def test_windows_files(good: Path) -> None:
    before = files.read(good)
    for path in [*(good / "observations").iterdir(), good / "survey.toml", good / "sheet_points.csv"]:
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes().replace(b"\n", b"\r\n"))
    assert differences(before.survey, files.read(good).survey) == []


def test_blank_lines_and_quotes_go_the_other_way(good: Path) -> None:
    before = files.read(good)
    path = good / "observations" / "image_points.csv"
    text = path.read_text().replace("e10,X", '\n"e10",X')
    path.write_text(text)
    after = files.read(good)
    assert differences(before.survey, after.survey) == []
    assert table_reading.read_table(path, IMAGE_POINTS).lines.tolist() == [2, 3, 5, 6, 7, 8]


@pytest.fixture
def two_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two threads, and every table is a large one."""
    monkeypatch.setenv("LABSURVEY_THREADS", "2")
    for module in ("project.tables.files", "project.tables.arrow", "folder.ahead"):
        monkeypatch.setattr(f"survey.{module}.LARGE", 0)


@contextmanager
def _tables_ahead(folder: Path) -> Iterator[dict[Path, table_reading.Begun]]:
    with reading_ahead.reading_ahead(folder) as ahead:
        yield table_reading.begin_tables(ahead)


@pytest.mark.usefixtures("two_threads")
def test_large_tables_are_read_ahead(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before, read, asked = files.read(good), table_reading._read, list[Path]()

    def asking(path: Path, *more: Any) -> tables.Table:
        asked.append(path)
        return read(path, *more)

    monkeypatch.setattr(table_reading, "_read", asking)
    with _tables_ahead(good) as ahead:
        expected = sorted([*ahead, good / "sheet_points.csv"])
        after = files.read(good, ahead)
        assert ahead == {}  # nothing of them stays
    assert good / "observations" / "image_points.csv" in expected
    assert (sorted(asked), differences(before.survey, after.survey), after.inputs) == (expected, [], before.inputs)
    monkeypatch.setenv("LABSURVEY_THREADS", "1")
    with _tables_ahead(good) as ahead:
        assert ahead == {}


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("replaced", [True, False])
def test_a_table_that_changed_since_it_was_read_ahead_is_read_again(good: Path, replaced: bool) -> None:
    path = good / "observations" / "image_points.csv"
    text = path.read_text()
    with _tables_ahead(good) as ahead:
        for begun in ahead.values():
            begun.table()
        if replaced:
            files.atomic_write(path, text.replace("e10,X", "e10,Z"))
        else:
            path.write_text(text + "e10\n")
        expected = r"image_points\.csv:4: camera_id: unknown camera 'Z'" if replaced else "found 1 fields, expected"
        with pytest.raises(SurveyError, match=expected):
            files.read(good, ahead)


@pytest.mark.usefixtures("two_threads")
def test_what_is_wrong_with_a_table_is_told_when_it_is_asked_for(good: Path) -> None:
    path = good / "observations" / "image_points.csv"
    path.write_text(path.read_text() + "e10\n")
    with _tables_ahead(good) as ahead:
        begun = ahead[path]
        with pytest.raises(SurveyError, match=r"image_points\.csv:\d+: found 1 fields, expected"):
            files.read(good, ahead)
    with _tables_ahead(good):
        pass  # nobody asks
    (good / "survey.toml").write_text("format = 0\n")
    with _tables_ahead(good) as ahead, pytest.raises(SurveyError, match=r"survey\.toml:1: format"):
        files.read(good, ahead)
    with pytest.raises(SurveyError, match="found 1 fields"):
        begun.table()


@pytest.mark.usefixtures("two_threads")
def test_nothing_is_read_any_more_when_a_command_has_failed(good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on, done = threading.Event(), threading.Event(), list[bool]()

    def content(path: Path) -> bytes:
        begun.set()
        assert go_on.wait(30.0)
        done.append(True)
        return path.read_bytes()

    monkeypatch.setattr(reading_ahead, "content", content)
    with suppress(SurveyError), _tables_ahead(good) as ahead:
        assert begun.wait(30.0)
        threading.Timer(0.1, go_on.set).start()
        raise SurveyError("a command that failed")
    assert len(done) == len(ahead) > 0


@pytest.mark.parametrize("quote", ["", '"'])
@pytest.mark.parametrize("n", [1, 2, 3, 7])
def test_chunks_of_a_table_join(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, n: int, quote: str) -> None:
    monkeypatch.setattr(table_reading, "CHUNK", 3)
    layout = tables.Layout("t", ("id",), ("x",), (), ("y",))
    path = tmp_path / "t.csv"
    path.write_text("id,x,y\n" + "".join(f"{quote}i{i % 4}{quote},{i}.5,{'' if i % 2 else i}\n" for i in range(n)))
    table = table_reading.read_table(path, layout)
    assert table.lines.tolist() == list(range(2, n + 2))
    assert table.text("id").values() == [f"i{i % 4}" for i in range(n)]
    assert table.numbers("x").tolist() == [i + 0.5 for i in range(n)]
    np.testing.assert_array_equal(table.numbers("y"), [np.nan if i % 2 else i for i in range(n)])


def test_parquet_faults(good: Path) -> None:
    pa, pq = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.parquet")
    (good / "observations" / "distances.csv").unlink()
    path = good / "observations" / "distances.parquet"
    columns: dict[str, list[Any]] = {"distance_id": ["d1", "d2"], "from_id": ["B1", "B2"], "to_id": ["B2", "B3"]}
    columns |= {"value_mm": [5.0, 6.0], "sigma_mm": [0.1, 0.1]}
    cases: list[tuple[dict[str, list[Any]], str]] = [
        ({"value_mm": [5.0, math.nan]}, r"distances\.parquet:2: value_mm: found nan"),
        ({"distance_id": ["d1", None]}, r"distances\.parquet:2: distance_id: is blank"),
        ({"from_id": [1, 2]}, r"from_id: the column holds int64, expected text"),
        ({"sigma_mm": ["a", "b"]}, r"sigma_mm: the column holds string, expected numbers"),
        ({"sigma": [1.0, 1.0]}, r"unknown column 'sigma'; did you mean 'sigma_mm'"),
        ({"from_id": ["B1", "B7"]}, r"distances\.parquet:2: .*unknown point 'B7'"),
    ]
    for change, expected in cases:
        pq.write_table(pa.table({**columns, **change}), path)
        with pytest.raises(SurveyError, match=expected):
            files.read(good)
    path.write_bytes(b"not Parquet")
    with pytest.raises(SurveyError, match=r"distances\.parquet:1: not a Parquet file"):
        files.read(good)


def test_atomic_write(tmp_path: Path) -> None:
    path = tmp_path / "new" / "file.txt"
    files.atomic_write(path, "grün\n")
    assert path.read_bytes() == "grün\n".encode()
    files.atomic_write(path, b"second")
    assert [p.name for p in path.parent.iterdir()] == ["file.txt"]
    path.with_name("folder").mkdir()
    with pytest.raises(OSError):  # noqa: PT011  the kind of OSError differs between systems
        files.atomic_write(path.with_name("folder"), b"")
    assert sorted(p.name for p in path.parent.iterdir()) == ["file.txt", "folder"]


_PLAIN = """\
format = 1
title = "a b = c: [d]"

[stations.0]
motion = "fixed"
world_from_station = { treatment = "held", translation_mm = [0.0, -1e-5, 3], rotation_quaternion_wxyz = [1.0, 0, 0, 0] }

# added from = [new]

[stations.head]
flag = true
"""


@pytest.mark.slow
def test_plain_documents_are_read_as_by_tomllib() -> None:
    """Line by line or not, right or wrong: the same values and the same complaints."""
    rng, signs = np.random.default_rng(0), list("[]{}=\"',.:# \n\\+-01eE_aln\t\x01\u2028")
    n_valid = 0
    for _ in range(6000):
        text = list(_PLAIN)
        for at in rng.integers(0, len(text), rng.integers(0, 3)).tolist():
            text[at : at + int(rng.integers(0, 2))] = [signs[int(rng.integers(len(signs)))]]
        document = "".join(text)
        expected, found = _read_or_refused(tomllib.loads, document), _read_or_refused(read_tables, document)
        assert found == expected, document
        n_valid += expected.startswith("{")
    assert n_valid > 1000


def test_plain_documents_are_read_line_by_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comments of a line do not stand in the way: `add` writes one into every definition that it makes."""
    expected = tomllib.loads(_PLAIN)
    monkeypatch.setattr(tomllib, "loads", pytest.fail)
    assert read_tables(_PLAIN) == expected


def _read_or_refused(read: Callable[[str], dict], document: str) -> str:
    try:
        return repr(read(document))
    except tomllib.TOMLDecodeError as error:
        return str(error)


@pytest.mark.parametrize(
    "text",
    ["[a]\nb = 1\n[a]\n", "[a]\nb = 1\nb = 2\n", "a = 1\n[a]\n", "[a.b]\n[a]\nb = 1\n", "a = { b = 1, b = 2 }\n",
     "a = { b = 1 }\n[a.c]\n", "a = NaN\n", "a = null\n", 'a = { "b": 1 }\n', "a = [1,\n", "a = 01\n"],
)  # fmt: skip
def test_what_is_no_toml_is_refused(text: str) -> None:
    with pytest.raises(tomllib.TOMLDecodeError):
        read_tables(text)


def test_lines_of_toml_keys() -> None:
    text = '''# comment = 1
a.b = "x = 1 # no" # yes
"c d" = [1, # one ]
  { e = """
two = 2
""", f.g = \'\'\'it's'\'\'\' },
]
[t]
k = 'lit\\'
[t."u.v"]
w = 1979-05-27 07:32:00
[[list]]
m = 1
[[list]]
m = { n = "}", o = [ [1], [2,
 3] ] }
'''
    tomllib.loads(text)
    lines = key_lines(text)
    assert lines == {
        ("a",): 2, ("a", "b"): 2, ("c d",): 3, ("c d", 0): 3, ("c d", 1): 4, ("c d", 1, "e"): 4,
        ("c d", 1, "f"): 6, ("c d", 1, "f", "g"): 6, ("t",): 8, ("t", "k"): 9, ("t", "u.v"): 10,
        ("t", "u.v", "w"): 11, ("list",): 12, ("list", 0): 12, ("list", 0, "m"): 13, ("list", 1): 14,
        ("list", 1, "m"): 15, ("list", 1, "m", "n"): 15, ("list", 1, "m", "o"): 15, ("list", 1, "m", "o", 0): 15,
        ("list", 1, "m", "o", 0, 0): 15, ("list", 1, "m", "o", 1): 15, ("list", 1, "m", "o", 1, 0): 15,
        ("list", 1, "m", "o", 1, 1): 16,
    }  # fmt: skip


@pytest.mark.parametrize("unit", ["mm", "deg", "arcsec", "mm2"])
def test_units_return_what_was_typed(unit: str) -> None:
    typed = np.concatenate([np.round(np.random.default_rng(1).uniform(-1000, 1000, 2000), 3), [0.0, 20.0, 0.1, 1e-9]])
    inside = to_si(typed, unit)
    np.testing.assert_array_equal(to_si(from_si(inside, unit), unit), inside)
    np.testing.assert_allclose(from_si(inside, unit), typed, rtol=3e-16)


@pytest.mark.slow
def test_large_table_is_read_in_blocks(good: Path, record_property: Any) -> None:
    """200 000 rows in random order; the time is recorded, not judged."""
    rng = np.random.default_rng(2)
    n_epochs, per_block = 10_000, 20
    rows = [
        (f"s{epoch}", "X", "board", f"r{i // 5}c{i % 5}", u, v, 0.1, 0.1, 0.0)
        for epoch, values in enumerate(rng.uniform(0, 1000, (n_epochs, per_block, 2)).tolist())
        for i, (u, v) in enumerate(values)
    ]
    path = good / "observations" / "image_points.csv"
    with path.open("w", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(COLUMNS)
        writer.writerows(rows[i] for i in rng.permutation(len(rows)).tolist())
    start = time.perf_counter()
    blocks = files.read(good).survey.image_blocks
    record_property("seconds", time.perf_counter() - start)
    assert len(blocks) == n_epochs
    assert blocks[123].epoch_id == "s123"
    np.testing.assert_array_equal(blocks[123].uv, [row[4:6] for row in rows[123 * per_block : 124 * per_block]])


def test_pairs_as_columns_say_of_each_what_it_has() -> None:
    """A pose and a rotation, each with sigmas and with a full covariance: blank is what was not measured."""
    full = np.full((6, 6), 1e-9) + np.diag([4e-8] * 3 + [1e-6] * 3)
    alone = np.diag(np.diagonal(full))
    motion = Pose3(Rot3.Rodrigues(np.array([0.1, -0.2, 0.3])), np.array([1.0, 2.0, 3.0]))
    ends = FrameRef("station", "a"), FrameRef("station", "b")
    rows = [Pair(str(i), *ends, motion if n == 6 else motion.rotation(), cov[:n, :n])
            for i, (n, cov) in enumerate(((6, alone), (6, full), (3, alone), (3, full)))]  # fmt: skip
    found = pair_columns(rows)
    filled = {name: [not np.isnan(x) for x in column] for name, column in found.items() if not name.endswith("id")}
    assert filled["qw"] == [True] * 4
    assert filled["tx_mm"] == [True, True, False, False]
    assert filled["sigma_rx_arcsec"] == [True, False, True, False]
    assert filled["sigma_tx_mm"] == [True, False, False, False]
    assert filled["cov_rx_rx_rad2"] == filled["cov_rx_ry_rad2"] == [False, True, False, True]
    assert filled["cov_rx_tx_rad_m"] == filled["cov_tx_tx_m2"] == filled["cov_tx_ty_m2"] == [False, True, False, False]
    assert "cov_ry_rx_rad2" not in found
    assert "cov_tx_ty_m2" not in pair_columns(rows[2:])
    np.testing.assert_allclose(np.asarray(found["sigma_tx_mm"])[0], 1e3 * np.sqrt(full[3, 3]), rtol=1e-12)
