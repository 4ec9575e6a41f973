"""Surveys with measured pairs: whole pairs that contradict the rest are found by test, left out, and listed.

Surveys that are nothing but pairs are solved as pose networks, which need no start. In all others the worst pair goes
first, one by one (Baarda's data snooping, 1968), each tested with the error probability of the whole family (Sidak
1967); what fits in the end is taken back. Pairs that are left out stay in the survey, out of use: predicted and tested.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np
from gtsam import Pose3

from adjust.adjustment import AdjustOptions, adjust
from adjust.distributions import chi2
from adjust.errors import IndeterminateError
from adjust.graph import StartValues
from adjust.model import FloatArray, Survey
from adjust.result import Adjustment, ObservationResidual
from adjust.survey_kind import is_pose_network

if TYPE_CHECKING:
    from adjust.pose_network import NetworkSolution

Progress = Callable[[int, float], None]
_FAMILY = 0.001
_ROUNDS = 40
_CONTROLLED = 1e-4  # redundancy number below which nothing controls an observation
_MANY = 20  # pairs from which the typical one says how cautious the sigmas are


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
        return adjusted_network(survey, network_solution(survey, options, progress), options)
    result = adjust(survey, start, options.adjust, progress)
    if options.reject_pairs and any(p.used for p in survey.pairs):
        result = _snooped(survey, result, options, progress)
    return replace(result, warnings=result.warnings + _uncontrolled_warning(result))


def is_pure(survey: Survey) -> bool:
    """Whether a survey is a network of pairs between fixed stations, and nothing else."""
    return is_pose_network(survey) and not (survey.points or survey.targets or survey.tables)


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
    from adjust.pose_network.from_survey import network_adjustment  # here: as above

    used = solution.network.used.tolist()
    pairs = tuple(replace(p, used=bool(u)) for p, u in zip(survey.pairs, used, strict=True))
    result = network_adjustment(replace(survey, pairs=pairs), solution, options.adjust.alpha)
    return replace(result, warnings=_test_warning(result) + result.warnings + _uncontrolled_warning(result))


def _test_warning(result: Adjustment) -> tuple[str, ...]:
    test = result.global_test
    return () if test is None or test.passed else (test.warning(result.sigma0),)


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


def _snooped(survey: Survey, first: Adjustment, options: PairOptions, progress: Progress | None) -> Adjustment:
    """Leave out the worst pair until none fails, and take back what then fits; a pair comes back only once."""
    candidates = {p.pair_id for p in survey.pairs if p.used}
    out: list[str] = []
    returned: set[str] = set()
    result = first
    for _ in range(_ROUNDS):
        over = _excess(result, candidates)
        bad = [p for p in over if p not in out and over[p] > 1.0]
        if bad:
            out.append(max(bad, key=lambda p: over[p]))
        else:
            back = [p for p in out if over.get(p, np.inf) <= 1.0 and p not in returned]
            if not back:
                break
            returned |= set(back)
            out = [p for p in out if p not in back]
        pairs = tuple(replace(p, used=p.used and p.pair_id not in out) for p in survey.pairs)
        result = adjust(replace(survey, pairs=pairs), values_of(first), options.adjust, progress)
    found = {o.ids[0]: o for o in result.other_residuals if o.kind == "pair"}
    notes = tuple(_said(found[p]) for p in out)
    return replace(result, warnings=result.warnings + notes)


def _excess(result: Adjustment, candidates: set[str]) -> dict[str, float]:
    """Test of every pair over its limit, at one level for all; above 1 it fails.

    Where the typical pair's test is too large the sigmas are too small throughout: the limit grows with it.
    """
    pairs = [o for o in result.other_residuals if o.kind == "pair" and o.ids[0] in candidates]
    tested = [o for o in pairs if not o.used or float(o.redundancy.max()) > 1e-6]
    single = -np.expm1(np.log1p(-_FAMILY) / max(1, len(tested)))
    used = [o for o in tested if o.used]
    factor = 1.0
    if len(used) >= _MANY:
        factor = max(1.0, float(np.median([o.test / chi2.ppf(0.5, len(o.components)) for o in used])))
    return {o.ids[0]: float(o.test / (chi2.isf(single, len(o.components)) * factor)) for o in tested}


def _said(o: ObservationResidual) -> str:
    turn = np.degrees(np.linalg.norm(o.residual[:3]))
    shift = f" and {np.linalg.norm(o.residual[3:]):.4g} m" if len(o.residual) == 6 else ""
    p = chi2.sf(o.test, len(o.components))
    return f"left out: pair {o.ids[0]}: off by {turn:.4g} deg{shift}, test {o.test:.1f}, p {p:.2g}"


def values_of(adjustment: Adjustment) -> StartValues:
    """Adjusted values as start values."""
    estimates = adjustment.estimates
    poses = {n: e.value for n, e in estimates.items() if isinstance(e.value, Pose3)}
    arrays = {n: np.asarray(e.value) for n, e in estimates.items() if not isinstance(e.value, Pose3)}
    return StartValues(
        {n[1]: v for n, v in arrays.items() if n[0] == "lens"},
        poses,
        {n[1]: v for n, v in arrays.items() if n[0] == "point"},
        {n: v for n, v in arrays.items() if n[0] not in ("lens", "point")},
    )


