"""Surveys with measured pairs: those that are nothing but pairs are solved as pose networks, which need no start."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from adjust.adjustment import AdjustOptions, adjust, assemble
from adjust.graph.assembly import StartValues
from adjust.model.errors import IndeterminateError, listed
from adjust.model.result import Adjustment
from adjust.model.survey import Survey

if TYPE_CHECKING:
    from adjust.pose_network import NetworkSolution

Progress = Callable[[int, float], None]
_FAMILY = 0.001
_CONTROLLED = 1e-4  # redundancy number below which nothing controls an observation


@dataclass(frozen=True)
class PairOptions:
    """reject_pairs: leave out what contradicts the rest: pairs, and observations of all kinds but image points.

    adjust: what holds for all surveys.
    """

    reject_pairs: bool = True
    adjust: AdjustOptions = field(default_factory=AdjustOptions)


def adjust_with_pairs(
    survey: Survey, options: PairOptions = PairOptions(), progress: Progress | None = None,
    start: StartValues | None = None,
) -> Adjustment:  # fmt: skip
    """Adjust a survey; a network of nothing but pairs without its wrong ones, where the options say so.

    start: where the adjustment begins; found where not given. Raises as :func:`adjust.adjustment.adjust`.
    """
    if is_pure(survey):
        found = _adjusted_network(survey, _network_solution(survey, options, progress, start), options)
        if survey.pair_form == "poses":
            return found
        from adjust.relay.closed import in_condition_form  # here: as below

        return in_condition_form(found)
    return adjust(survey, start, options.adjust, progress)


def is_pure(survey: Survey) -> bool:
    """Whether a survey is a network of pairs between fixed stations, and nothing else."""
    return survey.is_pose_network and not (survey.points or survey.targets or survey.tables)


def _network_solution(
    survey: Survey, options: PairOptions = PairOptions(), progress: Progress | None = None,
    start: StartValues | None = None,
) -> "NetworkSolution":  # fmt: skip
    """The pose network of a pure survey, solved. start: poses of all its stations, where there are any.

    Raises IndeterminateError naming the stations that no pair in use reaches.
    """
    reached = {r.frame_id for p in survey.pairs for r in (p.a, p.b)}
    lost = [s.station_id for s in survey.stations
            if s.station_id not in reached and s.world_from_station.treatment == "free"]  # fmt: skip
    if lost:
        raise IndeterminateError(
            f"no measured pair ties {listed(lost, 8)} to the datum; measure a pair to the rest, hold the "
            "station, or leave it out", tuple(lost),
        )  # fmt: skip
    from adjust.pose_network import NetworkOptions, solve_network  # here: a survey without pairs starts without it
    from adjust.pose_network.from_survey import network_from_survey

    network = network_from_survey(survey)
    how = NetworkOptions(robust="auto" if options.reject_pairs else "off", alpha=_FAMILY)
    if start is None:
        return solve_network(network, options=how, progress=progress)
    poses = [start.poses["world_from_station", s] for s in network.station_ids]
    begin = np.array([p.rotation().matrix() for p in poses]), np.array([p.translation() for p in poses])
    return solve_network(network, begin, how, progress)


def _adjusted_network(survey: Survey, solution: "NetworkSolution", options: PairOptions) -> Adjustment:
    """The solution of a pure survey as its adjustment, with warnings."""
    used, minimum = solution.network.used.tolist(), solution.minimum
    pairs = tuple(replace(p, used=bool(u)) for p, u in zip(survey.pairs, used, strict=True))
    notes = tuple(f"left out: {r}" for r in solution.rejected)
    result = assemble(minimum.graph, minimum.solved, options.adjust, notes, solution.precision.of_survey)
    result = replace(result, survey=replace(survey, pairs=pairs))
    return replace(result, warnings=result.warnings + uncontrolled_pairs(result))


def uncontrolled_pairs(result: Adjustment) -> tuple[str, ...]:
    """Warning of pairs in use that nothing checks."""
    ids = [o.ids[0] for o in result.other_residuals
           if o.kind == "pair" and o.used and float(o.redundancy.max()) < _CONTROLLED]  # fmt: skip
    if not ids:
        return ()
    what = "pair {} closes no loop: nobody would notice an error in it" if len(ids) == 1 else (
        "pairs {} close no loop: nobody would notice an error in them"
    )  # fmt: skip
    return (what.format(listed(ids, 12)) + "; measure a second way to what it leads to",)
