"""One round of the search for gross errors: in one solution, linearised there, to the likeliest set of them."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from adjust.model.errors import IndeterminateError
from adjust.model.names import numbered
from adjust.model.result import Adjustment, Decision
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.precision.precision import Precision, precision_of
from adjust.statistics.condensed import condensed_system
from adjust.statistics.outliers.candidates import Candidates, candidates
from adjust.statistics.outliers.exchange import Exchange, better_set, equal_sets
from adjust.statistics.outliers.outcome import GLOBAL, Action, OutlierSearch, SearchOptions
from adjust.statistics.outliers.snooping import Snooping, Verdict
from adjust.statistics.outliers.watched import WatchedSnooping, watchable, watched
from adjust.statistics.reliability import observation_name
from adjust.statistics.result import Alternative
from adjust.statistics.rows import groups_of_others
from adjust.statistics.system import linear_system
from adjust.testing.criteria import MANY, limits
from adjust.testing.distributions import chi2
from adjust.testing.gross_errors import Search, State, Verdicts, best_back_first
from adjust.testing.single_tests import CONTROLLED

_CROWD = 0.05
"""Share of the observations that fail, from which a network of pairs is first looked at without a solution."""
_FEW = 200
"""Tests of a group up to which they count as independent of each other."""
_NONE: IntArray = np.zeros(0, dtype=np.int64)


class Round:
    """The search in one solution, linearised there. given: (M,) what the survey uses, which the solution may not.

    index: (m,) which of the M observations the snooping follows: all, in a large survey those that are watched, among
    them what was so ``before``.
    """

    def __init__(
        self, now: Adjustment, options: SearchOptions, images: bool, given: BoolArray | None = None, number: int = 1,
        before: IntArray = _NONE,
    ) -> None:  # fmt: skip
        self.now, self.options, self.images, self.number = now, options, images, number
        precision = precision_of(now)
        self.found = candidates(precision.graph, images)
        points = 0 if images else int(now.image_residuals.used.sum())
        self.given = used_at(now, self.found) if given is None else given
        allowed = self.found.mask & self.given
        if options.kinds is not None:
            kinds = ["image"] * self.found.n_image + precision.graph.of_others(lambda o: o.kind, lambda _: "pair")
            kinds += [r.kind for r in now.survey.readings]
            allowed &= [kind in options.kinds for kind in kinds]
        self._everything = tests_of_all(now) if watchable(now) else None
        if self._everything is None:
            self._follow_all(precision, allowed, 2 * points)
        else:
            self._watch(self._everything, allowed, before)
        tests = self._all(self.snooping.tests())
        self.n_tests = int(np.count_nonzero(tests.freedom > 0)) + points
        self.cautious, self.factor, self.contradicted = tests.cautious, typical(tests), 0.0
        self.snooping.candidates &= ~self.cautious[self.snooping.group]
        self._at = {o: i for i, o in enumerate(self.index.tolist())}

    def _follow_all(self, precision: Precision, allowed: BoolArray, n_kept: int) -> None:
        system = linear_system(self.now) if self.images else condensed_system(precision).system
        first = 0 if self.images else system.n_image
        system = replace(system, used=np.concatenate([system.used[:first], self.given]))
        self.index, self.snooping = np.arange(len(allowed)), Snooping(system, allowed, first, n_kept)

    def _watch(self, tests: Verdicts, allowed: BoolArray, before: IntArray) -> None:
        n = int(np.count_nonzero(tests.freedom > 0))
        limit = limits(self.options.family_alpha, tests.freedom, n) * typical(tests)[tests.group]
        over = np.where(tests.freedom > 0, tests.statistic / limit, 0.0)
        self.index = watched(over, tests.used, allowed & (tests.freedom > 0), before)
        self.snooping = WatchedSnooping(self.now, self.index, self.given)

    @property
    def crowded(self) -> bool:
        """Whether so much of many fails that the tests no longer say whom to suspect."""
        tests = self._all(self.snooping.tests())
        limit = limits(self.options.family_alpha, tests.freedom, self.n_tests) * self.factor[tests.group]
        failing = np.count_nonzero(tests.used & (tests.freedom > 0) & (tests.statistic > limit))
        return bool(failing > max(_CROWD * self.n_tests, 1.0) and self.n_tests >= MANY and not self.cautious.all())

    def _all(self, tests: Verdicts) -> Verdicts:
        """Tests (M,) of everything, where ``tests`` are of what the snooping follows."""
        every = self._everything
        if every is None:
            return tests
        statistic, freedom, used = every.statistic.copy(), every.freedom.copy(), every.used.copy()
        statistic[self.index], freedom[self.index], used[self.index] = tests.statistic, tests.freedom, tests.used
        return replace(every, statistic=statistic, freedom=freedom, used=used)

    def _name(self, o: int) -> tuple[str, tuple[str, ...]]:
        """Kind and ids."""
        if self.images:
            return observation_name(self.now, o)
        found = self.now.other_residuals[o]
        return found.kind, found.ids

    def searched(self, out: Iterable[int], log: list[Decision]) -> tuple[State[Snooping], tuple[int, ...]]:
        """The state without gross errors, and all that is out then; ``out`` are those of the round before."""
        now, begin, how = self.snooping, [self._at[o] for o in out if o in self._at], ""
        self.factor = self._factor(now)
        state = self._search().judged(now, now.tests())
        if not begin and (state.tests.used & (state.over > 1.0)).any():
            begin, how = self._suspected(state), "robust"
        now = now.using(now.used)
        for i in begin:
            if now.possible(i):
                if how:
                    log.append(self._decision("rejected", i, now, how))
                now.leave_out(i)
        if begin:
            self.factor = self._factor(now)

        def said(state: State[Snooping], goes: BoolArray, back: BoolArray) -> None:
            log.extend(self._decision("rejected", i, state.solution, "test") for i in np.flatnonzero(goes).tolist())
            log.extend(self._decision("readmitted", i, state.solution, "test") for i in np.flatnonzero(back).tolist())

        search = replace(self._search(), said=said)
        state = search.settled(search.judged(now, now.tests()))
        for _ in range(2 * len(now.sizes) + 2):
            found = None if self.contradicted else better_set(state.solution, self._limits())
            if found is None:
                break
            log += [self._decision("readmitted", i, state.solution, "exchange") for i in found.kept]
            used = state.tests.used.copy()
            used[list(found.kept)] = True
            now = state.solution.using(used)
            for i in found.instead:
                log.append(self._decision("rejected", i, now, "exchange"))
                now.leave_out(i)
            state = search.settled(search.judged(now, now.tests()))
        unwatched = [o for o in out if o not in self._at]
        return state, (*unwatched, *self.index[state.solution.out].tolist())

    def _search(self) -> Search[Snooping]:
        def solve(used: BoolArray, before: State[Snooping] | None) -> tuple[Snooping, Verdicts] | None:
            try:
                now = (self.snooping if before is None else before.solution).using(used)
            except IndeterminateError:
                return None
            return now, now.tests()

        return Search(solve, self.options.family_alpha, best_back_first, np.inf, self.n_tests, self.factor)

    def _factor(self, now: Snooping) -> FloatArray:
        """By how much the sigmas (squared) of every group (G,) are too small, where that cannot be chance; else 1."""
        mine = now.tests()
        tests = self._all(mine)
        self.factor = typical(tests)
        n = np.bincount(tests.group[tests.used & (tests.freedom > 0)], minlength=len(self.factor))
        most = float(self.factor.max(initial=1.0))
        self.contradicted = most if most > GLOBAL else 0.0
        few, search = (n > 0) & (n < MANY), self._search()
        state = search.judged(now, mine)
        if not few[mine.group[mine.used & (state.over > 1.0)]].any():
            return self.factor
        best = search.likeliest(state, few)
        if best is None or not best.failing.any():
            return self.factor
        return np.maximum(self.factor, np.where(few, best.supposed, 1.0))

    def _suspected(self, state: State[Snooping]) -> list[int]:
        """Whom a robust solution suspects, worst first."""
        squares = self.snooping.robust_squares(state.tests.freedom, self.factor)
        limit = limits(self.options.family_alpha, state.tests.freedom, self.n_tests)
        ratio = np.where(state.tests.used & self.snooping.candidates, squares / limit, 0.0)
        return [int(o) for o in np.argsort(-ratio, kind="stable")[: int(np.count_nonzero(ratio > 1.0))]]

    def _limits(self) -> FloatArray:
        """Of the tests (M,) of whole observations."""
        s = self.snooping
        return limits(self.options.family_alpha, s.sizes, self.n_tests) * self.factor[s.group]

    def _decision(self, action: Action, i: int, now: Snooping, how: str) -> Decision:
        """Of what the snooping counts as ``i``."""
        return self._told(action, int(self.index[i]), now.verdict(i), int(now.group[i]), how)

    def _told(self, action: Action, o: int, v: Verdict, group: int, how: str) -> Decision:
        (kind, ids), factor = self._name(o), float(self.factor[group])
        limit = float(limits(self.options.family_alpha, np.array(v.freedom), self.n_tests)) * factor
        p = float(chi2.sf(v.statistic / factor, max(v.freedom, 1)))
        name = self.snooping.group_names[group]
        return Decision(action, kind, name, ids, v.statistic, v.freedom, p, limit, v.error, self.number, how)

    def rejected(self, o: int, now: Snooping, how: str = "test") -> Decision:
        """Of an observation that is out, watched or not."""
        every = self._everything
        if o in self._at or every is None:
            return self._decision("rejected", self._at[o], now, how)
        r = self.now.other_residuals[o]
        e = np.linalg.norm(precision_of(self.now).rows(precision_of(self.now).graph.other(o)).e)
        verdict = Verdict(r.test, int(every.freedom[o]), float(e))
        return self._told("rejected", o, verdict, int(every.group[o]), how)

    def without_search(self, out: Iterable[int]) -> OutlierSearch:
        """Nothing more left out: no set of single observations explains what contradicts."""
        self.factor = self._factor(self.snooping)
        state = self._search().judged(self.snooping, self.snooping.tests())
        return replace(self.result(state, out, (), [], False, self.now), suspects=())

    def result(
        self, state: State[Snooping], out: Iterable[int], needed: Iterable[int], log: list[Decision], converged: bool,
        adjustment: Adjustment,
    ) -> OutlierSearch:  # fmt: skip
        """With ``out`` left out, and what is ``needed`` in use, though it fails."""
        used, kept = self.snooping.used.copy(), [self._at[o] for o in needed if o in self._at]
        used[[*(self._at[o] for o in out if o in self._at), *kept]] = False
        now = state.solution.using(used)
        last, names = self._search().judged(now, now.tests()), now.group_names
        rejected = [self.rejected(o, now) for o in out]
        suspects = [*np.flatnonzero(last.tests.used & (last.over > 1.0)).tolist(), *kept]
        suspects.sort(key=lambda i: -float(last.over[i]))
        mine = {names[g] for g in np.unique(now.group[now.candidates]).tolist()}
        return OutlierSearch(
            adjustment, tuple(sorted(rejected, key=lambda d: -d.statistic / d.limit)), tuple(log),
            tuple(self._decision("rejected", i, now, "test") for i in suspects), converged,
            tuple(self._alternative(x) for x in equal_sets(now, self._limits())),
            tuple(n for n, timid in zip(names, self.cautious, strict=False) if timid),
            tuple((n, float(f)) for n, f in zip(names, self.factor, strict=False) if f > 1.0 and n in mine),
        )  # fmt: skip

    def _alternative(self, x: Exchange) -> Alternative:
        kept, instead = (
            tuple((kind, *ids) for kind, ids in (self._name(int(self.index[i])) for i in part))
            for part in (x.kept, x.instead)
        )
        return Alternative(kept, instead, float(np.exp(0.5 * x.more)))


def typical(tests: Verdicts) -> FloatArray:
    """Of groups (G,) of many the factor that their typical test shows.

    Tests of n observations that share r / n of their redundancy vary no more than r independent ones: the squared
    correlations of a projection's rows add up to n / r. Of few that is not asked: what is wrong takes it away.
    """
    factor = np.ones(len(tests.omega))
    n = np.bincount(tests.group[tests.used & (tests.freedom > 0)], minlength=len(factor))
    for g in np.flatnonzero(n >= MANY).tolist():
        mine = tests.used & (tests.group == g) & (tests.freedom > 0)
        freedom, of = np.unique(tests.freedom[mine], return_inverse=True)
        ratio = tests.statistic[mine] / chi2.ppf(0.5, freedom)[of]
        independent = min(n[g], max(tests.redundancy[g] / np.mean(tests.freedom[mine]), _FEW))
        if np.mean(ratio > 1.0) > 0.5 + 1.5 / np.sqrt(independent):  # three sigmas of a fair coin
            factor[g] = max(1.0, float(np.median(ratio)))
    return factor


def used_at(now: Adjustment, found: Candidates) -> BoolArray:
    """What takes part (M,) in an adjustment."""
    points = now.image_residuals.used if found.n_image else now.image_residuals.used[:0]
    return np.concatenate([points, now.other_arrays.used])


def tests_of_all(now: Adjustment) -> Verdicts:
    """Tests (M,) of everything but image points and readings, each with the others as they are."""
    graph, others = precision_of(now).graph, now.other_arrays
    names, group = numbered(groups_of_others(graph))
    tested = np.isfinite(others.test) & (~others.used | (others.redundancy > CONTROLLED))
    freedom = np.where(tested, others.n_components, 0)
    if graph.pairs is not None:
        freedom[graph.first_pair + graph.pairs.rows] = precision_of(now).pairs.freedom
    none, possible = np.full(len(names) + 1, np.nan), np.ones(len(group), dtype=np.bool_)
    own = np.where(others.used[others.observation], others.redundancies, 0.0)
    redundancy = np.bincount(group[others.observation], own, len(names) + 1).astype(float)
    return Verdicts(np.nan_to_num(others.test), freedom, others.used, possible, group, none, redundancy)
