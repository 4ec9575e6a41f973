"""The search for gross errors: what fails its test goes, what fits comes back, until neither is left.

Data snooping (Baarda 1968; Kok 1984 for the iteration), once for all that is searched: pairs of a network, epochs of a
rigid body, spots, and single observations. A search is made of values: how a set of observations is solved and tested,
the error probability of all tests together, the number of tests from which the typical one tells whether sigmas are too
small throughout, and the step from one state to the next.

Sigmas that are too small are told from wrong observations: of many the typical test says it, and the limits grow. Among
few a wrong one shows in most of the others; there the search is gone through worst first, and the state whose
explanation is likeliest counts (:func:`adjust.testing.criteria.explanation_cost`).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import numpy as np

from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.frozen import frozen
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.testing.criteria import (
    MANY,
    cautious,
    cost_of_leaving_out,
    explanation_cost,
    limits,
    typical_factor,
    widening,
)

S = TypeVar("S")
_LONGEST = 60
"""Observations that may go before the likeliest explanation is no longer looked for: far too much is wrong then."""


@frozen(eq=False)
class Verdicts:
    """Of M observations: test statistics, degrees of freedom (0 where nothing tests one), which are in use.

    Those out of use are tested against what the others predict. possible: (M,) may be left out. group: (M,). omega,
    redundancy: (G,) v'Pv of all groups.
    """

    statistic: FloatArray
    freedom: IntArray
    used: BoolArray
    possible: BoolArray
    group: IntArray
    omega: FloatArray
    redundancy: FloatArray

    @property
    def cautious(self) -> BoolArray:
        """Groups (G,) whose residuals are all together far smaller than their sigmas say: nothing contradicts these."""
        mine = [self.used & (self.group == g) for g in range(len(self.omega))]
        return np.array([cautious(self.statistic[m], self.freedom[m]) for m in mine], dtype=np.bool_)


def one_group(
    statistic: FloatArray, freedom: IntArray, used: BoolArray, omega: float = np.nan, redundancy: float = np.nan
) -> Verdicts:
    """Tests of observations that may all be left out, and have the same standard of sigmas."""
    none = np.zeros(len(used), dtype=np.int64)
    return Verdicts(statistic, freedom, used, freedom > 0, none, np.array([omega]), np.array([redundancy]))


@frozen(eq=False)
class State(Generic[S]):
    """A solution without what is out. limit: (M,) of the tests, widened; over: (M,) tests over it, 0 where untested.

    factor: (G,) what the limits of each group are widened by.
    """

    solution: S
    tests: Verdicts
    limit: FloatArray
    over: FloatArray
    factor: FloatArray

    @property
    def failing(self) -> BoolArray:
        """Observations (M,) in use that fail and may be left out."""
        return np.asarray(self.tests.used & self.tests.possible & (self.over > 1.0))

    @property
    def fitting(self) -> BoolArray:
        """Observations (M,) that are out, and fit."""
        return np.asarray(~self.tests.used & (self.tests.freedom > 0) & (self.over <= 1.0))

    @property
    def worst(self) -> int:
        """Of those that fail."""
        return int(np.where(self.failing, self.over, 0.0).argmax())

    @property
    def cost(self) -> float:
        """-2 ln likelihood of what is left, and the price of what was left out."""
        t = self.tests
        out = ~t.used & (t.freedom > 0)
        left_out = cost_of_leaving_out(t.statistic[out], t.freedom[out], self.limit[out])
        return explanation_cost(zip(t.omega.tolist(), t.redundancy.tolist(), strict=True), left_out)

    @property
    def supposed(self) -> FloatArray:
        """The factors (G,) of limits that go with this explanation, 1 where none is needed."""
        t = self.tests
        of = ((g, t.used & (t.group == g)) for g in range(len(t.omega)))
        return np.array([widening(float(t.omega[g]), float(t.redundancy[g]), t.statistic[m], t.freedom[m])
                         for g, m in of])  # fmt: skip


Step = Callable[[State[S], BoolArray], tuple[BoolArray, BoolArray]]
"""From a state, and what has come back before (M,): what goes (M,), and what comes back (M,)."""


def only(index: int, n: int) -> BoolArray:
    """A mask (n,) of one."""
    out = np.zeros(n, dtype=np.bool_)
    out[index] = True
    return out


def worst_first(state: State[S], returned: BoolArray) -> tuple[BoolArray, BoolArray]:
    """The worst goes; when none fails, all that fit come back."""
    none = np.zeros(len(returned), dtype=np.bool_)
    if state.failing.any():
        return only(state.worst, len(returned)), none
    return none, state.fitting & ~returned


def all_at_once(state: State[S], returned: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Everything that fails goes, and everything that fits comes back."""
    return state.failing, state.fitting & ~returned


def best_back_first(state: State[S], returned: BoolArray) -> tuple[BoolArray, BoolArray]:
    """What fits best comes back; when none does, the worst goes."""
    none, back = np.zeros(len(returned), dtype=np.bool_), state.fitting & ~returned
    if back.any():
        return none, only(int(np.where(back, state.tests.statistic, np.inf).argmin()), len(back))
    return (only(state.worst, len(returned)), none) if state.failing.any() else (none, none)


@dataclass(eq=False)
class Search(Generic[S]):
    """How one kind of observations is searched.

    solve: the solution with the observations (M,) in use and its tests, from the state before where there is one; None
    where there is no such solution. family_alpha: error probability of all tests together; n_tests: how many these are,
    counted where not given. many: tests from which the typical one widens the limits. factor: (G,) that these are wider
    by anyhow. said: told of every step before it is made.
    """

    solve: Callable[[BoolArray, State[S] | None], tuple[S, Verdicts] | None]
    family_alpha: float
    step: Step[S] = worst_first
    many: float = MANY
    n_tests: int | None = None
    factor: FloatArray = field(default_factory=lambda: np.ones(1))
    said: Callable[[State[S], BoolArray, BoolArray], None] = lambda *_: None

    def state(self, used: BoolArray, before: State[S] | None = None) -> State[S] | None:
        """Solved with these (M,) in use, and judged; None where there is no solution."""
        found = self.solve(used, before)
        return None if found is None else self.judged(*found)

    def judged(self, solution: S, tests: Verdicts) -> State[S]:
        """Tests over their limits, at one level for all."""
        tested = tests.freedom > 0
        mine = tests.used & tested
        factor = self.factor
        if np.count_nonzero(mine) >= self.many:
            factor = np.maximum(factor, typical_factor(tests.statistic, np.where(mine, tests.freedom, 0)))
        n = int(tested.sum()) if self.n_tests is None else self.n_tests
        limit = limits(self.family_alpha, tests.freedom, n) * (factor if len(factor) == 1 else factor[tests.group])
        over = np.where(tested & ~np.isnan(tests.statistic), tests.statistic / limit, 0.0)
        return State(solution, tests, limit, over, factor)

    def settled(self, state: State[S], most: int | None = None) -> State[S]:
        """From this state on, until nothing goes and nothing comes back; each comes back only once.

        Where a step leads to no solution it ends before it. Raises NotConvergedError after ``most`` steps.
        """
        returned = np.zeros(len(state.tests.used), dtype=np.bool_)
        for _ in range(3 * len(returned) + 2 if most is None else most):
            out, back = self.step(state, returned)
            if not out.any() and not back.any():
                return state
            self.said(state, out, back)
            returned |= back
            after = self.state((state.tests.used | back) & ~out, state)
            if after is None:
                return state
            state = after
        raise NotConvergedError("no set of observations that agree was found; they contradict each other")

    def likeliest(self, state: State[S], groups: BoolArray) -> State[S] | None:
        """Of this state and those after it, worst first down to half of one of the ``groups`` (G,), the likeliest.

        None where far too much is wrong to say.
        """
        best = state
        size = np.bincount(state.tests.group[state.tests.used], minlength=len(groups))
        for _ in range(_LONGEST):
            if not state.failing.any():
                break
            worst = state.worst
            g = int(state.tests.group[worst])
            left = int(np.count_nonzero(state.tests.used & (state.tests.group == g)))
            if groups[g] and 2 * (left - 1) < size[g]:
                break
            try:
                after = self.state(state.tests.used & ~only(worst, len(state.over)), state)
            except IndeterminateError:
                break
            if after is None:
                break
            state = after
            best = min(best, state, key=lambda s: s.cost)
        else:
            return None
        return best
