"""The search for gross errors: every step against a dense refit, planted errors, false alarms, what comes back."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import binom

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues
from adjust.model.errors import NotConvergedError
from adjust.model.observations import Distance, FrameRef, Pair, PositionRef, Reading, ReadingCovariance
from adjust.model.survey import FloatArray, Point, PointParameter, Survey
from adjust.start.robust import limit
from adjust.statistics.condensed import condensed_system
from adjust.statistics.outliers import exchange
from adjust.statistics.outliers import round as rounds
from adjust.statistics.outliers.candidates import candidates, without
from adjust.statistics.outliers.outcome import SearchOptions
from adjust.statistics.outliers.search import search_outliers
from adjust.statistics.outliers.snooping import Snooping
from adjust.statistics.reliability import reliability
from adjust.statistics.system import LinearSystem, linear_system
from adjust.testing.gross_errors import Search
from survey.simulate import head_on_table, resample
from tests.adjust import helpers as h
from tests.adjust import statistics_networks as net
from tests.adjust.pose_networks import simulate


def refit(system: LinearSystem, out: list[int]) -> tuple[FloatArray, FloatArray]:
    """Residuals (m,) and their cofactors I - A Q A' (m, m) by dense algebra, without the observations ``out``."""
    A, rows = system.A.toarray(), ~np.isin(system.row_of, out)
    for joint in system.joint:  # a bias for what is out of a joint block, which is the same as leaving it out
        for place, row in enumerate(joint.rows):
            if system.row_of[row] in out:
                rows[row] = True
                column = np.zeros((len(A), 1))
                column[joint.rows, 0] = joint.W[:, place]
                A = np.hstack([A, column])
    used = A[rows]
    D = np.hstack([system.datum.toarray(), np.zeros((system.datum.shape[0], A.shape[1] - system.datum.shape[1]))])
    Q = np.linalg.inv(used.T @ used + D.T @ D)
    e = system.e - A @ Q @ used.T @ system.e[rows]
    return e, np.eye(len(A)) - A @ Q @ A.T


def mixed_survey() -> LinearSystem:
    """Images of unknown points, coordinates, distances, and readings with a joint covariance."""
    survey, truth = h.network(7, n_epochs=3, n_points=9, coordinates=2)
    system = linear_system(adjust(survey, h.start_at(truth)))
    return system


def joint_hall() -> LinearSystem:
    survey, start = net.hall(3)
    ids = tuple(r.reading_id for r in survey.readings[:6])
    s = np.array([r.sigma for r in survey.readings[:6]])
    C = 0.4 * np.ones((6, 6)) + 0.6 * np.eye(6)
    survey = replace(survey, reading_covariances=(ReadingCovariance(ids, C * np.outer(s, s)),))
    return linear_system(adjust(survey, start))


@pytest.mark.parametrize(("make", "out"), [(mixed_survey, [3, 20, 45]), (joint_hall, [2, 14, 40, 17])])
def test_elimination_against_a_dense_refit(make, out: list[int]) -> None:
    system = make()
    snooping = Snooping(system, np.ones(len(system.used), dtype=np.bool_))
    for o in out:
        snooping.leave_out(o)
    e, R = refit(system, out)
    tests = snooping.tests()
    T, freedom = tests.statistic, tests.freedom
    joint = set(system.joint_of)
    for o in range(len(system.used)):
        rows = np.arange(system.ptr[o], system.ptr[o + 1])
        if o in out or freedom[o] < len(rows):
            continue
        if o in joint:
            block, place = system.joint_of[o]
            c = block.W[:, place]
            expected = (c @ e[block.rows]) ** 2 / (c @ R[np.ix_(block.rows, block.rows)] @ c)
        else:
            expected = e[rows] @ np.linalg.solve(R[np.ix_(rows, rows)], e[rows])
        np.testing.assert_allclose(T[o], expected, rtol=1e-5, atol=1e-7)
    for o in out:  # what is out: prediction against observation, with the others out
        if o in joint:
            continue
        rows = np.arange(system.ptr[o], system.ptr[o + 1])
        cov = 2.0 * np.eye(len(rows)) - R[np.ix_(rows, rows)]  # I + A Q A'
        expected = e[rows] @ np.linalg.solve(cov, e[rows])
        assert snooping.verdict(o).statistic == pytest.approx(expected, rel=1e-6)
        assert snooping.verdict(o).error == pytest.approx(np.linalg.norm(e[rows]), rel=1e-6)
    used = ~np.isin(system.row_of, out)
    if not joint:
        assert snooping.omega == pytest.approx(e[used] @ e[used], rel=1e-9)
        assert snooping.left == int(used.sum()) - len(system.columns)
    before = Snooping(system, snooping.candidates).tests().statistic
    snooping.take_back(out)
    np.testing.assert_allclose(snooping.tests().statistic, before, rtol=1e-7, atol=1e-9)


def test_tests_by_the_tree_are_those_of_the_normal_matrix() -> None:
    """Image points condensed, the rest by covariances of the tree: also what the solution left out and is in here."""
    survey, truth = h.network(7, n_epochs=3, n_points=9, coordinates=2)
    distances = tuple(replace(d, used=i not in (1, 3)) for i, d in enumerate(survey.distances))
    adjustment = adjust(replace(survey, distances=distances), h.start_at(truth))
    whole, condensed = linear_system(adjustment), condensed_system(adjustment.precision).system
    every = [replace(s, used=np.ones(len(s.used), dtype=np.bool_)) for s in (whole, condensed)]
    images = int(adjustment.image_residuals.used.sum())
    assert images == whole.n_image
    apart, ours = (Snooping(s, np.ones(len(s.used) - first, dtype=np.bool_), first, n)
                   for s, first, n in ((every[0], 0, 0), (every[1], condensed.n_image, 2 * images)))  # fmt: skip
    for out in ((), (2,), (2, 4)):
        a = apart.using(~np.isin(np.arange(len(apart.used)), np.add(out, images))).tests()
        b = ours.using(~np.isin(np.arange(len(ours.used)), out)).tests()
        np.testing.assert_allclose(b.statistic, a.statistic[images:], rtol=1e-5, atol=1e-7)  # weak ones lose digits
        assert b.freedom.tolist() == a.freedom[images:].tolist()
        assert b.omega.sum() == pytest.approx(a.omega.sum(), rel=1e-9)
        assert b.redundancy.sum() == pytest.approx(a.redundancy.sum(), rel=1e-9)


def planted(seed: int) -> tuple[Survey, Survey, dict[str, float]]:
    """A hall clean and with errors of 6 to 50 sigmas in 5 % of its readings, and these over the detectable bias."""
    survey, start = net.hall(seed, n_points=20, n_stations=4, n_tapes=20)
    tests = reliability(adjust(survey, start), most_influences=0).tests
    rng = np.random.default_rng(seed)
    readings, sizes = list(survey.readings), {}
    first = len(tests.used) - len(readings)
    for i in rng.choice(len(readings), len(readings) // 20, replace=False):
        r, error = readings[i], float(rng.uniform(6.0, 50.0) * rng.choice([-1, 1]) * readings[i].sigma)
        readings[i] = replace(r, value=r.value + error)
        sizes[r.reading_id] = abs(error) / tests.detectable_component[tests.ptr[first + i]]
    return survey, replace(survey, readings=tuple(readings)), sizes


@pytest.mark.slow
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_planted_errors_are_found_and_named(seed: int) -> None:
    _, wrong, sizes = planted(seed)
    _, start = net.hall(seed, n_points=20, n_stations=4, n_tapes=20)
    found = search_outliers(wrong, start, SearchOptions(0.05))
    named = {d.ids[0] for d in found.rejected}
    assert found.converged
    assert named >= {i for i, size in sizes.items() if size > 1.5}
    assert len(named - set(sizes)) <= 1
    assert abs(found.adjustment.sigma0 - 1.0) < 0.2
    # reversible: what was given is as it was but for the flags
    assert [replace(r, used=True) for r in found.adjustment.survey.readings] == list(wrong.readings)
    kept = {r.reading_id for r in found.adjustment.survey.readings if not r.used}
    assert kept == named
    worst = found.rejected[0]
    assert worst.kind in worst.text()
    assert worst.statistic > worst.limit
    assert worst.p < 1e-6


def test_false_alarms_at_the_nominal_rate() -> None:
    """400 clean samples of one network: at least one false alarm in 5 % of them; 0.1 % of all tests by method b."""
    survey, start = net.hall(5)
    system = linear_system(adjust(survey, start))
    rng = np.random.default_rng(5)
    M = len(system.used)
    first = Snooping(system, np.ones(M, dtype=np.bool_))
    search: Search[Snooping] = Search(lambda *_: None, 0.05, n_tests=M, many=np.inf, factor=np.ones(10))
    alarms, single = 0, 0
    A, N = system.A, system.normal
    for _ in range(400):
        e = rng.normal(size=len(system.e))
        first.g = e - A @ N.solve(A.T @ e)
        state = search.judged(first, first.tests())
        alarms += bool(state.over.max() > 1.0)
        single += int(np.sum(state.tests.statistic[state.tests.freedom > 0] > 10.828))  # chi-square, 0.1 %
    # tests of one network are correlated: the rate of the family stays a little below its bound
    low, high = binom.ppf([0.001, 0.999], 400, 0.05)
    assert low - 8 <= alarms <= high
    low, high = binom.ppf([0.001, 0.999], 400 * M, 0.001)
    assert low <= single <= high


@pytest.mark.slow
def test_no_group_is_taken_for_too_confident_because_its_tests_agree_with_each_other() -> None:
    """Corridors of pairs, of whose redundancy there is a third: their tests vary 1.5 times as much as as many coins.

    As many coins would raise four alarms in these fifty; two are the most that chance makes.
    """
    alarms = 0
    for seed in range(50):
        now = adjust(simulate(300, 2, seed).network.as_survey)
        tests = rounds.tests_of_all(now)
        assert tests.redundancy[0] == pytest.approx(now.redundancy, rel=1e-9)
        alarms += bool(rounds.typical(tests).max() > 1.0)
    assert alarms <= binom.ppf(0.999, 50, 0.00135)


def test_a_robust_suspect_that_fits_comes_back() -> None:
    """Two large errors in one point's few sights pull the rest of them along; in the end only the two are out."""
    survey, start = net.hall(8)
    mine = [i for i, r in enumerate(survey.readings) if r.to.point_id == "P3" and r.kind == "slope_distance"]
    wrong = net.with_reading(survey, mine[0], value=survey.readings[mine[0]].value + 0.02)
    found = search_outliers(wrong, start)
    assert [d.ids[0] for d in found.rejected] == [survey.readings[mine[0]].reading_id]
    out = {d.ids for d in found.log if d.action == "rejected"} - {d.ids for d in found.log if d.action == "readmitted"}
    assert out == {d.ids for d in found.rejected}


@pytest.mark.slow
def test_errors_of_other_kinds() -> None:
    """A pair, a distance and an image point off in one survey of a head on a table."""
    survey, truth = head_on_table(1, n_cameras=2, n_table_epochs=4, n_free_epochs=2)
    blocks = tuple(replace(b, point_idx=b.point_idx[::3], uv=b.uv[::3], cov=b.cov[::3]) for b in survey.image_blocks)
    a, b = (FrameRef("camera", c.camera_id, survey.image_blocks[0].epoch_id) for c in survey.cameras[:2])
    board = survey.targets[0]
    far = PositionRef(board.point_ids[-1], FrameRef("target", board.target_id))
    near = PositionRef(frame=FrameRef("camera", survey.cameras[0].camera_id, survey.image_blocks[0].epoch_id))
    pairs, tapes = (Pair("pair", a, b, Pose3(), 1e-8 * np.eye(6)),), (Distance("tape", near, far, 1.0, 3e-4),)
    survey = replace(survey, image_blocks=blocks, pairs=pairs, distances=tapes)
    survey = resample(survey, truth, 4)
    uv = survey.image_blocks[3].uv.copy()
    uv[2] += (4.0, -3.0)
    pair = replace(survey.pairs[0], b_from_a=survey.pairs[0].b_from_a * Pose3.Expmap(np.array([0.05, 0, 0, 0, 0, 0])))
    blocks = (*survey.image_blocks[:3], replace(survey.image_blocks[3], uv=uv), *survey.image_blocks[4:])
    wrong = replace(survey, image_blocks=blocks, pairs=(pair,),
                    distances=(replace(survey.distances[0], value=survey.distances[0].value + 0.01),))  # fmt: skip
    found = search_outliers(wrong, h.start_at(truth))
    assert sorted(d.kind for d in found.rejected) == ["distance", "image", "pair"]
    image = next(d for d in found.rejected if d.kind == "image")
    block = wrong.image_blocks[3]
    assert image.ids == (block.camera_id, block.epoch_id, block.target_id, board.point_ids[int(block.point_idx[2])])
    only = search_outliers(wrong, h.start_at(truth), SearchOptions(kinds=("pair", "distance")))
    assert sorted(d.kind for d in only.rejected) == ["distance", "pair"]
    assert not only.suspects  # of image points the adjustment itself says so
    assert any(w.startswith(f"camera {block.camera_id} at epoch {block.epoch_id}") for w in only.adjustment.warnings)


@pytest.mark.slow
def test_a_wrong_table_reading_and_a_wrong_prior() -> None:
    """The reading is left out and predicted; the prior, part of what is asked for, is only named."""
    survey, truth = head_on_table(2, n_cameras=1, n_table_epochs=5, n_free_epochs=0)
    survey = resample(survey, truth, 4)
    readings = list(survey.table_readings)
    readings[2] = replace(readings[2], angles=readings[2].angles + 60.0 * np.sqrt(np.diag(readings[2].cov)))
    found = search_outliers(replace(survey, table_readings=tuple(readings)), h.start_at(truth))
    assert [(d.kind, d.ids[1]) for d in found.rejected] == [("table", readings[2].epoch_id)]
    assert not found.suspects
    assert [o.used for o in found.adjustment.other_residuals if o.kind == "table"] == [True, True, False, True, True]
    hall, start = net.hall(3)
    points = list(hall.points)
    x = np.asarray(points[5].x_in_world.value)
    points[5] = replace(points[5], x_in_world=PointParameter(x + 0.04, "prior", 1e-6 * np.eye(3)))
    found = search_outliers(replace(hall, points=tuple(points)), start)
    assert [(d.kind, d.ids[1]) for d in found.suspects] == [("prior", points[5].point_id)]
    assert any("cannot be left out: prior" in n for n in found.notes)


def test_joint_covariances_are_split() -> None:
    survey, start = net.hall(3)
    ids = tuple(r.reading_id for r in survey.readings[:4])
    cov = np.diag([r.sigma**2 for r in survey.readings[:4]])
    cov[0, 1] = cov[1, 0] = 0.3 * np.sqrt(cov[0, 0] * cov[1, 1])
    survey = replace(survey, reading_covariances=(ReadingCovariance(ids, cov),))
    adjustment = adjust(survey, start)
    place = candidates(adjustment.precision.graph)
    row = place.n - len(survey.readings) + 1
    less = without(survey, place, [row])
    assert [c.reading_ids for c in less.reading_covariances] == [(ids[0], ids[2], ids[3]), (ids[1],)]
    assert not less.readings[1].used
    np.testing.assert_array_equal(less.reading_covariances[0].cov, cov[np.ix_([0, 2, 3], [0, 2, 3])])
    assert adjust(less, start).redundancy == adjustment.redundancy - 1


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "least"), [(14, 3.0), (29, 2.5), (46, 1.6)])
def test_good_observations_that_went_out_for_a_bad_one_come_back(seed: int, least: float) -> None:
    """Surveys in which data snooping alone keeps a large error and leaves out good readings of a point."""
    _, wrong, sizes = planted(seed)
    _, start = net.hall(seed, n_points=20, n_stations=4, n_tapes=20)
    found = search_outliers(wrong, start, SearchOptions(0.05))
    named = {d.ids[0] for d in found.rejected}
    assert {i for i, size in sizes.items() if size > 1.5} <= named
    assert not named - set(sizes)
    back = [d for d in found.log if d.how == "exchange"]
    assert {d.ids[0] for d in back if d.action == "rejected"} & {i for i, size in sizes.items() if size > least}


def test_two_explanations_that_cannot_be_told_apart_are_both_named() -> None:
    """A point seen by two distances and nothing else along their line: either may be the wrong one."""
    x = {"S1": np.zeros(3), "S2": np.array([10.0, 0.0, 0.0]), "P1": np.array([4.0, 0.0, 0.0])}
    points = tuple(Point(n, PointParameter(v, "free" if n == "P1" else "held", held=("y", "z") if n == "P1" else ()))
                   for n, v in x.items())  # fmt: skip
    readings = tuple(Reading(s, "slope_distance", PositionRef(s), PositionRef("P1"), d, 1e-4)
                     for s, d in (("S1", 4.0), ("S2", 6.01)))  # fmt: skip
    found = search_outliers(Survey(points=points, readings=readings), StartValues({}, {}, x))
    assert len(found.rejected) == 1
    assert len(found.alternatives) == 1
    other = found.alternatives[0]
    assert {other.kept[0][1], other.instead[0][1]} == {"S1", "S2"}
    assert other.odds == pytest.approx(1.0, abs=1e-6)
    assert any("either" in n and "S1" in n and "S2" in n for n in found.notes)


@pytest.mark.slow
def test_nothing_is_left_out_of_a_group_whose_residuals_are_far_below_its_sigmas() -> None:
    survey, start = net.hall(4, n_points=60, n_stations=4)
    readings = [replace(r, sigma=20.0 * r.sigma) if r.group == "direction" else r for r in survey.readings]
    number = next(i for i, r in enumerate(readings) if r.group == "direction")
    wrong = [*readings]
    wrong[number] = replace(wrong[number], value=wrong[number].value + 6.0 * wrong[number].sigma)
    found = search_outliers(replace(survey, readings=tuple(wrong)), start)
    assert not found.rejected
    assert "direction" in found.cautious
    (suspect,) = found.suspects
    assert suspect.ids[0] == wrong[number].reading_id
    assert "stays, for the residuals of group direction are together far smaller" in found.notes[-1]
    # of the others something is, and of the same with sigmas that are right
    distance = next(i for i, r in enumerate(readings) if r.group == "slope_distance")
    wrong[distance] = replace(wrong[distance], value=wrong[distance].value + 20.0 * wrong[distance].sigma)
    again = search_outliers(replace(survey, readings=tuple(wrong)), start)
    assert [d.ids[0] for d in again.rejected] == [wrong[distance].reading_id]
    right = tuple(replace(r, sigma=r.sigma / 20.0) if r.group == "direction" else r for r in wrong)
    both = search_outliers(replace(survey, readings=right), start)
    assert {d.ids[0] for d in both.rejected} == {wrong[number].reading_id, wrong[distance].reading_id}


def test_the_last_solution_stays_where_there_is_none_without_an_observation(monkeypatch: pytest.MonkeyPatch) -> None:
    survey, start = net.hall(4)
    wrong = net.with_reading(survey, 4, value=survey.readings[4].value + 100.0 * survey.readings[4].sigma)
    wrong = net.with_reading(wrong, 40, value=wrong.readings[40].value + 100.0 * wrong.readings[40].sigma)
    needed = wrong.readings[4].reading_id

    def fragile(given: Survey, *arguments: object) -> object:
        if any(r.reading_id == needed and not r.used for r in given.readings):
            raise NotConvergedError("it went astray")
        return adjust(given, *arguments)

    monkeypatch.setattr("adjust.statistics.outliers.search.adjust", fragile)
    found = search_outliers(wrong, start)
    assert needed not in {d.ids[0] for d in found.rejected}
    assert any(f"cannot be left out: {wrong.readings[4].kind}" in n and needed in n for n in found.notes)
    assert all(r.used for r in found.adjustment.survey.readings if r.reading_id == needed)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_small_group_with_sigmas_too_small_loses_only_what_is_wrong(seed: int) -> None:
    survey, start = net.hall(seed, factors={"tape": 64.0})
    assert sum(d.group == "tape" for d in survey.distances) == 12
    assert not [d for d in search_outliers(survey, start).rejected if d.group == "tape"]
    tapes = list(survey.distances)
    tapes[3] = replace(tapes[3], value=tapes[3].value + 150.0 * tapes[3].sigma)
    found = search_outliers(replace(survey, distances=tuple(tapes)), start)
    assert [d.ids[0] for d in found.rejected if d.group == "tape"] == [tapes[3].distance_id]
    assert "tape" in dict(found.widened)


def test_image_points_stay_where_residuals_are_far_below_their_sigmas() -> None:
    survey, truth = h.network(7, n_epochs=3, n_points=40, coordinates=2)
    blocks = [replace(b, cov=100.0 * b.cov) for b in survey.image_blocks]
    uv = blocks[0].uv.copy()
    uv[3] += 7.0 * np.sqrt(blocks[0].cov[3, 0, 0]) * np.array([1.0, 0.0])
    blocks[0] = replace(blocks[0], uv=uv)
    options = AdjustOptions(reject_points=True)
    timid = adjust(replace(survey, image_blocks=tuple(blocks)), h.start_at(truth), options)
    assert timid.image_residuals.used.all()
    assert timid.image_residuals.test[3] > limit(len(timid.image_residuals.test))
    right = tuple(replace(b, cov=b.cov / 100.0) for b in blocks)
    bold = adjust(replace(survey, image_blocks=right), h.start_at(truth), options)
    assert np.flatnonzero(~bold.image_residuals.used).tolist() == [3]


def test_nothing_is_left_out_where_all_directions_are_in_a_wrong_unit() -> None:
    """No set of single readings explains that: the search ends after it has seen that leaving out does not help."""
    survey, start = net.hall(4, n_points=20, n_stations=4, n_tapes=20)
    wrong = tuple(replace(r, value=0.9 * r.value) if r.kind == "direction" else r for r in survey.readings)
    first = adjust(replace(survey, readings=wrong), start)
    found = search_outliers(first.survey, first=first)
    assert found.adjustment is first
    assert (found.rejected, found.log, found.suspects) == ((), (), ())
    assert all(f > 100.0**2 for _, f in found.widened)
    assert any("direction: its typical observation contradicts" in n and "check its units" in n for n in found.notes)


def test_the_criterion_of_every_set_is_that_of_its_own_elimination() -> None:
    """g' inv(R) g of all sets of observations of one, two and three components; a set that leaves something open."""
    rng = np.random.default_rng(5)
    sizes, limits = (1, 2, 3, 1), np.array([7.0, 9.0, 11.0, 5.0])
    B = rng.standard_normal((7, 7))
    B[6] = B[0]  # the first and the last check nothing but each other
    R, g, at = B @ B.T, B @ rng.standard_normal(7), np.split(np.arange(7), np.cumsum(sizes)[:-1])
    sets, J = exchange._criteria(exchange._Near([0, 1, 2, 3], frozenset({0}), g, R, at), limits)
    found = dict(zip(sets.tolist(), J.tolist(), strict=True))
    for s in range(16):
        chosen = [i for i in range(4) if s >> i & 1]
        rows = np.concatenate([np.zeros(0, dtype=int), *(at[i] for i in chosen)])
        own, mine = R[np.ix_(rows, rows)], g[rows]
        expected = np.inf if s & 9 == 9 else limits[chosen].sum() - mine @ np.linalg.solve(own, mine)
        assert found.get(s, np.inf) == pytest.approx(expected, abs=1e-9)
