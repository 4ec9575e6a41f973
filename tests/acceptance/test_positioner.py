"""A real two-axis positioner under a metrology sensor (205 poses): axes, fit and the significance of both defects."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.survey import TABLE_GEOMETRY
from adjust.model.tables import harmonic_names
from adjust.testing.significance import significances
from tests.acceptance.positioner import (
    POSITIONER,
    PoseWeights,
    axis_tests,
    blockwise_covariance,
    pose_fit,
    positioner_survey,
    weights_from_residuals,
)
from tests.data import data_folder


@pytest.fixture(scope="module")
def recorded():
    with np.load(data_folder("calibration", "two_axis_positioner") / "positioner.npz") as file:
        joints, pose = file["joints"], file["pose_xyz_quat_xyzw"]
    matrices = np.tile(np.eye(4), (len(pose), 1, 1))
    matrices[:, :3, :3], matrices[:, :3, 3] = Rotation.from_quat(pose[:, 3:]).as_matrix(), pose[:, :3]
    return joints, matrices


@pytest.fixture(scope="module")
def solved(recorded):
    return adjust(positioner_survey(*recorded))


@pytest.fixture(scope="module")
def weighted(recorded):
    """The adjustment with the sigmas that its residuals tell, and these."""
    return weights_from_residuals(*recorded)


def turn(axis, angles):
    return Rotation.from_rotvec(np.outer(angles, np.eye(3)["xz".index(axis) * 2])).as_matrix()


def eighteen_parameters(joints, measured):
    """The same fit by plain lines: base, a pose between the axes and a mount, all six components each."""

    def poses(p):
        R = [Rotation.from_rotvec(p[i : i + 3]).as_matrix() for i in (0, 6, 12)]
        R1, R2 = turn("x", joints[:, 0]), turn("z", joints[:, 1])
        rotation = R[0] @ R1 @ R[1] @ R2 @ R[2]
        x = R2 @ p[15:18]
        x = np.einsum("nij,nj->ni", R1, x @ R[1].T + p[9:12])
        return rotation, x @ R[0].T + p[3:6]

    def residual(p):
        rotation, x = poses(p)
        turned = Rotation.from_matrix(np.swapaxes(measured[:, :3, :3], 1, 2) @ rotation).as_rotvec()
        return np.concatenate([1e3 * turned.ravel(), 1e3 * (x - measured[:, :3, 3]).ravel()])

    starts = Rotation.random(4, random_state=1).as_rotvec()
    found = [least_squares(residual, np.r_[s, np.zeros(9), -s, np.zeros(3)], max_nfev=60) for s in starts]
    best = min(found, key=lambda f: f.cost)
    return best, Rotation.from_rotvec(best.x[6:9]).as_matrix(), best.x[9:12]


def test_the_fit_is_that_of_an_independent_solution(recorded, solved):
    best, between, shift = eighteen_parameters(*recorded)
    assert solved.omega == pytest.approx(2.0 * best.cost, rel=1e-5)
    # direction and place of the inner axis in the frame of the outer one, which is x
    axis = between[:, 2]
    common = np.cross([1.0, 0.0, 0.0], axis)
    skewness, offset = solved.estimates[("table_geometry", POSITIONER)].value[:2]
    assert np.pi / 2 - np.arccos(abs(axis[0])) == pytest.approx(abs(skewness), abs=1e-8)
    assert abs(shift @ common) / np.linalg.norm(common) == pytest.approx(abs(offset), abs=1e-8)


def test_published_figures(recorded, solved):
    fit = pose_fit(solved)
    assert fit.position_mean_m * 1e3 == pytest.approx(0.381, abs=6e-4)
    assert fit.position_rms_m * 1e3 == pytest.approx(0.411, abs=6e-4)
    assert fit.position_max_m * 1e3 == pytest.approx(0.897, abs=6e-4)
    assert np.degrees(fit.rotation_mean_rad) == pytest.approx(0.0459, abs=6e-5)
    skewness, offset = solved.estimates[("table_geometry", POSITIONER)].value[:2]
    assert 90.0 - np.degrees(abs(skewness)) == pytest.approx(89.975, abs=6e-4)
    assert abs(offset) * 1e3 == pytest.approx(0.630, abs=6e-4)
    perfect = pose_fit(adjust(positioner_survey(*recorded, perfect_axes=True)))
    assert perfect.position_mean_m * 1e3 == pytest.approx(0.420, abs=6e-4)
    assert np.degrees(perfect.rotation_mean_rad) == pytest.approx(0.0466, abs=6e-5)
    assert solved.n_observations - solved.redundancy == 14 + recorded[0].size


def test_both_defects_of_the_axes_are_significant(recorded, weighted):
    result, weights = weighted
    assert result.sigma0 == pytest.approx(1.0, abs=2e-3)
    # one component has a third of the square, and the fourteen parameters take little of 1230 observations
    v = np.array([o.residual for o in result.other_residuals if o.kind == "pair"])
    assert 1.0 < weights.rotation_rad / np.sqrt(np.mean(v[:, :3] ** 2)) < 1.02
    assert 1.0 < weights.position_m / np.sqrt(np.mean(v[:, 3:] ** 2)) < 1.02
    skewness, offset, both = axis_tests(result)
    assert 89.97 < 90.0 - np.degrees(skewness.values[0]) < 89.98
    assert skewness.sigmas[0] < np.radians(0.004)
    assert offset.sigmas[0] < 0.06e-3
    assert skewness.significant
    assert offset.significant
    assert both.p_value < min(skewness.p_value, offset.p_value)
    # the tests against the fit without either: the square sum grows by what the joint statistic says
    perfect = adjust(positioner_survey(*recorded, weights, perfect_axes=True))
    assert perfect.omega - result.omega == pytest.approx(2.0 * both.statistic, rel=0.02)


def test_they_stay_so_although_neighbouring_poses_err_alike(recorded, weighted):
    result, weights = weighted
    v = np.array([o.residual / o.sigma for o in result.other_residuals if o.kind == "pair"])
    alike = [np.corrcoef(v[:-1, i], v[1:, i])[0, 1] for i in range(6)]
    assert min(alike) > 0.4
    blocks = blockwise_covariance(*recorded, weights)
    skewness, offset, both = axis_tests(result, blocks=blocks)
    white = axis_tests(result)
    # the offset's sigma is three times that of white noise
    assert offset.sigmas[0] > 2.0 * white[1].sigmas[0]
    assert np.degrees(skewness.sigmas[0]) == pytest.approx(0.004, abs=0.001)
    assert offset.sigmas[0] == pytest.approx(0.15e-3, abs=0.03e-3)
    assert skewness.significant
    assert offset.significant
    assert both.significant
    assert both.degrees == (2, 18)


@pytest.fixture(scope="module")
def perfect_machine(recorded):
    joints = recorded[0][::4]
    rng, poses = np.random.default_rng(5), []
    base = Rotation.from_rotvec([0.4, -1.1, 0.7]).as_matrix()
    for R1, R2 in zip(turn("x", joints[:, 0]), turn("z", joints[:, 1]), strict=True):
        m = np.eye(4)
        m[:3, :3] = base @ R1 @ R2 @ Rotation.from_rotvec(rng.normal(0, 5e-4, 3)).as_matrix()
        m[:3, 3] = base @ R1 @ R2 @ [0.1, -0.2, 0.3] + [1.0, 0.5, -0.2] + rng.normal(0, 2e-4, 3)
        poses.append(m)
    return joints, np.array(poses)


def test_perfect_axes_pass(perfect_machine):
    result, weights = weights_from_residuals(*perfect_machine)
    assert weights.position_m == pytest.approx(2e-4, rel=0.15)
    assert weights.rotation_rad == pytest.approx(5e-4, rel=0.15)
    assert not any(t.significant for t in axis_tests(result))
    # white noise: the blocks say the same as the residuals
    blocks = blockwise_covariance(*perfect_machine, weights, n_blocks=13)
    assert not any(t.significant for t in axis_tests(result, blocks=blocks))
    for a, b in zip(axis_tests(result, blocks=blocks), axis_tests(result), strict=True):
        assert 0.4 < a.sigmas[0] / b.sigmas[0] < 2.0


def test_what_cannot_be_tested_or_read_is_refused(perfect_machine):
    joints, poses = perfect_machine
    with pytest.raises(SurveyError, match="perfect_axes=False"):
        axis_tests(adjust(positioner_survey(joints, poses, PoseWeights(), perfect_axes=True)))
    with pytest.raises(SurveyError, match="30 blocks of 52 poses"):
        blockwise_covariance(joints, poses, PoseWeights(), n_blocks=30)
    with pytest.raises(SurveyError, match=r"\(52, 2\) joint angles and \(3, 4, 4\) poses"):
        positioner_survey(joints, poses[:3])


def with_harmonics(survey, highest):
    """With the harmonics of the inner axis unknown, up to an order of each kind."""
    (table,) = survey.tables
    given, waves = table.geometry, [n for kind, k in highest.items() for n in harmonic_names(kind, 1, k)]
    geometry = replace(given, names=(*given.names, *waves), values=np.append(given.values, np.zeros(len(waves))),
                       free=(*given.free, *waves))  # fmt: skip
    return replace(survey, tables=(replace(table, geometry=geometry),))


@pytest.mark.parametrize(
    ("highest", "omega", "mean_mm", "significant"),
    [
        ({"angle": 1}, 199.56, 0.3764, {"angle_2_order_1"}),
        ({"angle": 2}, 199.52, 0.3766, {"angle_2_order_1"}),
        ({"angle": 2, "axial": 2, "radial": 1, "tilt": 1}, 158.325, 0.2619,
         {"angle_2_order_1", "angle_2_order_2",
          "radial_2_order_-1", "tilt_2_order_-1", "axial_2_order_1", "axial_2_order_2"}),
    ],
)  # fmt: skip
def test_harmonics_of_its_inner_axis(recorded, highest, omega, mean_mm, significant):
    """As another program fitted them (SciPy, plain lines, with weak priors)."""
    result = adjust(with_harmonics(positioner_survey(*recorded), highest))
    assert result.omega == pytest.approx(omega, abs=1e-2)
    assert 1e3 * pose_fit(result).position_mean_m == pytest.approx(mean_mm, abs=6e-5)
    tests = significances(result, result.estimates["table_geometry", POSITIONER], estimated_sigma0=True)
    assert {test.term for test in tests if test.significant} == significant


def test_harmonics_of_an_axis_that_turned_too_little_are_refused(recorded):
    """The outer axis turned by 60 degrees."""
    survey = positioner_survey(*recorded)
    (table,) = survey.tables
    waves = harmonic_names("angle", 0, 1)
    geometry = replace(table.geometry, names=(*TABLE_GEOMETRY, *waves), values=np.zeros(6), free=waves)
    with pytest.raises(SurveyError, match=r"axis 1 was read at 49 angles over 60 deg.*240 deg"):
        adjust(replace(survey, tables=(replace(table, geometry=geometry),)))
