"""The simulator against closed forms and OpenCV's own solvers; nothing here uses the adjustment."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.observations import Distance, FrameRef, Pair, PositionRef
from adjust.model.survey import PoseParameter
from survey.simulate import BROWN, Scene, full_lab, head_on_table, relay, resample, single_camera, stereo
from survey.simulate.draft import table_angles
from survey.simulate.scene import rotation_about


def _noise_free(survey, truth):
    """The survey with (almost) exact observations."""
    blocks = tuple(replace(b, cov=b.cov * 1e-18) for b in survey.image_blocks)
    return resample(replace(survey, image_blocks=blocks), truth, 0)


def _opencv_lens(truth, camera_id):
    lens = dict(zip(BROWN, truth["lens", camera_id], strict=True))
    matrix = np.array([[lens["fx"], 0, lens["u0"]], [0, lens["fy"], lens["v0"]], [0, 0, 1]])
    return matrix, np.array([lens[n] for n in ("k1", "k2", "p1", "p2", "k3")])


def test_solvepnp_finds_the_true_pose_of_a_hand_held_board():
    survey, truth = single_camera(3, n_images=4)
    matrix, distortion = _opencv_lens(truth, "C1")
    for block in _noise_free(survey, truth).image_blocks:
        x = survey.targets[0].x_in_target[block.point_idx]
        _, rotation, translation = cv2.solvePnP(x, block.uv, matrix, distortion)
        pose = Pose3(Rot3(cv2.Rodrigues(rotation)[0]), translation.ravel())
        true = truth["carrier_from_target", "board", block.epoch_id]
        # the solver's own stopping rule leaves some 1e-7
        np.testing.assert_allclose(Pose3.Logmap(true.between(pose)), 0.0, atol=1e-5)


@pytest.mark.slow
def test_the_station_carries_the_camera_through_the_whole_table_chain():
    survey, truth = head_on_table(2, n_table_epochs=3, n_free_epochs=1, axis_offset_mm=3.0)
    ideal = _noise_free(survey, truth)
    for block in ideal.image_blocks:
        matrix, distortion = _opencv_lens(truth, block.camera_id)
        _, rotation, translation = cv2.solvePnP(survey.targets[0].x_in_target, block.uv, matrix, distortion)
        world_from_camera = Pose3(Rot3(cv2.Rodrigues(rotation)[0]), translation.ravel()).inverse()
        station_from_camera = truth["station_from_camera", block.camera_id]
        if block.epoch_id.startswith("h"):
            expected = truth["world_from_station", "head", block.epoch_id] * station_from_camera
        else:
            a1, a2 = truth["table_angles", "turntable", block.epoch_id]
            skew, offset, _, _ = truth["table_geometry", "turntable"]
            mount = Pose3(Rot3.Rx(a1), np.zeros(3)) * Pose3(Rot3(), np.array([0.0, offset, 0.0]))
            mount = mount * Pose3(Rot3.Ry(skew), np.zeros(3)) * Pose3(Rot3.Rz(a2), np.zeros(3))
            expected = truth["world_from_table", "turntable"] * mount * station_from_camera
        np.testing.assert_allclose(Pose3.Logmap(expected.between(world_from_camera)), 0.0, atol=1e-5)


def test_projection_is_a_pinhole_where_the_lens_has_no_distortion():
    survey, truth = single_camera(1, n_images=1)
    lens = np.zeros(13)
    lens[:5] = 1000.0, 1100.0, 2.0, 300.0, 200.0
    scene = Scene(survey, {**truth, ("lens", "C1"): lens})
    uv = scene.project("C1", "e01", np.array([[0.2, -0.1, 2.0], [0.0, 0.0, -1.0]]))
    np.testing.assert_allclose(uv[0], [300.0 + 1000.0 * 0.1 + 2.0 * -0.05, 200.0 + 1100.0 * -0.05])
    assert np.isnan(uv[1]).all()


@pytest.mark.parametrize("face", [0, 1])
def test_table_angles_point_where_they_are_told(face):
    d, b = np.array([0.9, -0.2, 0.3]), np.array([0.1, -0.6, 0.75])
    a1, a2 = table_angles(d, b, face)
    turned = (rotation_about("x", a1) @ rotation_about("z", a2))[:3, :3] @ d
    np.testing.assert_allclose(turned / np.linalg.norm(d), b / np.linalg.norm(b), atol=1e-12)


def test_equal_seeds_give_equal_surveys_and_others_do_not():
    (a, _), (b, _), (c, _) = stereo(5), stereo(5), stereo(6)
    assert all(np.array_equal(x.uv, y.uv) for x, y in zip(a.image_blocks, b.image_blocks, strict=True))
    assert not np.array_equal(a.image_blocks[0].uv, c.image_blocks[0].uv)


@pytest.mark.slow
def test_noise_has_the_stated_covariance():
    survey, truth = head_on_table(1, n_table_epochs=2, n_free_epochs=0, sigma_px=0.2)
    cov = np.array([[0.04, 0.018], [0.018, 0.01]])
    blocks = tuple(replace(b, cov=np.broadcast_to(cov, b.cov.shape)) for b in survey.image_blocks)
    survey = replace(survey, image_blocks=blocks)
    draws = [resample(survey, truth, seed) for seed in range(60)]
    uv = np.array([np.concatenate([b.uv for b in s.image_blocks]) for s in draws])
    scatter = np.einsum("kni,knj->ij", uv - uv.mean(0), uv - uv.mean(0)) / (uv.shape[0] - 1) / uv.shape[1]
    # 528 points x 60 draws: 0.6 % on a variance; four times that
    np.testing.assert_allclose(scatter, cov, rtol=0.025)
    angles = np.array([[r.angles for r in s.table_readings] for s in draws])
    true = np.array([truth["table_angles", "turntable", r.epoch_id] for r in survey.table_readings])
    sigma = np.sqrt(((angles - true) ** 2).mean())
    # 720 readings: 2.6 %; four times that
    assert sigma == pytest.approx(np.radians(8.0 / 3600.0), rel=0.11)


def test_pairs_distances_and_priors_are_drawn_around_the_truth():
    survey, truth = stereo(2)
    left, right = FrameRef("camera", "left"), FrameRef("camera", "right")
    pair = Pair("p", left, right, Pose3(), np.eye(6) * 1e-12)
    distance = Distance("d", PositionRef(frame=left), PositionRef(frame=right), 0.0, 1e-6)
    prior = PoseParameter(Pose3(), "prior", np.diag([1e-12, 1e-12, 1e-12, 1e-12, np.inf, 1e-12]))
    cameras = (survey.cameras[0], replace(survey.cameras[1], station_from_camera=prior))
    drawn = resample(replace(survey, cameras=cameras, pairs=(pair,), distances=(distance,)), truth, 1)
    true = truth["station_from_camera", "right"]
    np.testing.assert_allclose(Pose3.Logmap(drawn.pairs[0].b_from_a * true), 0.0, atol=1e-5)
    assert 0.0 < abs(drawn.distances[0].value - np.linalg.norm(true.translation())) < 1e-5
    error = Pose3.Logmap(true.between(drawn.cameras[1].station_from_camera.value))
    np.testing.assert_allclose(error, 0.0, atol=1e-5)
    assert np.abs(error).max() > 1e-8


@pytest.mark.slow
def test_every_unknown_of_the_full_lab_has_a_truth_and_is_observed():
    survey, truth = full_lab(4)
    for camera in survey.cameras:
        blocks = [b for b in survey.image_blocks if b.camera_id == camera.camera_id]
        uv = np.concatenate([b.uv for b in blocks])
        assert len(blocks) >= 9
        assert (uv >= 0).all()
        assert (uv <= np.array(camera.image_size) - 1).all()
        assert np.ptp(uv, axis=0).min() > 600.0  # spread over the frame, not a corner of it
        assert ("lens", camera.camera_id) in truth
    seen = np.concatenate([b.point_idx for b in survey.image_blocks if b.target_id is None])
    assert np.bincount(seen, minlength=len(survey.points)).min() >= 3
    grids = {(b.camera_id[0], b.target_id) for b in survey.image_blocks if str(b.target_id).startswith("G")}
    assert {name for camera, name in grids if camera == "R"} == {"G1", "G2", "G3", "G4"}
    assert {name for camera, name in grids if camera in "XY"} == {"G1", "G2", "G3", "G4"}


def test_every_plate_is_seen_by_every_relay_camera():
    survey, _ = relay(1)
    assert len({(b.camera_id, b.target_id) for b in survey.image_blocks}) == 16
