"""Clocks: derivatives, values against the truth, what is refused, and what is left out where no motion is known."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.frames.runs import within_motion
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.observations.between_epochs import weights
from survey.simulate import Truth, resample
from tests.adjust import helpers as h
from tests.adjust.moving import board_before_cameras, camera_on_hand, clock, head_on_moving_table

LEFT, RIGHT = ("camera_clock", "left"), ("camera_clock", "right")
TABLE, HAND = ("table_clock", "turntable"), ("pose_clock", "hand")
JITTER = {(*RIGHT, f"e{k + 1:02d}"): np.random.default_rng(k).normal(0.0, 0.01, 1) for k in range(16)}
SURVEYS = {
    "camera": lambda n=12: board_before_cameras(
        n, {"right": clock(offset=0.03, drift=0.01)}, {RIGHT: np.array([0.03, 0.01])}),
    "rows": lambda n=10: board_before_cameras(
        n, {"right": clock(offset=0.006, line_time=2e-5)}, {RIGHT: np.array([0.006, 2e-5])}),
    "epochs": lambda n=12: board_before_cameras(
        n, {"right": clock(0.01, offset=0.03)}, {RIGHT: np.array([0.03])} | JITTER),
    "table": lambda n=14: head_on_moving_table(n, {"turntable": clock(offset=0.03)}, {TABLE: np.array([0.03])}),
    "cameras on a table": lambda n=12: head_on_moving_table(
        n, {"left": clock(offset=0.03), "right": clock(line_time=2e-5)},
        {LEFT: np.array([0.03]), RIGHT: np.array([2e-5])}),
    "robot": lambda n=14: camera_on_hand(n, {"hand": clock(offset=0.03, drift=0.0)}, {HAND: np.array([0.03, 0.0])}),
}  # fmt: skip


def misses(result: Adjustment, truth: Truth) -> list[float]:
    """d' inv(C) d over its degrees of freedom, of every clock."""
    out = []
    for name, estimate in result.estimates.items():
        if name[0].endswith("_clock") and len(name) == 2:
            d = np.asarray(estimate.value) - np.asarray(truth[name])
            out.append(float(d @ np.linalg.solve(estimate.cov, d)) / len(d))
    return out


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SURVEYS))
def test_derivatives_by_every_unknown(name: str) -> None:
    """Of the whole objective, against differences, away from the minimum.

    Seven epochs, each between its four neighbours: at both ends, beside them, and in the middle.
    """
    survey, truth = SURVEYS[name](7)
    graph = h.build(survey, h.start_at(truth))
    values = h.disturbed(graph.start, graph, 3, 0.3)
    for unknown in graph.unknowns.by_name.values():
        if unknown.name[0].endswith("_clock"):
            values.update(unknown.key, np.array([{"offset": 0.04, "drift": 0.02, "line_time": 3e-5}.get(c, 0.005)
                                                 for c in unknown.components]))  # fmt: skip
    gradient = graph.linearized(graph.prepare(values, jacobians=True, reduced=False)).gradientAtZero()
    for unknown in graph.unknowns.by_name.values():
        steps = np.full(unknown.dim, 1e-6) if unknown.name[0].endswith("clock") else 0.1 * h.steps_of(unknown, values)
        steps = np.array([1e-9 if c == "line_time" else s for c, s in zip(unknown.components, steps, strict=True)])
        numeric = h.differences(lambda v: np.array([0.5 * graph.omega(v)]), values, unknown.key, steps)[0]
        np.testing.assert_allclose(gradient.at(unknown.key), numeric, rtol=1e-4, atol=2e-5 * np.abs(numeric).max(),
                                   err_msg=str(unknown.name))  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", list(SURVEYS))
def test_clocks_are_found_within_their_sigmas(name: str) -> None:
    survey, truth = SURVEYS[name]()
    result = adjust(survey)
    assert result.global_test is not None
    assert result.global_test.passed
    assert all(miss < 10.0 for miss in misses(result, truth))
    if name == "cameras on a table":  # it does not even converge
        return
    without = replace(survey, cameras=tuple(replace(c, clock=None) for c in survey.cameras),
                      tables=tuple(replace(t, clock=None) for t in survey.tables),
                      stations=tuple(replace(s, clock=None) for s in survey.stations))  # fmt: skip
    assert adjust(without).sigma0 > 1.4 * result.sigma0


@pytest.mark.slow
def test_factors_alone_agree_with_the_batch() -> None:
    """What GTSAM asks of a factor at values of its own is what the batch served."""
    survey, truth = SURVEYS["cameras on a table"]()
    graph = h.build(survey, h.start_at(truth))
    values = gtsam.Values(graph.start)
    served = graph.linearized(graph.prepare(values, jacobians=True, reduced=False)).gradientAtZero()
    alone = graph.graph.linearize(values).gradientAtZero()
    for key in graph.unknowns.by_key:
        np.testing.assert_allclose(alone.at(key), served.at(key), rtol=1e-9, atol=1e-9 * np.abs(served.at(key)).max())


def test_the_rows_of_an_image_are_one_factor() -> None:
    """Each at a time of its own, with as many rows as coordinates where no more are unknown."""
    survey, truth = SURVEYS["rows"]()
    graph = h.build(survey, h.start_at(truth))
    coordinates = [2 * len(b.uv) for b in survey.image_blocks if b.camera_id == "right"]
    factors = [graph.graph.at(i) for i in range(graph.others_graph.size(), graph.graph.size())]
    assert len(graph.images.blocks) > 3 * len(survey.image_blocks)
    assert len(factors) == len(survey.image_blocks)
    assert sorted(f.dim() for f in factors)[-len(coordinates) :] == sorted(coordinates)


def test_weights_are_those_of_a_polynomial() -> None:
    times = np.array([[0.0, -1.0, 0.8, 2.1, -2.0]])

    def polynomial(t: FloatArray) -> FloatArray:
        return np.asarray(1.0 - 2.0 * t + 0.3 * t**2 - 0.1 * t**3 + 0.05 * t**4)

    w, by_dt = weights(times, np.array([0.4]))
    assert w[0] @ polynomial(times[0]) == pytest.approx(polynomial(np.array(0.4)))
    slope = (polynomial(np.array(0.4 + 1e-5)) - polynomial(np.array(0.4 - 1e-5))) / 2e-5
    assert by_dt[0] @ polynomial(times[0]) == pytest.approx(slope)


def test_given_clocks_are_obeyed() -> None:
    """A line time as its maker says, an offset with a sigma."""
    true = {RIGHT: np.array([2e-5])}
    survey, _ = board_before_cameras(12, {"right": clock(held=("line_time",), line_time=2e-5)}, true)
    result = adjust(survey)
    assert result.global_test is not None
    assert result.global_test.passed
    assert result.estimates[RIGHT].status == ("held",)


def test_some_clock_must_be_the_time() -> None:
    survey, _ = board_before_cameras(12, {"left": clock(offset=0.0), "right": clock(offset=0.0)},
                                     {LEFT: np.zeros(1), RIGHT: np.zeros(1)})  # fmt: skip
    with pytest.raises(SurveyError, match="clocks of camera left, camera right: the offset of every clock"):
        adjust(survey)


def test_clocks_of_what_stands_still_are_named() -> None:
    survey, _ = board_before_cameras(12, {"right": clock(offset=0.0)}, {RIGHT: np.zeros(1)})
    first = survey.image_blocks[0].epoch_id
    alone = replace(survey, image_blocks=tuple(b for b in survey.image_blocks if b.epoch_id == first))
    with pytest.raises(SurveyError, match="clock of camera right: at no epoch is it known"):
        adjust(alone)
    still = replace(survey, targets=tuple(replace(t, motion="fixed") for t in survey.targets))
    with pytest.raises(SurveyError, match="clock of camera right"):
        adjust(replace(still, image_blocks=alone.image_blocks))


def _dropped(survey: Survey) -> set[tuple[str, str]]:
    return {(b.camera_id, b.epoch_id) for b in survey.image_blocks if not b.mask.any()}


def test_ends_of_runs_are_not_used() -> None:
    """Nor is an image that alone shows where the board was then; a long pause ends a run."""
    survey, _ = board_before_cameras(12, {"right": clock(offset=0.0)}, {RIGHT: np.zeros(1)})
    assert _dropped(within_motion(survey)) == {("right", "e01"), ("right", "e12")}
    later = replace(survey, times={e: t + (5.0 if e > "e06" else 0.0) for e, t in survey.times.items()})
    assert _dropped(within_motion(later)) == {("right", e) for e in ("e01", "e06", "e07", "e12")}
    blind = replace(survey, image_blocks=tuple(
        b for b in survey.image_blocks if (b.camera_id, b.epoch_id) != ("left", "e01")))  # fmt: skip
    fewer = within_motion(blind)
    assert _dropped(fewer) == {("right", "e02"), ("right", "e12")}
    assert "e01" not in {b.epoch_id for b in fewer.image_blocks}


def test_times_that_cannot_be_are_refused() -> None:
    survey, _ = board_before_cameras(6, {"right": clock(offset=0.0)}, {RIGHT: np.zeros(1)})
    with pytest.raises(SurveyError, match="epoch 'e03' has no time"):
        adjust(replace(survey, times={e: t for e, t in survey.times.items() if e != "e03"}))
    with pytest.raises(SurveyError, match="two of its epochs have the same time"):
        adjust(replace(survey, times=dict.fromkeys(survey.times, 0.0)))


@pytest.mark.slow
def test_sigmas_of_poses_are_true_beside_a_clock() -> None:
    """All poses of the board, the camera's place and its clock together, over repeats."""
    survey, truth = board_before_cameras(12, {"right": clock(offset=0.02)}, {RIGHT: np.array([0.02])})
    squares, freedom = 0.0, 0
    for seed in range(10):
        result = adjust(resample(survey, truth, seed))
        names = [n for n, e in result.estimates.items() if e.cov.any() and n[0] != "lens"]
        d = []
        for name in names:
            value, true = result.estimates[name].value, truth[name]
            both = isinstance(value, Pose3) and isinstance(true, Pose3)
            d.append(Pose3.Logmap(true.between(value)) if both else np.asarray(value) - np.asarray(true))
        x = np.concatenate(d)
        squares += float(x @ np.linalg.solve(np.asarray(result.precision.joint(names)), x))
        freedom += len(x)
    assert freedom == 10 * (12 * 6 + 6 + 1)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], freedom)
    assert low <= squares <= high
