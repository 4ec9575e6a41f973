import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.pose_network.from_survey import network_from_survey
from adjust.pose_network.start import carried
from adjust.relay import session as session_module
from adjust.relay.session import NetworkSession
from tests.adjust.pose_networks import Simulated, simulate, solve_network
from tests.benchmarks.networks import additions, adjusted, difference, first_stations


def grown(sim: Simulated, group: int = 1) -> NetworkSession:
    session = NetworkSession(first_stations(sim.network))
    steps = additions(sim.network)
    for k in range(0, len(steps), group):
        session.add([pair for step in steps[k : k + group] for pair in step])
    return session


@pytest.mark.slow
@pytest.mark.parametrize(("nx", "ny", "group"), [(60, 2, 1), (30, 4, 7), (9, 9, 1)])
def test_a_grown_network_equals_its_batch_solution(nx: int, ny: int, group: int) -> None:
    sim = simulate(nx, ny, seed=nx)
    session = grown(sim, group)
    batch = solve_network(sim.network)
    metres, sigmas = difference(session.poses(), batch)
    assert sigmas < 0.05
    finished = session.finish()
    assert finished.iterations <= 3
    metres, sigmas = difference(adjusted(finished), batch)
    assert sigmas < 1e-6
    assert metres < 1e-6
    assert finished.omega == pytest.approx(batch.omega, rel=1e-10)


@pytest.mark.slow
def test_a_long_corridor_goes_on_by_qr_where_cholesky_refuses_it() -> None:
    sim = simulate(400, 2, seed=3)
    session = grown(sim, 20)
    assert session._growth.use_qr
    assert difference(session.poses(), solve_network(sim.network))[1] < 0.05
    assert session.uses(sim.network.pair_ids[0])
    session.remove(sim.network.pair_ids[:1])
    assert not session.uses(sim.network.pair_ids[0])


@pytest.mark.slow
def test_settled_stations_wake_when_they_are_needed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "_SECTION", 30)
    sim = simulate(100, 2, seed=9)
    session = grown(sim)
    batch = solve_network(sim.network)
    assert difference(session.poses(), batch)[1] < 0.5
    # a loop from the far end to a settled station moves everything, also what had settled
    R, t = sim.rotations, sim.translations
    shift = R[199].T @ (t[20] - t[199])
    loop = Pair("loop", FrameRef("station", "s20"), FrameRef("station", "s199"), Pose3(Rot3(R[199].T @ R[20]), shift),
                np.diag([1e-3] * 3 + [1e-2] * 3) ** 2)  # fmt: skip
    done = session.add([loop])
    assert {"s100", "s150"} <= done.moved.keys()
    present = session.poses()
    finished = session.finish()
    again = solve_network(network_from_survey(finished.survey))
    assert difference(present, again)[1] < 0.2
    assert finished.omega == pytest.approx(again.omega, rel=1e-9)
    # the same where a pair between settled stations is taken out
    session = grown(sim)
    session.remove(["p3"])
    assert session.finish().redundancy == batch.redundancy - 6


def test_additions_say_what_is_new_and_what_moved() -> None:
    sim = simulate(40, 2, seed=3)
    session = NetworkSession(first_stations(sim.network))
    steps = additions(sim.network)
    first = session.add(steps[0])
    assert list(first.new) == ["s2"]
    for step in steps[1:]:
        before = {s: session.estimate(s) for s in sim.network.station_ids[: session.n_stations]}
        done = session.add(step)
        for station, pose in before.items():
            far = np.linalg.norm(pose.between(session.estimate(station)).translation())
            assert (far < 1e-4) or done.moved[station][1] == pytest.approx(far, rel=0.2, abs=1e-4)
        assert set(done.misfit) == {p.pair_id for p in step}
        assert max(done.misfit.values()) < 60
    # a wrong pair shows at once, and can be taken out again
    ends = FrameRef("station", "s70"), FrameRef("station", "s10")
    wrong = Pair("wrong", *ends, Pose3(Rot3(), np.zeros(3)), np.eye(6) * 1e-4)
    before = session.estimate("s40")
    done = session.add([wrong])
    assert done.misfit["wrong"] > 1e4
    assert len(done.moved) > 30
    session.remove(["wrong"])
    batch = solve_network(sim.network)
    finished = session.finish()
    assert [p.pair_id for p in finished.survey.pairs if not p.used] == ["wrong"]
    assert finished.omega == pytest.approx(batch.omega, rel=1e-9)
    assert adjusted(finished)["s40"].translation() == pytest.approx(before.translation(), abs=1e-2)


def test_a_pair_may_start_at_a_held_station(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session_module, "_RELINEARIZE", 1e-6)
    sim = simulate(4, 3)
    session = grown(sim)
    R, t = sim.rotations, sim.translations
    cov = np.diag([1e-4, 1e-2, 1.0, 1e-3, 0.1, 1.0]) ** 2  # strong in some directions of a only
    measured = Pose3(Rot3(R[10].T @ R[0]), R[10].T @ (t[0] - t[10]) + 0.02)
    session.add([Pair("back", FrameRef("station", "s0"), FrameRef("station", "s10"), measured, cov)])
    batch = solve_network(network_from_survey(session.survey()))
    assert difference(session.poses(), batch)[1] < 1e-3


def test_rotations_may_be_added_to_poses() -> None:
    sim = simulate(5, 3)
    session = grown(sim)
    extra = Pair("turn", FrameRef("station", "s1"), FrameRef("station", "s9"),
                 Rot3(sim.rotations[9].T @ sim.rotations[1]), np.eye(3) * 1e-10)  # fmt: skip
    session.add([extra])
    finished = session.finish()
    assert finished.redundancy == solve_network(sim.network).redundancy + 3
    poses = adjusted(finished)
    turn = poses["s9"].between(poses["s1"]).rotation().matrix()
    assert turn == pytest.approx(sim.rotations[9].T @ sim.rotations[1], abs=1e-4)


@pytest.mark.parametrize(
    ("pair_id", "a", "b", "cov", "message"),
    [
        ("p0", "s0", "new", np.eye(6), "exists already"),
        ("x", "other", "new", np.eye(6), "ties other, new to the network"),
        ("x", "s0", "s0", np.eye(6), "does not join two stations"),
        ("x", "s0", "new", -np.eye(6), "covariance"),
    ],
)
def test_what_cannot_be_added_is_refused_and_changes_nothing(pair_id, a, b, cov, message) -> None:
    session = grown(simulate(4, 2))
    before = session.n_stations
    with pytest.raises(SurveyError, match=message):
        session.add([Pair(pair_id, FrameRef("station", a), FrameRef("station", b), Pose3(), cov)])
    assert session.n_stations == before
    assert len(session.finish().survey.stations) == before


def test_a_station_is_placed_by_the_best_pair_that_reaches_it() -> None:
    def pair(name: str, a: str, b: str, x: float, sigma: float) -> Pair:
        ends = FrameRef("station", a), FrameRef("station", b)
        return Pair(name, *ends, Pose3(Rot3(), np.array([-x, 0.0, 0.0])), sigma**2 * np.eye(6))

    pairs = [pair("poor", "A", "C", 7.0, 1.0), pair("first", "A", "B", 1.0, 0.1), pair("second", "C", "B", -2.0, 0.2),
             pair("elsewhere", "X", "Y", 1.0, 0.1)]  # fmt: skip
    placed = carried({"A": Pose3(Rot3(), np.array([0.0, 5.0, 0.0]))}, pairs)
    assert {s: p.translation().tolist() for s, p in placed.items()} == {"B": [1.0, 5.0, 0.0], "C": [3.0, 5.0, 0.0]}
