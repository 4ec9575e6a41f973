"""What the statistics of an adjustment say, gathered for reports and result files."""

from dataclasses import dataclass

from adjust.model import FloatArray
from adjust.result import ParameterName
from adjust.statistics.result import (
    BudgetEntry,
    Correlation,
    Decision,
    RelativePrecision,
    Reliability,
    VarianceComponents,
    WeakDirection,
)
from survey.tolerances import Verdict


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
