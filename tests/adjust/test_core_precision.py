"""Covariances, redundancy numbers, residual statistics and gross errors, without a bundle (see test_core_bundle)."""

from dataclasses import replace
from functools import cache

import gtsam
import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.adjustment import AdjustOptions, assemble
from adjust.graph.assembly import StartValues
from adjust.model.observations import Distance, FrameRef, Pair, PositionRef
from adjust.model.result import Adjustment
from adjust.model.survey import Datum, FloatArray, PoseParameter, Survey, Tie, VectorParameter, VectorPrior
from adjust.precision.precision import Precision
from survey.simulate import beacons, head_on_table, relay, resample, single_camera, stereo
from survey.simulate.scene import Truth
from tests.adjust import helpers as h


def near(truth: Truth) -> StartValues:
    return h.shaken(h.start_at(truth), 1, 0.002, 0.002)


def thinned(survey: Survey, step: int, seed: int = 0, unused: float = 0.0) -> Survey:
    """Every ``step``-th point of a target, full covariances, and some points not used."""
    rng = np.random.default_rng(seed)
    blocks = []
    for b in survey.image_blocks:
        k = slice(None, None, step if b.target_id else 1)
        n = len(b.uv[k])
        blocks.append(
            replace(
                b, point_idx=b.point_idx[k], uv=b.uv[k], cov=h.point_covs(rng, n), used=rng.uniform(size=n) >= unused
            )
        )
    return replace(survey, image_blocks=tuple(blocks))


def adjusted(survey: Survey, start: StartValues) -> Adjustment:
    graph, done = h.solved(survey, start, tight=False)
    return assemble(graph, done, AdjustOptions())


def test_single_camera_with_unused_points() -> None:
    survey, truth = single_camera(1, n_images=5)
    survey = resample(thinned(survey, 2, unused=0.2), truth, 5)
    h.check_against_dense(survey, near(truth))


def test_stereo_with_tied_lens_priors_and_a_relative_pose() -> None:
    survey, truth = stereo(1, n_pairs=4)
    lens = truth["lens", "right"]
    assert not isinstance(lens, Pose3)
    tie = Tie("fy", "fx", float(lens[1] / lens[0]))
    prior = VectorPrior(("k1", "p1"), np.zeros(2), h.random_cov(np.random.default_rng(1), [1e-3, 1e-4]))
    free = tuple(n for n in survey.cameras[1].lens.free if n != "fy")
    right = replace(survey.cameras[1], lens=replace(survey.cameras[1].lens, free=free, ties=(tie,), prior=prior))
    rng = np.random.default_rng(2)
    a, b = FrameRef("camera", "left", "e01"), FrameRef("camera", "right", "e01")
    pairs = (
        Pair("pose", a, b, Pose3(), h.random_cov(rng, [1e-4] * 6)),
        Pair("rotation", b, a, Rot3(), h.random_cov(rng, [1e-4] * 3)),
        Pair("aside", a, b, Pose3(), h.random_cov(rng, [1e-4] * 6), used=False),
    )
    survey = replace(survey, cameras=(survey.cameras[0], right), pairs=pairs)
    precision, _ = h.check_against_dense(resample(thinned(survey, 2), truth, 5), near(truth))
    sigma = np.sqrt(np.diag(h.covariance_of(precision, ("lens", "right"))))
    fx = adjusted(resample(survey, truth, 5), near(truth)).estimates["lens", "right"]
    assert fx.cov[1, 1] == pytest.approx(tie.factor**2 * fx.cov[0, 0], rel=1e-12)
    assert fx.status[:2] == ("free", "tied")
    assert sigma[0] > 0


@pytest.mark.slow
def test_head_on_a_table_with_warped_board_priors_and_distances() -> None:
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=4, n_free_epochs=2)
    board = survey.targets[0]
    truth = {**truth, ("warp", "board"): np.array([2e-4, -1e-4])}
    of_warp = VectorPrior(("warp_x", "warp_y"), np.zeros(2), h.random_cov(np.random.default_rng(3), [1e-4, 1e-4]))
    warp = VectorParameter(("warp_x", "warp_y"), np.zeros(2), ("warp_x", "warp_y"), of_warp)
    unknown = np.array([0.0, 0.0, np.inf, 0.0, 0.0, np.inf])
    part = h.random_cov(np.random.default_rng(4), [1e-4] * 6) + np.diag(unknown)
    table = replace(survey.tables[0], world_from_table=PoseParameter(Pose3(), "prior", part))
    epoch = survey.table_readings[0].epoch_id
    first, last = board.point_ids[0], board.point_ids[-1]
    there = PositionRef(last, FrameRef("target", "board"))
    distances = (
        Distance("d1", PositionRef(frame=FrameRef("camera", survey.cameras[0].camera_id, epoch)), there, 1.0, 1e-4),
        Distance("d2", PositionRef(frame=FrameRef("station", "head", epoch)), there, 1.0, 1e-4),
        Distance("d3", PositionRef(first, FrameRef("target", "board")), there, 1.0, 1e-4),
        Distance("d4", PositionRef(frame=FrameRef("table", "turntable")), there, 1.0, 1e-4, used=False),
    )
    survey = replace(survey, targets=(replace(board, warp=warp),), tables=(table,), distances=distances)
    h.check_against_dense(resample(thinned(survey, 3, unused=0.1), truth, 3), near(truth))


@pytest.mark.slow
def test_relay_station_and_free_network_of_targets() -> None:
    survey, truth = relay(1, n_epochs=5)
    thin = resample(thinned(survey, 3), truth, 2)
    h.check_against_dense(thin, near(truth))
    free = tuple(replace(t, carrier_from_target=PoseParameter()) for t in thin.targets)
    precision, _ = h.check_against_dense(replace(thin, targets=free, datum=Datum("inner")), near(truth))
    assert precision.solved.datum is not None
    assert precision.solved.datum.defect == 6


@pytest.mark.slow
def test_joint_covariances() -> None:
    """Of unknowns in one clique and far apart, hidden ones refused, in the order asked for."""
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    survey = resample(thinned(survey, 4), truth, 3)
    graph, done = h.solved(survey, near(truth))
    precision = Precision(graph, done)
    full = h.dense(graph, dict(h.start_at(truth).lenses), done.values)
    Q = full.inverse()
    names = list(graph.unknowns.by_name)
    for chosen in (names[::-1], names[::3], [names[0], names[-1]], [names[4]]):
        index = np.concatenate([np.arange(full.place[n].start, full.place[n].stop) for n in chosen])
        assert h.relative(precision.joint(chosen), Q[np.ix_(index, index)]) < 1e-7


@pytest.mark.slow
def test_redundancy_numbers_add_up() -> None:
    survey, truth = beacons(3, n_table_epochs=4, n_free_epochs=3, n_night_epochs=5)
    result = adjusted(survey, near(truth))
    total = result.image_residuals.redundancy.sum() + sum(o.redundancy.sum() for o in result.other_residuals)
    assert total == pytest.approx(result.redundancy, abs=1e-6)
    assert sum(g.redundancy for g in result.groups) == pytest.approx(result.redundancy, abs=1e-6)
    assert sum(g.omega for g in result.groups) == pytest.approx(result.omega)


def with_gross_error(kind: str, survey: Survey, rng: np.random.Generator) -> tuple[Survey, int, int]:
    """The survey with one observation off by 5 to 10 sigma, and where: (block or item, point or component)."""
    size = rng.uniform(7.0, 10.0) * rng.choice([-1.0, 1.0])
    if kind == "image":
        blocks = list(survey.image_blocks)
        i = int(rng.integers(len(blocks)))
        k = int(rng.integers(len(blocks[i].uv)))
        uv = blocks[i].uv.copy()
        uv[k] += size * np.sqrt(np.diag(blocks[i].cov[k])) * (1.0, 0.2)
        blocks[i] = replace(blocks[i], uv=uv)
        return replace(survey, image_blocks=tuple(blocks)), i, k
    if kind == "distance":
        i = 2
        distances = list(survey.distances)
        distances[i] = replace(distances[i], value=distances[i].value + size * distances[i].sigma)
        return replace(survey, distances=tuple(distances)), i, 0
    readings = list(survey.table_readings)
    i = int(rng.integers(len(readings)))
    angles = readings[i].angles.copy()
    angles[1] += size * np.sqrt(readings[i].cov[1, 1])
    readings[i] = replace(readings[i], angles=angles)
    return replace(survey, table_readings=tuple(readings)), i, 1


@cache
def night() -> tuple[Survey, Truth]:
    return beacons(3, n_table_epochs=4, n_free_epochs=3, n_night_epochs=6)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize("kind", ["image", "distance", "table"])
def test_a_gross_error_is_found_where_it_is(kind: str, seed: int) -> None:
    """The largest test of its kind, beyond doubt."""
    survey, truth = night()
    spoilt, i, k = with_gross_error(kind, survey, np.random.default_rng(seed))
    result = adjusted(spoilt, near(truth))
    if kind == "image":
        images = result.image_residuals
        assert int(np.nanargmax(images.test)) == int(images.block_ptr[i]) + k
        return
    mine = [o for o in result.other_residuals if o.kind == kind]
    assert int(np.argmax([np.nanmax(np.abs(o.standardized)) for o in mine])) == i
    assert int(np.nanargmax(np.abs(mine[i].standardized))) == k
    assert np.abs(mine[i].standardized[k]) > 3.29  # 99.9 %


def test_an_observation_without_redundancy_has_no_test() -> None:
    """Neither a standardized residual nor a test value made of rounding."""
    survey, truth = single_camera(1, n_images=4)
    bar = replace(survey.stations[0], station_id="bar", world_from_station=PoseParameter())
    tip = Pair("alone", FrameRef("world"), FrameRef("station", "bar"), Pose3(Rot3.Rx(0.3), [0.1, 0.2, 0.3]),
               h.random_cov(np.random.default_rng(1), [1e-4] * 6))  # fmt: skip
    truth = {**truth, ("world_from_station", "bar"): tip.b_from_a.inverse()}
    result = adjusted(replace(survey, stations=(*survey.stations, bar), pairs=(tip,)), near(truth))
    (alone,) = result.other_residuals
    np.testing.assert_allclose(alone.redundancy, 0.0, atol=1e-9)
    assert np.isnan(alone.standardized).all()
    assert alone.test == pytest.approx(0.0, abs=1e-6)


def test_marginals_of_gtsam_agree() -> None:
    """The same graph inside GTSAM's own algorithm, which copies the values and so asks outside the batch."""
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=3, n_free_epochs=2)
    graph, done = h.solved(survey, near(truth))
    precision = Precision(graph, done)
    mine = {n: h.covariance_of(precision, n) for n in graph.unknowns.by_name}
    marginals = gtsam.Marginals(graph.graph, gtsam.Values(done.values))
    for name, unknown in graph.unknowns.by_name.items():
        expected: FloatArray = marginals.marginalCovariance(unknown.key)
        assert h.relative(mine[name], expected) < 1e-6
