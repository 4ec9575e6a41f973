"""The surveys built from real data are the published ones: at the published optimum they give its statistics."""

import cv2
import numpy as np
import pytest

from adjust.lenses.models import MODELS, lens_constants, lens_derivatives, lens_residuals
from tests.acceptance import published
from tests.adjust.lenses import slopes
from tests.data import data_folder


def brown_values(names, values):
    lens = np.zeros(MODELS["brown"].n)
    lens[[MODELS["brown"].names.index(name) for name in names]] = values
    return lens


def board_residuals(survey, block, values, camera_from_board, warp=(0.0, 0.0)):
    x = survey.targets[0].x_in_target[block.point_idx].copy()
    u, v = (survey.targets[0].x_in_target / survey.targets[0].x_in_target.max(axis=0, initial=1e-9)).T[:2]
    x[:, 2] += (warp[0] * 4 * u * (1 - u) + warp[1] * 4 * v * (1 - v))[block.point_idx]
    q = camera_from_board.transformFrom(x.T).T
    constants = lens_constants("brown", survey.cameras[0].image_size)
    return lens_residuals(MODELS["brown"], values, constants, q, block.uv)


def dbat_point_squares(survey, solution, point_idx, x_in_world):
    """Sum of squared whitened residuals of one point; x None: intersected first, then Gauss-Newton on it alone."""
    model = MODELS["brown_backward_dbat"]
    constants = lens_constants(model, survey.cameras[0].image_size, survey.cameras[0].lens.pixel_size_mm)
    seen = [
        (published.world_from_camera(solution.stations[b.epoch_id]), b.uv[b.point_idx == point_idx])
        for b in survey.image_blocks
        if np.any(b.point_idx == point_idx)
    ]
    poses, uv = [s[0] for s in seen], np.vstack([s[1] for s in seen])
    R = np.array([p.rotation().matrix().T for p in poses])
    origins = np.array([p.translation() for p in poses])
    if x_in_world is None:
        directions = np.column_stack([slopes(model, solution.lens, constants, uv), np.ones(len(uv))])
        d = np.einsum("nji,nj->ni", R, directions / np.linalg.norm(directions, axis=1, keepdims=True))
        across = np.eye(3) - d[:, :, None] * d[:, None, :]
        x_in_world = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, origins))
        for _ in range(5):
            q = np.einsum("nij,nj->ni", R, x_in_world - origins)
            residuals, _, by_q = lens_derivatives(model, solution.lens, constants, q, uv)
            J = (by_q @ R).reshape(-1, 3)
            x_in_world = x_in_world - np.linalg.lstsq(J, residuals.ravel(), rcond=None)[0]
    q = np.einsum("nij,nj->ni", R, x_in_world - origins)
    return float(np.sum((lens_residuals(model, solution.lens, constants, q, uv) / 0.1) ** 2)), len(uv)


@pytest.fixture(scope="module")
def dbat():
    return data_folder("calibration", "dbat_camcal")


def test_dbat_report_is_read_completely(dbat):
    report = published.dbat_report(dbat / "camcal-dbatreport.txt")
    assert tuple(report.lens) == ("c", "px", "py", "K1", "K2", "K3", "P1", "P2", "as")
    assert len(report.stations) == 21
    assert all(len(station) == 6 for station in report.stations.values())
    survey = published.dbat_survey(dbat)
    free = [p for p in survey.points if p.x_in_world.treatment == "free"]
    assert len(survey.points) == 100
    assert report.n_unknowns == 9 + 6 * len(survey.image_blocks) + 3 * len(free)
    assert report.n_observations == 2 * sum(len(b.uv) for b in survey.image_blocks)
    assert report.redundancy == report.n_observations - report.n_unknowns


def test_dbat_report_and_result_files_agree(dbat):
    report = published.dbat_report(dbat / "camcal-dbatreport.txt")
    solution = published.dbat_solution(dbat)
    for name, exact in zip(MODELS["brown_backward_dbat"].names, solution.lens, strict=True):
        value = report.lens[name][0]
        # the result files come from a run that stopped a little earlier: one unit of the last digit
        assert abs(value.value - exact) < 3 * value.half_digit, name
    to_printed = np.array([180 / np.pi] * 3 + [1.0] * 3)
    for image, station in report.stations.items():
        exact = solution.stations[image] * to_printed
        sigmas = solution.station_sigmas[image] * to_printed
        for k, (value, deviation) in enumerate(station.values()):
            assert abs(value.value - exact[k]) < 3 * value.half_digit, (image, k)
            assert deviation.value == pytest.approx(sigmas[k], rel=5.1e-3), (image, k)


def test_dbat_sigma0_at_the_published_optimum(dbat):
    survey, solution = published.dbat_survey(dbat), published.dbat_solution(dbat)
    report = published.dbat_report(dbat / "camcal-dbatreport.txt")
    results = [dbat_point_squares(survey, solution, k, p.x_in_world.value) for k, p in enumerate(survey.points)]
    squares, n_points = (sum(column) for column in zip(*results, strict=True))
    assert np.sqrt(squares / report.redundancy) == pytest.approx(report.sigma0.value, abs=report.sigma0.half_digit)
    # printed: rms of the distance
    assert 0.1 * np.sqrt(squares / n_points) == pytest.approx(report.rms_px.value, abs=report.rms_px.half_digit)


def test_omega_phi_kappa_and_their_jacobian_by_differences():
    pose = published.world_from_camera(np.array([-0.6, 0.3, 2.4, 0.4, 1.8, 1.4]))
    np.testing.assert_allclose(published.station_parameters(pose), [-0.6, 0.3, 2.4, 0.4, 1.8, 1.4], atol=1e-14)
    jacobian = published.station_parameter_jacobian(pose)
    for k in range(6):
        step = np.zeros(6)
        step[k] = 1e-6
        ends = [published.station_parameters(pose.retract(sign * step)) for sign in (1, -1)]
        np.testing.assert_allclose(jacobian[:, k], (ends[0] - ends[1]) / 2e-6, atol=1e-8)


@pytest.mark.parametrize("regularised", [True, False])
def test_mrcal_cost_and_sigma_at_the_published_optimum(regularised):
    path = data_folder("calibration", "mrcal") / "opencv8-0.npz"
    survey, solution = published.mrcal_survey(path, regularised), published.mrcal_solution(path)
    values = brown_values(published.MRCAL_LENS, solution.lens)
    squares, n_used, n_outliers = 0.0, 0, 0
    for block in survey.image_blocks:
        residuals = board_residuals(survey, block, values, solution.camera_from_board[block.epoch_id], solution.warp)
        whitened = residuals / np.sqrt(block.cov[:, 0, 0])[:, None]
        squares += float(np.sum(whitened[block.used] ** 2))
        n_used += 2 * int(block.used.sum())
        n_outliers += int((~block.used).sum())
    assert (n_used, n_outliers) == (37194, 3)
    assert squares == pytest.approx(solution.board_cost, rel=1e-12)
    n_unknowns = 12 + 6 * 186 + 2
    assert np.sqrt(squares / (n_used - n_unknowns)) == pytest.approx(solution.sigma_px, rel=1e-12)
    prior = survey.cameras[0].lens.prior
    if not regularised:
        assert prior is None
        return
    offset = values[[MODELS["brown"].names.index(name) for name in prior.names]] - prior.mean
    penalty = float(offset @ np.linalg.solve(prior.cov, offset))
    assert penalty == pytest.approx(solution.cost - solution.board_cost, rel=1e-10)


def test_opencv_survey_at_the_optimum_that_opencv_finds_for_its_corners():
    folder = data_folder("calibration", "opencv_samples")
    survey = published.opencv_survey(folder, ("left",))
    x = [survey.targets[0].x_in_target.astype(np.float32)] * 13
    uv = [block.uv.astype(np.float32) for block in survey.image_blocks]
    flags = cv2.CALIB_FIX_ASPECT_RATIO
    rms, matrix, coefficients, rvecs, tvecs = cv2.calibrateCamera(x, uv, (640, 480), np.eye(3), None, flags=flags)
    coefficients = coefficients.ravel()[:5]
    lens = [matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *coefficients]
    values = brown_values(("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3"), lens)
    squares = 0.0
    for block, r, t in zip(survey.image_blocks, rvecs, tvecs, strict=True):
        pose = published.Pose3(published.Rot3.Expmap(r.ravel()), t.ravel())
        squares += float(np.sum(board_residuals(survey, block, values, pose) ** 2))
    # OpenCV takes its image points in single precision
    assert np.sqrt(squares / (13 * 54)) == pytest.approx(rms, rel=1e-5)


def test_opencv_published_calibration_fits_the_corners_of_every_view_but_one():
    folder = data_folder("calibration", "opencv_samples")
    survey, solution = published.opencv_survey(folder, ("left",)), published.opencv_left_solution(folder)
    values = brown_values(("fx", "fy", "u0", "v0", "k1", "k2", "p1", "p2", "k3"), solution.lens)
    for block in survey.image_blocks:
        residuals = board_residuals(survey, block, values, solution.camera_from_board[block.epoch_id])
        rms = np.sqrt(np.mean(np.sum(residuals**2, axis=1)))
        # the published calibration had corners of its own, in view 02 with gross errors (see opencv_wide_corners)
        assert rms < (0.9 if block.epoch_id == "02" else 0.35), block.epoch_id
        assert rms < solution.view_rms_px[block.epoch_id] + 0.07


def test_opencv_stereo_survey_pairs_the_views():
    folder = data_folder("calibration", "opencv_samples")
    survey = published.opencv_survey(folder)
    assert [c.camera_id for c in survey.cameras] == ["left", "right"]
    assert survey.cameras[1].station_from_camera.treatment == "free"
    epochs = {side: [b.epoch_id for b in survey.image_blocks if b.camera_id == side] for side in ("left", "right")}
    assert epochs["left"] == epochs["right"] == list(published.opencv_images(folder, "right"))
    assert all(path.exists() for side in ("left", "right") for path in published.opencv_images(folder, side).values())


def test_aicon_residuals_of_all_image_points():
    result = published.aicon_result(data_folder("network", "jaicov"))
    pixel_size_mm = 0.005  # any: the model is in millimetres
    constants = lens_constants("aicon", (1, 1), pixel_size_mm, result.r0_mm)
    poses = {image: published.world_from_camera(p) for image, p in result.images.items()}
    q = [poses[i].transformTo(result.points[p]) for i, p in zip(result.image, result.point, strict=True)]
    y_down = np.array([1.0, -1.0])
    uv = result.measured * y_down / pixel_size_mm
    residuals = lens_residuals(MODELS["aicon"], result.lens, constants, np.array(q), uv) * y_down * pixel_size_mm
    assert residuals.shape == (9972, 2)
    assert 3.9e-4 < residuals.std() < 4.0e-4
    # object coordinates are printed to 1e-4 mm, a 50th of that in the image, the lens to 5e-6 mm
    np.testing.assert_allclose(residuals, result.residuals, atol=1e-5)
