"""Real data adjusted from nothing: what others published, or what another program finds in the same numbers."""

import cv2
import numpy as np
import pytest
from gtsam import Pose3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.lenses.models import MODELS
from tests.acceptance import published
from tests.data import data_folder


@pytest.fixture(scope="module")
def dbat():
    folder = data_folder("calibration", "dbat_camcal")
    return folder, adjust(published.dbat_survey(folder))


@pytest.fixture(scope="module")
def mrcal():
    path = data_folder("calibration", "mrcal") / "opencv8-0.npz"
    return path, published.mrcal_solution(path), adjust(published.mrcal_survey(path, regularised=True))


def turned_back(angles):
    """Differences of angles without full turns."""
    return (angles + np.pi) % (2 * np.pi) - np.pi


def test_dbat_statistics_and_lens(dbat):
    folder, result = dbat
    report, solution = published.dbat_report(folder / "camcal-dbatreport.txt"), published.dbat_solution(folder)
    assert result.sigma0 == pytest.approx(report.sigma0.value, abs=report.sigma0.half_digit)
    assert (result.redundancy, result.n_unknowns) == (report.redundancy, report.n_unknowns)
    lens = result.estimates[("lens", "camera")]
    sigmas = np.sqrt(np.diag(lens.cov)) * result.sigma0
    # the result files' run stopped at a relative step of 1e-6
    np.testing.assert_array_less(np.abs(lens.value - solution.lens) / sigmas, 1e-4)
    for k, name in enumerate(lens.components):
        value, deviation = report.lens[name]
        assert abs(lens.value[k] - value.value) <= value.half_digit * 1.001, name
        assert abs(sigmas[k] - deviation.value) <= deviation.half_digit * 1.001, name


def test_dbat_stations(dbat):
    folder, result = dbat
    solution = published.dbat_solution(folder)
    for image, expected in solution.stations.items():
        station = result.estimates[("world_from_station", "body", image)]
        jacobian = published.station_parameter_jacobian(station.value)
        sigmas = np.sqrt(np.diag(jacobian @ station.cov @ jacobian.T)) * result.sigma0
        difference = published.station_parameters(station.value) - expected
        difference[:3] = turned_back(difference[:3])
        np.testing.assert_array_less(np.abs(difference) / sigmas, 1e-4)
        np.testing.assert_allclose(sigmas, solution.station_sigmas[image], rtol=1e-6)


def test_dbat_points_have_the_printed_largest_sigmas(dbat):
    _, result = dbat
    sigmas = {
        name[1]: np.sqrt(np.diag(e.cov)) * result.sigma0 for name, e in result.estimates.items() if name[0] == "point"
    }
    # from the report's "Point Precision"
    assert all(np.all(sigmas[control] == 0) for control in ("1001", "1002", "1003", "1004"))
    np.testing.assert_allclose(sigmas["90"], [5.0e-5, 5.3e-5, 8.5e-5], atol=0.05e-5)
    total = {point: np.linalg.norm(s) for point, s in sigmas.items() if s.any()}
    assert max(total, key=total.__getitem__) == "90"
    assert min(total, key=total.__getitem__) == "49"


def test_mrcal_with_its_regularisation_meets_its_optimum(mrcal):
    _, solution, result = mrcal
    lens = result.estimates[("lens", "camera")]
    order = [lens.components.index(name) for name in published.MRCAL_LENS]
    sigmas = np.sqrt(np.diag(solution.lens_cov))
    np.testing.assert_array_less(np.abs(lens.value[order] - solution.lens) / sigmas, 1e-3)
    images = next(g for g in result.groups if g.group == "image")
    assert images.omega == pytest.approx(solution.board_cost, rel=1e-9)
    assert result.omega == pytest.approx(solution.cost, rel=1e-9)
    np.testing.assert_allclose(result.estimates[("warp", "board")].value, solution.warp, atol=1e-9)
    for epoch, expected in solution.camera_from_board.items():
        moved = expected.localCoordinates(result.estimates[("carrier_from_target", "board", epoch)].value)
        assert np.abs(moved).max() < 1e-6, epoch


def test_mrcal_covariance(mrcal):
    path, solution, result = mrcal
    lens = result.estimates[("lens", "camera")]
    order = [lens.components.index(name) for name in published.MRCAL_LENS]
    C = lens.cov[np.ix_(order, order)]
    prior = published.mrcal_survey(path, regularised=True).cameras[0].lens.prior
    P = np.zeros((12, 12))
    P[2:, 2:] = np.linalg.inv(prior.cov)
    # mrcal propagates the observations' noise alone through an optimum that the priors take part in
    cov = solution.sigma_px**2 * (C - C @ P @ C)
    scale = np.sqrt(np.diag(solution.lens_cov))
    np.testing.assert_allclose(cov / np.outer(scale, scale), solution.lens_cov / np.outer(scale, scale), atol=1e-5)


def test_mrcal_without_regularisation_moves_by_a_third_of_a_sigma(mrcal):
    path, solution, regularised = mrcal
    estimates = regularised.estimates
    start = StartValues(
        {"camera": estimates[("lens", "camera")].value},
        {name: e.value for name, e in estimates.items() if isinstance(e.value, Pose3)},
        {},
        {("warp", "board"): estimates[("warp", "board")].value},
    )
    result = adjust(published.mrcal_survey(path, regularised=False), start)
    lens = result.estimates[("lens", "camera")]
    order = [lens.components.index(name) for name in published.MRCAL_LENS]
    moved = (lens.value[order] - solution.lens) / np.sqrt(np.diag(solution.lens_cov))
    # an independent plain solution of the same equations: fx 2073.8865, fy 2077.4657, cx 3004.6879, cy 1997.3757
    np.testing.assert_allclose(lens.value[order[:4]], [2073.8865, 2077.4657, 3004.6879, 1997.3757], atol=6e-5)
    assert np.abs(moved).max() < 0.35
    assert result.sigma0 == pytest.approx(0.559847, abs=6e-7)


def test_opencv_left_is_what_opencv_finds_in_the_same_corners():
    survey = published.opencv_survey(data_folder("calibration", "opencv_samples"), ("left",))
    x = [survey.targets[0].x_in_target.astype(np.float32)] * 13
    uv = [block.uv.astype(np.float32) for block in survey.image_blocks]
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-15)
    rms, matrix, coefficients, _, _, deviations, *_ = cv2.calibrateCameraExtended(
        x, uv, (640, 480), np.eye(3), None, flags=cv2.CALIB_FIX_ASPECT_RATIO, criteria=criteria
    )
    result = adjust(survey)
    lens = result.estimates[("lens", "left")]
    expected = [matrix[0, 0], matrix[1, 1], 0.0, matrix[0, 2], matrix[1, 2], *coefficients.ravel()[:5]]
    sigmas = np.sqrt(np.diag(lens.cov)) * result.sigma0
    free = sigmas > 0
    # OpenCV takes its points in single precision
    assert np.abs((lens.value[:10] - expected)[free[:10]] / sigmas[:10][free[:10]]).max() < 1e-3
    assert np.sqrt(np.sum(result.image_residuals.residuals**2) / (13 * 54)) == pytest.approx(rms, rel=1e-5)
    assert lens.status[MODELS["brown"].names.index("fy")] == "tied"
    assert deviations.ravel()[1] == pytest.approx(sigmas[1], rel=1e-3)


def test_opencv_left_with_the_published_calibrations_corners_meets_it():
    folder = data_folder("calibration", "opencv_samples")
    solution = published.opencv_left_solution(folder)
    corners = {"left": published.opencv_wide_corners(folder, "left")}
    result = adjust(published.opencv_survey(folder, ("left",), corners=corners))
    lens = result.estimates[("lens", "left")]
    order = [lens.components.index(n) for n in ("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3")]
    sigmas = np.sqrt(np.diag(lens.cov))[order] * result.sigma0
    # the corners are found anew here, by another version of OpenCV than the one that published
    np.testing.assert_array_less(np.abs(lens.value[order] - solution.lens) / sigmas, 0.02)
    images = result.image_residuals
    for k, block in enumerate(result.survey.image_blocks):
        residuals = images.residuals[images.block_ptr[k] : images.block_ptr[k + 1]]
        rms = np.sqrt(np.mean(np.sum(residuals**2, axis=1)))
        assert rms == pytest.approx(solution.view_rms_px[block.epoch_id], abs=2e-3), block.epoch_id


def test_opencv_stored_corners_are_free_of_the_published_gross_errors():
    folder = data_folder("calibration", "opencv_samples")
    result = adjust(published.opencv_survey(folder, ("left",)))
    images = result.image_residuals
    assert np.linalg.norm(images.residuals, axis=1).max() < 0.6
    lens, solution = result.estimates[("lens", "left")], published.opencv_left_solution(folder)
    sigma = np.sqrt(lens.cov[0, 0]) * result.sigma0
    # so this lens is not the published one: three pixels of focal length apart, seven of its sigmas
    assert 5 < (solution.lens[0] - lens.value[0]) / sigma < 10


def test_opencv_pair_is_what_opencv_finds_in_the_same_corners():
    folder = data_folder("calibration", "opencv_samples")
    survey = published.opencv_survey(folder)
    x = [survey.targets[0].x_in_target.astype(np.float32)] * 13
    uv = {
        side: [b.uv.astype(np.float32) for b in survey.image_blocks if b.camera_id == side]
        for side in published.OPENCV_SIDES
    }
    single = {
        side: cv2.calibrateCamera(x, uv[side], (640, 480), np.eye(3), None, flags=cv2.CALIB_FIX_ASPECT_RATIO)[1:3]
        for side in published.OPENCV_SIDES
    }
    criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 500, 1e-15)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO
    rms, left, _, right, _, R, t, *_ = cv2.stereoCalibrate(
        x, uv["left"], uv["right"], *single["left"], *single["right"], (640, 480), flags=flags, criteria=criteria
    )
    result = adjust(survey)
    distances = np.sum(result.image_residuals.residuals**2, axis=1)
    assert np.sqrt(np.mean(distances)) == pytest.approx(rms, rel=1e-5)
    for side, matrix in (("left", left), ("right", right)):
        lens = result.estimates[("lens", side)]
        sigmas = np.sqrt(np.diag(lens.cov)) * result.sigma0
        difference = lens.value[[0, 3, 4]] - [matrix[0, 0], matrix[0, 2], matrix[1, 2]]
        assert np.abs(difference / sigmas[[0, 3, 4]]).max() < 0.02
    pose = result.estimates[("station_from_camera", "right")]
    expected = Pose3(published.Rot3(R), t.ravel()).inverse()
    sigmas = np.sqrt(np.diag(pose.cov)) * result.sigma0
    assert np.abs(expected.localCoordinates(pose.value) / sigmas).max() < 0.02
