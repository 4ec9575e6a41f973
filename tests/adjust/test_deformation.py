"""Deformations of a chain of six stations measured twice; poses are 4 x 4 matrices here, motions scipy's."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.linalg import expm
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.epochs.deformation import relative_poses, station_deformations
from adjust.model.errors import SurveyError
from adjust.model.observations import Coordinates, FrameRef, Pair, PositionRef
from adjust.model.survey import Datum, Point, PoseParameter, Station, Survey
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned
from tests.sizes import size

SIGMAS = np.r_[np.full(3, np.radians(10 / 3600)), np.full(3, 1e-4)]
EDGES = [(i, j) for i in range(6) for j in range(i + 1, min(6, i + 3))]
OPTIONS = CleanOptions(reject_pairs=False)


def chain():
    rng = np.random.default_rng(5)
    out = np.tile(np.eye(4), (6, 1, 1))
    out[:, :3, :3] = Rotation.from_rotvec(rng.normal(size=(6, 3))).as_matrix()
    out[:, :3, 3] = rng.normal(size=(6, 3)) * 0.3 + np.arange(6)[:, None] * [1.5, 0, 0]
    return out


def small(xi):
    """Motion (4, 4) of a tangent, rotation first, by the matrix exponential."""
    x, y, z, *t = xi
    return expm(np.array([[0, -z, y, t[0]], [z, 0, -x, t[1]], [-y, x, 0, t[2]], [0, 0, 0, 0]]))


def measured(poses, rng, sigmas=SIGMAS, held=0, rotations=False):
    """Survey of noisy pairs; one station is held in its true pose, none for an inner datum."""
    n, pairs = 3 if rotations else 6, []
    for i, j in EDGES:
        m = Pose3(np.linalg.inv(poses[j]) @ poses[i] @ small(rng.normal(size=6) * sigmas))
        pairs.append(Pair(f"{i}{j}", FrameRef("station", f"S{i}"), FrameRef("station", f"S{j}"),
                          m.rotation() if rotations else m, np.diag(sigmas[:n] ** 2)))  # fmt: skip
    stations = [Station(f"S{i}") for i in range(6)]
    if held is not None:
        stations[held] = Station(f"S{held}", world_from_station=PoseParameter(Pose3(poses[held]), "held"))
    return Survey(stations=tuple(stations), pairs=tuple(pairs), datum=Datum("inner" if held is None else "given"))


def relative_pose(adjustment, a, b):
    b_from_a, cov = relative_poses(adjustment, [(a, b)])
    return Pose3(b_from_a.matrices()[0]), cov[0]


def adjusted(survey):
    return adjust_cleaned(survey, OPTIONS)


def with_a_point(survey):
    """The same as no pure network of pairs: it goes through the whole adjustment."""
    seen = Coordinates((PositionRef("B"),), np.zeros((1, 3)), np.eye(3) * 1e-6)
    return replace(survey, points=(Point("B"),), coordinates=(seen,))


def test_a_single_pair_gives_what_was_measured_with_its_covariance():
    rng = np.random.default_rng(1)
    poses = chain()
    root = rng.normal(size=(6, 6)) * SIGMAS[:, None]
    given = replace(measured(poses, rng).pairs[0], cov=root @ root.T)
    stations = (Station("S0"), Station("S1", world_from_station=PoseParameter(Pose3(poses[1]), "held")))
    result = adjusted(Survey(stations=stations, pairs=(given,)))
    b_from_a, cov = relative_pose(result, "S0", "S1")
    np.testing.assert_allclose(b_from_a.matrix(), given.b_from_a.matrix(), atol=1e-9)
    unit = np.outer(SIGMAS, SIGMAS)
    np.testing.assert_allclose(cov / unit, given.cov / unit, atol=1e-6)
    back, back_cov = relative_pose(result, "S1", "S0")
    np.testing.assert_allclose((back * b_from_a).matrix(), np.eye(4), atol=1e-12)
    Ad = b_from_a.AdjointMap()
    np.testing.assert_allclose(back_cov / unit, Ad @ cov @ Ad.T / unit, atol=1e-6)


def test_covariance_is_that_of_the_derivatives_also_of_large_deformations():
    poses, moved = chain(), chain()
    moved[2] = moved[2] @ small([0.5, -0.4, 0.3, 0.2, 0.3, -0.1])
    rng = np.random.default_rng(2)
    epochs = [adjusted(measured(p, rng)) for p in (poses, moved)]
    d = next(d for d in station_deformations(*epochs) if (d.a, d.b) == ("S2", "S3"))
    (P1, C1), (P2, C2) = (relative_pose(e, "S2", "S3") for e in epochs)

    def at(x):
        D = np.linalg.inv(P1.matrix() @ small(x[:6])) @ P2.matrix() @ small(x[6:])
        R = Rotation.from_matrix(D[:3, :3])
        return np.r_[R.as_rotvec(), D[:3, 3], R.as_euler("ZYX")[::-1]]

    assert np.abs(d.rotation).max() > 0.3
    np.testing.assert_allclose(np.r_[d.rotation, d.displacement, d.euler_zyx], at(np.zeros(12)), atol=1e-12)
    J = np.stack([(at(h) - at(-h)) / 2e-5 for h in np.eye(12) * 1e-5], axis=1)
    zero = np.zeros((6, 6))
    expected = J @ np.block([[C1, zero], [zero, C2]]) @ J.T
    scale = np.outer(*(np.sqrt(np.diag(expected)),) * 2)
    np.testing.assert_allclose(d.cov / scale[:6, :6], expected[:6, :6] / scale[:6, :6], atol=1e-6)
    np.testing.assert_allclose(d.euler_cov / scale[6:, 6:], expected[6:, 6:] / scale[6:, 6:], atol=1e-6)


@pytest.mark.slow
def test_without_deformation_the_tests_are_chi_square():
    poses, rng, n = chain(), np.random.default_rng(3), size(200, 25)
    draws = [station_deformations(adjusted(measured(poses, rng)), adjusted(measured(poses, rng))) for _ in range(n)]
    for k in range(5):
        for name, freedom in (("rotation_test", 3), ("displacement_test", 3), ("test", 6)):
            total = sum(getattr(draw[k], name).statistic for draw in draws)
            lower, upper = chi2.ppf([5e-4, 1 - 5e-4], n * freedom)
            assert lower < total < upper, (k, name)
    false = sum(any(d.significant for d in draw) for draw in draws)
    assert false <= 0.05 * n + 4.0 * np.sqrt(0.05 * 0.95 * n)  # 5 % for the whole family, and four sigmas more


@pytest.mark.parametrize("through", [lambda s: s, with_a_point], ids=["network", "graph"])
def test_a_station_that_turned_and_moved_is_found_at_its_two_relations(through):
    poses, moved, rng = chain(), chain(), np.random.default_rng(4)
    xi = np.r_[0, 0, np.radians(60 / 3600), 5e-4, 0, 0]
    moved[3] = moved[3] @ small(xi)
    first, second = (adjusted(through(measured(p, rng))) for p in (poses, moved))
    found = station_deformations(first, second)
    assert [(d.a, d.b) for d in found if d.significant] == [("S2", "S3"), ("S3", "S4")]
    own = found[3]  # of S3, in its own frame: just what was planted
    miss = np.r_[own.rotation, own.displacement] - xi
    assert miss @ np.linalg.solve(own.cov, miss) < chi2.ppf(0.999, 6)
    assert max(own.rotation_test.p, own.displacement_test.p) < 1e-3


@pytest.mark.parametrize("through", [lambda s: s, with_a_point], ids=["network", "graph"])
def test_the_datum_makes_no_difference(through):
    poses, moved = chain(), chain()
    moved[3] = moved[3] @ small([0, 0, 3e-4, 5e-4, 0, 0])
    held = [0, 4] if through is with_a_point else [0, 4, None]
    first = [adjusted(through(measured(poses, np.random.default_rng(6), held=h))) for h in held]
    second = [adjusted(through(measured(moved, np.random.default_rng(7), held=h))) for h in held]
    expected = station_deformations(first[0], second[0])
    for other in second[1:]:
        for d, e in zip(station_deformations(first[1], other), expected, strict=True):
            np.testing.assert_allclose(np.r_[d.rotation, d.displacement], np.r_[e.rotation, e.displacement], atol=1e-9)
            np.testing.assert_allclose(d.cov / np.outer(SIGMAS, SIGMAS), e.cov / np.outer(SIGMAS, SIGMAS), atol=1e-6)
            assert d.test.statistic == pytest.approx(e.test.statistic, rel=1e-5)


def test_networks_of_rotations_know_no_displacement():
    rng = np.random.default_rng(8)
    moved = chain()
    moved[3] = moved[3] @ small([0, 0, 5e-4, 5e-4, 0, 0])
    turned = [adjusted(measured(p, rng, rotations=True)) for p in (chain(), moved)]
    whole = adjusted(measured(chain(), rng))
    for first in (turned[0], whole):
        found = station_deformations(first, turned[1])
        assert [(d.a, d.b) for d in found if d.significant] == [("S2", "S3"), ("S3", "S4")]
        for d in found:
            assert np.isnan(d.displacement).all()
            assert np.isfinite(d.cov[:3, :3]).all()
            assert (d.displacement_test.freedom, d.test) == (0, d.rotation_test)


def test_scaling_multiplies_with_sigma0_squared_of_its_epoch():
    rng = np.random.default_rng(9)
    epochs = [adjusted(measured(chain(), rng)) for _ in range(2)]
    plain, both = (station_deformations(*epochs, scale=(s, s))[0].cov for s in (False, True))
    unit, total = np.outer(SIGMAS, SIGMAS), plain
    for epoch, scale in zip(epochs, ((True, False), (False, True)), strict=True):
        more = station_deformations(*epochs, scale=scale)[0].cov - plain
        # hardly deformed: what an epoch adds is the covariance of its own relative pose, but for the noise's rotation
        own = (epoch.sigma0**2 - 1.0) * relative_pose(epoch, "S0", "S1")[1]
        np.testing.assert_allclose(more / unit, own / unit, atol=1e-3)
        total = total + more
    np.testing.assert_allclose(both / unit, total / unit, atol=1e-9)


def test_held_stations_have_no_error_and_no_test():
    poses = chain()
    survey = measured(poses, np.random.default_rng(10))
    stations = list(survey.stations)
    stations[1] = Station("S1", world_from_station=PoseParameter(Pose3(poses[1]), "held"))
    result = adjusted(replace(survey, stations=tuple(stations)))
    np.testing.assert_array_equal(relative_pose(result, "S0", "S1")[1], np.zeros((6, 6)))
    first = station_deformations(result, result)[0]
    assert (first.test.freedom, first.significant) == (0, False)
    assert np.isnan(first.test.p)


def test_what_cannot_be_compared_is_said():
    result = adjusted(measured(chain(), np.random.default_rng(11)))
    with pytest.raises(SurveyError, match="'X' was not adjusted as a fixed station; fixed stations: S0, S1"):
        relative_pose(result, "S0", "X")
    with pytest.raises(SurveyError, match="to itself"):
        relative_pose(result, "S0", "S0")
    pose = PoseParameter(Pose3(Rot3(), np.zeros(3)), "held")
    ref = [FrameRef("station", i) for i in ("S0", "Y")]
    stations = (Station("S0", world_from_station=pose), Station("Y"))
    other = adjusted(Survey(stations=stations, pairs=(Pair("p", *ref, Pose3(), np.eye(6)),)))
    with pytest.raises(SurveyError, match="only 'S0' in common"):
        station_deformations(result, other)
