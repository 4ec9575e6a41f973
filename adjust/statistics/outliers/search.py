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

from adjust.adjustment import AdjustOptions, adjust
from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import BoolArray, FloatArray, Survey
from adjust.statistics.condensed import condensed_system
from adjust.statistics.outliers.candidates import as_given, candidates, without
from adjust.statistics.outliers.exchange import Exchange, better_set, equal_sets
from adjust.statistics.outliers.snooping import Snooping
from adjust.statistics.reliability import observation_name
from adjust.statistics.result import Alternative, Decision
from adjust.statistics.system import linear_system, precision_of
from adjust.testing.criteria import MANY, limits
from adjust.testing.distributions import chi2
from adjust.testing.gross_errors import Search, State, Verdicts, best_back_first

_ROUNDS = 12
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


def search_outliers(
    survey: Survey, start: StartValues | None = None, options: SearchOptions = DEFAULT_SEARCH,
    progress: Callable[[int, float], None] | None = None, first: Adjustment | None = None,
) -> OutlierSearch:  # fmt: skip
    """Adjust a survey without its gross errors. first: its adjustment, where there is one.

    What the survey does not use stays out. Raises as :func:`adjust.adjustment.adjust`.
    """
    now = first or adjust(survey, start, options.adjust, progress)
    images = options.kinds is None or "image" in options.kinds
    survey = as_given(now.survey, survey) if options.adjust.reject_points and not images else now.survey
    round_ = first_round = _Round(now, options, images)
    found, given = round_.found, round_.snooping.used
    log: list[Decision] = []
    seen: set[frozenset[int]] = {frozenset()}
    needed: set[int] = set()
    out: tuple[int, ...] = ()
    first, worst = now, np.inf
    while True:
        state = round_.searched((*out, *sorted(needed)), log)
        if round_.contradicted > _BETTER * worst:
            return first_round.without_search(first)
        worst = round_.contradicted if round_.contradicted else worst
        new = tuple(o for o in state.solution.out if o not in needed)
        if frozenset(new) in seen:
            new = tuple(sorted({*new, *out}))  # turning in circles: the cautious choice
        converged = set(new) == set(out)
        if converged or round_.number == _ROUNDS:
            return round_.result(state, out, needed, log, converged, now)
        seen.add(frozenset(new))
        before, (now, out) = out, _left_out(now, out, new, lambda these, now: adjust(
            without(survey, found, these), values_of(now), options.adjust, progress))  # fmt: skip
        needed |= set(new) - set(out)
        if out == before and set(new) <= set(out):  # what should come back has no solution either
            return round_.result(state, out, needed, log, True, now)
        round_ = _Round(now, options, images, given, round_.number + 1)


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


class _Round:
    """The search in one solution, linearised there. given: (M,) what the survey uses, which the solution may not."""

    def __init__(
        self, now: Adjustment, options: SearchOptions, images: bool, given: BoolArray | None = None, number: int = 1
    ) -> None:
        self.now, self.options, self.images, self.number = now, options, images, number
        system = linear_system(now) if images else condensed_system(precision_of(now)).system
        first = 0 if images else system.n_image
        if given is not None:
            system = replace(system, used=np.concatenate([system.used[:first], given]))
        self.found = candidates(system.precision.graph, images)
        points = int(now.image_residuals.used.sum())
        allowed = self.found.mask() & system.used[first:]
        if options.kinds is not None:
            allowed &= [self._name(o)[0] in options.kinds for o in range(len(allowed))]
        self.snooping = Snooping(system, allowed, first, 0 if images else 2 * points)
        tests = self.snooping.tests()
        self.cautious, self.factor, self.contradicted = tests.cautious, np.ones(len(tests.omega)), 0.0
        self.snooping.candidates = allowed & ~self.cautious[tests.group]
        self.n_tests = int(np.count_nonzero(tests.freedom > 0)) + (0 if images else points)

    def _name(self, o: int) -> tuple[str, tuple[str, ...]]:
        """Kind and ids."""
        if self.images:
            return observation_name(self.now, o)
        found = self.now.other_residuals[o]
        return found.kind, found.ids

    def searched(self, out: Iterable[int], log: list[Decision]) -> State[Snooping]:
        """The state without gross errors; ``out`` are those of the round before."""
        now, begin, how = self.snooping, list(out), ""
        self.factor = self._factor(now)
        state = self._search().judged(now, now.tests())
        if not begin and (state.tests.used & (state.over > 1.0)).any():
            begin, how = self._suspected(state), "robust"
        now = now.using(now.used)
        for o in begin:
            if now.possible(o):
                if how:
                    log.append(self._decision("rejected", o, now, how))
                now.leave_out(o)
        if begin:
            self.factor = self._factor(now)

        def said(state: State[Snooping], goes: BoolArray, back: BoolArray) -> None:
            log.extend(self._decision("rejected", o, state.solution, "test") for o in np.flatnonzero(goes).tolist())
            log.extend(self._decision("readmitted", o, state.solution, "test") for o in np.flatnonzero(back).tolist())

        search = replace(self._search(), said=said)
        state = search.settled(search.judged(now, now.tests()))
        for _ in range(2 * len(now.sizes) + 2):
            found = None if self.contradicted else better_set(state.solution, self._limits())
            if found is None:
                break
            log += [self._decision("readmitted", o, state.solution, "exchange") for o in found.kept]
            used = state.tests.used.copy()
            used[list(found.kept)] = True
            now = state.solution.using(used)
            for o in found.instead:
                log.append(self._decision("rejected", o, now, "exchange"))
                now.leave_out(o)
            state = search.settled(search.judged(now, now.tests()))
        return state

    def _search(self) -> Search[Snooping]:
        def solve(used: BoolArray, before: State[Snooping] | None) -> tuple[Snooping, Verdicts]:
            now = (self.snooping if before is None else before.solution).using(used)
            return now, now.tests()

        return Search(solve, self.options.family_alpha, best_back_first, np.inf, self.n_tests, self.factor)

    def _factor(self, now: Snooping) -> FloatArray:
        """By how much the sigmas (squared) of every group (G,) are too small, where that cannot be chance; else 1."""
        tests = now.tests()
        self.factor = np.ones(len(tests.omega))
        n = np.bincount(tests.group[tests.used & (tests.freedom > 0)], minlength=len(self.factor))
        for g in np.flatnonzero(n >= MANY).tolist():
            mine = tests.used & (tests.group == g) & (tests.freedom > 0)
            ratio = tests.statistic[mine] / chi2.ppf(0.5, tests.freedom[mine])
            if np.mean(ratio > 1.0) > 0.5 + 1.5 / np.sqrt(n[g]):  # three sigmas of a fair coin
                self.factor[g] = max(1.0, float(np.median(ratio)))
        most = float(self.factor.max())
        self.contradicted = most if most > _GLOBAL else 0.0
        few, search = (n > 0) & (n < MANY), self._search()
        state = search.judged(now, tests)
        if not few[tests.group[tests.used & (state.over > 1.0)]].any():
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

    def _decision(self, action: Action, o: int, now: Snooping, how: str) -> Decision:
        (kind, ids), v, g = self._name(o), now.verdict(o), int(now.group[o])
        factor = float(self.factor[g])
        limit = float(limits(self.options.family_alpha, np.array(v.freedom), self.n_tests)) * factor
        p = float(chi2.sf(v.statistic / factor, max(v.freedom, 1)))
        group = now.system.group_names[g]
        return Decision(action, kind, group, ids, v.statistic, v.freedom, p, limit, v.error, self.number, how)

    def without_search(self, adjustment: Adjustment) -> OutlierSearch:
        """Nothing left out: no set of single observations explains what contradicts."""
        self.factor = self._factor(self.snooping)
        state = self._search().judged(self.snooping, self.snooping.tests())
        return replace(self.result(state, (), (), [], False, adjustment), suspects=())

    def result(
        self, state: State[Snooping], out: Iterable[int], needed: Iterable[int], log: list[Decision], converged: bool,
        adjustment: Adjustment,
    ) -> OutlierSearch:  # fmt: skip
        """With ``out`` left out, and what is ``needed`` in use, though it fails."""
        used = self.snooping.used.copy()
        used[[*out, *needed]] = False
        now = state.solution.using(used)
        last, names = self._search().judged(now, now.tests()), now.system.group_names
        rejected = [self._decision("rejected", o, now, "test") for o in out]
        suspects = [*np.flatnonzero(last.tests.used & (last.over > 1.0)).tolist(), *needed]
        suspects.sort(key=lambda o: -float(last.over[o]))
        mine = {names[g] for g in np.unique(now.group[now.candidates]).tolist()}
        return OutlierSearch(
            adjustment, adjustment.survey, tuple(sorted(rejected, key=lambda d: -d.statistic / d.limit)), tuple(log),
            tuple(self._decision("rejected", o, now, "test") for o in suspects), self.number, converged,
            tuple(self._alternative(x) for x in equal_sets(now, self._limits())),
            tuple(n for n, timid in zip(names, self.cautious, strict=False) if timid),
            tuple((n, float(f)) for n, f in zip(names, self.factor, strict=False) if f > 1.0 and n in mine),
        )  # fmt: skip

    def _alternative(self, x: Exchange) -> Alternative:
        kept, instead = (tuple((kind, *ids) for kind, ids in map(self._name, part)) for part in (x.kept, x.instead))
        return Alternative(kept, instead, float(np.exp(0.5 * x.more)))
