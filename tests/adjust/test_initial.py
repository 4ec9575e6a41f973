"""Start values of whole surveys, projected by OpenCV from known poses."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.model.observations import Coordinates, Distance, FrameRef, ImageBlock, Pair, PositionRef, TableReading
from adjust.model.survey import (
    TABLE_GEOMETRY,
    Camera,
    LensParameter,
    Point,
    PointParameter,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
    VectorParameter,
)
from adjust.start import find_start
from adjust.start.network import table_from_mount

SIZE = (1280, 1024)
FREE = ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2")
TRUE = np.array([1600.0, 1595.0, 632.0, 522.0, -0.13, 0.2, -0.0004, 0.0002])
K = np.array([[TRUE[0], 0, TRUE[2]], [0, TRUE[1], TRUE[3]], [0, 0, 1]])
HELD = PoseParameter(treatment="held")


def grid(columns=11, rows=8, step=0.02):
    x, y = np.meshgrid(np.arange(columns) * step, np.arange(rows) * step)
    return np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])


def board(target_id="board", **options):
    x = grid()
    return Target(target_id, tuple(f"p{i}" for i in range(len(x))), x, **options)


def pose(rotvec_deg=(0, 0, 0), t=(0, 0, 0)):
    m = np.eye(4)
    m[:3, :3] = Rotation.from_rotvec(np.deg2rad(np.asarray(rotvec_deg, float))).as_matrix()
    m[:3, 3] = t
    return m


def inv(m):
    return np.linalg.inv(m)


def pixels(x, camera_from_x):
    rvec = Rotation.from_matrix(camera_from_x[:3, :3]).as_rotvec()
    return cv2.projectPoints(np.asarray(x, float), rvec, camera_from_x[:3, 3], K, TRUE[4:])[0][:, 0]


def inside(uv):
    return np.all((uv >= 0) & (uv <= np.array(SIZE) - 1), axis=1)


def camera(camera_id="c", station_id="s", values=None, **options):
    full = None if values is None else np.concatenate([values[:2], [0], values[2:], np.zeros(4)])
    return Camera(camera_id, station_id, SIZE, LensParameter("brown", FREE, full), **options)


def block(camera_id, epoch_id, target_id, x, camera_from_x, rng, rows=None, noise=0.1):
    rows = np.arange(len(x)) if rows is None else np.asarray(rows)
    uv = pixels(x[rows], camera_from_x)
    ahead = (x[rows] @ camera_from_x[:3, :3].T + camera_from_x[:3, 3])[:, 2] > 0.01
    seen = inside(uv) & ahead
    rows, uv = rows[seen], uv[seen] + rng.normal(0, noise, (int(seen.sum()), 2))
    cov = np.tile(np.eye(2) * noise**2, (len(rows), 1, 1))
    return ImageBlock(camera_id, epoch_id, target_id, rows, uv, cov)


def board_views(rng, n, distance=0.5, tilt=25):
    """camera_from_board of a board that moves about in front of a camera."""
    out = []
    for _ in range(n):
        m = pose(rng.uniform(-tilt, tilt, 3))
        centre = [*rng.uniform(-0.05, 0.05, 2), distance * rng.uniform(0.9, 1.2)]
        m[:3, 3] = centre - m[:3, :3] @ [0.1, 0.07, 0]
        out.append(m)
    return out


def difference(found, truth):
    """Turn in degrees and shift in mm between two motions."""
    found = found.matrix() if isinstance(found, Pose3) else found
    d = inv(truth) @ found
    return np.rad2deg(np.linalg.norm(Rotation.from_matrix(d[:3, :3]).as_rotvec())), 1e3 * np.linalg.norm(d[:3, 3])


def assert_near(found, truth, deg, mm):
    turn, shift = difference(found, truth)
    assert turn < deg, f"{turn:.3f} deg"
    assert shift < mm, f"{shift:.3f} mm"


def assert_small_misfit(start, px=1.0):
    good = [r for i, r in enumerate(start.block_rms_px) if i not in start.excluded_blocks and np.isfinite(r)]
    assert len(good) > 0.5 * len(start.block_rms_px)
    assert max(good) < px


def single(rng, n=12):
    views = board_views(rng, n)
    blocks = [block("c", f"e{i}", "board", grid(), m, rng) for i, m in enumerate(views)]
    survey = Survey((camera(),), (Station("s", "epoch"),), targets=(board(),), image_blocks=tuple(blocks))
    return survey, views


def test_single_camera_moved_about_a_board():
    survey, views = single(np.random.default_rng(1))
    start = find_start(survey)
    lens = start.lenses["c"]
    np.testing.assert_allclose(lens[[0, 1, 3, 4]], TRUE[:4], atol=8)
    np.testing.assert_allclose(lens[5:7], TRUE[4:6], atol=0.1)
    # the datum is chosen: the board is the world, the camera is the station
    assert start.poses[("carrier_from_target", "board")].equals(Pose3(), 1e-12)
    assert start.poses[("station_from_camera", "c")].equals(Pose3(), 1e-12)
    for i, m in enumerate(views):
        assert_near(start.poses[("world_from_station", "s", f"e{i}")], inv(m), 0.2, 3)
    assert start.excluded_blocks == ()
    assert_small_misfit(start)


def test_the_same_survey_gives_the_same_start():
    survey, _ = single(np.random.default_rng(1), 6)
    a, b = find_start(survey), find_start(survey)
    assert all(np.array_equal(a.poses[k].matrix(), b.poses[k].matrix()) for k in a.poses)
    assert np.array_equal(a.lenses["c"], b.lenses["c"])


@pytest.mark.parametrize("damage", ["order", "gross"])
def test_a_mis_detected_image_is_named_and_left_out(damage):
    rng = np.random.default_rng(2)
    survey, _ = single(rng)
    blocks = list(survey.image_blocks)
    uv = blocks[4].uv.copy()
    if damage == "order":
        uv = uv.reshape(8, 11, 2).swapaxes(0, 1).reshape(-1, 2)
    else:
        uv[::3] += rng.uniform(20, 60, uv[::3].shape)
    blocks[4] = replace(blocks[4], uv=uv)
    start = find_start(replace(survey, image_blocks=tuple(blocks)))
    assert start.excluded_blocks == (4,)
    assert "epoch 'e4'" in start.reasons[0]
    np.testing.assert_allclose(start.lenses["c"][[0, 1, 3, 4]], TRUE[:4], atol=8)
    # nothing else shows the station at this epoch: it has a value all the same
    assert ("world_from_station", "s", "e4") in start.poses
    assert_small_misfit(start)


def test_one_gross_corner_leaves_its_image_in():
    survey, views = single(np.random.default_rng(3))
    uv = survey.image_blocks[2].uv.copy()
    uv[5] += 40
    blocks = (*survey.image_blocks[:2], replace(survey.image_blocks[2], uv=uv), *survey.image_blocks[3:])
    start = find_start(replace(survey, image_blocks=blocks))
    assert start.excluded_blocks == ()
    assert any("1 of 88 points are gross" in note for note in start.notes)
    assert_near(start.poses[("world_from_station", "s", "e2")], inv(views[2]), 0.2, 3)


def test_stereo_on_a_fixed_station_with_a_moved_board():
    rng = np.random.default_rng(4)
    right_from_left = pose((1, -8, 2), (-0.1, 0.01, 0.02))
    blocks, views = [], board_views(rng, 10, 0.7)
    for i, m in enumerate(views):
        blocks.append(block("left", f"e{i}", "board", grid(), m, rng))
        blocks.append(block("right", f"e{i}", "board", grid(), right_from_left @ m, rng))
    assert len(blocks[7].uv) == 88
    blocks[7] = replace(blocks[7], uv=blocks[7].uv[::-1].copy())  # read from its other end: fits, but elsewhere
    cameras = (camera("left"), camera("right"))
    survey = Survey(cameras, (Station("s"),), targets=(board(motion="epoch"),), image_blocks=tuple(blocks))
    start = find_start(survey)
    left, right = (start.poses[("station_from_camera", c)].matrix() for c in ("left", "right"))
    assert_near(inv(right) @ left, right_from_left, 0.3, 3)
    assert start.excluded_blocks == (7,)
    assert "where the other blocks put it" in start.reasons[0]
    assert_small_misfit(start, 3.0)


def table_motion(table_id, angles):
    return pose((np.rad2deg(angles[0]), 0, 0)) @ pose((0, 0, np.rad2deg(angles[1])))


def three_camera_head(rng, axes=("x", "z"), n=14):
    """A head that turns before a board; each camera sees it at angles of its own, never two at once."""
    world_from_table = pose((3, -2, 4), (0.05, -0.1, -0.6))
    cameras = {"X": pose((0, 0, 0), (0.08, -0.03, 0.05)), "Y": pose((0, 0, 120), (-0.03, 0.08, 0.04)),
               "Z": pose((2, -1, 240), (0.03, 0.03, 0.09))}  # fmt: skip
    readings, blocks = [], []
    shift = pose(t=(-0.1, -0.07, 0))
    for k, (name, head_from_camera) in enumerate(cameras.items()):
        for i in range(n):
            a1 = np.deg2rad(rng.uniform(-22, 22)) if len(axes) == 2 else 0.0
            angles = np.array([a1, np.deg2rad(120 * -k + rng.uniform(-25, 25))])
            epoch = f"{name}{i}"
            world_from_camera = world_from_table @ table_motion("t", angles) @ head_from_camera
            blocks.append(block(name, epoch, "board", grid(), inv(world_from_camera) @ shift, rng))
            readings.append(TableReading("t", epoch, angles[-len(axes) :], np.eye(len(axes)) * 1e-10))
    station = Station("head", "table", table_id="t", mount_from_station=HELD)
    if len(axes) == 1:
        table = Table("t", axes, geometry=replace(Table("t").geometry, names=("zero_1",), values=np.zeros(1), free=()))
    else:
        table = Table("t", axes)
    target = board(carrier_from_target=PoseParameter(treatment="held"))
    survey = Survey(tuple(camera(c, "head") for c in cameras), (station,), (table,), (target,),
                    image_blocks=tuple(blocks), table_readings=tuple(readings))  # fmt: skip
    return survey, cameras, inv(shift) @ world_from_table


def test_three_cameras_without_common_view_on_a_two_axis_table():
    survey, cameras, world_from_table = three_camera_head(np.random.default_rng(5))
    start = find_start(survey)
    assert start.excluded_blocks == ()
    assert_near(start.poses[("world_from_table", "t")], world_from_table, 0.5, 8)
    for name, truth in cameras.items():
        assert_near(start.poses[("station_from_camera", name)], truth, 0.5, 8)
    assert_small_misfit(start, 1.0)
    assert ("table_angles", "t", "X0") in start.vectors
    assert ("table_geometry", "t") in start.vectors


def test_one_axis_table_gets_a_consistent_start():
    survey, _, _ = three_camera_head(np.random.default_rng(6), axes=("z",))
    start = find_start(survey)
    assert any("one axis" in note for note in start.notes)
    assert_small_misfit(start, 1.0)


def test_two_cameras_without_common_view_by_their_motion():
    rng = np.random.default_rng(7)
    second_from_first = pose((5, 170, 0), (0.02, 0.05, -0.1))
    second_from_first_board = pose((3, 180, 5), (0.3, 0.1, -1.2))
    blocks = []
    for i in range(12):
        m = pose(rng.uniform(-20, 20, 3))
        first_from_board = pose(t=(*rng.uniform(-0.03, 0.03, 2), 0.5)) @ m @ pose(t=(-0.1, -0.07, 0))
        blocks.append(block("a", f"e{i}", "A", grid(), first_from_board, rng))
        second_from_other = second_from_first @ first_from_board @ second_from_first_board
        if second_from_other[2, 3] > 0.2:
            blocks.append(block("b", f"e{i}", "B", grid(), second_from_other, rng))
    blocks = [b for b in blocks if len(b.uv) > 12]
    assert sum(b.camera_id == "b" for b in blocks) > 7
    survey = Survey((camera("a"), camera("b", values=TRUE)), (Station("s", "epoch"),), targets=(board("A"), board("B")),
                    image_blocks=tuple(blocks))  # fmt: skip
    start = find_start(survey)
    a, b = (start.poses[("station_from_camera", c)].matrix() for c in ("a", "b"))
    assert_near(inv(b) @ a, second_from_first, 0.4, 6)
    first, second = (start.poses[("carrier_from_target", t)].matrix() for t in ("A", "B"))
    assert_near(inv(first) @ second, second_from_first_board, 0.6, 8)
    assert_small_misfit(start, 1.0)


def looking_at(eye, at):
    z = np.asarray(at, float) - eye
    z /= np.linalg.norm(z)
    x = np.cross([0.1, 1.0, 0.2], z)
    x /= np.linalg.norm(x)
    m = np.eye(4)
    m[:3, :3] = np.column_stack([x, np.cross(z, x), z])
    m[:3, 3] = eye
    return m


def beacons(rng, n_known, n=12):
    x = rng.uniform([-1, -0.8, -0.3], [1, 0.8, 0.3], (n, 3))
    points = tuple(
        Point(f"B{i}", PointParameter(x[i] if i < n_known else None, "held" if i < n_known else "free"))
        for i in range(n)
    )
    return x, points


def test_beacons_are_intersected_from_stations_resected_on_a_few():
    rng = np.random.default_rng(8)
    x, points = beacons(rng, 5)
    eyes = [
        looking_at(np.array(e), (0, 0, 0)) for e in ((0.5, 0.3, -4.0), (2.5, 0, -3), (-2.5, 0.5, -3), (0, -2, -3.5))
    ]
    blocks = tuple(block("c", f"e{i}", None, x, inv(m), rng) for i, m in enumerate(eyes))
    survey = Survey((camera(values=TRUE, station_from_camera=HELD),), (Station("s", "epoch"),), points=points,
                    image_blocks=blocks)  # fmt: skip
    start = find_start(survey)
    for i in range(12):
        np.testing.assert_allclose(start.points[f"B{i}"], x[i], atol=2e-3)
    for i, m in enumerate(eyes):
        assert_near(start.poses[("world_from_station", "s", f"e{i}")], m, 0.1, 5)
    assert_small_misfit(start, 0.5)


def test_relay_station_places_its_cameras_from_beacons_with_observed_coordinates():
    rng = np.random.default_rng(9)
    x, points = beacons(rng, 0)
    station_from = {"a": pose(), "b": pose((0, 30, 0), (0.2, 0, 0)), "c": pose((0, -30, 5), (-0.2, 0, 0))}
    world_from_station = looking_at(np.array([0.2, 0.1, -3.0]), (0, 0, 0))
    wide = np.concatenate(
        [x, x @ pose((0, 30, 0))[:3, :3].T + [1.5, 0, 0], x @ pose((0, -30, 0))[:3, :3].T - [1.5, 0, 0]]
    )
    points = tuple(Point(f"B{i}") for i in range(len(wide)))
    known = Coordinates(tuple(PositionRef(p.point_id) for p in points), wide, np.eye(3 * len(wide)) * 1e-8)
    blocks = tuple(block(c, "e", None, wide, inv(world_from_station @ m), rng) for c, m in station_from.items())
    assert min(len(b.uv) for b in blocks) >= 5
    cameras = tuple(camera(c, values=TRUE, **({"station_from_camera": HELD} if c == "a" else {})) for c in station_from)
    survey = Survey(cameras, (Station("s"),), points=points, image_blocks=blocks, coordinates=(known,))
    start = find_start(survey)
    assert_near(start.poses[("world_from_station", "s")], world_from_station, 0.1, 5)
    for c, m in station_from.items():
        assert_near(start.poses[("station_from_camera", c)], m, 0.2, 10)


def test_cameras_that_see_two_beacons_each_place_their_station_together():
    rng = np.random.default_rng(10)
    station_from = {"a": pose(), "b": pose((0, 60, 0), (0.2, 0, 0)), "c": pose((0, -60, 5), (-0.2, 0.1, 0))}
    world_from_station = pose((10, 20, -15), (0.3, 0.2, -0.4))
    x = []
    for m in station_from.values():
        local = rng.uniform([-0.5, -0.4, 1.5], [0.5, 0.4, 2.5], (2, 3))
        x += list(local @ (world_from_station @ m)[:3, :3].T + (world_from_station @ m)[:3, 3])
    x = np.array(x)
    points = tuple(Point(f"B{i}", PointParameter(v, "held")) for i, v in enumerate(x))
    blocks = tuple(
        block(c, "e", None, x, inv(world_from_station @ m), rng, rows=[2 * k, 2 * k + 1])
        for k, (c, m) in enumerate(station_from.items())
    )
    cameras = tuple(
        camera(c, values=TRUE, station_from_camera=PoseParameter(Pose3(m), "held")) for c, m in station_from.items()
    )
    start = find_start(Survey(cameras, (Station("s"),), points=points, image_blocks=blocks))
    assert_near(start.poses[("world_from_station", "s")], world_from_station, 0.2, 5)


def test_pairs_alone_place_stations_and_rotations_do_where_nothing_else_does():
    truth = [pose(), pose((10, 20, 30), (1, 2, 3)), pose((-40, 5, 80), (0, 1, -1))]
    stations = tuple(Station(f"s{i}", world_from_station=HELD if i == 0 else PoseParameter()) for i in range(3))

    def pair(i, j, full):
        b_from_a = Pose3(inv(truth[j]) @ truth[i])
        refs = FrameRef("station", f"s{i}"), FrameRef("station", f"s{j}")
        return Pair(f"{i}-{j}", *refs, b_from_a if full else b_from_a.rotation(), np.eye(6 if full else 3) * 1e-6)

    start = find_start(Survey(stations=stations, pairs=(pair(0, 1, True), pair(2, 1, True))))
    assert_near(start.poses[("world_from_station", "s2")], truth[2], 1e-6, 1e-6)
    start = find_start(Survey(stations=stations, pairs=(pair(0, 1, False), pair(2, 1, False), pair(0, 2, False))))
    assert difference(start.poses[("world_from_station", "s2")], truth[2])[0] < 1e-6


def test_a_free_world_is_moved_onto_observed_coordinates():
    rng = np.random.default_rng(11)
    survey, _ = single(rng, 6)
    world_from_board = pose((100, 30, -60), (5, 6, 7))
    rows = (0, 10, 77)
    seen_at = grid()[list(rows)] @ world_from_board[:3, :3].T + world_from_board[:3, 3]
    refs = tuple(PositionRef(f"p{i}", FrameRef("target", "board")) for i in rows)
    survey = replace(survey, coordinates=(Coordinates(refs, seen_at, np.eye(9) * 1e-8),))
    start = find_start(survey)
    assert_near(start.poses[("carrier_from_target", "board")], world_from_board, 1e-6, 1e-6)
    assert_small_misfit(start)


def test_what_nothing_determines_is_named():
    rng = np.random.default_rng(12)
    x, points = beacons(rng, 2)
    m = looking_at(np.array([0.5, 0.3, -4.0]), (0, 0, 0))
    survey = Survey((camera(values=TRUE, station_from_camera=HELD),), (Station("s"),), points=points,
                    image_blocks=(block("c", "e", None, x, inv(m), rng),))  # fmt: skip
    with pytest.raises(SurveyError, match=r"world_from_station s: no target and at most 2 known point"):
        find_start(survey)
    with pytest.raises(SurveyError, match=r"camera 'c': no lens values are given"):
        find_start(replace(survey, cameras=(camera(station_from_camera=HELD),)))


def test_given_values_are_kept():
    survey, _ = single(np.random.default_rng(13), 6)
    given = Pose3(pose((10, 0, 5), (1, 2, 3)))
    survey = replace(survey, targets=(board(carrier_from_target=PoseParameter(given)),),
                     cameras=(camera(values=TRUE + [5, 5, 3, 3, 0, 0, 0, 0]),))  # fmt: skip
    start = find_start(survey)
    assert start.poses[("carrier_from_target", "board")].equals(given, 1e-12)
    assert start.lenses["c"][0] == TRUE[0] + 5


def test_a_field_of_unknown_points_is_oriented_and_scaled_by_one_distance():
    rng = np.random.default_rng(14)
    x, points = beacons(rng, 0, n=30)
    eyes = [
        looking_at(np.array(e), (0, 0, 0)) for e in ((0.5, 0.3, -4.0), (2.5, 0, -3), (-2.5, 0.5, -3), (0, -2, -3.5))
    ]
    blocks = tuple(block("c", f"e{i}", None, x, inv(m), rng) for i, m in enumerate(eyes))
    tape = Distance("d", PositionRef("B3"), PositionRef("B17"), float(np.linalg.norm(x[3] - x[17])), 1e-4)
    survey = Survey((camera(values=TRUE, station_from_camera=HELD),), (Station("s", "epoch"),), points=points,
                    image_blocks=blocks, distances=(tape,))  # fmt: skip
    start = find_start(survey)
    found = np.array([start.points[f"B{i}"] for i in range(30)])
    distances = np.linalg.norm(found[:, None] - found[None], axis=2)
    truth = np.linalg.norm(x[:, None] - x[None], axis=2)
    np.testing.assert_allclose(distances, truth, atol=0.03)
    assert_small_misfit(start, 1.0)
    with pytest.raises(SurveyError, match="point B30: no image shows it"):
        find_start(replace(survey, points=(*points, Point("B30"))))


def test_a_block_of_gross_points_is_left_out_also_where_the_lens_is_given():
    survey, _ = single(np.random.default_rng(15), 6)
    blocks = list(survey.image_blocks)
    uv = blocks[2].uv.copy()
    uv[::3] += np.random.default_rng(16).uniform(20, 60, uv[::3].shape)
    blocks[2] = replace(blocks[2], uv=uv)
    start = find_start(replace(survey, cameras=(camera(values=TRUE),), image_blocks=tuple(blocks)))
    assert start.excluded_blocks == (2,)
    assert "of 88 points are more than 3.0 px off" in start.reasons[0]


def test_a_table_with_given_geometry_moves_as_its_formula_says():
    table = Table("t", ("x", "z"), geometry=VectorParameter(TABLE_GEOMETRY, np.array([0.02, 0.01, 0.3, -0.2])))
    a1, a2 = np.rad2deg([0.5 + 0.3, -0.7 - 0.2])
    expected = pose((a1, 0, 0)) @ pose(t=(0, 0.01, 0)) @ pose((0, np.rad2deg(0.02), 0)) @ pose((0, 0, a2))
    np.testing.assert_allclose(table_from_mount(table, [np.array([0.5, -0.7])])[0], expected, atol=1e-12)
    with pytest.raises(SurveyError, match="2 axes, a reading has 1"):
        table_from_mount(table, [np.array([0.5])])
