"""What the statistics of an adjustment say, gathered for reports and result files."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import islice

import numpy as np

from adjust.epochs.states import origin
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Decision, Estimate, ParameterName, VarianceComponents
from adjust.model.survey import FloatArray
from adjust.native.parallel import Beside
from adjust.precision.precision import precision_of
from adjust.statistics.condensed import condensed_system
from adjust.statistics.consistency import consistency
from adjust.statistics.effects import uncertainty_budget
from adjust.statistics.relative_precision import relative_precision
from adjust.statistics.reliability import LARGEST_NETWORK, reliability
from adjust.statistics.result import (
    BudgetEntry,
    Consistency,
    Correlation,
    RelativePrecision,
    Reliability,
    WeakDirection,
)
from adjust.statistics.system import LinearSystem
from adjust.statistics.weakness import compared_columns, correlations, weak_directions
from adjust.testing.criteria import LevelOptions
from survey.project.project import AdjustmentOptions
from survey.solution.quantities import PROBABILITY, Scale, correlations_in, estimated, in_joint
from survey.solution.tolerances import Verdict, verdicts


@frozen(eq=False)
class CorrelationMatrix:
    """Correlations (n, n) between components; ``labels`` n, ``starts`` of the parameters they belong to, by name."""

    labels: tuple[str, ...]
    starts: tuple[int, ...]
    names: tuple[ParameterName, ...]
    matrix: FloatArray


@frozen(eq=False)
class Statistics:
    """Tests and reliability, variance components where they were asked for, and what else a report shows.

    correlated: pairs of components above 95 %. weak: directions that the survey determines badly. relative: between
    neighbouring points and stations. budget: of points, stations and lenses. decisions: the log of the outlier search.
    verdicts: on the tolerances of the project. consistency: of every part with the rest, and of cameras and targets
    with themselves through time. left_out: for people, what is not all there, and why.
    """

    reliability: Reliability
    components: VarianceComponents | None
    correlated: tuple[Correlation, ...]
    weak: tuple[WeakDirection, ...]
    relative: tuple[RelativePrecision, ...]
    budget: tuple[BudgetEntry, ...]
    correlations: CorrelationMatrix | None
    decisions: tuple[Decision, ...] = ()
    verdicts: tuple[Verdict, ...] = ()
    consistency: Consistency | None = None
    left_out: tuple[str, ...] = ()


MOST_CORRELATED = 110
"""Components that the picture of correlations shows: what there is once before what there is at every epoch."""
MOST_BUDGETS = 60
"""Parameters with a budget: cameras, tables and stations first, then points."""
MOST_NEIGHBOURS = 150


def tested_parts(adjustment: Adjustment) -> Consistency:
    """Of the statistics only what a verdict needs: every part with the rest, and through time."""
    condensed = None if _is_large_network(adjustment) else condensed_system(precision_of(adjustment))
    return consistency(adjustment, condensed, _alpha(adjustment))


def statistics_of(
    adjustment: Adjustment, options: AdjustmentOptions, scale: Scale, tested: Consistency | None = None
) -> Statistics:
    """All of them, at every size. Raises SurveyError for a tolerance that is about nothing.

    tested: what :func:`tested_parts` found, where that is known.
    """
    judged, alpha = verdicts(adjustment, options.tolerances, scale), _alpha(adjustment)
    levels = LevelOptions(options.alpha, options.alpha0, options.power)
    drawn, near = correlation_matrix(adjustment), neighbours(adjustment, scale)
    if _is_large_network(adjustment):
        tested = tested or consistency(adjustment, None, alpha)
        return Statistics(reliability(adjustment, levels), adjustment.variance_components, (), (), near, (), drawn,
                          adjustment.decisions, judged, tested, (*tested.left_out, _LARGE_NETWORK))  # fmt: skip
    condensed = condensed_system(precision_of(adjustment))
    system, components = condensed.system, adjustment.variance_components
    names = _budgeted(adjustment)
    _ = system.structured, system.sigmas  # all of these ask for them
    with Beside() as made:
        consistent = made.of(lambda: tested or consistency(adjustment, condensed, alpha))
        reliable = made.of(lambda: reliability(adjustment, levels, system=condensed))
        weak = made.of(lambda: weak_directions(adjustment, system=system))
        correlated = made.of(lambda: correlations(adjustment, system=system))
        budget = made.of(lambda: _budget(adjustment, names[:MOST_BUDGETS], system, scale.factor))
        left_out = consistent().left_out  # first: it takes longest
        return Statistics(
            reliable(), components, correlated(), weak(), near, budget(), drawn, adjustment.decisions, judged,
            consistent(), (*left_out, *_left_out(adjustment, system, len(names))),
        )  # fmt: skip


def _is_large_network(adjustment: Adjustment) -> bool:
    return adjustment.survey.is_pose_network and len(adjustment.other_residuals) > LARGEST_NETWORK


def _alpha(adjustment: Adjustment) -> float:
    return adjustment.global_test.alpha if adjustment.global_test is not None else 0.05


_LARGE_NETWORK = (
    f"correlations, weak directions, uncertainty budgets and influences: not computed for a network of more than "
    f"{LARGEST_NETWORK} pairs; the covariance of any stations is there (Solution.covariance)"
)


def _left_out(adjustment: Adjustment, system: LinearSystem, n_budgets: int) -> tuple[str, ...]:
    """For people: what the statistics show a part of, and which."""
    out, n = [], len(system.columns)
    compared = len(compared_columns(system))
    if compared < n:
        out.append(
            f"correlations: of {n} components {compared} were compared with all others, points and then those of "
            "single epochs last; the rest only within their own unknown"
        )
    if n_budgets > MOST_BUDGETS:
        out.append(f"uncertainty budgets: of {MOST_BUDGETS} of {n_budgets} parameters, points last")
    places = sum(1 for name in adjustment.estimates if len(name) == 2 and name[0] in ("point", "world_from_station"))
    if places > MOST_NEIGHBOURS:
        out.append(f"relative precision: of {MOST_NEIGHBOURS} pairs of neighbours among {places} points and stations")
    return tuple(out)


def _budgeted(adjustment: Adjustment) -> tuple[ParameterName, ...]:
    """What gets a budget: what there is once, points last."""
    rank = {"lens": 0, "station_from_camera": 1, "mount_from_station": 2, "world_from_table": 3, "table_geometry": 4,
            "world_from_station": 5, "point": 6}  # fmt: skip
    names = [n for n, e in adjustment.estimates.items() if n[0] in rank and len(n) == 2 and _unknown_components(e)]
    return tuple(sorted(names, key=lambda n: rank[n[0]]))


def _budget(
    adjustment: Adjustment, names: Sequence[ParameterName], system: LinearSystem, factor: float
) -> tuple[BudgetEntry, ...]:
    """Of these unknowns, its sigmas scaled as the others are."""
    found = uncertainty_budget(adjustment, names, PROBABILITY, adjustment.variance_components, system) if names else ()
    return tuple(
        replace(x, u=factor * x.u, expanded=factor * x.expanded,
                lines=tuple(replace(line, u=factor * line.u) for line in x.lines))
        for x in found
    )  # fmt: skip


def _nearest(x: FloatArray, i: int, k: int) -> list[int]:
    """The k of all places (n, 3) that are nearest to the i-th, itself first."""
    squares = np.sum((x - x[i]) ** 2, axis=1)
    squares[i] = -1.0
    near = np.flatnonzero(squares <= np.partition(squares, k - 1)[k - 1])
    found: list[int] = near[np.argsort(squares[near], kind="stable")][:k].tolist()
    return found


def neighbours(adjustment: Adjustment, scale: Scale) -> tuple[RelativePrecision, ...]:
    """Relative precision of every point and fixed station to its two nearest; sigmas scaled as the others are."""
    names, places = [], []
    for name, e in adjustment.estimates.items():
        if len(name) == 2 and name[0] in ("point", "world_from_station"):
            names.append(name)
            places.append(origin(e.value))
    x, found = np.array(places).reshape(-1, 3), dict[tuple[int, int], None]()
    there = np.flatnonzero(np.isfinite(x).all(axis=1))
    names, x = [names[i] for i in there.tolist()], x[there]
    if len(names) < 2:
        return ()
    for i in range(len(x)):
        near = _nearest(x, i, min(3, len(x)))
        free = [bool(_unknown_components(adjustment.estimates[names[k]])) for k in near]
        found |= {(min(i, k), max(i, k)): None for k, known in zip(near[1:], free[1:], strict=True) if free[0] or known}
        if len(found) >= MOST_NEIGHBOURS:
            break
    pairs = [(names[i], names[k]) for i, k in islice(found, MOST_NEIGHBOURS)]
    posterior = scale.sigmas == "a_posteriori"
    f = scale.factor
    return tuple(
        replace(r, cov=f**2 * r.cov, sigma_distance=f * r.sigma_distance,
                rotation_cov=None if r.rotation_cov is None else f**2 * r.rotation_cov)
        for r in relative_precision(adjustment, pairs, PROBABILITY, posterior)
        if r.ellipsoid.dimension  # rotations alone say nothing of positions
    )  # fmt: skip


def correlation_matrix(adjustment: Adjustment) -> CorrelationMatrix | None:
    """Correlations between the components of parameters that are there once; None where fewer than two are free."""
    names: list[ParameterName] = []
    components: list[tuple[str, ...]] = []
    for name, estimate in adjustment.estimates.items():
        free = _unknown_components(estimate) if len(name) < 3 and name[0] != "table_angles" else ()
        if free:
            if sum(map(len, components)) + len(free) > MOST_CORRELATED:
                break
            names.append(name)
            components.append(free)
    sizes = [len(free) for free in components]
    if sum(sizes) < 2:
        return None
    labels = tuple(f"{'/'.join(name)}/{c}" for name, free in zip(names, components, strict=True) for c in free)
    starts = tuple(int(x) for x in np.concatenate([[0], np.cumsum(sizes)[:-1]]))
    return CorrelationMatrix(labels, starts, tuple(names), correlations_in(adjustment.precision.joint(names)))


def _unknown_components(estimate: Estimate) -> tuple[str, ...]:
    """Its components in a joint covariance, none where it is no unknown."""
    return in_joint(estimate) if estimated(estimate) else ()
