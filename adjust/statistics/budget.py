"""Uncertainty budgets: which source of information makes how much of the uncertainty of a result (GUM, JCGM 100:2008).

With Q the covariance of the unknowns and N_g the normal matrix of a source, Q = sum of Q N_g Q: what the errors of
source g put into the result.
"""

from collections.abc import Sequence

import numpy as np

from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName, VarianceComponents
from adjust.model.survey import FloatArray, IntArray
from adjust.statistics.result import BudgetEntry, BudgetLine
from adjust.statistics.system import LinearSystem, linear_system
from adjust.statistics.weakness import covariance_columns
from adjust.testing.distributions import norm, student


def uncertainty_budget(
    adjustment: Adjustment, names: Sequence[ParameterName], level: float = 0.95,
    components: VarianceComponents | None = None, system: LinearSystem | None = None,
) -> tuple[BudgetEntry, ...]:  # fmt: skip
    """Budget of every free component of these unknowns. Priors count one by one, observations by group.

    components: of the variances that the adjustment was made with; sources among them that were estimated are type A
    with their degrees of freedom, all others type B. level: of the expanded uncertainty; the coverage factor is
    Student's with the effective degrees of freedom (GUM, G.4). Raises SurveyError for what is no unknown.
    """
    system = system or linear_system(adjustment)
    lost = [n for n in names if n not in system.columns.at]
    if lost:
        raise SurveyError(f"{' '.join(lost[0])} is no unknown of this adjustment; a budget needs one")
    index = system.columns.of(names)
    sources, of_row = _sources(system)
    estimated = components.components if components is not None else ()
    kinds = {c.group: c.freedom for c in estimated if c.status in ("estimated", "unseparable")}
    squares = _squares(system, index, of_row, len(sources))
    return tuple(_entry(system, int(column), squares[:, i], sources, kinds, level) for i, column in enumerate(index))


def _squares(system: LinearSystem, index: IntArray, of_row: IntArray, n_sources: int) -> FloatArray:
    """Variance (sources, k) that every source makes; of the one with most rows what the others leave of the whole."""
    used = system.used[system.row_of]
    most = int(np.bincount(of_row[used], minlength=n_sources).argmax())
    Q = covariance_columns(system, index)
    rows = np.flatnonzero(used & (of_row != most))
    squares = np.zeros((n_sources, len(index)))
    np.add.at(squares, of_row[rows], np.asarray(system.A[rows] @ Q) ** 2)
    squares[most] = np.maximum(Q[index, np.arange(len(index))] - squares.sum(axis=0), 0.0)
    return squares


def _sources(system: LinearSystem) -> tuple[list[str], IntArray]:
    """Names of all sources, and that of every row (m,): a group, or a single prior."""
    names = list(system.group_names)
    of_observation = system.group.copy()
    graph = system.precision.graph
    for i, item in zip(graph.single, graph.singles, strict=True):
        if item.kind == "prior":
            of_observation[system.n_image + i] = len(names)
            names.append(f"prior {' '.join(item.ids)}")
    return names, of_observation[system.row_of]


def _entry(
    system: LinearSystem, column: int, squares: FloatArray,
    sources: Sequence[str], freedoms: dict[str, float], level: float,
) -> BudgetEntry:  # fmt: skip
    total = float(squares.sum())
    lines = tuple(
        BudgetLine(sources[g], "A" if sources[g] in freedoms else "B", float(np.sqrt(squares[g])),
                   float(squares[g] / total), freedoms.get(sources[g], float("inf")))
        for g in np.argsort(-squares, kind="stable") if squares[g] > 0.0
    )  # fmt: skip
    loss = sum(line.u**4 / line.freedom for line in lines)
    freedom = total**2 / loss if loss > 0.0 else float("inf")
    coverage = float(student.ppf(0.5 + 0.5 * level, freedom) if np.isfinite(freedom) else norm.ppf(0.5 + 0.5 * level))
    u = float(np.sqrt(total))
    c = system.columns
    what = c.names[column], c.components[column], c.units[column]
    return BudgetEntry(*what, u, freedom, level, coverage, coverage * u, lines)
