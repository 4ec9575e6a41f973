"""Gross errors among observations of every kind: found by tests, each decision logged, taken back where it was wrong.

A robust solution says what most observations agree on, and whom to suspect first; tests with the error probability of
the whole family decide (:mod:`adjust.testing.gross_errors`, on the linear system of
:mod:`adjust.statistics.outliers.snooping`); the survey is solved again without what they leave out, and the
search repeated there, until nothing changes. The result is a plain least squares. Where image points are not searched
they stand condensed, and are screened anew at every solution.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from gtsam import Pose3, Rot3

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.result import Adjustment, Decision, ObservationResidual, ParameterName
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.precision.precision import Precision, precision_of
from adjust.statistics.condensed import condensed_system
from adjust.statistics.outliers.candidates import Candidates, as_given, candidates, without
from adjust.statistics.outliers.exchange import Exchange, better_set, equal_sets
from adjust.statistics.outliers.snooping import Snooping, Verdict
from adjust.statistics.outliers.watched import FOLLOWED, WatchedSnooping, large, watchable, watched
from adjust.statistics.reliability import observation_name
from adjust.statistics.result import Alternative
from adjust.statistics.system import groups_of_others, linear_system
from adjust.testing.criteria import MANY, limits
from adjust.testing.distributions import chi2
from adjust.testing.gross_errors import Search, State, Verdicts, best_back_first
from adjust.testing.single_tests import CONTROLLED

_ROUNDS = 12
_CROWD = 0.05
"""Share of the observations that fail, from which a network of pairs is first looked at without a solution."""
_NONE: IntArray = np.zeros(0, dtype=np.int64)
_GLOBAL = 100.0**2
"""Factor of variances from which not single observations are wrong, but a unit, a sense or a name of them all."""
_BETTER = 0.25
"""What a round must bring it down to, to go on all the same: large errors show only once some of them are out."""


@dataclass(frozen=True)
class SearchOptions:
    """family_alpha: error probability of all tests together.

    kinds: which may be left out (kinds as in ``ObservationResidual``, "image" for image points); None for all but
    priors.
    """

    family_alpha: float = 0.001
    kinds: tuple[str, ...] | None = None
    adjust: AdjustOptions = field(default_factory=AdjustOptions)


Action = Literal["rejected", "readmitted"]
DEFAULT_SEARCH = SearchOptions()


@dataclass(frozen=True, eq=False)
class OutlierSearch:
    """The clean least squares, its survey, and how it was found.

    rejected: what is out in the end, worst first. log: every decision in order, also those taken back. suspects: what
    fails its test but cannot be left out, because something would be undetermined without it, or because it is a prior
    or of a kind that is kept. converged: whether the last round changed nothing. alternatives: where other observations
    could be the wrong ones. cautious: groups whose residuals are all together far smaller than their sigmas say; of
    them nothing is left out. widened: factors of the variances of groups that are too small throughout.
    """

    adjustment: Adjustment
    survey: Survey
    rejected: tuple[Decision, ...]
    log: tuple[Decision, ...]
    suspects: tuple[Decision, ...]
    rounds: int
    converged: bool
    alternatives: tuple[Alternative, ...] = ()
    cautious: tuple[str, ...] = ()
    widened: tuple[tuple[str, float], ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """For people, worst first."""
        pairs = {o.ids: o for o in self.adjustment.other_residuals if o.kind == "pair" and not o.used}
        notes = tuple(_said_of_pair(pairs[d.ids], d) if d.ids in pairs else d.text() for d in self.rejected)
        notes += tuple(a.text() for a in self.alternatives)
        notes += tuple(
            f"group {g}: its typical observation contradicts the rest; sigmas {np.sqrt(f):.1f} times as large explain "
            f"that better than wrong observations do, and none was left out for it; {_to_check(f)}"
            for g, f in self.widened
        )
        return notes + tuple(
            f"fails its test, but {self._stays(d)}: {d.text().split(': ', 1)[1]}" for d in self.suspects
        )

    def _stays(self, suspect: Decision) -> str:
        if suspect.group in self.cautious:
            return f"stays, for the residuals of group {suspect.group} are together far smaller than its sigmas say"
        return "cannot be left out"


def _to_check(factor: float) -> str:
    if factor > _GLOBAL:
        return "check its units, the sense of its angles and the names in it"
    return "check its sigmas, and those of what it is compared with, or estimate variance components"


def _said_of_pair(o: ObservationResidual, d: Decision) -> str:
    """In degrees and metres."""
    turn = np.degrees(np.linalg.norm(o.residual[:3]))
    shift = f" and {np.linalg.norm(o.residual[3:]):.4g} m" if len(o.residual) == 6 else ""
    return f"left out: pair {o.ids[0]}: off by {turn:.4g} deg{shift}, test {d.statistic:.1f}, p {d.p:.2g}"


@dataclass(frozen=True, eq=False)
class Disagreeing:
    """Pairs (E,) of a network that do not agree with the others, and where these put the stations."""

    pairs: BoolArray
    start: StartValues


def search_outliers(
    survey: Survey, start: StartValues | None = None, options: SearchOptions = DEFAULT_SEARCH,
    progress: Callable[[int, float], None] | None = None, first: Adjustment | None = None,
    wrong: Disagreeing | None = None,
) -> OutlierSearch:  # fmt: skip
    """Adjust a survey without its gross errors. first: its adjustment, where there is one.

    wrong: pairs that the search begins without. What the survey does not use stays out. Raises as
    :func:`adjust.adjustment.adjust`.
    """
    def solved(part: Survey, start: StartValues | None) -> Adjustment:
        return adjust(part, start, options.adjust, progress)

    images, given, out = options.kinds is None or "image" in options.kinds, None, tuple[int, ...]()
    if wrong is None:
        now = first or solved(survey, start)
        survey = as_given(now.survey, survey) if options.adjust.reject_points and not images else now.survey
    else:
        now = solved(_with_pairs(survey, wrong.pairs), wrong.start)
        found = candidates(precision_of(now).graph, images)
        given, out = _used(now, found), found.of("pairs", np.flatnonzero(wrong.pairs))
        given[list(out)] = True
        now, out = _taken_back(now, out, options, lambda these, now: solved(
            without(survey, found, these), values_of(now)))  # fmt: skip
    round_ = first_round = _Round(now, options, images, given)
    found, given, first_out, worst = round_.found, round_.given, out, np.inf
    if wrong is None and round_.crowded:
        wrong = disagreeing_pairs(now.survey, float(round_.factor.max()))
        if wrong is not None:
            mine, begin = found.of("pairs", np.flatnonzero(wrong.pairs)), wrong.start
            now, out = _left_out(now, (), mine, lambda these, _: solved(without(survey, found, these), begin))
            now, out = _taken_back(now, out, options, lambda these, now: solved(
                without(survey, found, these), values_of(now)))  # fmt: skip
            round_ = _Round(now, options, images, given)
    log = [round_.rejected(o, round_.snooping, "robust") for o in out]
    seen: set[frozenset[int]] = {frozenset()}
    needed: set[int] = set()
    while True:
        state, every = round_.searched((*out, *sorted(needed)), log)
        if round_.contradicted > _BETTER * worst:
            return first_round.without_search(first_out)
        worst = round_.contradicted or worst
        new = tuple(o for o in every if o not in needed)
        if frozenset(new) in seen:
            new = tuple(sorted({*new, *out}))  # turning in circles: the cautious choice
        converged = set(new) == set(out)
        if converged or round_.number == _ROUNDS:
            return round_.result(state, out, needed, log, converged, now)
        seen.add(frozenset(new))
        before, (now, out) = out, _left_out(now, out, new, lambda these, now: solved(
            without(survey, found, these), values_of(now)))  # fmt: skip
        needed |= set(new) - set(out)
        if out == before and set(new) <= set(out):  # what should come back has no solution either
            return round_.result(state, out, needed, log, True, now)
        round_ = _Round(now, options, images, given, round_.number + 1, round_.index)


def disagreeing_pairs(survey: Survey, factor: float = 1.0, only_large: bool = False) -> Disagreeing | None:
    """What of a network does not agree, found before its tests; None for other surveys.

    factor: of all variances. only_large: None, too, where a solution with the wrong ones in costs little.
    """
    if not survey.pairs:
        return None
    from adjust.pose_network.agreement import disagreeing
    from adjust.pose_network.from_survey import network_of_pairs  # here: a survey without pairs starts without it

    network = network_of_pairs(survey)
    if network is None or (only_large and not large(int(network.sizes.sum()), network.n_stations * network.dim)):
        return None
    try:
        found = disagreeing(network, DEFAULT_SEARCH.family_alpha, factor)
    except (IndeterminateError, NotConvergedError):
        return None
    if found is None or not found[0].any():
        return None
    pairs, (R, t) = found
    names: list[ParameterName] = [("world_from_station", s) for s in network.station_ids]
    poses = {n: Pose3(Rot3(a), b) for n, a, b in zip(names, R, t, strict=True)}
    return Disagreeing(pairs, StartValues({}, poses, {}))


def _with_pairs(survey: Survey, wrong: BoolArray) -> Survey:
    """Without the wrong ones (E,)."""
    return replace(survey, pairs=tuple(
        replace(p, used=False) if out else p for p, out in zip(survey.pairs, wrong.tolist(), strict=True)
    ))  # fmt: skip


def _left_out(
    now: Adjustment, out: tuple[int, ...], new: tuple[int, ...],
    leave: Callable[[tuple[int, ...], Adjustment], Adjustment],
) -> tuple[Adjustment, tuple[int, ...]]:  # fmt: skip
    """Adjusted without ``new``; where there is no such solution, without those before and as many more as can go."""
    try:
        return leave(new, now), new
    except (IndeterminateError, NotConvergedError):
        if len(set(new) - set(out)) > 1:
            for o in new:
                if o not in out:
                    now, out = _left_out(now, out, (*out, o), leave)
        return now, out


def _taken_back(
    now: Adjustment, out: tuple[int, ...], options: SearchOptions,
    leave: Callable[[tuple[int, ...], Adjustment], Adjustment],
) -> tuple[Adjustment, tuple[int, ...]]:  # fmt: skip
    """Of more than can be followed one by one all that fits comes back at once, until little does."""
    for _ in range(_ROUNDS):
        tests = _tests_of_all(now)
        limit = limits(options.family_alpha, tests.freedom, int(np.count_nonzero(tests.freedom > 0)))
        fits = tests.statistic <= limit * _typical(tests)[tests.group]
        left = tuple(o for o in out if not fits[o])
        if len(out) <= FOLLOWED or len(left) == len(out):
            break
        now, out = leave(left, now), left
    return now, out


class _Round:
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
        self.given = _used(now, self.found) if given is None else given
        allowed = self.found.mask() & self.given
        if options.kinds is not None:
            allowed &= [self._name(o)[0] in options.kinds for o in range(len(allowed))]
        self._everything = _tests_of_all(now) if watchable(now) else None
        if self._everything is None:
            self._follow_all(precision, allowed, 2 * points)
        else:
            self._watch(self._everything, allowed, before)
        tests = self._all(self.snooping.tests())
        self.n_tests = int(np.count_nonzero(tests.freedom > 0)) + points
        self.cautious, self.factor, self.contradicted = tests.cautious, _typical(tests), 0.0
        self.snooping.candidates &= ~self.cautious[self.snooping.group]
        self._at = {o: i for i, o in enumerate(self.index.tolist())}

    def _follow_all(self, precision: Precision, allowed: BoolArray, n_kept: int) -> None:
        system = linear_system(self.now) if self.images else condensed_system(precision).system
        first = 0 if self.images else system.n_image
        system = replace(system, used=np.concatenate([system.used[:first], self.given]))
        self.index, self.snooping = np.arange(len(allowed)), Snooping(system, allowed, first, n_kept)

    def _watch(self, tests: Verdicts, allowed: BoolArray, before: IntArray) -> None:
        n = int(np.count_nonzero(tests.freedom > 0))
        limit = limits(self.options.family_alpha, tests.freedom, n) * _typical(tests)[tests.group]
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
        def solve(used: BoolArray, before: State[Snooping] | None) -> tuple[Snooping, Verdicts]:
            now = (self.snooping if before is None else before.solution).using(used)
            return now, now.tests()

        return Search(solve, self.options.family_alpha, best_back_first, np.inf, self.n_tests, self.factor)

    def _factor(self, now: Snooping) -> FloatArray:
        """By how much the sigmas (squared) of every group (G,) are too small, where that cannot be chance; else 1."""
        mine = now.tests()
        tests = self._all(mine)
        self.factor = _typical(tests)
        n = np.bincount(tests.group[tests.used & (tests.freedom > 0)], minlength=len(self.factor))
        most = float(self.factor.max(initial=1.0))
        self.contradicted = most if most > _GLOBAL else 0.0
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
        e = np.linalg.norm(precision_of(self.now).rows(precision_of(self.now).graph.others[o]).e)
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
            adjustment, adjustment.survey, tuple(sorted(rejected, key=lambda d: -d.statistic / d.limit)), tuple(log),
            tuple(self._decision("rejected", i, now, "test") for i in suspects), self.number, converged,
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


def _typical(tests: Verdicts) -> FloatArray:
    """Of groups (G,) of many the factor that their typical test shows."""
    factor = np.ones(len(tests.omega))
    n = np.bincount(tests.group[tests.used & (tests.freedom > 0)], minlength=len(factor))
    for g in np.flatnonzero(n >= MANY).tolist():
        mine = tests.used & (tests.group == g) & (tests.freedom > 0)
        ratio = tests.statistic[mine] / chi2.ppf(0.5, tests.freedom[mine])
        if np.mean(ratio > 1.0) > 0.5 + 1.5 / np.sqrt(n[g]):  # three sigmas of a fair coin
            factor[g] = max(1.0, float(np.median(ratio)))
    return factor


def _used(now: Adjustment, found: Candidates) -> BoolArray:
    """What takes part (M,) in an adjustment."""
    points = now.image_residuals.used if found.n_image else now.image_residuals.used[:0]
    return np.concatenate([points, now.other_arrays.used])


def _tests_of_all(now: Adjustment) -> Verdicts:
    """Tests (M,) of everything but image points and readings, each with the others as they are."""
    graph, others = precision_of(now).graph, now.other_arrays
    names = groups_of_others(graph)
    number = {name: i for i, name in enumerate(dict.fromkeys(names))}
    tested = np.isfinite(others.test) & (~others.used | (others.redundancy > CONTROLLED))
    freedom = np.where(tested, others.n_components, 0)
    if graph.pairs is not None:
        freedom[graph.first_pair + graph.pairs.rows] = precision_of(now).pairs.freedom
    none = np.full(len(number) + 1, np.nan)
    return Verdicts(np.nan_to_num(others.test), freedom, others.used, np.ones(len(names), dtype=np.bool_),
                    np.array([number[n] for n in names], dtype=np.int64), none, none)  # fmt: skip
