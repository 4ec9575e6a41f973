"""The search for gross errors on the smallest survey there is: one length, measured many times."""

import numpy as np
import pytest
from scipy.stats import chi2

from adjust.model.errors import NotConvergedError
from adjust.model.survey import BoolArray, FloatArray
from adjust.testing.gross_errors import (
    Search,
    State,
    Verdicts,
    all_at_once,
    best_back_first,
    one_group,
    worst_first,
)

ALPHA = 0.01


def of_one_length(lengths: FloatArray, sigma: float = 1.0) -> Search[float]:
    """The mean of what is in use; tests of the others against it (Baarda 1968)."""

    def solve(used: BoolArray, before: State[float] | None) -> tuple[float, Verdicts] | None:
        n = int(used.sum())
        if n < 2:
            return None
        mean = float(lengths[used].mean())
        e = (lengths - mean) / sigma
        T = e**2 / np.where(used, 1.0 - 1.0 / n, 1.0 + 1.0 / n)
        return mean, one_group(T, np.ones(len(T), dtype=np.int64), used, float(e[used] @ e[used]), n - 1.0)

    return Search(solve, ALPHA, many=np.inf)


def begun(search: Search[float], used: BoolArray) -> State[float]:
    state = search.state(used)
    assert state is not None
    return state


def test_limits_are_those_of_the_family() -> None:
    state = begun(of_one_length(np.array([0.1, -0.2, 0.3, 0.0])), np.ones(4, dtype=np.bool_))
    np.testing.assert_allclose(state.limit, chi2.isf(1.0 - (1.0 - ALPHA) ** 0.25, 1), rtol=1e-12)


@pytest.mark.parametrize("step", [worst_first, best_back_first])
def test_what_fails_goes_and_what_was_out_by_mistake_comes_back(step) -> None:
    lengths = np.array([0.3, -0.4, 0.1, 12.0, 0.2, -9.0, -0.1, 0.5])
    search = of_one_length(lengths)
    search.step = step
    told: list[tuple[list[int], list[int]]] = []
    search.said = lambda _, out, back: told.append((np.flatnonzero(out).tolist(), np.flatnonzero(back).tolist()))
    used = np.ones(8, dtype=np.bool_)
    used[0] = False  # by mistake
    last = search.settled(begun(search, used))
    assert np.flatnonzero(~last.tests.used).tolist() == [3, 5]
    assert last.solution == pytest.approx(lengths[[0, 1, 2, 4, 6, 7]].mean())
    assert ([3], []) in told
    assert any(0 in back for _, back in told)


def test_all_that_fail_may_go_at_once_while_all_that_fit_come_back() -> None:
    search = of_one_length(np.array([0.3, -0.4, 0.1, 12.0, 0.2, -9.0, -0.1, 0.5]))
    search.step = all_at_once
    told: list[tuple[list[int], list[int]]] = []
    search.said = lambda _, out, back: told.append((np.flatnonzero(out).tolist(), np.flatnonzero(back).tolist()))
    last = search.settled(begun(search, np.arange(8) > 0))
    assert told == [([3, 5], [0])]
    assert np.flatnonzero(~last.tests.used).tolist() == [3, 5]


def test_where_the_next_step_has_no_solution_the_last_one_stays() -> None:
    search = of_one_length(np.array([0.0, 40.0, 90.0]))
    last = search.settled(begun(search, np.ones(3, dtype=np.bool_)))
    assert last.tests.used.sum() == 2
    assert last.failing.any()


def test_a_search_without_end_is_said() -> None:
    search = of_one_length(np.array([0.3, -0.4, 0.1, 12.0, 0.2, -9.0]))
    with pytest.raises(NotConvergedError, match="contradict"):
        search.settled(begun(search, np.ones(6, dtype=np.bool_)), most=1)


def test_among_few_a_wrong_one_is_told_from_sigmas_that_are_too_small() -> None:
    lengths = np.array([1.1, -0.6, 0.4, -1.3, 0.2, 0.9, -0.7])
    every, groups = np.ones(7, dtype=np.bool_), np.ones(1, dtype=np.bool_)
    small = of_one_length(lengths, sigma=0.1)
    best = small.likeliest(begun(small, every), groups)
    assert best is not None
    assert best.tests.used.all()
    spread = float(np.sum((lengths - lengths.mean()) ** 2)) / 0.01 / 6.0
    assert best.supposed[0] >= spread  # with such sigmas nothing is wrong
    wrong = of_one_length(lengths + 25.0 * (np.arange(7) == 2))
    best = wrong.likeliest(begun(wrong, every), groups)
    assert best is not None
    assert np.flatnonzero(~best.tests.used).tolist() == [2]
    assert best.supposed.tolist() == [1.0]
