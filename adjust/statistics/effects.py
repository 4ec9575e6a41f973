"""What observations do to the unknowns: a bias that nobody notices, and the errors of every source of information.

An undetected bias moves them by ``dx = Q A' P bias``, each unknown counted in its own sigmas (Baarda 1968). A budget
of uncertainty (GUM, JCGM 100:2008) is ``Q = sum of Q N_g Q``, N_g the normal matrix of source g: what its errors do.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from scipy import sparse

from adjust.graph.datum import in_world
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName, VarianceComponents
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.statistics.condensed import CondensedSystem
from adjust.statistics.result import BudgetEntry, BudgetLine, Influence
from adjust.statistics.system import LinearSystem, linear_system
from adjust.statistics.weakness import covariance_columns
from adjust.testing.distributions import norm, student

_CHUNK = 64


def shifts(condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]) -> FloatArray:
    """How all unknowns (n, k) move with a bias of each of k observations; biases (c,) in sigmas, observed too large.

    rows: image points first, then all others.
    """
    system, parts = condensed.system, list[tuple[IntArray, FloatArray]]()
    for row in rows:
        if row < condensed.n_points:
            columns, A = condensed.point_rows(row)
            parts.append((columns, A.T @ bias[row]))
        else:
            parts.append(system.bias_column(row - condensed.n_points + system.n_image, bias[row]))
    places, values = (np.concatenate(x) for x in zip(*parts, strict=True))
    ptr = np.cumsum([0, *(len(x) for x, _ in parts)])
    right = sparse.csc_matrix((values, places, ptr), (len(system.columns), len(rows)))
    return system.times_covariance(right.toarray() if system.structured is None or system.motions.shape[1] else right)


def influences(
    condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]
) -> tuple[Influence, ...]:
    """The unknown and the position that each bias moves most; in the order of ``rows``."""
    system = condensed.system
    c, sigmas = system.columns, np.where(system.sigmas > 0.0, system.sigmas, np.inf)
    places, coordinates = _positions(system)

    def of(first: int) -> list[Influence]:
        part, out = rows[first : first + _CHUNK], list[Influence]()
        dx = shifts(condensed, part, bias)
        ratio = np.abs(dx)
        ratio /= sigmas[:, None]
        length, furthest = _furthest(dx, coordinates)
        for i, (row, j) in enumerate(zip(part, _first_largest(ratio).tolist(), strict=True)):
            name = places[int(furthest[i])] if places else ()
            out.append(Influence(row, c.names[j], c.components[j], c.units[j], float(dx[j, i]), float(ratio[j, i]),
                                 name, float(length[i])))  # fmt: skip
        return out

    return tuple(x for part in side_by_side(of, range(0, len(rows), _CHUNK)) for x in part)


def _positions(system: LinearSystem) -> tuple[list[ParameterName], sparse.csr_matrix]:
    """Unknowns that are positions in the world, and (p, n) which unknowns are the coordinates of each: ones."""
    names, columns, ptr = list[ParameterName](), list[int](), [0]
    components = system.columns.components
    for name, at in system.columns.at.items():
        if name[0] == "point" or in_world(system.precision.graph.survey, name):
            mine = [c for c in at.tolist() if components[c] in ("x", "y", "z", "tx", "ty", "tz")]
            if mine:
                names.append(name)
                columns += mine
                ptr.append(len(columns))
    return names, sparse.csr_matrix((np.ones(len(columns)), columns, ptr), (len(names), len(components)))


def _furthest(dx: FloatArray, coordinates: sparse.csr_matrix) -> tuple[FloatArray, IntArray]:
    """How far the position moves that moves most, and which that is; of every column of dx (n, k)."""
    if not coordinates.shape[0]:
        return np.zeros(dx.shape[1]), np.zeros(dx.shape[1], dtype=np.int64)
    squares = np.asarray(coordinates @ np.square(dx))
    at = _first_largest(squares)
    return np.sqrt(squares[at, np.arange(len(at))]), at


def _first_largest(values: FloatArray) -> IntArray:
    """Of every column (k,) the row of its largest value; ``argmax`` takes ten times as long along the first axis."""
    at = np.flatnonzero(~(values < values.max(axis=0)))  # what is no number is the largest, as for argmax
    rows, columns = np.divmod(at, values.shape[1])
    return np.asarray(rows[np.unique(columns, return_index=True)[1]])


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
