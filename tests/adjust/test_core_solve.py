"""The loop: convergence, refusal, damping, weak geometry."""

import contextlib
from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.graph.solver import SolveOptions, solve
from adjust.model.errors import GivenUpError, NotConvergedError, SurveyError
from adjust.model.observations import Distance, PositionRef
from adjust.model.survey import PoseParameter
from survey.simulate import head_on_table, single_camera, stereo
from tests.adjust import helpers as h


def nonsense() -> h.AdjustmentGraph:
    """Image points that have nothing to do with the board."""
    survey, truth = single_camera(1, n_images=4)
    rng = np.random.default_rng(1)
    blocks = tuple(replace(b, uv=rng.uniform(0, 1000, b.uv.shape)) for b in survey.image_blocks)
    return h.build(replace(survey, image_blocks=blocks), h.start_at(truth))


def test_nonsense_does_not_converge() -> None:
    with pytest.raises(NotConvergedError, match=r"did not converge in \d+ steps.*sigma"):
        solve(nonsense(), SolveOptions(max_iterations=8))


def test_what_is_hopeless_after_many_steps_is_given_up() -> None:
    """Where it is now decides: as soon as it is better than that, all steps are taken."""
    went: list[tuple[int, float]] = []
    with pytest.raises(NotConvergedError) as caught:
        solve(nonsense(), SolveOptions(), lambda *now: went.append(now))
    steps, there = max(i for i, _ in went), next(omega for i, omega in went if i >= 40)
    assert steps > 60
    assert type(caught.value) is NotConvergedError
    with pytest.raises(GivenUpError, match=r"did not converge in 4\d steps"):
        solve(nonsense(), SolveOptions(hopeless=0.99 * there))
    with pytest.raises(NotConvergedError) as caught:
        solve(nonsense(), SolveOptions(hopeless=1.01 * there))
    assert type(caught.value) is NotConvergedError


def test_a_start_behind_the_camera_never_converges_there() -> None:
    """A mirrored solution fits the pixels as well; it is refused, and the block is named."""
    survey, truth = single_camera(1, n_images=3)
    start = h.start_at(truth)
    name = ("carrier_from_target", "board", "e02")
    behind = start.poses[name]
    turned = Pose3(Rot3.Rz(np.pi) * behind.rotation(), -behind.translation())
    graph = h.build(survey, replace(start, poses={**start.poses, name: turned}))
    graph.prepare(graph.start, jacobians=False)
    assert [b.epoch_id for b in graph.behind_camera()] == ["e02"]
    with pytest.raises((NotConvergedError, SurveyError), match="C1 at e02"):
        solve(graph)


def test_a_step_behind_the_camera_is_refused() -> None:
    """From four times the distance the first step overshoots through the camera; no accepted step does."""
    survey, truth = single_camera(1, n_images=6)
    held = replace(survey.cameras[0], lens=replace(survey.cameras[0].lens, free=()))
    survey = replace(survey, cameras=(held,))
    start = h.start_at(truth)
    name = ("carrier_from_target", "board", "e02")
    pose = start.poses[name]
    far = Pose3(pose.rotation(), pose.translation() * (1.0, 1.0, 4.0))
    graph = h.build(survey, replace(start, poses={**start.poses, name: far}))
    graph.prepare(graph.start.retract(first_step(graph)), jacobians=False)
    assert [b.epoch_id for b in graph.behind_camera()] == ["e02"]
    behind: list[int] = []
    with contextlib.suppress(NotConvergedError):
        solve(graph, SolveOptions(max_iterations=15), lambda _i, _o: behind.append(len(graph.behind_camera())))
    assert len(behind) > 2
    assert not any(behind)


def first_step(graph: h.AdjustmentGraph) -> gtsam.VectorValues:
    graph.prepare(graph.start, jacobians=True)
    return graph.graph.linearize(graph.start).optimize()


def test_damping_finds_the_way_from_far_away() -> None:
    """Plain Gauss-Newton steps go uphill from there; the loop gets down to the same minimum."""
    survey, truth = stereo(1, n_pairs=5)
    start = h.start_at(truth)
    _, best = h.solved(survey, start)
    uphill = 0
    for seed in range(4):
        far = h.shaken(start, seed, 0.15)
        graph = h.build(survey, far)
        trial = graph.start.retract(first_step(graph))
        uphill += graph.omega(trial) > graph.omega(graph.start) or bool(graph.behind_camera())
        assert solve(graph).omega == pytest.approx(best.omega, rel=1e-9)
    assert uphill > 0, "no start of this test needs damping"


def test_bundle_is_damped_too() -> None:
    survey, truth = h.network(1)
    _, best = h.solved(survey, h.start_at(truth))
    for seed in range(3):
        far = h.shaken(h.start_at(truth), seed, 0.1, 0.3)
        assert solve(h.build(survey, far)).omega == pytest.approx(best.omega, rel=1e-9)


def test_convergence_means_what_is_left_in_sigmas() -> None:
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    graph, done = h.solved(survey, h.shaken(h.start_at(truth), 1, 0.005), tight=False)
    _, best = h.solved(survey, h.start_at(truth))
    precision = h.Precision(graph, done)
    for name, unknown in graph.unknowns.by_name.items():
        left = done.values.localCoordinates(best.values).at(unknown.key)
        assert np.all(np.abs(left) < 1e-5 * np.sqrt(np.diag(h.covariance_of(precision, name)))), name


def test_progress_tells_every_accepted_step() -> None:
    survey, truth = single_camera(1, n_images=4)
    told: list[tuple[int, float]] = []
    done = solve(h.build(survey, h.shaken(h.start_at(truth), 1, 0.01)), progress=lambda i, o: told.append((i, o)))
    assert [o for _, o in told] == sorted((o for _, o in told), reverse=True)
    assert told[-1] == (done.iterations, done.omega)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.03, 0.1, 0.3])
def test_weak_but_determined_geometry_is_solved_by_qr(sigma: float) -> None:
    """A network that hangs in the world by one loosely known pose: GTSAM's Cholesky refuses, nothing is undetermined.

    The bundle's own rounding must not hold the network in the place of its datum.
    """
    survey, truth = h.network(1, held=0, distances=2)
    first = truth["world_from_station", "head", "e0"]
    assert isinstance(first, Pose3)
    epochs = {"e0": PoseParameter(first, "prior", sigma**2 * np.eye(6))}
    survey = replace(survey, stations=(replace(survey.stations[0], epochs=epochs),))
    precision, _ = h.check_against_dense(survey, h.start_at(truth), 1e-6, refined=True)
    assert precision.solved.use_qr == (sigma > 0.05)
    name = ("world_from_station", "head", "e0")
    np.testing.assert_allclose(np.sqrt(np.diag(h.covariance_of(precision, name))), sigma, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.1, 1.0])
def test_a_loose_datum_holds_a_larger_network(sigma: float) -> None:
    """Closed form: the pose that alone carries the datum has the covariance of its prior, whatever hangs on it."""
    survey, truth = h.network(3, n_epochs=40, n_points=200, held=0, distances=2)
    first = truth["world_from_station", "head", "e0"]
    assert isinstance(first, Pose3)
    cov = h.random_cov(np.random.default_rng(1), [sigma] * 6)
    station = replace(survey.stations[0], epochs={"e0": PoseParameter(first, "prior", cov)})
    graph, done = h.solved(replace(survey, stations=(station,)), h.start_at(truth), tight=False)
    found = h.covariance_of(h.Precision(graph, done), ("world_from_station", "head", "e0"))
    assert h.relative(found, cov) < 1e-4


def test_two_held_ends_of_a_distance() -> None:
    survey, truth = h.network(1)
    both = Distance("dead", PositionRef("P0"), PositionRef("P1"), 1.0, 1e-3)
    with pytest.raises(SurveyError, match=r"distance 'dead' joins two held positions"):
        h.build(replace(survey, distances=(both,)), h.start_at(truth))
