"""Pairs with all loops closed: eyes that are no stations, mounts with play, and the two forms held together."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import NotConvergedError, SurveyError
from adjust.model.observations import Closure, FrameRef, Pair
from adjust.model.result import Adjustment
from adjust.model.survey import Camera, LensParameter, PoseParameter, Station, Survey, Target
from adjust.relay.closed import closed, play
from adjust.relay.conditions import MAX_HARD_LOOPS, adjust_condition_factors, adjust_conditions, adjust_loops
from adjust.statistics.screened_adjustment import CleanOptions, adjust_cleaned
from survey.simulate import resample, stereo
from tests.adjust import helpers as h
from tests.adjust.relay_networks import grid, simulate

ARCSEC = np.radians(1.0 / 3600.0)
UNSCREENED = CleanOptions(reject_pairs=False)
LENS = LensParameter("brown", ("fx", "fy", "u0", "v0"), None)
BLOCK = np.array([[0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]])
EYES = [("camera", "C1"), ("camera", "C2"), ("target", "M1"), ("target", "M2"), ("camera", "C3")]


def eyes(seed: int, rotations: bool = False) -> Survey:
    """Cameras and marker blocks on two stations, calibrated one with another: every pair but one, nothing else."""
    rng = np.random.default_rng(seed)
    world = {e: Pose3.Expmap(rng.normal(size=6)) for e in EYES}
    pairs = []
    for i, a in enumerate(EYES):
        for b in EYES[i + 1 :]:
            if (a, b) == (EYES[0], EYES[3]):
                continue
            cov = h.random_cov(rng, [20.0 * ARCSEC] * 3 + [3e-4] * 3)
            m = world[b].between(world[a]).retract(np.linalg.cholesky(cov) @ rng.normal(size=6))
            ends = FrameRef(*a), FrameRef(*b)
            motion, cov = (m.rotation(), cov[:3, :3]) if rotations else (m, cov)
            pairs.append(Pair(f"{a[1]}-{b[1]}", *ends, motion, cov))
    return Survey(
        cameras=tuple(Camera(c, "R1", (640, 480), LENS) for c in ("C1", "C2", "C3")),
        stations=(Station("R1"), Station("R2")),
        targets=tuple(Target(t, ("a", "b", "c", "d"), BLOCK, station_id="R2") for t in ("M1", "M2")),
        pairs=tuple(pairs),
    )


def as_stations(survey: Survey) -> Survey:
    """The same network with every eye written as a station by hand."""
    named = tuple(replace(p, a=FrameRef("station", p.a.frame_id), b=FrameRef("station", p.b.frame_id))
                  for p in survey.pairs)  # fmt: skip
    held = PoseParameter(Pose3(), "held")
    stations = tuple(Station(e, world_from_station=held if e == "C1" else PoseParameter()) for _, e in EYES)
    return Survey(stations=stations, pairs=named)


def check_equal(found: Adjustment, expected: Adjustment) -> None:
    assert found.omega == pytest.approx(expected.omega, rel=1e-8)
    assert found.redundancy == expected.redundancy
    mine, theirs = ({o.ids[0]: o for o in r.other_residuals if o.kind == "pair"} for r in (found, expected))
    for pair_id, o in theirs.items():
        np.testing.assert_allclose(mine[pair_id].residual, o.residual, atol=1e-6 * o.sigma.max())
        np.testing.assert_allclose(mine[pair_id].redundancy, o.redundancy, atol=1e-6)
        assert mine[pair_id].test == pytest.approx(o.test, rel=1e-5)


@pytest.mark.parametrize("rotations", [False, True])
def test_eyes_that_are_no_stations_close_their_loops(rotations: bool) -> None:
    """Conditions on the pairs against poses of hand-made stations: residuals, tests and covariances."""
    survey = eyes(1, rotations)
    found = adjust_cleaned(closed(survey), UNSCREENED)
    expected = adjust_cleaned(as_stations(survey), UNSCREENED)
    assert found.precision.by_conditions
    assert not expected.precision.by_conditions
    assert found.redundancy == (3 if rotations else 6) * (9 - 5 + 1)
    check_equal(found, expected)
    ids = [p.pair_id for p in survey.pairs]
    (covs, sizes), (known, n) = (x.precision.pair_covariances(ids) for x in (found, expected))
    dim = 3 if rotations else 6
    assert sizes.tolist() == n.tolist() == [dim] * len(ids)
    assert not covs[:, dim:].any()
    for cov, expected_cov in zip(covs[:, :dim, :dim], known[:, :dim, :dim], strict=True):
        assert h.relative(cov, expected_cov) < 1e-6
    assert not any(found.precision.pair_covariances(["none"])[1])
    assert not any("differ" in w for w in found.warnings)


@pytest.mark.slow
@pytest.mark.parametrize("n", [4, 16])
def test_few_loops_by_closure_factors_many_by_normal_equations(n: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same from both, and from the normal equations where the factors give up or lose a constraint."""
    network = simulate(grid(n, n), 3, seed=4).network
    expected = adjust_conditions(network).pairs
    used: list[int] = []

    def counted(*given, **named):
        used.append(1)
        return adjust_condition_factors(*given, **named)

    monkeypatch.setattr("adjust.relay.conditions.adjust_condition_factors", counted)
    found = adjust_loops(network).pairs
    assert len(used) == ((n - 1) ** 2 <= MAX_HARD_LOOPS)
    np.testing.assert_allclose(found.residual, expected.residual, atol=1e-10)
    np.testing.assert_allclose(found.cov, expected.cov, atol=1e-8 * np.abs(expected.cov).max())

    def lost(*given, **named):
        done = adjust_condition_factors(*given, **named)
        return replace(done, pairs=replace(done.pairs, redundancy=done.pairs.redundancy * 0.99, omega=-1.0))

    def stuck(*_given, **_named):
        raise NotConvergedError("the hard loop closures did not settle")

    for wrong in (lost, stuck):
        monkeypatch.setattr("adjust.relay.conditions.adjust_condition_factors", wrong)
        assert adjust_loops(network).pairs.omega == pytest.approx(expected.omega, rel=1e-9)


def test_conditions_that_contradict_the_poses_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    survey = closed(eyes(1))
    monkeypatch.setattr("adjust.relay.closed._AGREEMENT", 1e-15)
    assert any("differ by" in w for w in adjust_cleaned(survey, UNSCREENED).warnings)


@pytest.mark.parametrize("sigmas", [(200.0 * ARCSEC, 2e-3), (1e-3 * ARCSEC, 1e-8)])
def test_a_mount_is_one_more_motion_with_its_own_sigmas(sigmas: tuple[float, float]) -> None:
    """Against the same network with the mount as a pair of its own between two stations; a stiff one, and a loose."""
    survey = eyes(2)
    closure = Closure("plate", ("C1-C2", "C2-C3", "C1-C3"), *sigmas)
    found = adjust_cleaned(closed(survey, (closure,)), UNSCREENED)
    plain = as_stations(survey)
    here, there = FrameRef("station", "C1"), FrameRef("station", "plate")
    mount = Pair("mount", there, here, Pose3(), closure.cov(6))
    pairs = tuple(replace(p, a=there) if p.pair_id == "C1-C3" else p for p in plain.pairs)
    plain = replace(plain, pairs=(*pairs, mount), stations=(*plain.stations, Station("plate")))
    expected = adjust_cleaned(plain, UNSCREENED)
    assert found.omega == pytest.approx(expected.omega, rel=2e-4)
    assert found.redundancy == expected.redundancy
    theirs = {o.ids[0]: o for o in expected.other_residuals}
    over = next(p for p in found.survey.pairs if p.pair_id == "C1-C3")
    v = next(o.residual for o in found.other_residuals if o.ids[0] == "C1-C3")
    share = play(found.survey.closures, over, v)
    # to first order in the play, which turns the tangents of what follows it
    size = np.linalg.norm(theirs["mount"].residual[:3])
    assert np.linalg.norm(share[:3]) == pytest.approx(size, rel=0.02)
    left = v - share
    np.testing.assert_allclose(left, theirs["C1-C3"].residual, atol=0.02 * over.cov.diagonal().max() ** 0.5)


def test_a_loose_mount_leaves_its_loops_open_and_the_others_closed() -> None:
    survey = eyes(3)
    hard = adjust_cleaned(closed(survey), UNSCREENED)
    loose = Closure("plate", ("C1-C2", "C2-C3", "C1-C3"), 1.0, 10.0)
    found = adjust_cleaned(closed(survey, (loose,)), UNSCREENED)
    without = replace(survey, pairs=tuple(p for p in survey.pairs if p.pair_id != "C1-C3"))
    expected = adjust_cleaned(closed(without), UNSCREENED)
    assert found.omega == pytest.approx(expected.omega, rel=1e-4)
    assert hard.omega > found.omega


def rig(pair_of_eyes: bool) -> tuple[Survey, h.StartValues]:
    """Two cameras that see boards, joined by pairs over a block and a third camera that no image shows."""
    survey, truth = stereo(5, n_pairs=10)
    rng = np.random.default_rng(3)
    left, right = (FrameRef("camera", c) for c in ("left", "right"))
    block, third = FrameRef("target", "M"), FrameRef("camera", "X")
    at = {("world_from_station", "own"): Pose3()}
    named = FrameRef("station", "target M"), FrameRef("station", "camera X")
    for name in named:
        at["world_from_station", name.frame_id] = Pose3.Expmap(rng.normal(0.0, 0.3, 6))
    ends = [("l-M", left, named[0]), ("M-X", *named), ("X-r", named[1], right), ("l-X", left, named[1])]
    pairs = tuple(Pair(i, a, b, Pose3(), h.random_cov(rng, [1e-4] * 6)) for i, a, b in ends)
    stations = tuple(Station(n.frame_id) for n in named)
    truth |= {name: pose for name, pose in at.items() if name[1] != "own"}
    by_hand = resample(replace(survey, stations=(*survey.stations, *stations), pairs=pairs), truth, 7)
    start = h.shaken(h.start_at(truth), 1, 0.001)
    if not pair_of_eyes:
        return by_hand, start
    back = {named[0]: block, named[1]: third}
    given = tuple(replace(p, a=back.get(p.a, p.a), b=back.get(p.b, p.b)) for p in by_hand.pairs)
    return replace(
        by_hand, stations=(*survey.stations, Station("relay")), pairs=given,
        cameras=(*survey.cameras, Camera("X", "relay", (640, 480), LENS)),
        targets=(*survey.targets, Target("M", ("a", "b", "c", "d"), BLOCK, station_id="relay")),
    ), start  # fmt: skip


def test_eyes_close_their_loops_in_the_graph_of_the_cameras() -> None:
    """The same as with stations written by hand; and the pairs over them tell something of the rig."""
    by_hand, start = rig(False)
    given, _ = rig(True)
    found = adjust_cleaned(closed(given), UNSCREENED, start=start)
    expected = adjust_cleaned(by_hand, UNSCREENED, start=start)
    check_equal(found, expected)
    alone = adjust_cleaned(replace(by_hand, pairs=(), stations=by_hand.stations[:-2]), UNSCREENED, start=start)
    name = ("station_from_camera", "right")
    assert h.relative(found.estimates[name].cov, expected.estimates[name].cov) < 1e-6
    assert found.redundancy - alone.redundancy == 6 * (4 - 2)
    assert np.trace(found.estimates[name].cov) < np.trace(alone.estimates[name].cov)


def test_what_images_show_or_is_held_is_no_eye() -> None:
    given, _ = rig(True)
    done = closed(given)
    assert [c.camera_id for c in done.cameras] == ["left", "right"]
    assert {s.station_id for s in done.stations} >= {"camera X", "target M"}
    assert "relay" not in {s.station_id for s in done.stations}
    fixed = replace(given.targets[-1], carrier_from_target=PoseParameter(Pose3(), "held"))
    held = closed(replace(given, targets=(*given.targets[:-1], fixed)))
    assert "M" in {t.target_id for t in held.targets}
    assert "relay" in {s.station_id for s in held.stations}


def given_rig(known: PoseParameter, epochs: tuple[str, ...]) -> Survey:
    """Two cameras on one body, the first of which is its frame; pairs from both to one station, and one seen twice."""
    rng, two = np.random.default_rng(8), known.value or Pose3()
    body = {e: Pose3.Expmap(rng.normal(size=6)) for e in epochs}
    station, far = FrameRef("station", "A"), Pose3.Expmap(rng.normal(size=6))
    pairs = []
    for epoch in epochs:
        at = epoch if len(epochs) > 1 else None
        for camera, on in (("C1", Pose3()), ("C2", two)):
            for k in range(2 if camera == "C1" else 1):
                cov = h.random_cov(rng, [20.0 * ARCSEC] * 3 + [3e-4] * 3)
                error = np.linalg.cholesky(cov) @ rng.normal(size=6)
                seen = far.between(body[epoch] * on).retract(error)
                pairs.append(Pair(f"{camera}{epoch}{k}", FrameRef("camera", camera, at), station, seen, cov))
    poses = PoseParameter(Pose3(), "held"), known
    cameras = (Camera(c, "R", (640, 480), LensParameter("brown", (), np.array([500.0, 500, 0, 320, 240] + [0] * 8)),
                      station_from_camera=pose) for c, pose in zip(("C1", "C2"), poses, strict=True))  # fmt: skip
    held = Station("A", world_from_station=PoseParameter(far, "held"))
    return Survey(cameras=tuple(cameras), pairs=tuple(pairs),
                  stations=(held, Station("R", "epoch" if len(epochs) > 1 else "fixed")))  # fmt: skip


@pytest.mark.parametrize(
    ("known", "epochs", "redundancy"),
    [
        (PoseParameter(Pose3.Expmap(np.full(6, 0.1)), "held"), ("e1",), 6 + 6),
        (PoseParameter(Pose3.Expmap(np.full(6, 0.1)), held=("rx", "ry", "rz")), ("e1",), 6 + 3),
        (PoseParameter(), ("e1", "e2"), 6 + 6 + 6),
    ],
)  # fmt: skip
def test_loops_over_a_rig_count_as_they_do_by_poses(
    known: PoseParameter, epochs: tuple[str, ...], redundancy: int
) -> None:
    """A pose on a body that is held, in part or whole, or one and the same at several epochs, closes loops too."""
    survey = given_rig(known, epochs)
    found, expected = (adjust_cleaned(s, UNSCREENED) for s in (closed(survey), survey))
    assert expected.redundancy == redundancy
    check_equal(found, expected)
    assert not any("differ" in w for w in found.warnings)


def test_held_components_of_a_second_station_close_loops_too() -> None:
    survey = as_stations(eyes(1))
    pose = adjust_cleaned(survey, UNSCREENED).estimates["world_from_station", "M2"].value
    tilted = PoseParameter(pose.retract(np.array([0.0, 0.0, 50.0 * ARCSEC, 0.0, 0.0, 0.0])), held=("rz",))
    stations = tuple(replace(s, world_from_station=tilted) if s.station_id == "M2" else s for s in survey.stations)
    found, expected = (adjust_cleaned(s, UNSCREENED) for s in (
        closed(replace(survey, stations=stations)), replace(survey, stations=stations)))  # fmt: skip
    check_equal(found, expected)


def test_parts_of_nothing_but_eyes_each_have_their_place() -> None:
    survey = eyes(1)
    apart = tuple(p for p in survey.pairs if (p.a.kind == "camera") == (p.b.kind == "camera"))
    done = closed(replace(survey, pairs=apart))
    held = {s.station_id for s in done.stations if s.world_from_station.treatment == "held"}
    assert len(held) == 2


def test_a_free_station_ties_nothing_to_the_datum() -> None:
    """An eye is where the others are counted from, also where a station hangs on it of which pairs alone tell."""
    survey = eyes(1)
    more = Pair("C1-N", FrameRef("camera", "C1"), FrameRef("station", "N"), Pose3(), np.eye(6) * 1e-8)
    with_station = replace(survey, stations=(*survey.stations, Station("N")), pairs=(more, *survey.pairs))
    check_equal(adjust_cleaned(closed(with_station), UNSCREENED), adjust_cleaned(closed(survey), UNSCREENED))
    at_home = PoseParameter(Pose3(), "held")
    given = replace(with_station, stations=(*survey.stations, Station("N", world_from_station=at_home)))
    assert [s.station_id for s in closed(given).stations if s.world_from_station.treatment == "held"] == ["N"]


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        (("C1-C2", "C2-M1", "C1-C3"), "no loop in this order"), (("C1-C2", "C2-C9", "C1-C3"), "no pair 'C2-C9'"),
        (("C1-C2",), "two pairs or more"), (("C1-C2", "C1-C2"), "none of them twice"),
    ],
)  # fmt: skip
def test_a_closure_that_is_no_loop_is_refused(pairs: tuple[str, ...], message: str) -> None:
    with pytest.raises(SurveyError, match=message):
        closed(eyes(1), (Closure("plate", pairs, 1e-3),))


def test_two_mounts_at_one_pair_are_refused() -> None:
    loops = Closure("one", ("C1-C2", "C2-C3", "C1-C3"), 1e-3), Closure("two", ("C1-M1", "M1-C3", "C1-C3"), 1e-3)
    with pytest.raises(SurveyError, match="one mount sits at one pair"):
        closed(eyes(1), loops)
    assert isinstance(eyes(1, True).pairs[0].b_from_a, Rot3)
