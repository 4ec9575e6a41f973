"""Gross errors among observations of every kind: found by tests, each decision logged, taken back where it was wrong.

A robust solution says what most observations agree on, and whom to suspect first; tests with the error probability of
the whole family decide (see :mod:`adjust.statistics.snooping`); the survey is solved again without what they leave
out, and the search repeated there, until nothing changes. The result is a plain least squares.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np

from adjust.adjustment import AdjustOptions, adjust
from adjust.distributions import chi2
from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, IntArray, Survey
from adjust.statistics.candidates import Candidates, candidates, without
from adjust.statistics.criteria import criteria, sidak
from adjust.statistics.exchange import better_set, equal_sets
from adjust.statistics.reliability import observation_name
from adjust.statistics.result import Alternative, Decision, LevelOptions
from adjust.statistics.snooping import Snooping, robust_squares
from adjust.statistics.supposed import cautious_groups, group_factors
from adjust.statistics.system import LinearSystem, linear_system


@dataclass(frozen=True)
class SearchOptions:
    """levels: of the tests; with method "sidak" the family is all tested observations.

    kinds: which may be left out (kinds as in ``ObservationResidual``, "image" for image points); None for all but
    priors. robust: begin with a robust solution. posterior: test with sigma0 of the other
    observations. typical: where the sigmas of a whole group are plainly too small, widen its limits.
    """

    levels: LevelOptions = field(default_factory=lambda: LevelOptions(family_alpha=0.001))
    kinds: tuple[str, ...] | None = None
    robust: bool = True
    posterior: bool = False
    typical: bool = True
    max_rounds: int = 12
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
        notes = tuple(d.text() for d in self.rejected) + tuple(a.text() for a in self.alternatives)
        notes += tuple(
            f"group {g}: its typical observation contradicts the rest; sigmas {np.sqrt(f):.1f} times as large explain "
            "that better than wrong observations do, and none was left out for it; check its sigmas, and those of what "
            "it is compared with, or estimate variance components"
            for g, f in self.widened
        )
        return notes + tuple(
            f"fails its test, but {self._stays(d)}: {d.text().split(': ', 1)[1]}" for d in self.suspects
        )

    def _stays(self, suspect: Decision) -> str:
        if suspect.group in self.cautious:
            return f"stays, for the residuals of group {suspect.group} are together far smaller than its sigmas say"
        return "cannot be left out"


def search_outliers(
    survey: Survey, start: StartValues | None = None, options: SearchOptions = DEFAULT_SEARCH,
    progress: Callable[[int, float], None] | None = None, first: Adjustment | None = None,
) -> OutlierSearch:  # fmt: skip
    """Adjust a survey without its gross errors. first: its adjustment, where there is one.

    What the survey does not use stays out. Raises as :func:`adjust.adjustment.adjust`.
    """
    now = first or adjust(survey, start, options.adjust, progress)
    survey = now.survey
    found: Candidates | None = None
    out: tuple[int, ...] = ()
    log: list[Decision] = []
    seen: set[frozenset[int]] = {frozenset()}
    needed: set[int] = set()
    converged, rounds = False, 0
    while not converged and rounds < options.max_rounds:
        rounds += 1
        system = linear_system(now)
        if found is None:
            given, found = system.used.copy(), candidates(system.precision.graph)
        snooping = _searched(replace_used(system, given), found, now, options, out, rounds, log, needed)
        new = tuple(snooping.out)
        converged = set(new) == set(out)
        if converged:
            break
        if frozenset(new) in seen:
            new = tuple(sorted(set(new) | set(out)))  # turning in circles: the cautious choice
            converged = set(new) == set(out)
        seen.add(frozenset(new))
        try:
            now = adjust(without(survey, found, new), values_of(now), options.adjust, progress)
            out = new
        except (IndeterminateError, NotConvergedError):
            # without all of these there is no solution: the last good one stays, and they take part in it
            converged = set(new) <= set(out)
            needed |= set(new) - set(out)
    snooping.take_back([o for o in snooping.out if o not in out])
    rejected = _decisions("rejected", out, snooping, now, rounds, "test")
    names, factors = snooping.system.group_names, snooping.factors
    few = factors if options.typical else np.ones(len(names))
    return OutlierSearch(
        now, now.survey, tuple(sorted(rejected, key=lambda d: -d.statistic / d.limit)), tuple(log),
        _suspects(snooping, now, rounds), rounds, converged, _alternatives(snooping, now),
        tuple(np.array(names)[cautious_groups(snooping, len(names))].tolist()),
        tuple((n, float(f)) for n, f in zip(names, few, strict=True) if f > 1.0 and n in _kinds_groups(snooping)),
    )  # fmt: skip


def _kinds_groups(snooping: Snooping) -> set[str]:
    """Groups of which something may be left out."""
    names = snooping.system.group_names
    return {names[int(g)] for g in snooping.system.group[snooping.candidates]}


def replace_used(system: LinearSystem, used: BoolArray) -> LinearSystem:
    """The system with other observations in use."""
    return replace(system, used=used.copy())


def _searched(
    system: LinearSystem, found: Candidates, now: Adjustment, options: SearchOptions, out: Iterable[int], round_: int,
    log: list[Decision], needed: set[int],
) -> Snooping:  # fmt: skip
    """The system without its gross errors; ``out`` are those of the round before, ``needed`` stay."""
    G = len(system.group_names)
    snooping = Snooping(system, _allowed(system, found, now, options), 1.0, np.ones(G), options.posterior)
    snooping.candidates[list(needed)] = False
    snooping.candidates &= ~cautious_groups(snooping, G)[system.group]
    _, freedom, _ = snooping.statistics()
    snooping.level = _level(options, int(np.count_nonzero((freedom > 0) & system.used)))
    begin = list(out)
    if options.typical:
        snooping.factors = group_factors(snooping, G)
    if not begin and options.robust and _anything_fails(snooping):
        begin = _suspected(system, snooping, freedom, log, now, round_)
    for o in begin:
        if snooping.failing()[1][o]:
            snooping.leave_out(o)
    if options.typical and begin:
        snooping.factors = group_factors(snooping, G)
    _settle(snooping, log, now, round_)
    for _ in range(2 * len(snooping.sizes) + 2):
        if not _exchanged(snooping, log, now, round_):
            break
        _settle(snooping, log, now, round_)
    return snooping


def _exchanged(snooping: Snooping, log: list[Decision], now: Adjustment, round_: int) -> bool:
    """Put good observations back in place of bad ones; whether there were any."""
    found = better_set(snooping)
    if found is None:
        return False
    log += _decisions("readmitted", found.kept, snooping, now, round_, "exchange")
    snooping.take_back(found.kept)
    for o in found.instead:
        log.append(_decision("rejected", o, snooping, now, round_, "exchange"))
        snooping.leave_out(o)
    return True


def _alternatives(snooping: Snooping, now: Adjustment) -> tuple[Alternative, ...]:
    def names(observations: Iterable[int]) -> tuple[tuple[str, ...], ...]:
        return tuple((kind, *ids) for kind, ids in (observation_name(now, o) for o in observations))

    return tuple(
        Alternative(names(x.kept), names(x.instead), float(np.exp(0.5 * x.more))) for x in equal_sets(snooping)
    )


def _allowed(system: LinearSystem, found: Candidates, now: Adjustment, options: SearchOptions) -> BoolArray:
    mask = found.mask() & system.used
    if options.kinds is not None:
        for row in np.flatnonzero(mask).tolist():
            mask[row] = observation_name(now, row)[0] in options.kinds
    return mask


def _level(options: SearchOptions, n_tests: int) -> float:
    if options.levels.method == "sidak":
        return sidak(options.levels.family_alpha, n_tests)
    return float(criteria(options.levels, n_tests).alpha[0])


def _anything_fails(snooping: Snooping) -> bool:
    excess, _ = snooping.failing()
    return bool(excess.max(initial=0.0) > 1.0)


def _suspected(
    system: LinearSystem, snooping: Snooping, freedom: IntArray, log: list[Decision],
    now: Adjustment, round_: int,
) -> list[int]:  # fmt: skip
    """Whom a robust solution suspects, worst first."""
    squares = robust_squares(system, freedom, snooping.factors)
    limits = chi2.isf(snooping.level, np.maximum(freedom, 1))
    ratio = np.where(system.used & snooping.candidates, squares / limits, 0.0)
    order = np.argsort(-ratio, kind="stable")
    suspects = [int(o) for o in order[: int(np.count_nonzero(ratio > 1.0))]]
    for o in suspects:
        if snooping.failing()[1][o]:
            log.append(_decision("rejected", o, snooping, now, round_, "robust"))
            snooping.leave_out(o)
    snooping.take_back(list(snooping.out))
    return suspects


def _settle(snooping: Snooping, log: list[Decision], now: Adjustment, round_: int) -> None:
    """Take back what fits, leave out what fails worst, until neither is left; each comes back once in a round."""
    returned: set[int] = set()
    for _ in range(2 * len(snooping.sizes) + 2):
        back = [o for o in snooping.fitting() if o not in returned]
        if back:
            best = min(back, key=lambda o: snooping.verdict(o).statistic)
            log.append(_decision("readmitted", best, snooping, now, round_, "test"))
            returned.add(best)
            snooping.take_back([best])
            continue
        excess, possible = snooping.failing()
        excess = np.where(possible, excess, 0.0)
        worst = int(excess.argmax()) if len(excess) else 0
        if not len(excess) or excess[worst] <= 1.0:
            return
        log.append(_decision("rejected", worst, snooping, now, round_, "test"))
        snooping.leave_out(worst)


def _decision(action: Action, o: int, snooping: Snooping, now: Adjustment, round_: int, how: str) -> Decision:
    kind, ids = observation_name(now, o)
    v = snooping.verdict(o)
    group = snooping.system.group_names[int(snooping.system.group[o])]
    return Decision(action, kind, group, ids, v.statistic, v.freedom, v.p, v.limit, v.error, round_, how)


def _decisions(
    action: Action, rows: Iterable[int], snooping: Snooping, now: Adjustment, round_: int, how: str
) -> list[Decision]:
    return [_decision(action, o, snooping, now, round_, how) for o in rows]


def _suspects(snooping: Snooping, now: Adjustment, round_: int) -> tuple[Decision, ...]:
    excess, _ = snooping.failing()
    rows = np.argsort(-excess, kind="stable")[: int(np.count_nonzero(excess > 1.0))]
    return tuple(_decisions("rejected", [int(r) for r in rows], snooping, now, round_, "test"))
