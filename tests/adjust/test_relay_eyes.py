"""Eyes of a station from poses, motions, known targets, marker blocks and images."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.survey import FloatArray
from adjust.relay.eyes.eyes import EyeOptions, adjust_eyes
from adjust.relay.eyes.images import camera_sequence, eye_sequences, target_sequence
from adjust.relay.eyes.pairs import close_loops, pairs_of, triangle_misclosure
from adjust.relay.eyes.sequences import EyeSequence
from adjust.relay.eyes.setup import eye_setup
from adjust.relay.eyes.solver import EyeProblem, linearise
from adjust.spatial.rigid_motions import Motions
from tests.adjust.relay_networks import ends
from tests.adjust.relay_station import EYES, Station4, Trackers, motions, poses, random_rigid
from tests.sizes import size


def exact(sequence: EyeSequence, trackers: Trackers, eye: int) -> EyeSequence:
    """The sequence without noise."""
    return replace(sequence, reference_from_eye=motions(trackers.poses(eye)))


def motion_sequences(trackers: Trackers, sigma_rad: float, sigma_m: float) -> list[EyeSequence]:
    """Motions between neighbouring epochs, each with noise of its own."""
    out, sigma = [], np.repeat([sigma_rad, sigma_m], 3)
    for eye in range(len(trackers.station_from_eye)):
        P = trackers.poses(eye)
        true = np.linalg.inv(P[:-1]) @ P[1:]
        noisy = np.array([m @ Pose3.Expmap(sigma * trackers.rng.normal(size=6)).matrix() for m in true])
        cov = np.broadcast_to(np.diag(sigma**2), (len(true), 6, 6)).copy()
        ids = tuple(f"i{i}" for i in range(len(true)))
        out.append(EyeSequence(FrameRef("camera", "abcdef"[eye]), ids, motions(noisy), cov))
    return out


def error(found: Motions, true: FloatArray) -> FloatArray:
    """Tangents (k, 6) of the errors of eyes."""
    return np.asarray((motions(true).inverse() @ found).log())


# -- closed form -------------------------------------------------------------------------------------------------------


def test_poses_without_noise_give_the_truth() -> None:
    trackers = Trackers(3)
    sequences = [exact(s, trackers, i) for i, s in enumerate(trackers.measured())]
    found = adjust_eyes(sequences)
    assert np.abs(error(found.station_from_eye, trackers.station_from_eye)).max() < 1e-11
    assert found.omega < 1e-12
    room = found.room_from_world["wa"].inverse().compose(found.room_from_world["wc"])
    assert room.equals(Pose3(np.linalg.inv(trackers.room_from_world[0]) @ trackers.room_from_world[2]), 1e-10)


def test_motions_without_noise_give_the_truth() -> None:
    trackers = Trackers(4)
    found = adjust_eyes([replace(s, cov=s.cov + 1e-8 * np.eye(6)) for s in motion_sequences(trackers, 0.0, 0.0)])
    assert np.abs(error(found.station_from_eye, trackers.station_from_eye)).max() < 1e-10


@pytest.mark.slow
@pytest.mark.parametrize("scaled", [False, True])
def test_derivatives_away_from_zero_error(scaled: bool) -> None:
    trackers = Trackers(5, n=4)
    problems: list[EyeProblem] = [eye_setup(motion_sequences(trackers, 0.02, 0.05), free_scales=scaled).problem]
    if not scaled:
        problems.append(eye_setup(trackers.measured(0.02, 0.05)).problem)
    for problem in problems:
        everything = np.ones(len(problem.free), dtype=np.bool_)
        _check_derivatives(replace(problem, free=everything), trackers.rng)


def _check_derivatives(problem: EyeProblem, rng: np.random.Generator) -> None:
    v, scales = rng.normal(0, 0.1, (len(problem.observed), 6)), rng.normal(0, 0.1, problem.n_scales)
    U = problem.start.retract(rng.normal(0, 0.2, (len(problem.start), 6)))
    at, h = linearise(problem, U, scales, v), 1e-6
    n_free = 6 * int(problem.free.sum())

    def by(move: Callable[[float], FloatArray]) -> FloatArray:
        return np.asarray((move(h) - move(-h)).ravel() / (2 * h))

    for column in range(at.by.shape[1]):
        step = np.zeros(at.by.shape[1])
        step[column] = 1.0

        def moved(x: float, step: FloatArray = step) -> FloatArray:
            delta = np.zeros((len(U), 6))
            delta[problem.free] = x * step[:n_free].reshape(-1, 6)
            return linearise(problem, U.retract(delta), scales + x * step[n_free:], v).f

        assert np.abs(by(moved) - at.by[:, column]).max() < 1e-7
    for obs in range(len(problem.observed)):
        for component in range(6):
            one = np.zeros_like(v)
            one[obs, component] = 1.0
            numeric = by(lambda x, one=one: linearise(problem, U, scales, v + x * one).f).reshape(-1, 6)
            analytic = np.zeros_like(numeric)
            for idx, D in ((problem.conditions.k_idx, at.by_k), (problem.conditions.l_idx, at.by_l)):
                analytic[idx == obs] += D[idx == obs][:, :, component]
            assert np.abs(numeric - analytic).max() < 1e-7


# -- least squares -----------------------------------------------------------------------------------------------------


def test_minimum_is_that_of_all_true_poses_as_unknowns() -> None:
    """The conditions' minimum against SciPy's over station poses, eyes and worlds, with noise large enough to tell."""
    trackers = Trackers(6, n=6)
    sequences = trackers.measured(0.01, 0.02)
    found = adjust_eyes(sequences, EyeOptions(reject=False))
    k, n = 3, 6
    measured = [poses(s.reference_from_eye) for s in sequences]
    roots = [np.linalg.inv(np.linalg.cholesky(s.cov)) for s in sequences]

    def moved(start: FloatArray, d: FloatArray) -> list[Pose3]:
        return [Pose3(m).compose(Pose3.Expmap(e)) for m, e in zip(start, d, strict=True)]

    def residual(x: FloatArray) -> FloatArray:
        d = x.reshape(-1, 6)
        S = moved(trackers.room_from_station, d[:n])
        X = [
            Pose3(m).compose(Pose3.Expmap(e))
            for m, e in zip(trackers.station_from_eye[1:], d[n : n + k - 1], strict=True)
        ]
        W = [
            Pose3(m).compose(Pose3.Expmap(e)) for m, e in zip(trackers.room_from_world[1:], d[n + k - 1 :], strict=True)
        ]
        X, W = [Pose3(), *X], [Pose3(), *W]
        out = [
            roots[i][j] @ Pose3.Logmap(measured[i][j].between(W[i].inverse().compose(S[j]).compose(X[i])))
            for i in range(k)
            for j in range(n)
        ]
        return np.concatenate(out)

    best = least_squares(residual, np.zeros(6 * (n + 2 * (k - 1))), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    assert found.omega == pytest.approx(2 * best.cost, rel=1e-7)
    assert found.redundancy == 6 * (k * n - n - 2 * (k - 1))
    dense = np.linalg.inv(best.jac.T @ best.jac)[6 * n : 6 * (n + k - 1), 6 * n : 6 * (n + k - 1)]
    assert np.sqrt(np.diag(found.cov)[6:]) == pytest.approx(
        np.sqrt(np.diag(dense)), rel=0.02
    )  # other linearisation points


def test_covariance_is_the_scatter() -> None:
    trackers = Trackers(7)
    tests, omegas, pair_tests, n = [], [], [], size(60, 10)
    for _ in range(n):
        found = adjust_eyes(trackers.measured())
        d = error(found.station_from_eye, trackers.station_from_eye)[1:].ravel()
        tests.append(d @ np.linalg.solve(found.cov[6:, 6:], d))
        omegas.append(found.omega)
        pair = found.pair("b", "c")
        true = Pose3(np.linalg.inv(trackers.station_from_eye[2]) @ trackers.station_from_eye[1])
        assert isinstance(pair.b_from_a, Pose3)
        e = Pose3.Logmap(true.between(pair.b_from_a))
        pair_tests.append(e @ np.linalg.solve(pair.cov, e))
    for values, freedom in ((tests, 12), (omegas, found.redundancy), (pair_tests, 6)):
        assert chi2.ppf(0.0005, n * freedom) < np.sum(values) < chi2.ppf(0.9995, n * freedom)


def test_motions_covariance_is_the_scatter() -> None:
    tests, n = [], size(40, 10)
    for seed in range(n):
        trackers = Trackers(100 + seed)
        found = adjust_eyes(motion_sequences(trackers, 1e-3, 2e-3))
        d = error(found.station_from_eye, trackers.station_from_eye)[1:].ravel()
        tests.append(d @ np.linalg.solve(found.cov[6:, 6:], d))
    assert chi2.ppf(0.0005, n * 12) < np.sum(tests) < chi2.ppf(0.9995, n * 12)


def test_joint_covariance_given_as_a_whole_is_the_same() -> None:
    trackers = Trackers(8)
    blocks = trackers.measured()
    full = []
    for s in blocks:
        Q = np.zeros((len(s.cov), 6, len(s.cov), 6))
        Q[np.arange(len(s.cov)), :, np.arange(len(s.cov))] = s.cov
        full.append(replace(s, cov=Q.reshape(6 * len(s.cov), -1)))
    a, b = adjust_eyes(blocks), adjust_eyes(full)
    assert np.allclose(a.cov, b.cov, rtol=1e-6, atol=1e-16)
    assert np.allclose(a.solution.test, b.solution.test, rtol=1e-5)


def test_eyes_that_see_several_worlds_and_not_at_all_epochs() -> None:
    """Eye a is blind at first, so that eye b leads there; eye c looks at another target from the middle on."""
    tests, n = [], size(30, 8)
    for seed in range(n):
        trackers = Trackers(200 + seed, n=14)
        a, b, c = trackers.measured()
        late = slice(5, None)
        a = replace(
            a,
            epoch_ids=a.epoch_ids[5:],
            world_ids=a.world_ids[5:],
            reference_from_eye=a.reference_from_eye[late],
            cov=a.cov[late],
        )
        other = motions(random_rigid(trackers.rng, 1, 2.0, 3.0))
        seen = c.reference_from_eye.where(np.arange(14) < 7, other @ c.reference_from_eye)
        c = replace(c, world_ids=("wc",) * 7 + ("wd",) * 7, reference_from_eye=seen)
        found = adjust_eyes((a, b, c))
        assert found.redundancy == 6 * (9 + 14 - 2 - 3)
        d = error(found.station_from_eye, trackers.station_from_eye)[1:].ravel()
        tests.append(d @ np.linalg.solve(found.cov[6:, 6:], d))
        between = found.room_from_world["wd"].inverse().compose(found.room_from_world["wc"])
        assert between.equals(poses(other)[0], 0.02)
    assert chi2.ppf(0.0005, n * 12) < np.sum(tests) < chi2.ppf(0.9995, n * 12)


def test_influence_is_the_derivative() -> None:
    trackers = Trackers(9, n=5)
    sequences = trackers.measured(1e-6, 1e-6)
    found = adjust_eyes(sequences, EyeOptions(reject=False))
    step = np.zeros((5, 6))
    step[2] = [1e-5, -2e-5, 3e-5, 1e-4, 2e-4, -1e-4]
    moved = [replace(sequences[0], reference_from_eye=sequences[0].reference_from_eye.retract(step)), *sequences[1:]]
    again = adjust_eyes(moved, EyeOptions(reject=False))
    predicted = found.by_observation()[:, :30] @ step.ravel()
    actual = (found.station_from_eye.inverse() @ again.station_from_eye).log().ravel()
    assert np.abs(actual - predicted).max() < 2e-3 * np.abs(predicted).max()


# -- what is refused ---------------------------------------------------------------------------------------------------


def _about(axis: FloatArray, seed: int, n: int = 10) -> Trackers:
    trackers = Trackers(seed, k=2, n=n)
    turns = np.linspace(-0.6, 0.6, n)
    for i, turn in enumerate(turns):
        trackers.room_from_station[i, :3, :3] = Rotation.from_rotvec(turn * axis).as_matrix()
    return trackers


def test_parallel_axes_are_named() -> None:
    axis = np.array([0.6, 0.0, 0.8])
    with pytest.raises(
        SurveyError, match=r"eyes a and b.*one direction \(([+-]0\.600), ([+-]0\.00\d), ([+-]0\.80\d)\)"
    ):
        adjust_eyes(_about(axis, 11).measured(1e-5, 1e-4))


def test_a_second_axis_below_the_noise_is_no_axis() -> None:
    trackers = _about(np.array([0.0, 0.0, 1.0]), 12)
    wobble = Rotation.from_rotvec(np.random.default_rng(1).normal(0, 0.02, (10, 3))).as_matrix()
    trackers.room_from_station[:, :3, :3] = trackers.room_from_station[:, :3, :3] @ wobble
    assert adjust_eyes(trackers.measured(1e-4, 1e-4)).redundancy == 6 * 8
    with pytest.raises(SurveyError, match="undetermined"):
        adjust_eyes(trackers.measured(1e-2, 1e-4))


def test_small_turns_are_refused() -> None:
    with pytest.raises(SurveyError, match=r"eyes a and b: the largest of .* turns is 0\.\d+ deg"):
        adjust_eyes(Trackers(13, k=2, turn_rad=0.004).measured(1e-5, 1e-4))


def test_no_common_epoch_is_refused() -> None:
    a, b = Trackers(14, k=2).measured()
    with pytest.raises(SurveyError, match="no epoch is common"):
        adjust_eyes((a, replace(b, epoch_ids=tuple(f"x{i}" for i in range(12)))))


def test_wrong_epochs_are_found_and_listed() -> None:
    trackers = Trackers(15, n=14)
    sequences = trackers.measured()
    step = np.zeros((14, 6))
    step[3, 0], step[9, 4] = 30e-4, 30e-3  # 30 sigmas
    moved = sequences[1].reference_from_eye.retract(step)
    bad = [sequences[0], replace(sequences[1], reference_from_eye=moved), sequences[2]]
    found = adjust_eyes(bad)
    assert {(o.epoch_id, o.a_id, o.b_id) for o in found.outliers} == {("e3", "a", "b"), ("e9", "a", "b")}
    assert "left out" in str(found.outliers[0])
    d = error(found.station_from_eye, trackers.station_from_eye)[1:].ravel()
    assert d @ np.linalg.solve(found.cov[6:, 6:], d) < chi2.ppf(0.9999, 12)
    test = found.global_test(0.001)
    assert test is not None
    assert test.passed


def test_different_targets_of_one_epoch_are_refused_and_the_same_one_helps() -> None:
    with pytest.raises(SurveyError, match="nothing turns"):
        adjust_eyes(Trackers(16, k=2, n=1).measured())
    trackers = Trackers(17, k=2, n=6)
    trackers.room_from_world[1] = np.eye(4)
    sequences = trackers.measured()
    alone = adjust_eyes(sequences)
    same = adjust_eyes([replace(s, world_ids=("w",) * 6) for s in sequences])
    assert np.all(np.diag(same.cov)[6:] < np.diag(alone.cov)[6:])


# -- from images -------------------------------------------------------------------------------------------------------


def _joint_pair(result: object, a: str, b: str) -> tuple[Pose3, FloatArray]:
    estimates, precision = result.estimates, result.precision
    X = {e: estimates["station_from_camera", e].value for e in (a, b)}
    free = [e for e in (a, b) if e != "a"]
    C = np.zeros((12, 12))
    at = np.concatenate([6 * (a, b).index(e) + np.arange(6) for e in free])
    C[np.ix_(at, at)] = precision.joint([("station_from_camera", e) for e in free])
    b_from_a = X[b].between(X[a])
    J = np.hstack([np.eye(6), -b_from_a.inverse().AdjointMap()])
    return b_from_a, J @ C @ J.T


@pytest.mark.slow
@pytest.mark.parametrize("free", [(), ("fx", "u0", "v0")])
def test_what_condensing_costs(free: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """Pairs one by one lose what they share; poses with their joint covariance lose nothing."""
    station = Station4(1)
    survey = station.survey(2, 0.005, free)
    joint = adjust(survey)
    sequences = eye_sequences(survey)
    found = pairs_of(sequences)
    assert not found.refused
    assert len(found.pairs) == 6
    closed, complete = close_loops(found), adjust_eyes(sequences)
    lines = ["pair   alone  closed: claimed  actual   all poses jointly: sigma ratio-1, difference/sigma"]
    for i, pair in enumerate(found.pairs):
        a, b = pair.a.frame_id, pair.b.frame_id
        value, cov = _joint_pair(joint, a, b)
        sigma = np.sqrt(np.diag(cov))
        ratio = [
            float(np.mean(np.sqrt(np.diag(Q)) / sigma)) for Q in (pair.cov, closed.claimed_cov[i], closed.actual_cov[i])
        ]
        whole = complete.pair(a, b)
        assert isinstance(whole.b_from_a, Pose3)
        more = float(np.abs(np.sqrt(np.diag(whole.cov)) / sigma - 1).max())
        off = float(np.abs(Pose3.Logmap(value.between(whole.b_from_a)) / sigma).max())
        lines.append(f"{a}-{b}  {ratio[0]:6.2f}   {ratio[1]:6.3f}       {ratio[2]:6.3f}   {more:12.1e} {off:12.1e}")
        assert ratio[0] > 1.5
        assert ratio[0] > ratio[2] > ratio[1] > 1.05
        # second order in the image noise: ten times less with ten times less noise
        assert more < 1e-4
        assert off < 1e-3
    with capsys.disabled():
        print("\n" + "\n".join(lines))


@pytest.mark.slow
def test_condensing_costs_nothing_in_the_limit_of_small_noise() -> None:
    off = []
    for sigma_px in (5e-2, 5e-4, 5e-5):
        survey = Station4(1).survey(2, sigma_px)
        joint, complete = adjust(survey), adjust_eyes(eye_sequences(survey))
        worst = 0.0
        for a, b in (("a", "c"), ("b", "d")):
            value, cov = _joint_pair(joint, a, b)
            whole = complete.pair(a, b).b_from_a
            assert isinstance(whole, Pose3)
            worst = max(worst, float(np.abs(Pose3.Logmap(value.between(whole)) / np.sqrt(np.diag(cov))).max()))
        off.append(worst)
    assert off[2] < 2e-6  # at 5e-5 px: rounding, not noise, is all that is left below
    assert off[1] < 0.03 * off[0]


@pytest.mark.slow
def test_actual_covariance_of_closed_loops_is_the_scatter() -> None:
    """The covariance claimed by the loops is too small, the one that counts shared errors is right."""
    actual, claimed, n = [], [], size(20, 6)
    station = Station4(5, n_epochs=8)
    for seed in range(n):
        closed = close_loops(pairs_of(eye_sequences(station.survey(seed, 0.05))))
        adjusted = closed.adjusted.pairs
        for i in (0, 4):
            pair = ends(adjusted.network.topology, i)
            true = station.pair(pair[0][7:], pair[1][7:])
            value = poses(adjusted.b_from_a)[i]
            d = Pose3.Logmap(true.between(value))
            actual.append(d @ np.linalg.solve(closed.actual_cov[i], d))
            claimed.append(d @ np.linalg.solve(closed.claimed_cov[i], d))
    # the two pairs of a draw are correlated: the band is that of one
    low, high = (2 * chi2.ppf(p, n * 6) for p in (0.0005, 0.9995))
    assert low < np.sum(actual) < high
    assert np.sum(claimed) > 1.15 * np.sum(actual)


def test_pairs_of_one_station_share_their_errors() -> None:
    found = pairs_of(Trackers(19, n=9).measured())
    f, own, shared = triangle_misclosure(found, "a", "b", "c")
    assert np.trace(shared) < 0.5 * np.trace(own)
    assert f @ np.linalg.solve(shared, f) < chi2.ppf(0.9999, 6)


def test_pairs_from_images_and_what_they_need() -> None:
    survey = Station4(20).survey(3, 0.05)
    pairs = pairs_of(eye_sequences(survey, "relay")).pairs
    assert [p.pair_id for p in pairs] == [f"{a}-{b}" for i, a in enumerate(EYES) for b in EYES[i + 1 :]]
    with pytest.raises(SurveyError, match="has no camera"):
        eye_sequences(survey, "other")
    with pytest.raises(SurveyError, match="not part of the survey"):
        camera_sequence(survey, "x")
    with pytest.raises(SurveyError, match="target 'x' is not part of the survey"):
        target_sequence(survey, "x")
    with pytest.raises(SurveyError, match="no camera of another station that stands still has seen it"):
        target_sequence(survey, "Ta")
    moving = replace(survey, targets=tuple(replace(t, motion="epoch") for t in survey.targets))
    with pytest.raises(SurveyError, match="moves between epochs"):
        eye_sequences(moving)
