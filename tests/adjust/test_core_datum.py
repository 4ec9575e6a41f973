"""Datum and rank: what is missing is named; a free network has the shape of a held one and the smallest covariance."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.linalg import qr

from adjust.graph.datum import independent_rows
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import Camera, Datum, Point, PoseParameter, Station, Survey, Table, VectorParameter
from adjust.precision.precision import Precision
from survey.simulate import beacons, head_on_table, single_camera, stereo
from survey.simulate.scene import Truth
from tests.adjust import helpers as h

HEAD = {"n_cameras": 2, "n_table_epochs": 4, "n_free_epochs": 2}


@cache
def head() -> tuple[Survey, Truth]:
    return head_on_table(1, **HEAD)


def message(survey: Survey, truth: Truth) -> str:
    """Of the IndeterminateError that the survey must raise."""
    start = h.shaken(h.start_at(truth), 1, 0.002, 0.002)
    with pytest.raises(IndeterminateError) as caught:
        h.solved(survey, start)
    assert caught.value.parameters
    return str(caught.value)


def geometry(survey: Survey, free: tuple[str, ...]) -> Survey:
    table = survey.tables[0]
    return replace(survey, tables=(replace(table, geometry=replace(table.geometry, free=free)),))


# -- a datum or an observation is taken away ---------------------------------------------------------------------------


def test_no_held_board() -> None:
    survey, truth = head()
    board = replace(survey.targets[0], carrier_from_target=PoseParameter())
    text = message(replace(survey, targets=(board,)), truth)
    assert "6 directions" in text
    for word in ("position along world x, y, z", "rotation about world x, y, z", "hold a target"):
        assert word in text.replace("the position", "position")
    assert "scale" not in text


def test_free_mount_with_all_cameras_free() -> None:
    survey, truth = head()
    station = replace(survey.stations[0], mount_from_station=PoseParameter())
    text = message(replace(survey, stations=(station,)), truth)
    assert "station head" in text
    assert "hold one camera on it or its mount" in text
    assert "world" not in text


def test_station_frame_of_cameras_without_a_held_one() -> None:
    survey, truth = stereo(1, n_pairs=4)
    bar = Station("bar", "epoch")
    cameras = tuple(replace(c, station_from_camera=PoseParameter()) for c in survey.cameras)
    board = replace(survey.targets[0], motion="fixed", carrier_from_target=PoseParameter(Pose3(), "held"))
    moved = {
        ("world_from_station", "bar", name[2]): pose.inverse()
        for name, pose in truth.items()
        if name[0] == "carrier_from_target" and isinstance(pose, Pose3)
    }
    text = message(replace(survey, stations=(bar,), cameras=cameras, targets=(board,)), {**truth, **moved})
    assert "the frame of station bar" in text


@pytest.mark.slow
@pytest.mark.parametrize(("zero", "what"), [("zero_1", "table turntable"), ("zero_2", "table turntable")])
def test_free_encoder_zero_beside_a_free_base_and_head(zero: str, what: str) -> None:
    """An encoder's zero cannot be told from the azimuth of the base, nor the inner one's from that of the head."""
    survey, truth = head()
    text = message(geometry(survey, ("non_orthogonality", "axis_offset", zero)), truth)
    assert f"axes of {what} ({zero})" in text
    assert "pose of table turntable" in text if zero == "zero_1" else "on its station" in text


def test_both_encoder_zeros_count_as_two() -> None:
    survey, truth = head()
    text = message(geometry(survey, ("non_orthogonality", "axis_offset", "zero_1", "zero_2")), truth)
    assert "2 directions" in text
    assert "zero_1" in text
    assert "zero_2" in text


def test_table_turned_about_one_axis_only() -> None:
    """Skewness, offset and the shift along the only axis cannot be told from the camera's place on the head."""
    base, start = h.everything(1)
    rng = np.random.default_rng(2)
    held = PoseParameter(Pose3(), "held")
    board = replace(
        base.targets[0], warp=None, carrier_from_target=PoseParameter(Pose3(Rot3(), (-0.15, -0.1, 1.0)), "held")
    )
    truth: Truth = {
        ("lens", "X"): np.array([800, 810, 0, 320, 240, -0.1, 0.05, 0, 0, 0, 0, 0, 0], dtype=float),
        ("station_from_camera", "X"): start.poses["station_from_camera", "X"],
        ("world_from_table", "table"): start.poses["world_from_table", "table"],
        ("mount_from_station", "head"): Pose3(),
        ("carrier_from_target", "board"): Pose3(Rot3(), (-0.15, -0.1, 1.0)),
        ("table_geometry", "table"): np.array([0.01, 0.002, 0.0, 0.0]),
    }
    readings, blocks = [], []
    for i in range(8):
        truth["table_angles", "table", f"t{i}"] = np.array([0.08 * (i - 3.5), 0.2])
        readings.append(replace(base.table_readings[0], epoch_id=f"t{i}", cov=1e-10 * np.eye(2)))
        n = len(h.GRID)
        blocks.append(replace(base.image_blocks[0], epoch_id=f"t{i}", point_idx=np.arange(n), uv=np.zeros((n, 2)),
                              cov=h.point_covs(rng, n), used=None))  # fmt: skip
    lens = replace(base.cameras[0].lens, free=(), ties=())
    survey = Survey(
        cameras=(replace(base.cameras[0], lens=lens),),
        stations=(replace(base.stations[0], mount_from_station=held),),
        tables=(Table("table"),),
        targets=(board,), image_blocks=tuple(blocks), table_readings=tuple(readings),
    )  # fmt: skip
    text = message(h.resample(survey, truth, 1), truth)
    assert "non_orthogonality" in text
    assert "axis_offset" in text
    assert "camera X on its station" in text
    assert "3 directions" in text or "4 directions" in text


def test_no_scale() -> None:
    survey, truth = h.network(1, held=0, distances=0)
    first, second = truth["world_from_station", "head", "e0"], truth["point", "P3"]
    assert isinstance(first, Pose3)
    assert not isinstance(second, Pose3)
    station = replace(survey.stations[0], epochs={"e0": PoseParameter(first, "held")})
    text = message(replace(survey, stations=(station,)), truth)
    assert "the scale of the whole survey" in text
    assert "distance" in text
    assert "rotation" not in text


@pytest.mark.slow
def test_a_point_that_nothing_observes() -> None:
    survey, truth = beacons(1, n_table_epochs=3, n_free_epochs=2, n_night_epochs=4)
    lonely = replace(survey, points=(*survey.points, Point("B99")))
    assert "point B99" in message(lonely, {**truth, ("point", "B99"): np.zeros(3)})


def test_an_image_with_too_few_points() -> None:
    survey, truth = head()
    epoch = next(b.epoch_id for b in survey.image_blocks if b.epoch_id.startswith("hX"))
    blocks = [
        replace(b, point_idx=b.point_idx[:2], uv=b.uv[:2], cov=b.cov[:2]) if b.epoch_id == epoch else b
        for b in survey.image_blocks
    ]
    text = message(replace(survey, image_blocks=tuple(blocks)), truth)
    assert f"station head at epoch {epoch}" in text


def test_an_image_of_which_nothing_is_used() -> None:
    survey, truth = single_camera(1, n_images=4)
    blocks = list(survey.image_blocks)
    blocks[1] = replace(blocks[1], used=np.zeros(len(blocks[1].uv), bool))
    assert f"target board at epoch {blocks[1].epoch_id}" in message(replace(survey, image_blocks=tuple(blocks)), truth)


def test_a_camera_that_sees_nothing_is_no_fault_but_its_lens_is() -> None:
    """A lens that no image shows cannot be estimated."""
    survey, truth = single_camera(1, n_images=4)
    other: Camera = replace(survey.cameras[0], camera_id="C2")
    truth = {**truth, ("lens", "C2"): truth["lens", "C1"], ("station_from_camera", "C2"): Pose3()}
    assert "lens of camera C2" in message(replace(survey, cameras=(*survey.cameras, other)), truth)


def test_rotations_alone_leave_the_positions() -> None:
    """A chain of stations joined by relative rotations."""
    held = PoseParameter(Pose3(), "held")
    stations = (Station("a", world_from_station=held), Station("b"))
    cov = 1e-8 * np.eye(3)
    pair = Pair("ab", FrameRef("station", "a"), FrameRef("station", "b"), Rot3.Rz(0.1), cov)
    text = message(
        Survey(stations=stations, pairs=(pair,)), {("world_from_station", "b"): Pose3(Rot3.Rz(-0.1), (1, 2, 3))}
    )
    assert "3 directions" in text
    assert "position along world x, y, z" in text
    assert "station b" not in text, "the same three directions under two names"


def test_a_large_survey_is_not_called_undetermined_for_weak_geometry() -> None:
    """All boards nearly parallel: focal length and distances hardly separate, but they do."""
    survey, truth = single_camera(1, n_images=5)
    weak = {
        name: Pose3(Rot3.Expmap(1e-4 * np.array([i % 2, i % 3, 0.0])), [-0.1, -0.06, 0.7 + 1e-4 * i])
        for i, name in enumerate(k for k in truth if k[0] == "carrier_from_target")
    }
    truth = {**truth, **weak}
    survey = h.resample(survey, truth, 1)
    free = VectorParameter(("fx",), np.zeros(1)).names + ("fy", "u0", "v0")
    camera = replace(survey.cameras[0], lens=replace(survey.cameras[0].lens, free=free))
    graph, done = h.solved(replace(survey, cameras=(camera,)), h.start_at(truth), tight=False)
    full = h.dense(graph, dict(h.start_at(truth).lenses), done.values)
    Q, precision = full.inverse(), Precision(graph, done)
    for name, place in full.place.items():
        assert h.relative(h.covariance_of(precision, name), Q[place, place]) < 1e-3, name


# -- inner constraints -------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    "datum", [Datum("inner"), Datum("inner", points=("P0", "P4", "P7", "P9")), Datum("inner", stations=("head",))]
)
def test_free_network_has_the_shape_of_the_held_one(datum: Datum) -> None:
    """Same weighted square sum; a distance between two points is equal, with an equal sigma."""
    survey, truth = h.network(6, held=0, distances=2)
    anchor = truth["world_from_station", "head", "e0"]
    assert isinstance(anchor, Pose3)
    station = replace(survey.stations[0], epochs={"e0": PoseParameter(anchor, "held")})
    start = h.shaken(h.start_at(truth), 1, 0.002, 0.002)
    found = []
    for s in (replace(survey, stations=(station,)), replace(survey, datum=datum)):
        graph, done = h.solved(s, start)
        full = h.dense(graph, dict(start.lenses), done.values)
        Q = full.inverse(h.inner_rows(graph, full, done))
        places = [full.place["point", p] for p in ("P2", "P11")]
        index = np.concatenate([np.arange(p.start, p.stop) for p in places])
        d = np.subtract(*(done.values.atPoint3(graph.unknowns.by_name["point", p].key) for p in ("P2", "P11")))
        u = np.concatenate([d, -d]) / np.linalg.norm(d)
        found.append((done.omega, np.linalg.norm(d), np.sqrt(u @ Q[np.ix_(index, index)] @ u)))
    assert found[1][0] == pytest.approx(found[0][0], rel=1e-9)
    np.testing.assert_allclose(found[1], found[0], rtol=1e-6)


def test_inner_constraints_over_all_points_give_the_smallest_trace() -> None:
    survey, truth = h.network(5, held=0, distances=2)
    traces = {}
    for name, datum in {
        "all": Datum("inner"),
        "some": Datum("inner", points=("P1", "P2", "P5", "P7")),
        "stations": Datum("inner", stations=("head",)),
    }.items():
        graph, done = h.solved(replace(survey, datum=datum), h.start_at(truth))
        precision = Precision(graph, done)
        traces[name] = sum(np.trace(h.covariance_of(precision, n)) for n in graph.unknowns.by_name if n[0] == "point")
    assert traces["all"] < 0.999 * min(traces["some"], traces["stations"])


def test_inner_constraints_do_not_depend_on_the_start() -> None:
    """Covariances belong to the solution: the same to 1e-6 from a start some millimetres away."""
    survey, truth = h.network(5, held=0, distances=0)
    survey = replace(survey, datum=Datum("inner"))
    found = []
    for start in (h.start_at(truth), h.shaken(h.start_at(truth), 4, 0.003, 0.003)):
        graph, done = h.solved(survey, start)
        precision = Precision(graph, done)
        sigmas = [np.sqrt(np.trace(h.covariance_of(precision, ("point", f"P{i}")))) for i in range(5)]
        size = np.linalg.norm(
            np.subtract(*(done.values.atPoint3(graph.unknowns.by_name["point", p].key) for p in ("P0", "P1")))
        )
        found.append(np.array(sigmas) / size)  # without a distance the scale is that of the start
    np.testing.assert_allclose(found[0], found[1], rtol=1e-5)


def test_an_inner_datum_that_cannot_carry_the_defects() -> None:
    survey, truth = h.network(5, held=0, distances=2)
    with pytest.raises(SurveyError, match="cannot carry"):
        h.solved(replace(survey, datum=Datum("inner", points=("P1", "P2"))), h.start_at(truth))


def test_an_inner_datum_over_nothing_free() -> None:
    survey, truth = single_camera(1, n_images=3)
    with pytest.raises(SurveyError, match="needs free points or free fixed stations"):
        h.solved(replace(survey, datum=Datum("inner")), h.start_at(truth))


def test_an_inner_datum_without_defects_changes_nothing() -> None:
    survey, truth = h.network(5, held=4)
    _, given = h.solved(survey, h.start_at(truth))
    _, inner = h.solved(replace(survey, datum=Datum("inner")), h.start_at(truth))
    assert inner.datum is None
    assert inner.omega == pytest.approx(given.omega, rel=1e-12)


def test_independent_rows_are_the_pivots_of_lapack() -> None:
    rng = np.random.default_rng(5)
    for n, k in ((6, 1), (30, 4), (200, 7), (7, 7)):
        B = rng.normal(size=(n, k)) * 10.0 ** rng.uniform(-3, 3, (n, 1))
        assert independent_rows(B).tolist() == qr(B.T, pivoting=True, mode="r")[1][:k].tolist()
