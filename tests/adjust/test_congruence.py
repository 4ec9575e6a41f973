"""Congruence of epochs: error rates and power by simulation, planted motions found, no dependence on any datum."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import binom

from adjust.adjustment import adjust
from adjust.epochs.congruence import Common, CongruenceOptions, Pooled, compare, congruence, joint_congruence
from adjust.epochs.congruence_result import Congruence
from adjust.epochs.joint import joint_survey
from adjust.epochs.states import EpochState, aligned, epoch_normals, epoch_state, moved
from adjust.graph.assembly import StartValues
from adjust.model.errors import SurveyError
from adjust.model.observations import FrameRef, Pair
from adjust.model.survey import Datum, FloatArray, PointParameter, PoseParameter, Station, Survey
from adjust.precision.s_transformation import transformed
from adjust.testing.quadratic_forms import (
    pseudo_half,
    pseudo_precision,
    pseudo_square,
    pseudo_square_beside,
    pseudo_squares,
)
from tests.adjust import helpers as h
from tests.adjust import statistics_networks as net


def free_hall(seed: int, shift: dict[str, FloatArray] | None = None, noise: bool = True) -> tuple[Survey, StartValues]:
    """A free network; ``shift`` (m) of points against the coordinates they were drawn with."""
    x = net.coordinates(1, 12, 3)
    moved_x = {n: v + (shift or {}).get(n, 0.0) for n, v in x.items()}
    survey, start = net.hall(seed, n_tapes=0, noise=noise, places=moved_x)
    points = tuple(replace(p, x_in_world=PointParameter()) for p in survey.points)
    return replace(survey, points=points, datum=Datum("inner")), start


def states() -> tuple[EpochState, tuple[str, ...]]:
    state = epoch_state(adjust(*free_hall(1, noise=False)))
    return state, tuple(n[1] for n in state.names)


def drawn(state: EpochState, rng: np.random.Generator, factor: float = 1.0) -> EpochState:
    """With noise of its own covariance (times factor)."""
    values, vectors = np.linalg.eigh(state.cov)
    d = vectors @ (np.sqrt(np.maximum(values, 0.0) * factor) * rng.normal(size=len(values)))
    return replace(state, values=tuple(np.asarray(v) + x for v, x in zip(state.values, d.reshape(-1, 3), strict=True)))


KNOWN = Pooled(1.0, float("inf"), float("nan"))


@pytest.mark.slow
def test_error_rate_of_the_global_test_and_of_the_single_ones() -> None:
    state, _ = states()
    rng = np.random.default_rng(1)
    options = CongruenceOptions(scaled=False, search=False)
    failed, single, n = 0, 0, 150
    for _ in range(n):
        a, b = drawn(state, rng), drawn(state, rng)
        found = compare(Common(a, b, state.directions, KNOWN), options)
        assert found.before.freedom == 3 * len(state.names) - 4
        failed += not found.before.passed
        single += any(m.significant for m in found.motions)
    low, high = binom.ppf([0.001, 0.999], n, 0.05)
    assert low <= failed <= high
    assert single <= high


@pytest.mark.slow
def test_power_of_the_smallest_motion() -> None:
    """A point that moves by ``smallest`` in its worst direction is significant in 80 % of the samples."""
    state, ids = states()
    rng, i = np.random.default_rng(2), 5
    stable = tuple(n for j, n in enumerate(state.names) if j != i)
    options = CongruenceOptions(scaled=False, search=False, reference=stable)
    one = compare(Common(state, state, state.directions, KNOWN), options)
    motion = next(m for m in one.motions if m.name == ("point", ids[i]))
    step = motion.smallest * motion.ellipsoid.axes[:, 0]
    seen = 0
    for _ in range(150):
        a, b = drawn(state, rng), drawn(state, rng)
        values = list(b.values)
        values[i] = values[i] + step
        found = compare(Common(a, replace(b, values=tuple(values)), state.directions, KNOWN), options)
        seen += next(m for m in found.motions if m.name == motion.name).significant
    low, high = binom.ppf([0.001, 0.999], 150, 0.8)
    assert low <= seen <= high


@pytest.mark.parametrize("scaled", [False, True])
def test_planted_motions_are_found(scaled: bool) -> None:
    shift = {"P3": np.array([0.004, 0.0, 0.0]), "P7": np.array([0.0, -0.003, 0.003])}
    first, second = adjust(*free_hall(1)), adjust(*free_hall(2, shift))
    found = congruence(first, second, CongruenceOptions(scaled=scaled))
    assert not found.before.passed
    assert found.after.passed
    assert {n[1] for n in found.moved} == {"P3", "P7"}
    assert {s.name[1] for s in found.steps} == {"P3", "P7"}
    assert ("point", "P3") not in found.stable
    assert found.datum == ("tx", "ty", "tz", "rz")
    for m in found.motions:
        if m.name[1] in shift:
            d = m.displacement - shift[m.name[1]]
            assert d @ np.linalg.solve(m.cov, d) < 16.0
            assert np.linalg.norm(m.displacement) > m.ellipsoid.semi_axes[0]
    quiet = congruence(first, adjust(*free_hall(3)), CongruenceOptions(scaled=scaled))
    assert quiet.before.passed
    assert not quiet.moved


def test_the_datum_of_the_epochs_does_not_matter() -> None:
    """The second epoch solved with other points in its datum, and then turned and shifted as a whole."""
    shift = {"P3": np.array([0.004, 0.0, 0.0])}
    first, (survey, start) = adjust(*free_hall(1)), free_hall(2, shift)
    expected = congruence(first, adjust(survey, start))
    other = replace(survey, datum=Datum("inner", points=("S1", "P2", "P9")))
    found = congruence(first, adjust(other, start))
    assert found.before.statistic == pytest.approx(expected.before.statistic, rel=1e-4)
    before, after = epoch_state(first), epoch_state(adjust(survey, start))
    away = moved(after, np.array([3.0, -2.0, 1.0, 0.0, 0.0, 0.7, 0.0]))
    back = aligned(before, away, before.directions, range(len(before.names)))
    pooled = Pooled(expected.sigma0, expected.redundancy, 0.5)
    again = compare(Common(before, back, before.directions, pooled), CongruenceOptions())
    assert again.before.statistic == pytest.approx(expected.before.statistic, rel=1e-6)
    before_motion = {m.name: m.displacement for m in expected.motions}
    for m in again.motions:
        np.testing.assert_allclose(m.displacement, before_motion[m.name], atol=1e-7)


def pair_network(seed: int, turned: float) -> tuple[Survey, StartValues]:
    """Five stations, all relative poses between them; the third turns by ``turned`` (rad) about its y."""
    rng = np.random.default_rng(4)
    poses = [h.pose(rng, 1.0) for _ in range(5)]
    poses[2] = poses[2] * Pose3.Expmap(np.array([0.0, turned, 0.0, 0.0, 0.0, 0.0]))
    noise, cov = np.random.default_rng(seed), np.diag([2e-5] * 3 + [1e-4] * 3) ** 2
    pairs = []
    for i in range(5):
        for j in range(i):
            error = Pose3.Expmap(noise.multivariate_normal(np.zeros(6), cov))
            pairs.append(Pair(f"{i}-{j}", FrameRef("station", f"R{i}"), FrameRef("station", f"R{j}"),
                              poses[j].inverse() * poses[i] * error, cov))  # fmt: skip
    stations = tuple(Station(f"R{i}", world_from_station=PoseParameter()) for i in range(5))
    survey = Survey(stations=stations, pairs=tuple(pairs), datum=Datum("inner"))
    return survey, StartValues({}, {("world_from_station", f"R{i}"): p for i, p in enumerate(poses)}, {})


def held_hall(seed: int, shift: dict[str, FloatArray] | None = None) -> tuple[Survey, StartValues]:
    """The same with three points held."""
    survey, start = free_hall(seed, shift)
    points = [replace(p, x_in_world=PointParameter(start.points[p.point_id], "held")) for p in survey.points[:3]]
    return replace(survey, points=(*points, *survey.points[3:]), datum=Datum()), start


MOVED = {"P3": np.array([0.004, 0.0, 0.0]), "P7": np.array([0.0, -0.003, 0.003])}


@pytest.mark.parametrize(
    ("first", "second", "rel"),
    [
        (held_hall(1), held_hall(2, MOVED), 1e-9),
        (free_hall(1), held_hall(2, MOVED), 1e-9),
        # open in the second: each is linear at its own values
        (held_hall(1), free_hall(2, MOVED), 1e-4),
        (free_hall(1), free_hall(2, MOVED), 1e-4),
        (free_hall(1), free_hall(3), 1e-4),
    ],
)
def test_normal_equations_say_what_the_covariance_matrix_says(
    first: tuple[Survey, StartValues], second: tuple[Survey, StartValues], rel: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    epochs = adjust(*first), adjust(*second)
    expected = congruence(*epochs)
    monkeypatch.setattr("adjust.epochs.congruence.MOST_IN_MATRIX", 0)
    same_congruence(congruence(*epochs), expected, rel)
    monkeypatch.setattr("adjust.epochs.joined.JoinedChange._most_freed", 0)  # factored anew for each set of names
    same_congruence(congruence(*epochs), expected, rel)


def test_stations_are_compared_by_normal_equations_too(monkeypatch: pytest.MonkeyPatch) -> None:
    epochs = adjust(*pair_network(1, 0.0)), adjust(*pair_network(2, 4e-4))
    expected = congruence(*epochs)
    monkeypatch.setattr("adjust.epochs.congruence.MOST_IN_MATRIX", 0)
    same_congruence(congruence(*epochs), expected, 1e-4)


def same_congruence(found: Congruence, expected: Congruence, rel: float) -> None:
    for now, then in ((found.before, expected.before), (found.after, expected.after)):
        assert (now.statistic, now.freedom) == (pytest.approx(then.statistic, rel=rel), then.freedom)
    assert (found.moved, found.stable) == (expected.moved, expected.stable)
    assert [(s.name, s.share) for s in found.steps] == [
        (s.name, pytest.approx(s.share, rel=rel)) for s in expected.steps
    ]
    motions = {m.name: m for m in expected.motions}
    for m in found.motions:
        then, sigma = motions[m.name], np.sqrt(np.trace(motions[m.name].cov))
        np.testing.assert_allclose(m.displacement, then.displacement, atol=rel * sigma)
        np.testing.assert_allclose(m.cov, then.cov, atol=rel * sigma**2)
        assert m.test.statistic == pytest.approx(then.test.statistic, rel=10 * rel, abs=10 * rel)


def test_a_share_is_what_the_statistic_falls_by() -> None:
    """Where both epochs leave motions open too."""
    first, second = adjust(*free_hall(1)), adjust(*free_hall(2, MOVED))
    found = congruence(first, second)
    rest = tuple(n for n in found.stable if n != found.steps[0].name) + tuple(s.name for s in found.steps[1:])
    without = congruence(first, second, CongruenceOptions(reference=rest, search=False)).before
    square = [t.statistic * t.freedom * found.sigma0**2 for t in (found.before, without)]
    assert found.steps[0].share == pytest.approx(square[0] - square[1], rel=1e-5)


def test_an_epoch_that_holds_heights_alone_is_not_turned_by_normal_equations() -> None:
    state = epoch_normals(adjust(*free_hall(1)))
    partly = replace(state, column=np.where(np.arange(len(state.column)) == 5, -1, state.column))
    turned = moved(partly, np.array([0.0, 0.0, 0.0, 0.1, 0.0, 0.0, 0.0]))
    with pytest.raises(SurveyError, match="held in some directions alone"):
        turned.normals()
    moved(partly, np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.1, 0.0])).normals()


def test_a_station_that_turned() -> None:
    first, second = adjust(*pair_network(1, 0.0)), adjust(*pair_network(2, 4e-4))
    found = congruence(first, second)
    assert found.moved == (("world_from_station", "R2"),)
    motion = found.motions[0]
    assert motion.rotation is not None
    assert motion.rotation_cov is not None
    assert motion.rotation_test is not None
    assert not motion.rotation_test.passed
    loose = 4.0 * np.sqrt(np.diag(motion.rotation_cov).max())
    np.testing.assert_allclose(motion.rotation, [0.0, 4e-4, 0.0], atol=loose)
    assert congruence(first, adjust(*pair_network(3, 0.0))).moved == ()


def test_what_cannot_be_compared_is_said() -> None:
    first = adjust(*free_hall(1))
    survey, start = free_hall(2)
    names = {p.point_id: f"Q{p.point_id}" for p in survey.points}
    with pytest.raises(SurveyError, match="is not common"):
        congruence(first, first, CongruenceOptions(reference=(("point", names["P1"]),)))
    with pytest.raises(SurveyError, match="cannot carry the 4 motions"):
        congruence(first, adjust(survey, start), CongruenceOptions(reference=(("point", "P1"),)))


def test_epochs_adjusted_together() -> None:
    """Stable points shared: the same motions as of two adjustments in the datum of these points, and sharper."""
    shift = {"P3": np.array([0.004, 0.0, 0.0]), "P7": np.array([0.0, -0.003, 0.003])}
    surveys = {"a": free_hall(1)[0], "b": free_hall(2, shift)[0]}
    stable = tuple(p.point_id for p in surveys["a"].points if p.point_id not in (*shift, "P5"))
    joint = joint_survey(surveys, stable)
    x = net.coordinates(1, 12, 3)
    start = StartValues({}, {}, {p.point_id: x[p.point_id.split("@")[0]] for p in joint.points})
    together = adjust(joint, start)
    found = joint_congruence(together, ("a", "b"), CongruenceOptions(search=False))
    assert {n[1] for n in found.moved} == {"P3", "P7"}
    first, second = adjust(*free_hall(1)), adjust(*free_hall(2, shift))
    reference = tuple(("point", p) for p in stable)
    apart = {m.name: m for m in congruence(first, second, CongruenceOptions(reference=reference, search=False)).motions}
    for m in found.motions:
        d = m.displacement - apart[m.name].displacement
        assert d @ np.linalg.solve(apart[m.name].cov, d) < 9.0
        assert np.trace(m.cov) < np.trace(apart[m.name].cov)
    with pytest.raises(SurveyError, match="stable point 'X'"):
        joint_survey(surveys, ("X",))


def test_the_statistic_by_elimination_is_that_of_the_eigenvectors() -> None:
    """In a datum of some points, with metres and radians, and where more is open than its motions."""
    rng = np.random.default_rng(8)
    root, G = rng.standard_normal((12, 12)) * np.repeat([1.0, 1e-4], 6), rng.standard_normal((12, 3))
    weights = np.repeat([1.0, 0.0], [8, 4])
    d, Q = transformed(rng.standard_normal(12), root @ root.T, G, weights)
    held = (weights[:, None] * G)[:8]
    diagonal = np.diag(pseudo_square(d[:8], Q[:8, :8])[2])
    assert pseudo_precision(Q[:8, :8], held) == pytest.approx(diagonal, rel=1e-8)
    found = pseudo_square_beside(d[:8], Q[:8, :8], held)
    assert found == (pytest.approx(pseudo_square(d[:8], Q[:8, :8])[0], rel=1e-8), 5)
    singular = np.outer(root[0], root[0]) + np.outer(root[1], root[1])
    assert pseudo_square_beside(root[0], singular, np.zeros((12, 0)))[1] == 2


def test_what_neighbours_of_a_long_chain_know_of_each_other_is_no_rounding() -> None:
    steps = np.random.default_rng(3).normal(size=700) * np.where(np.arange(700) % 2, 1.0, 1e-3)
    sigmas = np.where(np.arange(700) % 2, 1.0, 1e-3)
    Q = np.minimum.outer(c := np.cumsum(sigmas**2), c)  # of a random walk
    statistic, rank = pseudo_square_beside(np.cumsum(steps), Q, np.zeros((700, 0)))
    assert rank == 700
    assert statistic == pytest.approx(((steps / sigmas) ** 2).sum(), rel=1e-6)


def test_directions_that_are_open_have_no_part_in_squares_of_many_at_once():
    rng = np.random.default_rng(12)
    A, g = rng.normal(size=(4, 5, 3)), rng.normal(size=(4, 5))
    M = A @ np.swapaxes(A, 1, 2)
    M[3] = np.diag([4.0, 1.0, 1e-8, 0.0, 0.25])
    half, rank = pseudo_half(M, 1e-6)
    expected = np.linalg.pinv(M, rcond=1e-7, hermitian=True)
    np.testing.assert_allclose(half @ np.swapaxes(half, 1, 2), expected, rtol=1e-9, atol=1e-9)
    assert rank.tolist() == [3, 3, 3, 3]
    assert pseudo_half(M[3], 1e-9)[1] == 4, "what is small is open only below the limit"
    assert pseudo_half(M[3], 1e-9, 1e-7)[1] == 3, "or below a share of the largest"
    squares, _ = pseudo_squares(g, M, 1e-6)
    np.testing.assert_allclose(squares, np.einsum("ni,nij,nj->n", g, expected, g), rtol=1e-9)
