"""Gross errors among observations of every kind: found by tests, each decision logged, taken back where it was wrong.

A robust solution says what most observations agree on, and whom to suspect first; tests with the error probability of
the whole family decide (:mod:`adjust.testing.gross_errors`, on the linear system of
:mod:`adjust.statistics.outliers.snooping`); the survey is solved again without what they leave out, and the
search repeated there, until nothing changes. The result is a plain least squares. Where image points are not searched
they stand condensed, and are screened anew at every solution.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.adjustment import adjust
from adjust.graph.assembly import StartValues, values_of
from adjust.model.errors import IndeterminateError, NotConvergedError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import with_rows
from adjust.model.survey import BoolArray, Survey
from adjust.precision.precision import precision_of
from adjust.statistics.outliers.candidates import as_given, candidates, without
from adjust.statistics.outliers.outcome import DEFAULT_SEARCH, OutlierSearch, SearchOptions
from adjust.statistics.outliers.round import Round, tests_of_all, typical, used_at
from adjust.statistics.outliers.watched import FOLLOWED, large
from adjust.testing.criteria import limits

_ROUNDS = 12
_BETTER = 0.25
"""What a round must bring it down to, to go on all the same: large errors show only once some of them are out."""
_Leave = Callable[[tuple[int, ...], Adjustment], Adjustment]
"""The survey adjusted without these, from the values of an adjustment."""


@frozen(eq=False)
class Disagreeing:
    """Pairs (E,) of a network that do not agree with the others, and where these put the stations.

    start: None where what is left is to be started by itself. field: of a survey that holds them, where they are no
    pairs.
    """

    pairs: BoolArray
    start: StartValues | None
    field: str = "pairs"


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

    def leave(these: tuple[int, ...], now: Adjustment) -> Adjustment:
        return solved(without(survey, found, these), values_of(now))

    images, given, out = options.kinds is None or "image" in options.kinds, None, tuple[int, ...]()
    if wrong is None:
        now = first or solved(survey, start)
        survey = as_given(now.survey, survey) if options.adjust.reject_points and not images else now.survey
    else:
        now = solved(_without(survey, wrong), wrong.start)
        found = candidates(precision_of(now).graph, images)
        given, out = used_at(now, found), found.of(wrong.field, np.flatnonzero(wrong.pairs))
        given[list(out)] = True
        now, out = _taken_back(now, out, options, leave)
    round_ = first_round = Round(now, options, images, given)
    found, given, first_out, worst = round_.found, round_.given, out, np.inf
    if wrong is None and round_.crowded:
        wrong = disagreeing_pairs(now.survey, float(round_.factor.max()))
        if wrong is not None:
            mine, begin = found.of("pairs", np.flatnonzero(wrong.pairs)), wrong.start
            now, out = _left_out(now, (), mine, lambda these, _: solved(without(survey, found, these), begin))
            now, out = _taken_back(now, out, options, leave)
            round_ = Round(now, options, images, given)
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
        before, (now, out) = out, _left_out(now, out, new, leave)
        needed |= set(new) - set(out)
        if out == before and set(new) <= set(out):  # what should come back has no solution either
            return round_.result(state, out, needed, log, True, now)
        round_ = Round(now, options, images, given, round_.number + 1, round_.index)


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


def _without(survey: Survey, wrong: Disagreeing) -> Survey:
    every = getattr(survey, wrong.field)
    rows = np.flatnonzero(wrong.pairs).tolist()
    return with_rows(survey, wrong.field, {i: replace(every[i], used=False) for i in rows})


def distances_in_the_way(survey: Survey) -> Disagreeing | None:
    """Distances that stand out at the start values of a survey; None where none do.

    With images the rest is started anew: blocks that contradict it are left out then.
    """
    if not survey.distances:
        return None
    from adjust.statistics.outliers.standing_out import distances_that_stand_out  # here: where something fails

    found = distances_that_stand_out(survey)
    return None if found is None else Disagreeing(found[0], None if survey.image_blocks else found[1], "distances")


def _left_out(
    now: Adjustment, out: tuple[int, ...], new: tuple[int, ...], leave: _Leave
) -> tuple[Adjustment, tuple[int, ...]]:
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
    now: Adjustment, out: tuple[int, ...], options: SearchOptions, leave: _Leave
) -> tuple[Adjustment, tuple[int, ...]]:
    """Of more than can be followed one by one all that fits comes back at once, until little does."""
    for _ in range(_ROUNDS):
        tests = tests_of_all(now)
        limit = limits(options.family_alpha, tests.freedom, int(np.count_nonzero(tests.freedom > 0)))
        fits = tests.statistic <= limit * typical(tests)[tests.group]
        left = tuple(o for o in out if not fits[o])
        if len(out) <= FOLLOWED or len(left) == len(out):
            break
        now, out = leave(left, now), left
    return now, out
