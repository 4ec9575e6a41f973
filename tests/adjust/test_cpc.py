"""The stepwise calibration on a table: its equations, its sigmas, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.model.survey import Camera, LensParameter, PoseParameter, Survey
from adjust.published import CpcInput, TableImages, body_on_main_axis, calibrate, propagate, single_camera_survey
from adjust.published.method import difference
from adjust.published.steps import lateral_offset, table_and_main_camera
from adjust.spatial.rotation_forms import matrix_from_euler
from tests.sizes import size

MAIN = np.radians([(0, 0), (0, -80), (0, -30), (0, 25), (0, 60), (-20, 0), (-11, 0), (9, 0), (18, 0)])
X_ANGLES = np.radians([(80, 85), (95, 95), (-85, -90), (-95, -80)])
Y_ANGLES = np.radians([(85, 5), (95, -10), (80, -4)])
HEIGHT = 0.108
PLACES = {"Z": (0.034, 0.031, 0.12), "X": (0.076, -0.037, 0.079), "Y": (-0.033, 0.076, 0.077)}
TABLE_PLACE = np.array([0.034, -0.129, -0.685])


def turn(axis, degrees):
    return Rotation.from_euler(axis, degrees, degrees=True).as_matrix()


def head(size_deg=1.0, seed=0):
    """True rotations: C_t^w and C_k^b, misaligned by some ``size_deg``."""
    rng = np.random.default_rng(seed)
    off = {k: Rotation.from_rotvec(np.radians(rng.uniform(-size_deg, size_deg, 3))).as_matrix() for k in "tZXY"}
    return {"t": off["t"], "Z": off["Z"], "X": turn("y", 90) @ off["X"], "Y": turn("x", -90) @ off["Y"]}


def images(rotations, camera_id, angles, cov=None):
    """By plain products: world <- table <- auxiliary axis <- main axis <- body <- camera."""
    poses = []
    for a1, a2 in np.degrees(angles):
        body = rotations["t"] @ turn("x", a1) @ turn("z", a2)
        m = np.eye(4)
        m[:3, :3] = body @ rotations[camera_id]
        m[:3, 3] = TABLE_PLACE + body @ ((0, 0, HEIGHT) + np.array(PLACES[camera_id]))
        poses.append(m)
    return TableImages(camera_id, angles, np.array(poses), cov)


def given(rotations, with_cov=False):
    def cov(n):
        return np.kron(np.eye(n), np.diag([2e-4, 3e-4, 1e-4, 1e-4, 1e-4, 3e-4]) ** 2) if with_cov else None

    all_images = [images(rotations, k, a, cov(len(a))) for k, a in (("Z", MAIN), ("X", X_ANGLES), ("Y", Y_ANGLES))]
    b_z = (TABLE_PLACE + rotations["t"] @ (0, 0, HEIGHT))[2]
    return CpcInput(all_images[0], tuple(all_images[1:]), b_z, 2.5e-4, 4e-5)


def disturbed(item, rng):
    """New readings, caliper and poses, with the noise that the input states."""

    def one(im):
        poses = []
        d = (np.linalg.cholesky(im.cov) @ rng.standard_normal(len(im.cov))).reshape(-1, 6)
        for m, step in zip(im.world_from_camera, d, strict=True):
            poses.append((Pose3(m) * Pose3(Rot3.Expmap(step[:3]), step[3:])).matrix())
        angles = im.angles + item.angle_sigma_rad * rng.standard_normal(im.angles.shape)
        return replace(im, angles=angles, world_from_camera=np.array(poses))

    return replace(item, main=one(item.main), others=tuple(one(o) for o in item.others),
                   b_z_m=item.b_z_m + item.b_z_sigma_m * rng.standard_normal())  # fmt: skip


def test_the_design_is_the_derivative_of_the_exact_rotation():
    """Equations A8 to A10, element by element, against the exact product of rotations."""
    h = 1e-5
    for j in range(6):
        moved = np.zeros(6)
        moved[j] = h
        small = {"t": matrix_from_euler(moved[:3], "213"), "Z": matrix_from_euler(moved[3:], "213")}
        # exact images of a small misalignment: the least squares has to give it back to second order
        np.testing.assert_allclose(table_and_main_camera(images(small, "Z", MAIN)).values, moved, atol=2e-9)


@pytest.mark.parametrize("size_deg", [0.01, 1.0])
def test_without_noise_only_the_second_order_is_missed(size_deg):
    truth = head(size_deg)
    found = calibrate(given(truth))
    second = np.degrees(np.radians(3.0 * size_deg) ** 2)
    for name, key in (("C_t^w", "t"), ("C_z^b", "Z"), ("C_x^b", "X"), ("C_y^b", "Y")):
        turned = Rotation.from_matrix(truth[key].T @ found.rotations[name].matrix).as_rotvec(degrees=True)
        assert np.abs(turned).max() < second
        if size_deg == 1.0 and key == "Z":
            assert np.abs(turned).max() > 1e-4
    for k in "ZXY":
        error = found.vectors[f"r_b{k.lower()}^b"].value_mm - 1e3 * np.array(PLACES[k])
        assert np.abs(error).max() < 700 * np.radians(second)
    assert found.vectors["r_wb^w"].value_mm[2] == pytest.approx(1e3 * given(truth).b_z_m)


def test_our_frames():
    truth = head(0.01)
    found = calibrate(given(truth))
    assert found.camera_ids == ("Z", "X", "Y")
    expected = given(truth).others[0]
    body = found.world_from_table * Pose3(Rot3(expected.turned[0]), np.zeros(3)) * found.mount_from_station
    camera = body * found.station_from_camera("X")
    np.testing.assert_allclose(camera.matrix(), expected.world_from_camera[0], atol=2e-6)
    np.testing.assert_allclose(
        matrix_from_euler(np.radians(found.rotations["C_x^b"].angles_deg), "213"), found.rotations["C_x^b"].matrix
    )


@pytest.mark.slow
def test_propagated_sigmas_are_the_scatter():
    item = replace(given(head(0.3), with_cov=True), angle_sigma_rad=3e-4)  # as much as the images
    names, cov = propagate(item)
    n = size(400, 60)
    rng, at = np.random.default_rng(1), calibrate(item)
    d = np.array([difference(at, calibrate(disturbed(item, rng)))[1] for _ in range(n)])
    known = np.diag(cov) > 1e-20  # the body's x and y on the main axis are zero by definition
    assert [n for n, k in zip(names, known, strict=True) if not k] == [("r_tb^b", "x"), ("r_tb^b", "y")]
    ratio = d.std(axis=0)[known] / np.sqrt(np.diag(cov))[known]
    np.testing.assert_allclose(ratio, 1.0, atol=4.5 / np.sqrt(2 * n))


@pytest.mark.slow
def test_each_step_judges_white_noise_rightly():
    """With the noise it supposes (equal, independent, nothing wrong before) the paper's sigma is the scatter."""
    truth, rng = head(0.0), np.random.default_rng(2)
    clean = images(truth, "Z", MAIN)
    found, claimed = [], []
    for _ in range(4000):
        poses = clean.world_from_camera.copy()
        poses[:, :3, 3] += 1e-4 * rng.standard_normal((len(poses), 3))
        fit = lateral_offset(np.eye(3), replace(clean, world_from_camera=poses))
        found.append(fit.values)
        claimed.append(np.diag(fit.cov))
    np.testing.assert_allclose(np.std(found, axis=0) / np.sqrt(np.mean(claimed, axis=0)), 1.0, atol=0.035)


def test_what_the_images_do_not_determine_is_named():
    item = given(head())
    main_only = replace(item, main=images(head(), "Z", MAIN[:5]))
    with pytest.raises(SurveyError, match=r"do not determine gamma, psi: camera Z .* \(it has 5 and 0\)"):
        calibrate(main_only)
    with pytest.raises(SurveyError, match="alpha, phi"):
        calibrate(replace(item, main=images(head(), "Z", MAIN[5:])))
    same = np.repeat(MAIN[1:2], 3, axis=0)
    with pytest.raises(SurveyError, match="z_x, z_y: camera Z needs images with the main axis turned to different"):
        lateral_offset(np.eye(3), images(head(), "Z", same))
    with pytest.raises(SurveyError, match="camera Z: the covariance of its poses is needed"):
        propagate(item)
    with pytest.raises(SurveyError, match=r"camera X: \(0, 2\) table angles"):
        TableImages("X", np.zeros((0, 2)), np.zeros((0, 4, 4)))


def test_a_single_image_has_no_scatter():
    item = given(head())
    found = calibrate(replace(item, others=(images(head(), "X", X_ANGLES[:1]),)))
    assert np.isnan(found.rotations["C_x^b"].sigma_deg).all()
    assert np.isnan(found.vectors["r_bx^b"].sigma_mm).all()


def test_the_body_is_held_on_the_axis_and_free_along_it():
    parameter = body_on_main_axis(0.1)
    assert parameter.treatment == "prior"
    assert np.isinf(np.diag(parameter.prior_cov)).tolist() == [False] * 5 + [True]


def test_a_camera_that_is_not_there():
    camera = Camera("Z", "head", (1280, 1024), LensParameter("brown", ()), PoseParameter())
    with pytest.raises(SurveyError, match="no camera 'Q'"):
        single_camera_survey(Survey(cameras=(camera,)), "Q")
