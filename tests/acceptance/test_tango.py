"""Three trackers bolted together and carried through a house (two recordings): a relay station of three eyes.

Nothing is known of the trackers' noise: it is estimated from how much they contradict each other. The recordings
give no true pairs; what is tested is whether the sigmas explain the contradictions that are left.
"""

import zipfile
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import scipy.linalg
from gtsam import Pose3
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import Camera, FloatArray, LensParameter, PoseParameter, Station, Survey
from adjust.precision.precision import global_test
from adjust.relay.conditions import adjust_conditions
from adjust.relay.eyes.drift import fit_drift, sequences
from adjust.relay.eyes.eyes import EyeOptions, adjust_eyes
from adjust.relay.eyes.pairs import close_loops, pairs_of, triangle_misclosure
from adjust.relay.eyes.sequences import EyeSequence
from adjust.relay.eyes.trajectories import CommonMotions, Trajectory, common_motions, time_offset
from adjust.relay.loops import loop_misclosures
from adjust.relay.network import network_from_pairs
from adjust.spatial.rigid_motions import Motions
from survey.jobs.relay import (
    RelayTrackers,
    one_metre,
    pair_text,
    read_trajectory,
    relay_trackers,
    tracker_pairs,
    trackers_text,
)
from tests.adjust.relay_station import poses
from tests.data import data_folder

IDS = ("CALIGULA", "MARS", "NERO")
RECORDINGS = ("easy", "hard")


def trajectories(recording: str) -> list[Trajectory]:
    """The three trajectories of a recording."""
    path = data_folder("calibration", "tango_triplet") / f"tango_triplet_{recording}.zip"
    with zipfile.ZipFile(path) as archive:
        names = sorted(n for n in archive.namelist() if n.endswith(".csv"))
        return [read_trajectory(archive.read(n).decode(), eye, n) for n, eye in zip(names, IDS, strict=True)]


@lru_cache
def solved(recording: str) -> tuple[tuple[Trajectory, ...], RelayTrackers]:
    found = trajectories(recording)
    return tuple(found), relay_trackers(found)


@pytest.mark.parametrize("recording", RECORDINGS)
def test_clocks_agree_around_the_triangle(recording: str) -> None:
    a, b, c = trajectories(recording)
    ab, ac, bc = time_offset(a, b), time_offset(a, c), time_offset(b, c)
    for offset in (ab, ac, bc):
        assert offset.correlation > 0.999
        assert offset.sigma_s < 1e-3
        assert abs(offset.drift_per_s) < 3 * offset.drift_sigma_per_s
    assert abs(ab.offset_s + bc.offset_s - ac.offset_s) < 1e-3


def test_trajectories_of_different_recordings_do_not_agree() -> None:
    with pytest.raises(SurveyError, match="agree at no time offset"):
        time_offset(trajectories("easy")[0], trajectories("hard")[1])


@pytest.mark.parametrize("recording", RECORDINGS)
def test_no_white_noise_explains_the_poses(recording: str) -> None:
    """With unmoved worlds the misclosures of neighbouring epochs are nearly the same, whatever the sigmas."""
    found, result = solved(recording)
    a, c = found[0], found[1]
    offset = result.offsets[0].offset_s
    times = result.common.times_s[:, 0]
    ids = tuple(f"{t:.2f}" for t in times)
    cov = np.broadcast_to(np.diag(np.repeat([0.01, 0.05], 3) ** 2), (len(ids), 6, 6)).copy()
    other = c.at(times + offset).rescaled(result.joint.scales[IDS[1]])
    eyes = [
        EyeSequence(FrameRef("camera", i), ids, p, cov, (i,) * len(ids))
        for i, p in zip(IDS[:2], (a.at(times), other), strict=True)
    ]
    pair = adjust_eyes(eyes, EyeOptions(reject=False))
    w = pair.solution.misclosure
    correlated = (w[1:] * w[:-1]).sum() / (w * w).sum()
    assert correlated > 0.6
    # drift instead: misclosures of motions grow with the interval; over 3 s against 0.1 s the root would be 5.5
    grown = result.growth
    assert np.all(grown[3] > 4.0 * grown[0])
    assert abs(result.drift.autocorrelation) < 3 * result.drift.autocorrelation_sigma


@pytest.mark.parametrize("recording", RECORDINGS)
def test_drift_and_eyes_do_not_depend_on_the_interval(recording: str, capsys: pytest.CaptureFixture[str]) -> None:
    found, result = solved(recording)
    shifts = [0.0, *(o.offset_s for o in result.offsets)]
    drift, joint = fit_drift(common_motions(found, shifts, 2.0 * result.drift.interval_s))
    assert np.all(np.abs(np.log(drift.rotation / result.drift.rotation)) < np.log(2.0))
    assert np.all(np.abs(np.log(drift.position / result.drift.position)) < np.log(2.0))
    assert result.joint.sigma0 == pytest.approx(1.0, abs=0.02)
    for i in (1, 2):
        one = np.array([i])
        d = (result.joint.station_from_eye[one].inverse() @ joint.station_from_eye[one]).log()[0]
        block = slice(6 * i, 6 * i + 6)
        assert d @ np.linalg.solve(joint.cov[block, block], d) < chi2.ppf(0.999, 6)
    with capsys.disabled():
        print(f"\n{recording}\n{trackers_text(result)}", end="")


@pytest.mark.parametrize("recording", RECORDINGS)
def test_lengths_of_the_trackers_differ(recording: str) -> None:
    """Their metres differ by one to three per cent, in both recordings the same way, far more than by chance."""
    joint = solved(recording)[1].joint
    assert joint.scales["MARS"] < 1.0 - 3 * joint.scale_sigmas["MARS"]
    assert joint.scales["MARS"] < joint.scales["NERO"] < 1.01
    held = adjust_eyes(
        sequences(solved(recording)[1].common, solved(recording)[1].drift), EyeOptions(reject=False)
    )
    assert held.omega - joint.omega > chi2.ppf(0.999, 2)


@pytest.mark.parametrize("recording", RECORDINGS)
def test_pairs_of_the_same_motions_close_as_well_as_they_should(recording: str) -> None:
    pairs = tracker_pairs(solved(recording)[1])
    f, own, shared = triangle_misclosure(pairs, *IDS)
    # three pairs from the same motions share their errors, so they close far better than their own sigmas say
    assert f @ np.linalg.solve(own, f) < chi2.ppf(0.5, 6)
    assert np.trace(shared) < 0.2 * np.trace(own)
    # What is left hangs on details of the noise, for which the random walk is too simple: simulated with this very
    # model the statistic averages 6, the recordings give 46 and 32. The misclosure itself is below half a pair's sigma.
    assert f @ np.linalg.solve(shared, f) < 60.0


def independent_pairs(result: RelayTrackers) -> list[Pair]:
    """Every pair from intervals of its own, each third one, so that the three share nothing but the scales."""
    common, out = one_metre(result), []
    for start, (i, j) in enumerate(((0, 1), (1, 2), (0, 2))):
        own = common[slice(start, None, 3)]
        both = [sequences(own, result.drift)[k] for k in (i, j)]
        pair = adjust_eyes(both, EyeOptions(reject=False)).pair(IDS[i], IDS[j])
        assert isinstance(pair.b_from_a, Pose3)
        t = pair.b_from_a.rotation().unrotate(pair.b_from_a.translation())  # the lever arm in frame a, as its tangent
        spread = max(result.joint.scale_sigmas[IDS[k]] for k in (i, j) if k > 0)
        out.append(replace(pair, cov=pair.cov + scipy.linalg.block_diag(np.zeros((3, 3)), spread**2 * np.outer(t, t))))
    return out


@pytest.mark.parametrize("recording", RECORDINGS)
def test_independent_pairs_close_within_their_sigmas_and_agree_with_the_joint_graph(
    recording: str, capsys: pytest.CaptureFixture[str]
) -> None:
    result = solved(recording)[1]
    network = network_from_pairs(independent_pairs(result))
    loops = loop_misclosures(network)
    assert len(loops.test) == 1
    closed = adjust_conditions(network).pairs
    test = global_test(closed.omega, closed.redundancy_total, 0.01)
    assert test is not None
    assert test.passed
    joint = joint_graph(result)
    lines = [f"{recording}, independent pairs: {loops.text(0)}"]
    for e, pair_id in enumerate(closed.network.topology.pair_ids):
        a, b = pair_id.split("-")
        value, cov = joint[a, b]
        d = Pose3.Logmap(poses(closed.b_from_a)[e].between(value))
        statistic = float(d @ np.linalg.solve(closed.cov[e], d))
        assert statistic < chi2.ppf(0.999, 6)
        lines.append(f"  {pair_id}: closed against joint graph {statistic:.1f} (6 degrees of freedom)")
        lines.append("    joint " + pair_text(Pair(pair_id, FrameRef("camera", a), FrameRef("camera", b), value, cov)))
    with capsys.disabled():
        print("\n" + "\n".join(lines))


def joint_graph(result: RelayTrackers) -> dict[tuple[str, str], tuple[Pose3, FloatArray]]:
    """All three trajectories in GTSAM's graph: station pose per epoch and eyes unknown; a world that drifts between
    epochs drops out of the motion over it, so motions are pairs between an eye before and the same eye after."""
    common = one_metre(result)
    n = len(common.times_s)
    lens = LensParameter("brown", (), np.array([1.0, 1.0, *np.zeros(11)]))
    held = PoseParameter(Pose3(), "held")
    cameras = tuple(Camera(i, "rig", (1, 1), lens, held if i == IDS[0] else PoseParameter()) for i in IDS)
    rig = Station("rig", "epoch", epochs={"0": held})
    observed = []
    for k, s in enumerate(sequences(common, result.drift)):
        for i, motion in enumerate(poses(s.reference_from_eye)):
            a, b = (FrameRef("camera", IDS[k], str(e)) for e in (i + 1, i))
            observed.append(Pair(f"{IDS[k]}{i}", a, b, motion, s.cov[i]))
    start: dict[tuple[str, ...], Pose3] = {}
    here = Pose3()
    for i, motion in enumerate(poses(common.motions[0])):
        here = here.compose(motion)
        start["world_from_station", "rig", str(i + 1)] = here
    for k in (1, 2):
        start["station_from_camera", IDS[k]] = poses(result.joint.station_from_eye)[k]
    survey = Survey(cameras=cameras, stations=(rig,), pairs=tuple(observed))
    graph = adjust(survey, StartValues({i: np.asarray(lens.values) for i in IDS}, start, {}))
    assert graph.redundancy == 6 * (3 * n - n - 2)
    names = [("station_from_camera", i) for i in IDS[1:]]
    joint = np.zeros((18, 18))
    joint[6:, 6:] = graph.precision.joint(names)
    # the same without station poses: conditions between motions
    conditions = adjust_eyes(sequences(common, result.drift), EyeOptions(reject=False))
    assert graph.omega == pytest.approx(conditions.omega, rel=1e-6)
    assert np.sqrt(np.diag(conditions.cov)[6:]) == pytest.approx(np.sqrt(np.diag(joint)[6:]), rel=0.02)
    out = {}
    for i, j in ((0, 1), (1, 2), (0, 2)):
        X = [graph.estimates["station_from_camera", IDS[k]].value for k in (i, j)]
        assert isinstance(X[0], Pose3)
        assert isinstance(X[1], Pose3)
        value = X[1].between(X[0])
        mine = conditions.pair(IDS[i], IDS[j])
        assert isinstance(mine.b_from_a, Pose3)
        J = np.zeros((6, 18))
        J[:, 6 * i : 6 * i + 6], J[:, 6 * j : 6 * j + 6] = np.eye(6), -value.inverse().AdjointMap()
        cov = J @ joint @ J.T
        assert np.abs(Pose3.Logmap(value.between(mine.b_from_a)) / np.sqrt(np.diag(cov))).max() < 1e-4
        out[IDS[i], IDS[j]] = (value, cov)
    return out


def test_scaled_motions_keep_their_turns() -> None:
    motions = Motions(np.eye(3)[None], np.array([[1.0, 2.0, 3.0]]))
    scaled = motions.rescaled(0.5).translation
    assert scaled is not None
    assert scaled[0] == pytest.approx([0.5, 1.0, 1.5])


def test_two_trackers_cannot_tell_whose_errors_they_are() -> None:
    result = solved("easy")[1]
    two = CommonMotions(
        result.common.eyes[:2], result.common.times_s, result.common.poses[:2], result.common.motions[:2]
    )
    with pytest.raises(SurveyError, match="cannot tell whose"):
        fit_drift(two)
    assert len(pairs_of(sequences(two, result.drift)).pairs) == 1
    assert close_loops(tracker_pairs(result)).adjusted.pairs.redundancy_total == 6
