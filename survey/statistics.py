"""What the statistics of an adjustment say, gathered for reports and result files."""

from dataclasses import dataclass

import numpy as np
from gtsam import Pose3

from adjust.model import FloatArray
from adjust.result import Adjustment, Estimate, ParameterName
from adjust.statistics.reliability import reliability
from adjust.statistics.result import (
    BudgetEntry,
    Correlation,
    Decision,
    RelativePrecision,
    Reliability,
    VarianceComponents,
    WeakDirection,
)
from survey.quantities import Scale
from survey.tolerances import Tolerance, Verdict, verdicts


@dataclass(frozen=True, eq=False)
class CorrelationMatrix:
    """Correlations (n, n) between components; ``labels`` n, ``starts`` of the parameters they belong to, by name."""

    labels: tuple[str, ...]
    starts: tuple[int, ...]
    names: tuple[ParameterName, ...]
    matrix: FloatArray


@dataclass(frozen=True, eq=False)
class Statistics:
    """Tests and reliability, variance components where they were asked for, and what else a report shows.

    correlated: pairs of components above 95 %. weak: directions that the survey determines badly. relative: between
    neighbouring points and stations. budget: of points, stations and lenses. decisions: the log of the outlier search.
    verdicts: on the tolerances of the project.
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


MOST_CORRELATED = 110
"""Components that the picture of correlations shows: what there is once before what there is at every epoch."""


def statistics_of(adjustment: Adjustment, tolerances: tuple[Tolerance, ...], scale: Scale) -> Statistics:
    """All of them. Raises SurveyError for a tolerance that is about nothing."""
    judged = verdicts(adjustment, tolerances, scale)
    found = reliability(adjustment)
    return Statistics(found, None, (), (), (), (), correlation_matrix(adjustment), (), judged)


def correlation_matrix(adjustment: Adjustment) -> CorrelationMatrix | None:
    """Correlations between the components of parameters that are there once; None where fewer than two are free."""
    names: list[ParameterName] = []
    components: list[tuple[str, ...]] = []
    for name, estimate in adjustment.estimates.items():
        free = _unknown_components(estimate)
        if free and len(name) < 3 and name[0] != "table_angles":
            if sum(map(len, components)) + len(free) > MOST_CORRELATED:
                break
            names.append(name)
            components.append(free)
    sizes = [len(free) for free in components]
    if sum(sizes) < 2:
        return None
    cov = adjustment.precision.joint(names)
    sigma = np.sqrt(np.clip(np.diag(cov), 0.0, None))
    safe = np.where(sigma > 0.0, sigma, np.inf)
    labels = tuple(f"{'/'.join(name)}/{c}" for name, free in zip(names, components, strict=True) for c in free)
    starts = tuple(int(x) for x in np.concatenate([[0], np.cumsum(sizes)[:-1]]))
    return CorrelationMatrix(labels, starts, tuple(names), cov / np.outer(safe, safe))


def _unknown_components(estimate: Estimate) -> tuple[str, ...]:
    """The components that stand in a joint covariance: all of a pose or point, the free ones of a vector."""
    free = tuple(c for c, s in zip(estimate.components, estimate.status, strict=True) if s in ("free", "prior"))
    whole = isinstance(estimate.value, Pose3) or estimate.name[0] == "point"
    return estimate.components if whole and free else free
