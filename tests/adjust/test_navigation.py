"""Navigation: the minimal problem, derivatives, pose fit and its covariance, motion, identification."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.spatial.transform import Rotation

from adjust.model.errors import SurveyError
from adjust.model.survey import TABLE_GEOMETRY
from adjust.native.navigation import three_point_poses
from adjust.navigation import Motion, NavigateOptions, NavigationEpoch, PosePrior, Spots, expected_precision, navigate
from adjust.navigation.fit import local, local_derivative
from adjust.navigation.motion import MotionState, predicted, table_prior
from adjust.navigation.system import evaluate, make_system, square_root
from adjust.spatial.rigid import rigid, rotation_exp
from tests.adjust.navigation import (
    Sight,
    drawn,
    mfns_head,
    pose_error,
    printed_beacons,
    scattered_beacons,
    simulated,
    turned,
    wide_head,
    with_table,
)

ALONE = NavigateOptions(motion=None)


def retract(pose, step):
    """The inverse of ``local``."""
    return pose @ rigid(rotation_exp(step[:3]), step[3:])


@pytest.mark.parametrize("centres", [3, 2, 1])
def test_minimal_problem_finds_the_true_pose_among_exact_ones(centres):
    rng = np.random.default_rng(centres)
    several = 0
    for _ in range(300):
        true, shift = Rotation.random(random_state=rng).as_matrix(), rng.normal(size=3)
        p = rng.uniform(-1, 1, (3, 3))
        o = rng.uniform(-0.1, 0.1, (3, 3))[np.minimum(np.arange(3), centres - 1)]
        d = (p - o) / np.linalg.norm(p - o, axis=1)[:, None]
        x = p @ true.T + shift
        R, t = three_point_poses(o, d, x, 0.0, 50.0)
        several += len(R) > 1
        assert min(np.abs(R - true).max(axis=(1, 2)), default=1.0) < 1e-6
        for Ri, ti in zip(R, t, strict=True):
            q = (x - ti) @ Ri - o
            np.testing.assert_allclose(q / np.linalg.norm(q, axis=1)[:, None], d, atol=1e-8)
    assert several > 30


def test_points_on_a_line_have_no_minimal_solution():
    x = np.array([[0.0, 0, 1], [0, 0, 2], [0, 0, 3]])
    d = np.array([[0.0, 0, 1], [0, 0.6, 0.8], [0.6, 0, 0.8]])
    assert len(three_point_poses(np.zeros((3, 3)), d, x, 0.0, 50.0)[0]) == 0


def test_rows_are_the_derivatives():
    head, beacons = mfns_head(), printed_beacons()
    system = make_system(head, beacons)
    pose = turned(0.2, (0.01, -0.02), (0.01, 0.02, 0.03)).matrix()
    camera, beacon = np.array([0, 1, 2]), np.array([8, 6, 9])
    uv = np.array([[600.0, 400], [700, 500], [650, 450]])
    residual, H, M = evaluate(system, pose, camera, beacon, uv)
    for j, h in enumerate(np.eye(6) * 1e-6):
        up, down = (evaluate(system, retract(pose, s * h), camera, beacon, uv)[0] for s in (1, -1))
        np.testing.assert_allclose((up - down) / 2e-6, H[:, j], rtol=1e-5, atol=1e-3)
    # M against beacons and cameras moved by one unit error each
    for k in (0, 10, 40, system.F.shape[1] - 1):
        step = 1e-3 * system.F[:, k]
        sides = [evaluate(make_system(*_moved(head, beacons, s * step)), pose, camera, beacon, uv)[0] for s in (1, -1)]
        np.testing.assert_allclose((sides[0] - sides[1]) / 2e-3, M[:, k], rtol=1e-4, atol=1e-5)
    assert residual.shape == (6,)


def _moved(head, beacons, step):
    cameras, at = [], 0
    for c in head.cameras:
        pose = retract(c.station_from_camera.matrix(), step[at + 13 : at + 19])
        cameras.append(replace(c, lens=c.lens + step[at : at + 13], station_from_camera=Pose3(pose)))
        at += 19
    return replace(head, cameras=tuple(cameras)), replace(
        beacons, x_in_world=beacons.x_in_world + step[at:].reshape(-1, 3)
    )


@pytest.mark.parametrize("size", [1e-9, 1e-3, 1.0, 3.1])
def test_steps_are_those_of_the_closed_forms(size):
    rng = np.random.default_rng(4)
    a = rigid(rotation_exp(rng.normal(size=3)), rng.normal(size=3))
    w = rng.normal(size=3)
    step = np.concatenate([size * w / np.linalg.norm(w), rng.normal(size=3)])
    b = a @ rigid(rotation_exp(step[:3]), step[3:])
    np.testing.assert_allclose(retract(a, step), b, atol=1e-14)
    np.testing.assert_allclose(local(a, b), step, rtol=1e-9, atol=1e-14)


def test_derivative_of_the_step_between_poses():
    rng = np.random.default_rng(1)
    a, b = (rigid(rotation_exp(rng.normal(size=3) * 0.8), rng.normal(size=3)) for _ in range(2))
    J = local_derivative(local(a, b))
    for j, h in enumerate(np.eye(6) * 1e-6):
        numeric = (local(a, retract(b, h)) - local(a, retract(b, -h))) / 2e-6
        np.testing.assert_allclose(J[:, j], numeric, atol=1e-7)


def _geometry(values):
    return dict(zip(TABLE_GEOMETRY, values, strict=True))


def test_table_prior_is_the_chain_and_its_errors():
    head = with_table(mfns_head(), 0.05, 0.3)
    head = replace(head, table=replace(head.table, geometry=_geometry([0.01, 0.002, 0.1, -0.2])))
    system = make_system(head, printed_beacons())
    epoch = NavigationEpoch("e", (), table_angles=np.array([0.3, 0.7]), table_cov=np.eye(2) * 1e-8)
    prior = table_prior(system, epoch)
    shift = np.eye(4)
    shift[1, 3] = 0.002
    x, y, z = np.eye(3)
    turn = [rigid(rotation_exp(v), np.zeros(3)) for v in (0.4 * x, 0.01 * y, 0.5 * z)]
    np.testing.assert_allclose(prior.pose, turn[0] @ shift @ turn[1] @ turn[2], atol=1e-12)
    assert np.sqrt(np.diag(prior.total)[3:]) == pytest.approx(3e-4, rel=0.01)
    assert prior.cov[2, 2] == pytest.approx(1e-8, rel=1e-3)


@pytest.mark.parametrize("which", range(4))
def test_table_geometry_errors_reach_the_pose(which):
    head = with_table(mfns_head(), 0.0, 0.0)
    mount = Pose3(rigid(rotation_exp(np.array([0.1, 0.2, 0.3])), np.array([0.1, 0.2, 0.3])))
    cov = head.cov.copy()
    cov[-10 + which, -10 + which] = 1e-6
    epoch = NavigationEpoch("e", (), table_angles=np.array([0.3, 0.7]))
    priors = []
    for step in (0.0, 1e-3):
        values = np.array([0.01, 0.002, 0.1, -0.2]) + step * np.eye(4)[which]
        geometry = _geometry(values.tolist())
        table = replace(head.table, geometry=geometry, mount_from_station=mount)
        priors.append(table_prior(make_system(replace(head, cov=cov, table=table), printed_beacons()), epoch))
    moved = local(priors[0].pose, priors[1].pose)
    np.testing.assert_allclose(np.sqrt(np.diag(priors[0].total)), np.abs(moved), rtol=1e-2, atol=2e-7)


def test_motion_at_constant_rates_is_a_screw():
    state = MotionState(0.0, np.eye(4), np.array([0, 0, 0.3, 0.1, 0, 0]), np.eye(12) * 1e-6, np.zeros((12, 2)))
    there = predicted(state, 2.0, Motion(0.0, 0.0))
    np.testing.assert_allclose(there.pose, Pose3.Expmap(2 * state.rate).matrix(), atol=1e-12)
    back = predicted(there, 0.0, Motion(0.0, 0.0))
    np.testing.assert_allclose(back.pose, np.eye(4), atol=1e-12)
    np.testing.assert_allclose(back.P, state.P, atol=1e-15)
    # the pose's share of an error of the rates, numerically
    h = 1e-6
    moved = [Pose3.Expmap(2 * (state.rate + s * h * np.eye(6)[1])) for s in (1, -1)]
    numeric = Pose3.Logmap(moved[1].between(moved[0])) / (2 * h)
    A = predicted(replace(state, P=np.diag(np.eye(12)[7])), 2.0, Motion(0.0, 0.0)).P[:6, :6]
    np.testing.assert_allclose(A, np.outer(numeric, numeric), atol=1e-6)


def test_shares_add_up_and_noise_shrinks_only_its_own():
    head, beacons = wide_head(), scattered_beacons(20)
    sharp, blunt = (expected_precision(head, beacons, [Pose3()], s)[0] for s in (0.1, 0.4))
    for e in (sharp, blunt):
        parts = e.shares.spots + e.shares.beacons + e.shares.calibration + e.shares.prior + e.shares.correlation
        np.testing.assert_allclose(parts, e.cov, rtol=1e-6, atol=1e-14)
    assert np.trace(sharp.shares.spots) < 0.2 * np.trace(blunt.shares.spots)
    assert np.all(np.diag(sharp.cov) < np.diag(blunt.cov))


@pytest.mark.parametrize("error", [(40.0, -30.0), (4.0, 4.0)])
def test_gross_error_is_found_at_its_spot(error):
    rng = np.random.default_rng(7)
    head, beacons = wide_head(), scattered_beacons(20)
    epoch, _ = simulated(head, beacons, turned(0.4), rng, Sight(0.2))
    uv = epoch.spots[1].uv.copy()
    uv[0] += error
    epoch = replace(epoch, spots=(epoch.spots[0], replace(epoch.spots[1], uv=uv), epoch.spots[2]))
    found = navigate(head, beacons, [epoch], ALONE).epochs[0]
    assert found.status == "fixed"
    assert found.labels[1][0] is None
    # the large one is not even a candidate; the small one has to fail its test
    assert found.rejected == ((("Y", 0),) if error[0] < 5 else ())
    assert np.abs(pose_error(found.world_from_station, turned(0.4)) / found.sigmas).max() < 5.0


@pytest.mark.parametrize("n_spots", [2, 1])
def test_open_directions_cost_nothing(n_spots):
    rng = np.random.default_rng(2)
    head, beacons = mfns_head(), printed_beacons()
    only = ("B9", "B10")[:n_spots]
    epoch, _ = simulated(head, beacons, turned(0.0), rng, Sight(1e-6, only=only))
    found = navigate(head, beacons, [epoch], ALONE).epochs[0]
    assert found.status == "undetermined"
    assert len(found.undetermined) == 6 - 2 * n_spots
    with_prior = replace(epoch, prior=PosePrior(Pose3(), np.diag([1e-4] * 3 + [1e-4] * 3)))
    held = navigate(head, beacons, [with_prior], ALONE).epochs[0]
    assert held.status == "bridged"
    assert held.bridge == "prior"
    assert np.isfinite(held.cov).all()


def test_motion_bridges_a_gap_with_growing_sigmas():
    rng = np.random.default_rng(3)
    head, beacons = wide_head(), scattered_beacons(20)
    true = drawn(head, beacons, rng)
    poses = [turned(0.02 * i) for i in range(20)]
    epochs = [
        simulated(*true, p, rng, Sight(0.2, named=False), f"e{i}", time_s=float(i))[0] for i, p in enumerate(poses)
    ]
    dark = [replace(e, spots=tuple(Spots(s.camera_id, s.uv[:0], s.cov[:0]) for s in e.spots)) if 10 <= i < 14 else e
            for i, e in enumerate(epochs)]  # fmt: skip
    found = navigate(head, beacons, dark, NavigateOptions(motion=Motion(0.005, 0.002, 0.2, 0.1))).epochs
    assert [e.status for e in found] == ["fixed"] * 10 + ["bridged"] * 4 + ["fixed"] * 6
    sigmas = np.array([e.sigmas for e in found[10:14]])
    assert np.all(np.diff(sigmas, axis=0) > 0)
    for e, pose in zip(found, poses, strict=True):
        d = pose_error(e.world_from_station, pose)
        assert d @ np.linalg.solve(e.cov, d) < 35.0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda h, b: (h, replace(b, beacon_ids=("B1",) * 10)), "named twice"),
        (lambda h, b: (replace(h, cov=np.eye(3)), b), "covariance of the calibration"),
        (lambda h, b: (h, replace(b, cov=b.cov - 1.0)), "variance of calibration or beacons is negative"),
        (lambda h, b: (h, replace(b, cov=b.cov - 1e-6 * (1 - np.eye(30)))), "negative eigenvalue"),
    ],
)
def test_what_is_wrong_is_named(change, words):
    with pytest.raises(SurveyError, match=words):
        make_system(*change(mfns_head(), printed_beacons()))


def test_unknown_names_are_refused():
    spots = Spots("X", np.array([[600.0, 500.0]]), np.eye(2)[None], ("B99",))
    with pytest.raises(SurveyError, match="B99 is no beacon"):
        navigate(mfns_head(), printed_beacons(), [NavigationEpoch("e", (spots,))])


def test_square_root():
    cov = np.diag([4.0, 0.0, 1e-8])
    F = square_root(cov)
    np.testing.assert_allclose(F @ F.T, cov, atol=1e-20)
    assert F.shape == (3, 2)
