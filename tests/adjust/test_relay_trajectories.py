"""Pairs from trajectories: do their sigmas cover? Simulated by plain lines of SciPy, of known drift and noise."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef
from adjust.model.survey import FloatArray
from adjust.relay.eyes.drift import fit_drift
from adjust.relay.eyes.trajectories import Trajectory, common_motions, time_offset
from adjust.spatial.rigid_motions import Motions
from survey.jobs.relay import relay_trackers, tracker_pairs
from tests.sizes import size

TURNS = [Rotation.identity(), Rotation.from_rotvec([0.1, 0.5, -0.2]), Rotation.from_rotvec([0.9, 0.0, 0.3])]
LEVERS = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.05], [0.0, 0.15, -0.1]])
RATES, CLOCKS = (30.0, 10.0, 15.0), (0.0, 0.37, -1.2)


def carried(t: FloatArray, how: FloatArray) -> tuple[Rotation, FloatArray]:
    """Attitudes and places (n, 3) m of the station at times (n,); how (2, 2, 3): phases and speeds."""
    (turn_at, way_at), speed = how
    turn = 0.6 * np.sin(np.array([0.97, 1.48, 2.29]) * speed[0] * t[:, None] + turn_at)
    return Rotation.from_rotvec(turn), 0.5 * np.sin(np.array([0.72, 1.16, 1.85]) * speed[1] * t[:, None] + way_at)


def drifted(R: FloatArray, x: FloatArray, dR: FloatArray, dx: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Dead reckoning: every small motion has errors dR (n - 1, 3, 3), dx (n - 1, 3) in the eye, which add up."""
    turn, way = [R[0]], [x[0]]
    for i, (turned, moved) in enumerate(zip(dR, dx, strict=True)):
        way.append(way[-1] + turn[-1] @ (R[i].T @ (x[i + 1] - x[i]) + moved))
        turn.append(turn[-1] @ R[i].T @ R[i + 1] @ turned)
    return np.array(turn), np.array(way)


def walk(rng: np.random.Generator, noise: FloatArray, drift: FloatArray, seconds: float = 40.0) -> list[Trajectory]:
    """Three trackers with clocks and rates of their own; noise, drift (2,): rad and m, of a pose, per root second."""
    how = np.stack([rng.uniform(0.0, 2.0 * np.pi, (2, 3)), rng.uniform(0.8, 1.2, (2, 3))])
    out = []
    for i, (rate, clock) in enumerate(zip(RATES, CLOCKS, strict=True)):
        t = np.arange(0.0, seconds, 1.0 / rate) + rng.uniform(0.0, 1.0 / rate)
        body, way = carried(t, how)
        step, n = drift / np.sqrt(rate), len(t)
        turned = Rotation.from_rotvec(step[0] * rng.standard_normal((n - 1, 3))).as_matrix()
        moved = step[1] * rng.standard_normal((n - 1, 3))
        R, x = drifted((body * TURNS[i]).as_matrix(), way + body.apply(LEVERS[i]), turned, moved)
        R = R @ Rotation.from_rotvec(noise[0] * rng.standard_normal((n, 3))).as_matrix()
        x = x + noise[1] * rng.standard_normal((n, 3))
        out.append(Trajectory(FrameRef("camera", "abc"[i]), t + clock, Motions(R, x)))
    return out


def true_pair(a: int, b: int) -> Pose3:
    """``b_from_a``."""
    turned = TURNS[b].inv()
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = (turned * TURNS[a]).as_matrix(), turned.apply(LEVERS[a] - LEVERS[b])
    return Pose3(matrix)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noise", "drift"), [((0.0, 0.0), (1e-3, 2e-3)), ((1e-3, 1e-3), (0.0, 0.0)), ((3e-4, 3e-4), (1e-3, 2e-3))]
)
def test_sigmas_of_pairs_cover_drift_and_noise(noise: tuple[float, float], drift: tuple[float, float]) -> None:
    tests, together, relative, n = [], [], [], size(100, 12)
    for seed in range(n):
        rng = np.random.default_rng([5, seed])
        found = tracker_pairs(relay_trackers(walk(rng, np.array(noise), np.array(drift))))
        assert [p.pair_id for p in found.pairs] == ["a-b", "a-c", "b-c"]
        errors = []
        for pair, (a, b) in zip(found.pairs, ((0, 1), (0, 2), (1, 2)), strict=True):
            assert isinstance(pair.b_from_a, Pose3)
            errors.append(Pose3.Logmap(true_pair(a, b).between(pair.b_from_a)))
            tests.append(errors[-1] @ np.linalg.solve(pair.cov, errors[-1]))
        e = np.concatenate(errors)
        relative.append(e / np.sqrt(np.diag(found.joint_cov)))
        together.append(e @ np.linalg.solve(found.joint_cov, e))  # also what pairs of one eye share
    low, high = chi2.ppf([1e-3, 0.999], 6 * n) / (6 * n)
    assert np.all(np.mean(np.reshape(tests, (n, 3)), axis=0) / 6.0 < 1.05 * high)  # drift itself is estimated
    assert np.all(np.mean(np.reshape(tests, (n, 3)), axis=0) / 6.0 > low)
    low, high = chi2.ppf([1e-4, 0.9999], n) / n
    assert np.all((low < np.mean(np.square(relative), axis=0)) & (np.mean(np.square(relative), axis=0) < 1.05 * high))
    low, high = chi2.ppf([1e-3, 0.999], 18 * n) / (18 * n)
    assert low < np.mean(together) / 18.0 < 1.1 * high


def test_poses_in_between_follow_the_motion() -> None:
    how = np.stack([np.full((2, 3), 0.4), np.ones((2, 3))])
    t, between = np.arange(0.0, 5.0, 0.1), np.arange(0.5, 4.5, 0.013)
    body, way = carried(t, how)
    found = Trajectory(FrameRef("camera", "a"), t, Motions(body.as_matrix(), way)).at(between)
    true, there = carried(between, how)
    assert (Rotation.from_matrix(found.rotation) * true.inv()).magnitude().max() < 2e-4  # straight: 3e-3 and 2e-3
    assert np.abs(found.shifts - there).max() < 1e-4


def test_uneven_times_do_not_enlarge_noise() -> None:
    rng = np.random.default_rng(2)
    t = np.cumsum(np.where(np.arange(200) % 3 == 1, 1e-5, 0.05))  # two poses nearly at once
    R = Rotation.from_rotvec(1e-3 * rng.standard_normal((200, 3))).as_matrix()
    found = Trajectory(FrameRef("camera", "a"), t, Motions(R, 1e-3 * rng.standard_normal((200, 3))))
    shown = found.at(np.linspace(t[2], t[-3], 2000)).shifts
    assert np.sqrt(np.mean(shown**2)) < 1.2e-3


@pytest.mark.slow
def test_a_tracker_without_noticeable_errors_is_no_failure() -> None:
    exact = walk(np.random.default_rng(8), np.zeros(2), np.zeros(2))
    common = common_motions(exact, CLOCKS, 1.0)
    found = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        e = np.repeat([1e-3, 2e-3], 3) * rng.standard_normal((2, len(common.times_s), 6))
        noisy = (common.motions[0], *(m.retract(d) for m, d in zip(common.motions[1:], e, strict=True)))
        found.append(fit_drift(replace(common, motions=noisy))[0].rotation)
    of_exact, *others = np.transpose(found)
    assert of_exact.min() < 1e-4  # nothing is left for it
    assert of_exact.max() < 6e-4  # three standard errors of a variance from some forty motions
    np.testing.assert_allclose(others, 1e-3, rtol=0.35)


def test_motions_that_repeat_themselves_tell_no_clock() -> None:
    t = np.arange(0.0, 40.0, 0.1)
    turn = 0.6 * np.sin(np.pi * np.array([0.4, 0.6, 0.8]) * t[:, None] + np.array([0.1, 0.9, 2.0]))  # every 10 s
    noise = np.random.default_rng(1).standard_normal((2, len(t), 3))
    both = [
        Trajectory(FrameRef("camera", e), t, Motions((Rotation.from_rotvec(turn) * Rotation.from_rotvec(1e-4 * d)
                                                      ).as_matrix(), np.zeros((len(t), 3))))
        for e, d in zip("ab", noise, strict=True)
    ]  # fmt: skip
    with pytest.raises(SurveyError, match="the motion repeats itself or is too quick"):
        time_offset(*both)


def test_what_cubics_miss_is_told_apart_from_noise() -> None:
    how = np.stack([np.full((2, 3), 0.4), np.ones((2, 3))])
    rng = np.random.default_rng(4)
    for rate, noise in ((5.0, 0.0), (5.0, 1e-3), (10.0, 1e-4)):
        t = np.arange(0.0, 120.0, 1.0 / rate)
        middle = t[5:-6] + 0.5 / rate
        body, way = carried(t, how)
        exact = Trajectory(FrameRef("camera", "a"), t, Motions(body.as_matrix(), way))
        turned = Rotation.from_rotvec(noise * rng.standard_normal((len(t), 3)))
        noisy = Motions((body * turned).as_matrix(), way + noise * rng.standard_normal((len(t), 3)))
        true, there = carried(middle, how)
        found = exact.at(middle)
        missed = (
            np.sqrt(np.mean((Rotation.from_matrix(found.rotation).inv() * true).as_rotvec() ** 2)),
            np.sqrt(np.mean((found.shifts - there) ** 2)),
        )
        told = replace(exact, world_from_eye=noisy).missed_between()
        np.testing.assert_allclose(told, missed, rtol=0.3)


@pytest.mark.slow
def test_poses_too_far_apart_for_the_motion_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    for rates, named in (((30.0, 5.0, 15.0), ["b"]), ((30.0, 10.0, 15.0), [])):
        monkeypatch.setattr("tests.adjust.test_relay_trajectories.RATES", rates)
        found = relay_trackers(walk(np.random.default_rng([5, 1]), np.full(2, 1e-4), np.zeros(2))).warnings
        assert [text.partition(":")[0] for text in found] == named
        assert all("5 poses a second are too few" in text for text in found)
