"""Scores of changes, of adjustments that ended early, and what units cost that make numbers smaller."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import AdjustOptions, adjust
from adjust.diagnosis.effects.effect import of_shape
from adjust.diagnosis.prediction import Linear
from adjust.diagnosis.units.conventions import MISREADINGS, Misreading, shrinking
from adjust.graph.solver import SolveOptions
from adjust.model.boards import deformation
from adjust.model.survey import FloatArray, Survey
from adjust.statistics.score import Part, Score, scores
from survey.simulate import stereo
from tests.adjust import pose_networks
from tests.adjust.test_pose_network import survey_of


def one_score(g: FloatArray, BB: FloatArray, taken: FloatArray) -> Score:
    return scores(g[None], BB[None], taken[None])[0]


def bent(size: float) -> Survey:
    """A board that is said to be bent by ``size`` m, and is not."""
    survey, _ = stereo(5)
    x = survey.targets[0].x_in_target
    by = deformation(x, ("warp_x",))[:, :, 0]
    return replace(survey, targets=(replace(survey.targets[0], x_in_target=x + size * by),))


def adjusted(survey: Survey, **options: float) -> Linear:
    return Linear(adjust(survey, None, AdjustOptions(solve=SolveOptions(**options))))


def test_a_score_is_the_same_where_the_adjustment_ended_early() -> None:
    survey = bent(1e-3)
    change = deformation(survey.targets[0].x_in_target, ("warp_x",))
    early, late = adjusted(survey, max_step=30.0), adjusted(survey)
    assert early.result.iterations < late.result.iterations
    assert early.result.omega > late.result.omega
    a, b = (of_shape(x, "board", change) for x in (early, late))
    assert a.theta == pytest.approx(b.theta, abs=0.1 * float(np.sqrt(b.cov[0, 0])))
    assert b.theta[0] == pytest.approx(-1e-3, rel=0.05)


@pytest.mark.parametrize("written_out", [0, 10**9])
def test_parts_of_a_course_are_rows_of_the_system(written_out: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("adjust.statistics.score._SMALL", written_out)
    linear = adjusted(bent(0.0))
    columns = linear.columns(("lens", "right"))
    rows = linear.rows_of(columns)
    parts = linear.parts(columns, [rows[40:60], rows[:7]])
    for at, J in parts:
        assert np.array_equal(J, linear.A[at][:, columns].toarray())
    whole = linear.of_parts(parts)
    B, some = np.concatenate([J for _, J in parts]), np.concatenate([at for at, _ in parts])
    AB = linear.A.toarray()[some].T @ B
    dense = one_score(B.T @ linear.e[some], B.T @ B, AB.T @ linear.system.covariance @ AB)
    assert whole.seen == dense.seen
    assert whole.theta == pytest.approx(dense.theta, rel=1e-6)
    assert whole.drop == pytest.approx(dense.drop, rel=1e-6)


def direct(linear: Linear, parts: Sequence[Part]) -> Score:
    """Of a change of all these parts, with full matrices."""
    some, B = (np.concatenate(x) for x in zip(*parts, strict=True))
    AB = linear.A[some].T @ B
    return one_score(B.T @ linear.e[some], B.T @ B, AB.T @ linear.system.normal.covariance(linear.system.datum) @ AB)


@pytest.mark.parametrize("inner", [False, True])
def test_steps_of_large_networks_are_those_of_full_matrices(inner: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the tree, in a datum that is given and in a free one."""
    monkeypatch.setattr("adjust.statistics.score.DENSE", 0)
    monkeypatch.setattr("adjust.statistics.weakness.DENSE", 0)
    linear = Linear(adjust(survey_of(pose_networks.simulate(6, 4, 1, extra=40, free=inner), inner)))
    ptr, of = linear.system.ptr, {name: linear.rows_of(at) for name, at in linear.system.columns.at.items()}
    name = max(of, key=lambda name: len(of[name]))
    numbers = np.unique(linear.system.row_of[of[name]])
    parts = linear.parts(linear.columns(name), [np.arange(ptr[i], ptr[i + 1]) for i in numbers])
    short, found, again = linear.steps([parts[:3], parts, parts[1:]])
    assert not short
    assert len(found) >= 3
    for cut, mine in again.items():
        assert mine.drop == pytest.approx(direct(linear, parts[1 + cut :]).drop, rel=1e-6, abs=1e-9)
    for cut, mine in {0: linear.of_parts(parts), **found}.items():
        expected = direct(linear, parts[cut:])
        assert mine.seen == expected.seen
        assert mine.theta == pytest.approx(expected.theta, rel=1e-6, abs=1e-9)
        assert mine.drop == pytest.approx(expected.drop, rel=1e-6, abs=1e-9)


def test_a_trial_ends_where_nothing_is_gained() -> None:
    """Far from linear, small steps go on for long after v'Pv is what it is in the end."""
    survey = bent(0.01)
    early, late = adjusted(survey, max_step=1e-9, settled=1e-6), adjusted(survey, max_step=1e-9)
    assert early.result.iterations < late.result.iterations
    assert early.result.omega == pytest.approx(late.result.omega, rel=1e-5)


def test_numbers_that_shrink_pay_for_it() -> None:
    """The density of y is that of f y times f."""
    assert shrinking(1e-3, 6) == pytest.approx(-2.0 * 6 * np.log(1e-3))
    assert shrinking(-1.0, 6) == shrinking(1000.0, 6) == 0.0


def test_a_circle_has_one_turn() -> None:
    radians = next(m for m in MISREADINGS if m.said == "are radians, read as degrees")
    degrees = next(m for m in MISREADINGS if m.said == "are degrees, read as radians")
    assert radians.may_be(np.radians(6.2))
    assert not radians.may_be(np.radians(200.0))
    assert degrees.may_be(200.0)
    assert not degrees.may_be(np.radians(200.0))
    assert Misreading("unit of lengths", "", 1e3, 0.0, ("slope_distance",)).may_be(1e4)
