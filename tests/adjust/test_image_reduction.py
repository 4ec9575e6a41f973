"""Poses reduced before GTSAM: the same solution and precision as with everything in sight, and no other refusals."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.solver import SolveOptions, solve
from adjust.model.errors import IndeterminateError
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import LensParameter, Survey, VectorParameter
from adjust.precision.precision import Precision
from survey.simulate import Truth, resample, single_camera, stereo
from tests.adjust import helpers as h


def thinned(survey: Survey, step: int) -> Survey:
    """Every ``step``-th image point, some of them out of use."""
    blocks = []
    for i, b in enumerate(survey.image_blocks):
        kept = slice(i % step, None, step)
        used = np.ones(len(b.uv[kept]), dtype=np.bool_)
        used[i % len(used)] = i % 3 != 0
        blocks.append(replace(b, point_idx=b.point_idx[kept], uv=b.uv[kept], cov=b.cov[kept], used=used))
    return replace(survey, image_blocks=tuple(blocks))


def near(truth: Truth) -> StartValues:
    return h.shaken(h.start_at(truth), 1, 0.003)


def warped_stereo() -> tuple[Survey, Truth]:
    """Two cameras, the second on one more link than the first; a warped board; a tied lens with all coefficients."""
    survey, truth = stereo(4, n_pairs=10)
    board = survey.targets[0]
    warp = VectorParameter(("warp_x", "warp_y"), np.array([3e-4, -2e-4]), ("warp_x", "warp_y"))
    lens = survey.cameras[1].lens
    cameras = (survey.cameras[0], replace(survey.cameras[1], lens=replace(lens, free=(*lens.free, "k3"))))
    survey = replace(survey, targets=(replace(board, warp=warp),), cameras=cameras)
    truth["warp", board.target_id] = warp.values
    return resample(thinned(survey, 3), truth, 2), truth


@pytest.mark.slow
def test_reduced_precision_is_that_of_one_dense_matrix() -> None:
    survey, truth = warped_stereo()
    assert h.build(survey, near(truth)).reduction is not None
    h.check_against_dense(survey, near(truth), 1e-7)


@pytest.mark.parametrize("model", ["brown", "fisheye"])
def test_joint_covariance_across_reduced_poses(model: str) -> None:
    """Of two epochs and a lens: as a graph without the reduction has it."""
    survey, truth = stereo(2, n_pairs=9)
    if model != "brown":
        lens = LensParameter(model, ("fx", "fy", "u0", "v0", "k1", "k2"), None)
        survey = replace(survey, cameras=tuple(replace(c, lens=lens) for c in survey.cameras))
        for c in survey.cameras:
            truth["lens", c.camera_id] = np.append(np.asarray(truth["lens", c.camera_id])[:5], [0.05, 0.0, 0.0, 0.0])
    graph, plain = h.build(survey, near(truth)), replace(h.build(survey, near(truth)), reduction=None)
    assert graph.reduction is not None
    mine, theirs = (Precision(g, solve(g, SolveOptions(max_step=1e-10))) for g in (graph, plain))
    poses = [name for name in graph.unknowns.by_name if name[0] == "carrier_from_target"]
    names = [poses[0], ("lens", survey.cameras[1].camera_id), poses[-1]]
    np.testing.assert_allclose(mine.solved.omega, theirs.solved.omega, rtol=1e-10)
    found, expected = mine.joint(names), theirs.joint(names)
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / scale / scale[:, None], expected / scale / scale[:, None], atol=1e-7)


@pytest.mark.slow
def test_many_points_in_a_block_are_taken_in_parts() -> None:
    """More points than are evaluated together, and a number that no part divides."""
    survey, truth = single_camera(3, n_images=9)
    target = survey.targets[0]
    x = np.concatenate([target.x_in_target + [dx, dy, 0.0] for dx in (0.0, 0.003) for dy in (0.0, 0.004)])
    many = replace(target, point_ids=tuple(f"m{i}" for i in range(len(x))), x_in_target=x)
    n = len(target.point_ids)
    blocks = []
    for b in survey.image_blocks:
        idx = np.concatenate([b.point_idx + k * n for k in range(4)])
        blocks.append(replace(b, point_idx=idx, uv=np.tile(b.uv, (4, 1)), cov=np.tile(b.cov, (4, 1, 1)), used=None))
    survey = resample(replace(survey, targets=(many,), image_blocks=tuple(blocks)), truth, 8)
    assert min(len(b.uv) for b in survey.image_blocks) > 128
    h.check_against_dense(survey, near(truth), 1e-7)


def test_far_starts_with_damping_reach_the_same_minimum() -> None:
    survey, truth = stereo(6, n_pairs=10)
    start = h.shaken(h.start_at(truth), 5, 0.08)
    lenses = {k: np.where(np.arange(len(v)) < 5, v, 0.0) * np.where(np.arange(len(v)) < 2, 1.25, 1.0)
              for k, v in start.lenses.items()}  # fmt: skip
    start = replace(start, lenses=lenses)
    graphs = [h.build(survey, start), replace(h.build(survey, start), reduction=None)]
    reduced, plain = (solve(g) for g in graphs)
    assert graphs[0].reduction is not None
    assert reduced.omega == pytest.approx(plain.omega, rel=1e-9)


def test_damped_step_is_that_of_the_damped_normal_equations() -> None:
    """One step of the interface with damped poses below it, against the dense matrix damped the same way."""
    survey, truth = stereo(6, n_pairs=8)
    graph = h.build(survey, near(truth))
    reduction = graph.reduction
    assert reduction is not None
    delta = graph.linearized(graph.prepare(graph.start, True, 0.3)).optimize()
    reduction.complete(delta)
    full = graph.graph.linearize(graph.start)
    keys = sorted(graph.unknowns.by_key)
    dims = [graph.unknowns.by_key[k].dim for k in keys]
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    A, b = full.jacobian(ordering)
    hidden = np.repeat([k in set(reduction.hidden) for k in keys], dims)
    N = A.T @ A
    N[hidden, hidden] *= 1.3
    expected = np.linalg.solve(N, A.T @ b)
    found = np.concatenate([delta.at(k) for k in keys])
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())


def refusal(graph: AdjustmentGraph) -> str:
    with pytest.raises(IndeterminateError) as caught:
        solve(graph)
    return str(caught.value)


def test_what_is_undetermined_is_named_as_without_the_reduction() -> None:
    """An epoch with two image points; and a camera whose images show too little of one board."""
    survey, truth = stereo(1, n_pairs=9)
    last = survey.image_blocks[-1].epoch_id
    blocks = [
        replace(b, point_idx=b.point_idx[:2], uv=b.uv[:2], cov=b.cov[:2], used=None) if b.epoch_id == last else b
        for b in survey.image_blocks
    ]
    seen_by_one = [b for b in blocks if not (b.epoch_id == last and b.camera_id == "right")]
    survey = replace(survey, image_blocks=tuple(seen_by_one))
    graph, plain = h.build(survey, near(truth)), replace(h.build(survey, near(truth)), reduction=None)
    assert graph.reduction is not None
    text = refusal(graph)
    assert last in text
    assert text == refusal(plain)


@pytest.mark.slow
def test_what_only_other_observations_determine_is_shown_to_the_solver() -> None:
    """Cameras that never see the same board, joined by a measured pose: the images alone leave the second one free."""
    survey, truth = stereo(2, n_pairs=10)
    epochs = sorted({b.epoch_id for b in survey.image_blocks})
    mine = {"left": set(epochs[::2]), "right": set(epochs[1::2])}
    blocks = [b for b in thinned(survey, 3).image_blocks if b.epoch_id in mine[b.camera_id]]
    a, b = FrameRef("camera", "left", epochs[0]), FrameRef("camera", "right", epochs[0])
    cov = h.random_cov(np.random.default_rng(2), [1e-4] * 6)
    survey = replace(survey, image_blocks=tuple(blocks), pairs=(Pair("rig", a, b, Pose3(), cov),))
    survey = resample(survey, truth, 4)
    graph = h.build(survey, near(truth))
    assert graph.reduction is not None
    assert solve(graph).tree.leaves is None
    assert graph.reduction is not None
    h.check_against_dense(survey, near(truth), 1e-7)
