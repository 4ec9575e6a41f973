"""One assertion per convention. Whoever changes one of these changes the meaning of every file ever written."""

import cv2
import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.frames.state import State
from adjust.frames.tables import table_motions
from adjust.frames.tree import FrameTree
from adjust.frames.unknowns import Unknowns
from adjust.lenses.models import MODELS, lens_constants, project
from adjust.model.boards import deformation
from adjust.model.observations import FrameRef, ImageBlock, Pair, TableReading
from adjust.model.result import Estimate
from adjust.model.survey import (
    Camera,
    FloatArray,
    LensParameter,
    PoseParameter,
    Station,
    Survey,
    Table,
    Target,
    VectorParameter,
)
from adjust.native.images import square_root_information
from survey.solution.quantities import Scale, pose_columns, pose_dict, sigmas_of
from tests.adjust import helpers as h

RNG = np.random.default_rng(3)
A, B = Pose3(Rot3.Expmap([0.3, -0.2, 0.5]), [1.0, 2.0, 3.0]), Pose3(Rot3.Expmap([-0.1, 0.4, 0.2]), [-0.5, 0.1, 0.7])
X = np.array([0.2, -0.3, 0.4])
BROWN = np.array([800, 810, 0, 320, 240, -0.1, 0.05, 0.001, -0.002, 0.01, 0, 0, 0], dtype=float)


def brown_pixel(x_in_camera: FloatArray) -> FloatArray:
    constants = lens_constants("brown", (640, 480))
    return project(MODELS["brown"], BROWN, constants, np.atleast_2d(x_in_camera))[0]


def motion(axes: tuple[str, ...], a: FloatArray, tilt: float = 0.0, offset: float = 0.0) -> FloatArray:
    """(4, 4) table_from_mount of the core."""
    (R,), (t,), _ = table_motions(axes, {"non_orthogonality": tilt, "axis_offset": offset}, a[None])
    return Pose3(Rot3(R), t).matrix()


def one_block(station: Station, target: Target, tables: tuple[Table, ...] = ()) -> tuple[Survey, dict[str, FloatArray]]:
    lens = LensParameter("brown", ("fx",), BROWN)
    camera = Camera("C", station.station_id, (640, 480), lens, PoseParameter(B, "held"))
    block = ImageBlock("C", "e", "T", np.arange(4), np.full((4, 2), 100.0), np.tile(np.eye(2), (4, 1, 1)))
    reading = tuple(TableReading(t.table_id, "e", np.zeros(len(t.axes)), np.eye(len(t.axes))) for t in tables)
    survey = Survey((camera,), (station,), tables, (target,), image_blocks=(block,), table_readings=reading)
    return survey, {"C": BROWN}


def chain_pose(survey: Survey, a: FrameRef, b: FrameRef) -> Pose3:
    """b_from_a through the core's frames, everything held."""
    unknowns = Unknowns()
    chain = FrameTree(survey, unknowns).relative(a, b)
    pose = Pose3()
    for link in chain:
        p = unknowns.slot_pose[link.slot]
        pose = pose * (p.inverse() if link.inverse else p)
    return pose


def test_a_from_b_takes_coordinates_in_b_to_a_and_neighbours_cancel() -> None:
    a_from_b, b_from_c = A, B
    np.testing.assert_allclose((a_from_b * b_from_c).transformFrom(X), A.transformFrom(B.transformFrom(X)), atol=1e-15)


def test_tangent_is_rotation_then_translation_on_the_right() -> None:
    xi = np.array([0.01, 0.02, -0.03, 0.1, -0.2, 0.3])
    small = Pose3(Rot3.Expmap(xi[:3]), np.zeros(3))
    retracted = gtsam.Values()
    retracted.insert(0, A)
    delta = gtsam.VectorValues()
    delta.insert(0, np.r_[xi[:3], 0.0, 0.0, 0.0])
    np.testing.assert_allclose(retracted.retract(delta).atPose3(0).matrix(), (A * small).matrix(), atol=1e-15)
    delta = gtsam.VectorValues()
    delta.insert(0, np.r_[0.0, 0.0, 0.0, xi[3:]])
    moved = retracted.retract(delta).atPose3(0)
    np.testing.assert_allclose(moved.translation(), A.translation() + A.rotation().matrix() @ xi[3:], atol=1e-15)


def test_pixel_origin_is_that_of_opencv_the_centre_of_the_first_pixel() -> None:
    K = np.array([[800, 0, 320], [0, 810, 240], [0, 0, 1.0]])
    q = np.array([[0.1, -0.05, 1.0], [-0.3, 0.2, 1.3]])
    expected = cv2.projectPoints(q, np.zeros(3), np.zeros(3), K, BROWN[5:10])[0].reshape(-1, 2)
    np.testing.assert_allclose([brown_pixel(x) for x in q], expected, atol=1e-10)
    assert lens_constants("brown_backward", (640, 480), 0.01)[1:3].tolist() == [319.5, 239.5]


def test_camera_x_right_y_down_z_forward() -> None:
    u, v = brown_pixel(np.array([0.0, 0.0, 1.0]))
    assert brown_pixel(np.array([0.1, 0.0, 1.0]))[0] > u
    assert brown_pixel(np.array([0.0, 0.1, 1.0]))[1] > v


def test_image_chain_is_camera_from_station_from_world_from_target() -> None:
    station = Station("S", world_from_station=PoseParameter(A, "held"))
    ids = ("a", "b", "c", "d")
    target = Target("T", ids, RNG.normal(size=(4, 3)), carrier_from_target=PoseParameter(A * B * A, "held"))
    survey, _ = one_block(station, target)
    found = chain_pose(survey, FrameRef("target", "T", "e"), FrameRef("camera", "C", "e"))
    expected = B.inverse() * A.inverse() * (A * B * A)  # camera_from_station * station_from_world * world_from_target
    np.testing.assert_allclose(found.matrix(), expected.matrix(), atol=1e-14)


def test_carrier_from_target_is_station_from_target_where_a_station_carries_it() -> None:
    station = Station("S", world_from_station=PoseParameter(A, "held"))
    target = Target("T", ("a",), np.zeros((1, 3)), "S", carrier_from_target=PoseParameter(B, "held"))
    survey, _ = one_block(station, target)
    found = chain_pose(survey, FrameRef("target", "T", "e"), FrameRef("world"))
    np.testing.assert_allclose(found.matrix(), (A * B).matrix(), atol=1e-15)


def test_table_angles_are_right_handed_about_the_named_axes_outermost_first() -> None:
    """Axes ("x", "z"): table_from_mount = Rx(a1) Rz(a2)."""
    a = np.array([0.3, -0.4])
    expected = Rot3.Rx(a[0]).matrix() @ Rot3.Rz(a[1]).matrix()
    np.testing.assert_allclose(motion(("x", "z"), a)[:3, :3], expected, atol=1e-15)
    quarter = motion(("x", "z"), np.array([0.0, np.pi / 2]))[:3, :3]
    np.testing.assert_allclose(quarter @ (1, 0, 0), (0, 1, 0), atol=1e-15)


def test_table_offset_then_skewness_along_and_about_the_third_axis() -> None:
    """R1 Trans3(offset) R3(non_orthogonality) R2, by 4 x 4 matrices."""
    a, tilt, offset = np.array([0.3, -0.4]), 0.02, 0.007
    y, turn = np.array([0.0, offset, 0.0]), Pose3(Rot3.Ry(tilt), np.zeros(3)).matrix()
    expected = (
        Pose3(Rot3.Rx(a[0]), np.zeros(3)).matrix()
        @ Pose3(Rot3(), y).matrix()
        @ turn
        @ Pose3(Rot3.Rz(a[1]), np.zeros(3)).matrix()
    )
    np.testing.assert_allclose(motion(("x", "z"), a, tilt, offset), expected, atol=1e-15)


def test_encoder_zeros_are_added_to_the_readings() -> None:
    names = ("non_orthogonality", "axis_offset", "zero_1", "zero_2")
    geometry = VectorParameter(names, np.array([0.0, 0.0, 0.1, 0.2]))
    held = PoseParameter(Pose3(), "held")
    table = Table("tab", ("x", "z"), held, geometry)
    station = Station("S", "table", table_id="tab", mount_from_station=held)
    target = Target("T", ("a", "b", "c", "d"), RNG.normal(size=(4, 3)), carrier_from_target=held)
    survey, lenses = one_block(station, target, (table,))
    start = h.StartValues(lenses, {}, {}, {("table_angles", "tab", "e"): np.array([0.3, -0.4])})
    graph = h.build(survey, start)
    graph.prepare(graph.start, jacobians=False)
    state: State = graph.state
    (slot,) = graph.unknowns.table_slots
    np.testing.assert_allclose(state.slot_R[slot], (Rot3.Rx(0.4) * Rot3.Rz(-0.2)).matrix(), atol=1e-15)


def test_a_one_axis_table_turns_about_its_axis_alone() -> None:
    expected = Pose3(Rot3.Rz(0.7), np.zeros(3)).matrix()
    np.testing.assert_allclose(motion(("z",), np.array([0.7]), 0.5, 0.5), expected, atol=1e-15)


def test_a_board_bends_most_in_the_middle_and_twists_at_its_corners() -> None:
    """z = warp_x 4u(1-u) + warp_y 4v(1-v) + warp_xy (2u-1)(2v-1), u along x, v along y, 0 to 1 over the points."""
    x = np.array([[-1.0, 2.0, 0.0], [1.0, 2.0, 0.0], [-1.0, 6.0, 0.0], [1.0, 6.0, 0.0], [0.0, 3.0, 0.0]])
    z = deformation(x, ("warp_x", "warp_y", "warp_xy"))[:, 2]
    np.testing.assert_allclose(z, [[0, 0, 1], [0, 0, -1], [0, 0, -1], [0, 0, 1], [1.0, 0.75, 0]], atol=1e-15)


def test_a_board_is_longer_along_an_axis_leans_along_x_and_grows_with_the_temperature() -> None:
    """x + (scale_x x + shear y, scale_y y, 0) + expansion (T - reference) x."""
    moves = deformation(np.array([[2.0, 3.0, 0.5]]), ("scale_y", "scale_x", "expansion", "shear"), warming=4.0)[0]
    np.testing.assert_allclose(moves.T, [[0, 3, 0], [2, 0, 0], [8, 12, 2], [3, 0, 0]], atol=1e-15)


def test_euler_angles_of_the_result_files_are_rz_ry_rx() -> None:
    x, y, z = np.radians(pose_dict(A)["rotation_euler_xyz_deg"])
    np.testing.assert_allclose((Rot3.Rz(z) * Rot3.Ry(y) * Rot3.Rx(x)).matrix(), A.rotation().matrix(), atol=1e-14)


def test_quaternions_are_written_w_first_and_positive() -> None:
    w, x, y, z = pose_dict(Pose3(Rot3.Rz(np.radians(350.0)), np.zeros(3)))["rotation_quaternion_wxyz"]
    np.testing.assert_allclose([w, x, y, z], [np.cos(np.radians(5)), 0, 0, -np.sin(np.radians(5))], atol=1e-15)


def test_translation_sigmas_are_along_the_axes_of_the_left_frame() -> None:
    cov = np.diag([1e-6, 4e-6, 9e-6, 1e-8, 4e-8, 9e-8])
    turned = Pose3(Rot3.Rz(np.pi / 2), np.zeros(3))
    names = ("rx", "ry", "rz", "tx", "ty", "tz")
    estimate = Estimate(("world_from_station", "s"), turned, names, ("rad",) * 3 + ("m",) * 3, cov, ("free",) * 6)
    entry = pose_columns([estimate], Scale("a_priori", 1.0, 1.0)).entry(estimate.name)
    np.testing.assert_allclose(entry["sigma_translation_mm"], [0.2, 0.1, 0.3], atol=1e-12)
    np.testing.assert_allclose(np.radians(np.array(entry["sigma_rotation_arcsec"]) / 3600), [1e-3, 2e-3, 3e-3])


def test_covariance_scales_with_the_square_of_sigma0() -> None:
    estimate = Estimate(("point", "p"), X, ("x", "y", "z"), ("m",) * 3, np.eye(3) * 4e-6, ("free",) * 3)
    np.testing.assert_allclose(sigmas_of(estimate, Scale("a_posteriori", 1.5, 1.0)), 3e-3)


def pair_graph(cov: FloatArray) -> tuple[h.AdjustmentGraph, Pair]:
    pair = Pair("p", FrameRef("station", "a"), FrameRef("station", "b"), A, cov)
    survey = Survey(stations=(Station("a"), Station("b")), pairs=(pair,))
    poses = {("world_from_station", "a"): A * B, ("world_from_station", "b"): B}
    return h.build(survey, h.StartValues({}, poses, {})), pair


def test_a_pair_measures_b_from_a() -> None:
    graph, _ = pair_graph(np.eye(6))
    values = graph.start
    world_from_b = values.atPose3(graph.unknowns.by_name["world_from_station", "b"].key)
    values.update(graph.unknowns.by_name["world_from_station", "a"].key, world_from_b * A)
    assert graph.graph.error(values) == pytest.approx(0.0, abs=1e-20)


def test_a_pairs_covariance_is_in_the_tangent_of_a() -> None:
    """On the right of b_from_a: an error of x along the axes of a has the sigma of tx."""
    cov = np.diag([1.0, 1.0, 1.0, 1e-2, 1.0, 1.0]) ** 2
    graph, pair = pair_graph(cov)
    values = graph.start
    world_from_b = values.atPose3(graph.unknowns.by_name["world_from_station", "b"].key)
    assert isinstance(pair.b_from_a, Pose3)
    off = world_from_b * pair.b_from_a * Pose3(Rot3(), [1e-2, 0.0, 0.0])
    values.update(graph.unknowns.by_name["world_from_station", "a"].key, off)
    assert 2.0 * graph.graph.error(values) == pytest.approx(1.0, rel=1e-12)


def test_residuals_are_predicted_minus_observed() -> None:
    station = Station("S", world_from_station=PoseParameter(Pose3(), "held"))
    x = np.array([[0.0, 0, 2], [0.2, 0, 2], [0, 0.2, 2], [0.2, 0.2, 2.2]])
    target = Target("T", ("a", "b", "c", "d"), x, carrier_from_target=PoseParameter(B, "held"))
    survey, lenses = one_block(station, target)
    graph = h.build(survey, h.StartValues(lenses, {}, {}))
    graph.prepare(graph.start, jacobians=True)
    residual, _ = graph.images.statistics(None)
    np.testing.assert_allclose(residual[1], brown_pixel(x[1]) - 100.0, atol=1e-10)


def test_whitening_is_upper_triangular() -> None:
    cov = h.point_covs(np.random.default_rng(1), 3)
    for (w00, w01, w11), c in zip(square_root_information(cov), cov, strict=True):
        W = np.array([[w00, w01], [0.0, w11]])
        np.testing.assert_allclose(W.T @ W, np.linalg.inv(c), rtol=1e-12)
        np.testing.assert_allclose(W, np.linalg.cholesky(np.linalg.inv(c)).T, rtol=1e-12)
