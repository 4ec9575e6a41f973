"""What observations do to the unknowns: a bias that nobody notices, and the errors of every source of information.

An undetected bias moves them by ``dx = Q A' P bias``, each unknown counted in its own sigmas (Baarda 1968). A budget
of uncertainty (GUM, JCGM 100:2008) is ``Q = sum of Q N_g Q``, N_g the normal matrix of source g: what its errors do.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from adjust.graph.datum import in_world
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName, VarianceComponents
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.statistics.condensed import CondensedSystem
from adjust.statistics.normal import Inverse
from adjust.statistics.result import BudgetEntry, BudgetLine, Influence
from adjust.statistics.system import LinearSystem, linear_system
from adjust.statistics.weakness import covariance_columns
from adjust.testing.distributions import norm, student

_CHUNK = 64
_ROUNDING = 1e-12
_COORDINATES = frozenset(("x", "y", "z", "tx", "ty", "tz"))


def shifts(condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]) -> FloatArray:
    """How all unknowns (n, k) move with a bias of each of k observations; biases (c,) in sigmas, observed too large.

    rows: image points first, then all others.
    """
    system, right = condensed.system, _right(condensed, rows, bias)
    return system.times_covariance(right.toarray() if system.structured is None or system.motions.shape[1] else right)


def _right(condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]) -> sparse.csc_matrix:
    """The right-hand sides (n, k) of the normal equations for these biases."""
    system, parts = condensed.system, list[tuple[IntArray, FloatArray]]()
    for row in rows:
        if row < condensed.n_points:
            columns, A = condensed.point_rows(row)
            parts.append((columns, A.T @ bias[row]))
        else:
            parts.append(system.bias_column(row - condensed.n_points + system.n_image, bias[row]))
    places, values = (np.concatenate(x) for x in zip(*parts, strict=True))
    ptr = np.cumsum([0, *(len(x) for x, _ in parts)])
    return sparse.csc_matrix((values, places, ptr), (len(system.columns), len(rows)))


def influences(
    condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]
) -> tuple[Influence, ...]:
    """The unknown and the position that each bias moves most; in the order of ``rows``."""
    system = condensed.system
    c, sigmas = system.columns, np.where(system.sigmas > 0.0, system.sigmas, np.inf)
    places, coordinates = _positions(system)
    shared = None if system.structured is None or system.motions.shape[1] else system.structured
    reach = None if shared is None else _Reach.of(shared, sigmas, coordinates)

    def of(first: int) -> list[Influence]:
        part, out = rows[first : first + _CHUNK], list[Influence]()
        if reach is None:
            which, among, dx = np.arange(len(c)), coordinates, shifts(condensed, part, bias)
        else:
            which, dx = reach.shifts(_right(condensed, part, bias))
            among = coordinates[:, which]
        ratio = np.abs(dx)
        ratio /= sigmas[which, None]
        length, furthest = _furthest(dx, among)
        for i, (row, j) in enumerate(zip(part, _first_largest(ratio).tolist(), strict=True)):
            name, at = places[int(furthest[i])] if places else (), int(which[j])
            out.append(Influence(row, c.names[at], c.components[at], c.units[at], float(dx[j, i]), float(ratio[j, i]),
                                 name, float(length[i])))  # fmt: skip
        return out

    return tuple(x for part in side_by_side(of, range(0, len(rows), _CHUNK)) for x in part)


@dataclass(frozen=True, eq=False)
class _Reach:
    """How far biases reach where Q = own + U' U. The set of an unknown that a bias touches moves by own and by U' U.

    All others by U' y alone, y = U b: no further than the length of y times that of their column of U. sigmas: (n,);
    coordinates: (p, n). of_unknowns, of_positions: (n,) and (p,) these lengths, over the sigmas and in m.
    """

    Q: Inverse
    sigmas: FloatArray
    coordinates: sparse.csr_matrix
    of_unknowns: FloatArray
    of_positions: FloatArray

    @staticmethod
    def of(Q: Inverse, sigmas: FloatArray, coordinates: sparse.csr_matrix) -> "_Reach":
        """Of unknowns with these sigmas, and positions with these coordinates."""
        squares = np.einsum("cn,cn->n", Q.U, Q.U)
        return _Reach(Q, sigmas, coordinates, np.sqrt(squares) / sigmas, np.sqrt(coordinates @ squares))

    def shifts(self, right: sparse.csc_matrix) -> tuple[IntArray, FloatArray]:
        """Unknowns (s,) among which, for each right-hand side (n, k), is what moves furthest; how these move (s, k)."""
        own, y = (self.Q.own @ right).tocsr(), np.asarray((right.T @ self.Q.U.T).T)
        near = np.union1d(np.flatnonzero(np.diff(own.indptr)), np.flatnonzero(self.Q.member < 0))
        dx, size = self._shifts(near, own, y), np.linalg.norm(y, axis=0)
        far = [near, self._beyond(self.of_unknowns, size, (np.abs(dx) / self.sigmas[near, None]).max(axis=0))]
        if len(self.of_positions):
            place = self._beyond(self.of_positions, size, _furthest(dx, self.coordinates[:, near])[0])
            far.append(self.coordinates[place].indices)
        which = np.unique(np.concatenate(far))
        return which, dx if len(which) == len(near) else self._shifts(which, own, y)

    def _shifts(self, which: IntArray, own: sparse.csr_matrix, y: FloatArray) -> FloatArray:
        return np.asarray(own[which].toarray() + self.Q.U[:, which].T @ y)

    @staticmethod
    def _beyond(lengths: FloatArray, size: FloatArray, found: FloatArray) -> IntArray:
        """Which of these may move further than what was found (k,), where y has these lengths (k,)."""
        return np.flatnonzero(lengths * (1.0 + _ROUNDING) >= (found / np.maximum(size, 1e-300)).min())


def _positions(system: LinearSystem) -> tuple[list[ParameterName], sparse.csr_matrix]:
    """Unknowns that are positions in the world, and (p, n) which unknowns are the coordinates of each: ones."""
    survey, c = system.precision.graph.survey, system.columns
    names = [name for name in c.at if name[0] == "point" or in_world(survey, name)]
    sizes = [len(c.at[name]) for name in names]
    columns, owner = c.of(names), np.repeat(np.arange(len(names)), sizes)
    kept = np.array([x in _COORDINATES for x in c.components], dtype=np.bool_)[columns]
    some, row = np.unique(owner[kept], return_inverse=True)
    entries = np.ones(len(row)), (row, columns[kept])
    return [names[i] for i in some.tolist()], sparse.csr_matrix(entries, (len(some), len(c)))


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
