"""Surveys with measured pairs: whole pairs that contradict the rest are found by test, left out, and listed.

Surveys that are nothing but pairs are solved as pose networks, which need no start. In all others the worst pair goes
first, one by one (Baarda's data snooping, 1968), each tested with the error probability of the whole family (Sidak
1967); what fits in the end is taken back. Pairs that are left out stay in the survey, out of use: predicted and tested.
It ends where a pair less would leave something undetermined, or half of them would be out; where sigmas that are too
small throughout explain the residuals better than wrong pairs, the limits grow instead.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from adjust.adjustment import AdjustOptions, adjust, assemble
from adjust.distributions import chi2
from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.statistics.criteria import (
    MANY,
    cautious,
    cost_of_leaving_out,
    explanation_cost,
    sidak,
    typical_factor,
    widening,
)
from adjust.statistics.robust import limit as image_limit

if TYPE_CHECKING:
    from adjust.pose_network import NetworkSolution

Progress = Callable[[int, float], None]
_FAMILY = 0.001
_ROUNDS = 40
_SUMS = ("omega", "redundancy")
_CONTROLLED = 1e-4  # redundancy number below which nothing controls an observation


@dataclass(frozen=True)
class PairOptions:
    """reject_pairs: leave pairs out that contradict the others. adjust: what holds for all surveys."""

    reject_pairs: bool = True
    adjust: AdjustOptions = field(default_factory=AdjustOptions)


def adjust_with_pairs(
    survey: Survey, options: PairOptions = PairOptions(), progress: Progress | None = None,
    start: StartValues | None = None,
) -> Adjustment:  # fmt: skip
    """Adjust a survey, without its wrong pairs where the options say so; the same as ``adjust`` where it has no pairs.

    start: where the adjustment begins; found where not given. Raises as :func:`adjust.adjustment.adjust`.
    """
    if is_pure(survey):
        found = adjusted_network(survey, network_solution(survey, options, progress), options)
        if survey.pair_form == "poses":
            return found
        from adjust.relay.closed import in_condition_form  # here: as below

        return in_condition_form(found)
    result = adjust(survey, start, options.adjust, progress)
    if options.reject_pairs and any(p.used for p in survey.pairs):
        result = _PairSearch(survey, result, options, progress).result()
    return replace(result, warnings=result.warnings + _uncontrolled_warning(result))


def is_pure(survey: Survey) -> bool:
    """Whether a survey is a network of pairs between fixed stations, and nothing else."""
    return survey.is_pose_network and not (survey.points or survey.targets or survey.tables)


def network_solution(
    survey: Survey, options: PairOptions = PairOptions(), progress: Progress | None = None,
    start: tuple[FloatArray, FloatArray] | None = None,
) -> "NetworkSolution":  # fmt: skip
    """The pose network of a pure survey, solved. start: rotations (N, 3, 3) and translations (N, 3) of its stations.

    Raises IndeterminateError naming the stations that no pair in use reaches.
    """
    reached = {r.frame_id for p in survey.pairs for r in (p.a, p.b)}
    lost = [s.station_id for s in survey.stations
            if s.station_id not in reached and s.world_from_station.treatment == "free"]  # fmt: skip
    if lost:
        more = f" and {len(lost) - 8} more" if len(lost) > 8 else ""
        raise IndeterminateError(
            f"no measured pair ties {', '.join(lost[:8])}{more} to the datum; measure a pair to the rest, hold the "
            "station, or leave it out", tuple(lost),
        )  # fmt: skip
    from adjust.pose_network import NetworkOptions, solve_network  # here: a survey without pairs starts without it
    from adjust.pose_network.from_survey import network_from_survey

    network = network_from_survey(survey)
    how = NetworkOptions(robust="auto" if options.reject_pairs else "off", alpha=_FAMILY)
    return solve_network(network, start, how, progress)


def adjusted_network(survey: Survey, solution: "NetworkSolution", options: PairOptions) -> Adjustment:
    """The solution of a pure survey as its adjustment, with warnings."""
    used, minimum = solution.network.used.tolist(), solution.minimum
    pairs = tuple(replace(p, used=bool(u)) for p, u in zip(survey.pairs, used, strict=True))
    notes = tuple(f"left out: {r}" for r in solution.rejected)
    result = assemble(minimum.graph, minimum.solved, options.adjust, notes, solution.precision.of_survey)
    result = replace(result, survey=replace(survey, pairs=pairs))
    return replace(result, warnings=result.warnings + _uncontrolled_warning(result))


def _uncontrolled_warning(result: Adjustment) -> tuple[str, ...]:
    """Pairs in use that nothing checks."""
    ids = [o.ids[0] for o in result.other_residuals
           if o.kind == "pair" and o.used and float(o.redundancy.max()) < _CONTROLLED]  # fmt: skip
    if not ids:
        return ()
    named = ", ".join(ids[:12]) + (f" and {len(ids) - 12} more" if len(ids) > 12 else "")
    what = "pair {} closes no loop: nobody would notice an error in it" if len(ids) == 1 else (
        "pairs {} close no loop: nobody would notice an error in them"
    )  # fmt: skip
    return (what.format(named) + "; measure a second way to what it leads to",)


@dataclass(frozen=True, eq=False)
class _State:
    """An adjustment without the pairs ``out``. over: tests over their limits, above 1 where they fail.

    cost: of this explanation; supposed: the factor of the limits that goes with it, 1 where none is needed.
    """

    out: tuple[str, ...]
    result: Adjustment
    over: dict[str, float]
    cost: float
    supposed: float


class _PairSearch:
    """The worst pair goes until none fails, and what then fits comes back; a pair comes back only once."""

    def __init__(
        self, survey: Survey, first: Adjustment, options: PairOptions, progress: Progress | None
    ) -> None:
        self.survey, self.options, self.progress, self.start = survey, options, progress, values_of(first)
        self.candidates = {p.pair_id for p in survey.pairs if p.used}
        self.kept: set[str] = set()
        self.states: list[_State] = []
        self.first = self._judged(first, ())

    def result(self) -> Adjustment:
        """The adjustment without the pairs that are wrong, with what was left out among its warnings."""
        pairs = _tested(self.first.result, self.candidates)
        if cautious(*_tests(pairs)):
            return self.first.result
        last = self._settled(self.first)
        best = min(self.states, key=lambda state: state.cost)
        if len(self.candidates) < MANY and best.cost < last.cost and best.supposed > 1.0:
            # few pairs, and most contradict: the sigmas do not fit, and only what is far beyond the others is wrong
            last = self._settled(self._judged(best.result, best.out, best.supposed), best.supposed)
        found = {o.ids[0]: o for o in last.result.other_residuals if o.kind == "pair"}
        needed = tuple(
            f"fails its test, but cannot be left out: pair {p}: without it the survey has no solution"
            for p in sorted(self.kept) if p not in last.out and last.over.get(p, 0.0) > 1.0
        )  # fmt: skip
        said = tuple(_said(found[p]) for p in last.out)
        return replace(last.result, warnings=last.result.warnings + said + needed)

    def _settled(self, state: _State, factor: float = 1.0) -> _State:
        """From this state on, with limits wider by ``factor``; the last that could be solved."""
        returned: set[str] = set()
        for _ in range(_ROUNDS):
            bad = [p for p in state.over if p not in state.out and state.over[p] > 1.0]
            back = [p for p in state.out if state.over.get(p, np.inf) <= 1.0 and p not in returned]
            if bad and 2 * (len(state.out) + 1) <= len(self.candidates):
                worst = max(bad, key=lambda p: state.over[p])
                now = self._tried((*state.out, worst), factor)
                if now is None:  # the others fail beside it, and none of them is to blame before it is cleared up
                    self.kept.add(worst)
                    break
                state = now
                continue
            if not back:
                break
            returned |= set(back)
            state = self._tried(tuple(p for p in state.out if p not in back), factor) or state
        return state

    def _tried(self, out: tuple[str, ...], factor: float) -> _State | None:
        """The adjustment without these; None where there is none."""
        pairs = tuple(replace(p, used=p.used and p.pair_id not in out) for p in self.survey.pairs)
        try:
            result = adjust(replace(self.survey, pairs=pairs), self.start, self.options.adjust, self.progress)
        except (IndeterminateError, NotConvergedError):
            return None
        return self._judged(result, out, factor)

    def _judged(self, result: Adjustment, out: tuple[str, ...], factor: float = 1.0) -> _State:
        """Tests over their limits, at one level for all pairs.

        Where the typical pair's test is too large the sigmas are too small throughout: the limit grows with it.
        """
        pairs = _tested(result, self.candidates)
        level = sidak(_FAMILY, len(pairs))
        limit = {o.ids[0]: float(chi2.isf(level, len(o.components))) for o in pairs}
        used = [o for o in pairs if o.used]
        tests = _tests(used)
        widened = max(factor, typical_factor(*tests)) if len(used) >= MANY else factor
        over = {o.ids[0]: float(o.test / (limit[o.ids[0]] * widened)) for o in pairs}
        left_out = _cost_of([o for o in pairs if not o.used], limit) + _cost_of_points(self.survey, result)
        cost = explanation_cost([(g.omega, g.redundancy) for g in result.groups], left_out)
        mine = {o.group for o in used}
        omega, redundancy = (sum(getattr(g, of) for g in result.groups if g.group in mine) for of in _SUMS)
        supposed = widening(omega, redundancy, *tests)
        state = _State(out, result, over, cost, supposed)
        self.states.append(state)
        return state


def _tested(result: Adjustment, candidates: set[str]) -> list[ObservationResidual]:
    """The pairs that the others check."""
    pairs = (o for o in result.other_residuals if o.kind == "pair" and o.ids[0] in candidates)
    return [o for o in pairs if not o.used or float(o.redundancy.max()) > 1e-6]


def _tests(pairs: list[ObservationResidual]) -> tuple[FloatArray, IntArray]:
    return np.array([o.test for o in pairs]), np.array([len(o.components) for o in pairs], dtype=np.int64)


def _cost_of(out: list[ObservationResidual], limit: dict[str, float]) -> float:
    return cost_of_leaving_out(*_tests(out), np.array([limit[o.ids[0]] for o in out]))


def _cost_of_points(survey: Survey, result: Adjustment) -> float:
    """Of the image points that are out here and not in the survey."""
    given = sum(int(len(b.uv) if b.used is None else b.used.sum()) for b in survey.image_blocks)
    images = result.image_residuals
    n, bound = given - int(images.used.sum()), image_limit(given)
    T = np.sort(np.nan_to_num(images.test[~images.used]))[::-1][:n]  # of images that the start refused none is known
    T = np.concatenate([T, np.zeros(n - len(T))])
    return cost_of_leaving_out(T, np.full(n, 2), np.full(n, bound))


def _said(o: ObservationResidual) -> str:
    turn = np.degrees(np.linalg.norm(o.residual[:3]))
    shift = f" and {np.linalg.norm(o.residual[3:]):.4g} m" if len(o.residual) == 6 else ""
    p = chi2.sf(o.test, len(o.components))
    return f"left out: pair {o.ids[0]}: off by {turn:.4g} deg{shift}, test {o.test:.1f}, p {p:.2g}"
