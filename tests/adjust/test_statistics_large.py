"""What the statistics do in large surveys, against what they do in small ones."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import sparse

from adjust.adjustment import adjust
from adjust.model.result import Adjustment
from adjust.native import blocks
from adjust.observations.images import batch as batch_module
from adjust.precision.precision import precision_of
from adjust.statistics import changes, weakness
from adjust.statistics import normal as normal_module
from adjust.statistics import system as system_module
from adjust.statistics.condensed import condensed_system
from adjust.statistics.effects import uncertainty_budget
from adjust.statistics.reliability import reliability
from adjust.statistics.system import linear_system
from adjust.statistics.weakness import correlations, weak_directions
from survey.simulate import head_on_table
from tests.adjust import helpers as h
from tests.adjust import statistics_networks as net

pytestmark = pytest.mark.slow


@cache
def lab() -> Adjustment:
    survey, truth = head_on_table(2, n_cameras=2, n_table_epochs=12, n_free_epochs=8)
    return adjust(survey, h.start_at(truth))


def test_few_unknowns_that_many_touch_and_many_small_sets() -> None:
    """Against a dense solution; right-hand sides of one and of several columns."""
    rng = np.random.default_rng(1)
    sizes = rng.integers(1, 7, 200)
    n, core = int(sizes.sum()) + 30, 30
    N = np.zeros((n, n))
    at = core
    for k in sizes:
        A = rng.normal(size=(20, core + k)) * (rng.random((20, core + k)) < 0.9)
        index = np.r_[np.arange(core), np.arange(at, at + k)]
        N[np.ix_(index, index)] += A.T @ A
        at += k
    order = rng.permutation(n)
    N = N[np.ix_(order, order)]
    found = normal_module.structured_inverse(sparse.csc_matrix(N), np.ones(n))
    assert found is not None
    assert 2 * n * len(found.U) < n**2
    for b in (rng.normal(size=n), rng.normal(size=(n, 3))):
        x = found.times(b)
        assert x.shape == b.shape
        np.testing.assert_allclose(x, np.linalg.solve(N, b), rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(found.times(sparse.csc_matrix(b.reshape(n, -1))), x.reshape(n, -1), atol=1e-12)
    scale = rng.uniform(0.5, 2.0, n)
    Q = normal_module.structured_inverse(sparse.csc_matrix(N), scale)
    assert Q is not None
    assert np.count_nonzero(Q.member < 0) == len(Q.U)
    inverse = np.linalg.inv(N) * np.outer(scale, scale)
    np.testing.assert_allclose(Q.own.toarray() + Q.U.T @ Q.U, inverse, rtol=1e-8, atol=1e-9 * np.abs(inverse).max())
    full = rng.normal(size=(n, n))
    assert normal_module.structured_inverse(sparse.csc_matrix(full @ full.T), np.ones(n)) is None


def test_lanczos_finds_the_directions_of_the_whole_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    for adjustment in (lab(), adjust(*net.hall(2, n_points=30)), free()):
        system = condensed_system(precision_of(adjustment)).system
        small = weak_directions(adjustment, least_inflation=1.0, system=system)
        with monkeypatch.context() as m:
            m.setattr(weakness, "FEW", 10)
            large = weak_directions(adjustment, least_inflation=1.0, system=system)
        assert len(large) == 5
        for a, b in zip(small, large, strict=True):
            assert b.inflation == pytest.approx(a.inflation, rel=1e-6)
            assert (b.parts[0].name, b.parts[0].component) == (a.parts[0].name, a.parts[0].component)
            assert abs(b.parts[0].amount) == pytest.approx(abs(a.parts[0].amount), rel=1e-3)


def free() -> Adjustment:
    """A network with inner constraints."""
    survey, start = net.hall(3)
    points = tuple(replace(p, x_in_world=replace(p.x_in_world, treatment="free", held=())) for p in survey.points)
    return adjust(replace(survey, points=points, datum=replace(survey.datum, kind="inner")), start)


def test_correlations_of_a_large_survey_leave_out_only_what_they_say(monkeypatch: pytest.MonkeyPatch) -> None:
    """Between single epochs; all others are those of a small one."""
    adjustment = lab()
    system = condensed_system(precision_of(adjustment)).system
    every = correlations(adjustment, 0.8, system=system)
    assert every == correlations(adjustment, 0.8, system=system)
    once = np.array([len(n) < 3 for n in system.columns.names])
    n = len(system.columns)
    monkeypatch.setattr(weakness, "PLAIN", 10)
    monkeypatch.setattr(weakness, "DENSE", 10)
    assert len(weakness.compared_columns(system)) == n
    monkeypatch.setattr(weakness, "_WORK", np.count_nonzero(once) * n)
    assert sorted(weakness.compared_columns(system)) == np.flatnonzero(once).tolist()
    found = correlations(adjustment, 0.8, system=system)
    key = lambda x: frozenset([(x.a, x.a_component), (x.b, x.b_component)])  # noqa: E731  # said twice
    expected = {key(x): x.coefficient for x in every if len(x.a) < 3 or len(x.b) < 3 or x.a == x.b}
    got = {key(x): x.coefficient for x in found}
    assert len(got) == len(found)
    assert got.keys() == expected.keys()
    assert len(got) > 10
    for k, value in got.items():
        assert value == pytest.approx(expected[k], abs=1e-6)


def test_small_sets_that_meet_in_few_unknowns_are_compared_with_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every pair, of single epochs too; and changes from every epoch on, as by solutions for each."""
    adjustment = lab()
    condensed = condensed_system(precision_of(adjustment))
    searched = changes.ChangeSearch(adjustment, condensed)
    assert condensed.system.normal.structured is None
    monkeypatch.setattr(weakness, "_MOST", 10_000)
    every = correlations(adjustment, 0.3, system=condensed.system)
    monkeypatch.setattr(normal_module, "PLAIN", 10)
    monkeypatch.setattr(system_module, "PLAIN", 10)
    monkeypatch.setattr(weakness, "PLAIN", 10)
    monkeypatch.setattr(weakness, "DENSE", 10)
    condensed = condensed_system(precision_of(adjustment))
    system = condensed.system
    monkeypatch.setattr(weakness, "_WHOLE", len(system.columns) - 1)
    assert weakness._structure(system, 0.3) is not None
    assert system.normal.structured is not None
    found = correlations(adjustment, 0.3, system=system)
    assert len(weakness.compared_columns(system)) == len(system.columns)
    assert len(found) == len(every) > 10
    for x, y in zip(sorted(found, key=str), sorted(every, key=str), strict=True):
        assert (x.a, x.a_component, x.b, x.b_component) == (y.a, y.a_component, y.b, y.b_component)
        assert x.coefficient == pytest.approx(y.coefficient, abs=1e-6)
    for a, b in zip(searched.candidates, changes.ChangeSearch(adjustment, condensed).candidates, strict=True):
        np.testing.assert_allclose(a.M, b.M, rtol=0.0, atol=1e-7)
    assert max(len(a.M) for a in searched.candidates) > 5


def test_the_covariance_through_tree_and_bundles_is_that_of_the_normal_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of given and inner datums, with points and poses that bundles hide: some columns, and what rows have of it."""
    rng, hidden = np.random.default_rng(0), set[str]()
    for adjustment in (lab(), adjust(*net.hall(2, n_points=30)), free(), adjust(*h.network(1)[:1])):
        precision = precision_of(adjustment)
        hidden |= {precision.unknowns.by_key[key].name[0] for key in precision.hidden}
        system = condensed_system(precision_of(adjustment)).system
        right, rows = rng.normal(size=(len(system.columns), 5)), system.A[::7]
        expected, of_rows = system.times_covariance(right), system.among(rows)
        with monkeypatch.context() as m:
            m.setattr(system_module, "PLAIN", 10)
            m.setattr(system_module, "AT_ONCE", 3)
            large = replace(system)
            assert large.structured is None
            scale = np.sqrt(np.diag(system.covariance))[:, None] * np.linalg.norm(system.sigmas)
            np.testing.assert_allclose(large.times_covariance(right) / scale, expected / scale, atol=1e-7)
            np.testing.assert_allclose(large.times_covariance(right[:, 0]), large.times_covariance(right)[:, 0])
            np.testing.assert_allclose(large.among(rows), of_rows, atol=1e-7)
            few = len(of_rows) // 3
            sums = of_rows[: 3 * few, : 3 * few].reshape(few, 3, few, 3)[::-1, :, ::-1].cumsum(axis=0).cumsum(axis=2)
            expected = np.einsum("jajb->jab", sums)[::-1]
            for one in (large, system):
                found = one.among_sums(rows[: 3 * few], 3)
                np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())
    assert hidden == {"point", "world_from_station"}


def test_correlations_from_the_tree_are_those_of_the_normal_matrix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a datum held by observations, and of inner constraints: all of them, nothing is left out."""
    for adjustment in (lab(), free()):
        system = condensed_system(precision_of(adjustment)).system
        every = correlations(adjustment, 0.5, system=system)
        with monkeypatch.context() as m:
            m.setattr(weakness, "PLAIN", 10)
            m.setattr(weakness, "DENSE", 10)
            m.setattr(weakness, "covariance_columns", None)
            assert len(weakness.compared_columns(system)) == len(system.columns)
            found = correlations(adjustment, 0.5, system=system)
        assert len(found) == len(every) > 10
        for x, y in zip(sorted(found, key=str), sorted(every, key=str), strict=True):
            assert (x.a, x.a_component, x.b, x.b_component) == (y.a, y.a_component, y.b, y.b_component)
            assert x.coefficient == pytest.approx(y.coefficient, abs=1e-6)


def test_drawn_solutions_scatter_as_the_covariance_says() -> None:
    """Of given and inner datums, with points and poses that bundles hide: every correlation within six sigmas."""
    k = 4000
    for adjustment in (lab(), adjust(*net.hall(2, n_points=30)), free(), adjust(*h.network(1)[:1])):
        system = condensed_system(precision_of(adjustment)).system
        errors, sigmas = system.drawn(k), np.sqrt(np.diag(system.covariance))
        rho = system.covariance / sigmas / sigmas[:, None]
        found = (errors @ errors.T) / k / sigmas / sigmas[:, None]
        assert np.abs((found - rho) / np.sqrt((1.0 + rho**2) / k)).max() < 6.0


def test_the_budget_is_that_of_all_rows() -> None:
    """By the condensed system, whose largest source is what the others leave, and source by source from every row."""
    adjustment = lab()
    full, small = linear_system(adjustment), condensed_system(precision_of(adjustment)).system
    names = [("lens", c.camera_id) for c in adjustment.survey.cameras] + [("table_geometry", "turntable")]
    Q = np.linalg.inv((full.A.T @ full.A + full.datum.T @ full.datum).toarray())
    effects = (full.A @ Q) ** 2
    for entry in uncertainty_budget(adjustment, names, system=small):
        at = full.columns.names.index(entry.name)
        at += full.columns.components[at:].index(entry.component)
        for line in entry.lines:
            group = full.group[full.row_of] == full.group_names.index(line.source)
            assert line.u**2 == pytest.approx(float(effects[group, at].sum()), rel=1e-5, abs=1e-9 * entry.u**2)


def test_threads_and_portions_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Tests, condensed rows, solutions and correlations by one thread and by three, and tests in other portions."""
    adjustment = lab()

    def everything() -> list[np.ndarray]:
        condensed = condensed_system(precision_of(adjustment))
        found = reliability(adjustment, system=condensed)
        listed = correlations(adjustment, 0.5, system=condensed.system)
        tests = [found.tests.external, found.tests.freedom, *vars(found.tests.every).values()]
        tests += [found.tests.p, found.tests.p_posterior, found.tests.p_w, found.tests.p_tau]
        rows = [condensed.system.A.toarray(), condensed.e, *condensed.own]
        shifts = np.array([x.shift for x in found.influences])
        return [*tests, *rows, shifts, np.array([x.coefficient for x in listed])]

    monkeypatch.setattr(blocks, "_WORTHWHILE", 300)
    monkeypatch.setattr(batch_module, "_AT_ONCE", 200)
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("LABSURVEY_THREADS", threads)
        found.append(everything())
    monkeypatch.setattr(blocks, "_WORTHWHILE", 50_000)
    found.append(everything())
    assert len(found[0][0]) > 900
    for others in found[1:]:
        for a, b in zip(found[0], others, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("case", [lab, free, lambda: adjust(*net.hall(2, n_points=30))])
def test_tests_of_some_observations_are_those_of_all(case: Callable[[], Adjustment]) -> None:
    tests = reliability(case(), most_influences=0).tests
    rows = np.flatnonzero(np.arange(len(tests.used)) % 7 == 3)
    assert rows[-1] > tests.n_image
    parts = np.concatenate([np.arange(tests.ptr[i], tests.ptr[i + 1]) for i in rows])
    some = tests.of(rows)
    np.testing.assert_array_equal(np.diff(some.ptr), tests.n_components[rows])
    np.testing.assert_array_equal(tests.every.external, tests.external)
    for name in ("redundancy", "least", "statistic", "detectable", "external"):
        np.testing.assert_array_equal(getattr(some, name), getattr(tests, name)[rows])
    for name in ("w", "error", "detectable_component", "bias"):
        np.testing.assert_array_equal(getattr(some, name), getattr(tests, name)[parts])


def test_what_others_say_as_arrays_is_what_they_say_one_by_one() -> None:
    adjustment = adjust(*net.hall(2, n_points=30))
    one_by_one, arrays = adjustment.other_residuals, adjustment.other_arrays
    assert len(one_by_one) > 100
    np.testing.assert_array_equal(arrays.n_components, [len(o.components) for o in one_by_one])
    np.testing.assert_array_equal(arrays.used, [o.used for o in one_by_one])
    np.testing.assert_array_equal(arrays.test, [o.test for o in one_by_one])
    np.testing.assert_array_equal(arrays.redundancy, [o.redundancy.max() for o in one_by_one])
    np.testing.assert_array_equal(arrays.standardized, np.concatenate([o.standardized for o in one_by_one]))
    largest = [np.nanmax(np.abs(o.standardized), initial=0.0) for o in one_by_one]
    np.testing.assert_array_equal(arrays.largest, largest)
