"""What observations do to the unknowns: a bias that nobody notices, and the errors of every source of information.

An undetected bias moves them by ``dx = Q A' P bias``, each unknown counted in its own sigmas (Baarda 1968). A budget
of uncertainty (GUM, JCGM 100:2008) is ``Q = sum of Q N_g Q``, N_g the normal matrix of source g: what its errors do.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from scipy import sparse

from adjust.frames.tree import in_world
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
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
_COORDINATES = frozenset(("x", "y", "z", "tx", "ty", "tz"))


def shifts(condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]) -> FloatArray:
    """How all unknowns (n, k) move with a bias of each of k observations; biases (c,) in sigmas, observed too large.

    rows: image points first, then all others.
    """
    system, right = condensed.system, _right(condensed, rows, bias)
    return system.times_covariance(right.toarray() if system.structured is None or system.motions.shape[1] else right)


def _right(condensed: CondensedSystem, rows: Sequence[int], bias: Mapping[int, FloatArray]) -> sparse.csc_matrix:
    """The right-hand sides (n, k) of the normal equations for these biases."""
    system, n = condensed.system, condensed.n_points
    points = [row for row in rows if row < n]
    of_points = iter(condensed.point_rows(np.array(points, dtype=np.int64)))
    parts = list[tuple[IntArray, FloatArray]]()
    for row in rows:
        if row < n:
            columns, A = next(of_points)
            parts.append((columns, A.T @ bias[row]))
        else:
            parts.append(system.bias_column(row - n + system.n_image, bias[row]))
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
    reach = None if shared is None else Reach.of(shared, sigmas, coordinates)

    def of(first: int) -> list[Influence]:
        part = rows[first : first + _CHUNK]
        if reach is None:
            found = furthest_of(shifts(condensed, part, bias), sigmas, coordinates)
        else:
            found = reach.furthest(_right(condensed, part, bias))
        return [
            Influence(row, c.names[i], c.components[i], c.units[i], shift, ratio, places[p] if places else (), length)
            for row, i, shift, ratio, p, length in zip(part, *(x.tolist() for x in found), strict=True)
        ]

    return tuple(x for part in side_by_side(of, range(0, len(rows), _CHUNK)) for x in part)


class Furthest(NamedTuple):
    """What moves furthest for each of k biases: unknown, its shift and that in its sigmas; position, how far (k,)."""

    unknown: IntArray
    shift: FloatArray
    ratio: FloatArray
    position: IntArray
    length: FloatArray


def furthest_of(dx: FloatArray, sigmas: FloatArray, coordinates: sparse.csr_matrix) -> Furthest:
    """Of unknowns with these sigmas (n,) that move by dx (n, k), and positions with these coordinates (p, n)."""
    k = np.arange(dx.shape[1])
    ratio = np.abs(dx)
    ratio /= sigmas[:, None]
    at = _first_largest(ratio)
    if not coordinates.shape[0]:
        return Furthest(at, dx[at, k], ratio[at, k], np.zeros_like(k), np.zeros(len(k)))
    squares = np.asarray(coordinates @ np.square(dx))
    place = _first_largest(squares)
    return Furthest(at, dx[at, k], ratio[at, k], place, np.sqrt(squares[place, k]))


@frozen(eq=False)
class _Shared:
    """How far things move by what all unknowns share, ``U' y``: at most the length of y times that of their own part.

    Those with the longest part come first: number (t,) of each, U (c, r) of their components, which begin by ptr
    (t + 1,), and lengths (t,). place: (t,) where each stands.
    """

    number: IntArray
    U: FloatArray
    ptr: IntArray
    lengths: FloatArray
    place: IntArray

    @staticmethod
    def of(U: FloatArray, components: sparse.csr_matrix) -> "_Shared":
        """Of things with these components (t, n), one of each row of the unknowns at most."""
        lengths = np.sqrt(components @ np.einsum("cn,cn->n", U, U))
        number = np.argsort(-lengths, kind="stable")
        mine = components[number]
        place = np.empty_like(number)
        place[number] = np.arange(len(number))
        return _Shared(number, U[:, mine.indices], mine.indptr.astype(np.int64), lengths[number], place)

    def beyond(self, y: FloatArray, found: float, others: IntArray) -> tuple[int, float] | None:
        """The first that moves further than ``found``, and how far; None of those that are not ``others``."""
        most = np.searchsorted(-self.lengths, -found / max(float(np.linalg.norm(y)), 1e-300), side="right")
        if not most:
            return None
        squares = np.add.reduceat(np.square(y @ self.U[:, : self.ptr[most]]), self.ptr[:most])
        place = self.place[others]
        squares[place[place < most]] = 0.0
        at = int(squares.argmax())
        return (int(self.number[at]), float(np.sqrt(squares[at]))) if squares[at] > found**2 else None


@frozen(eq=False)
class Reach:
    """What biases move where Q = own + U' U: the sets of unknowns that one touches by both, all others by U' U alone.

    sigmas: (n,). coordinates: (p, n). unknowns, positions: by what they share. position: (n,) of coordinates, else -1.
    """

    Q: Inverse
    sigmas: FloatArray
    coordinates: sparse.csr_matrix
    unknowns: _Shared
    positions: _Shared
    position: IntArray

    @staticmethod
    def of(Q: Inverse, sigmas: FloatArray, coordinates: sparse.csr_matrix) -> "Reach":
        """Of unknowns with these sigmas, and positions with these coordinates."""
        position = np.full(len(sigmas), -1)
        position[coordinates.indices] = np.repeat(np.arange(coordinates.shape[0]), np.diff(coordinates.indptr))
        each = sparse.identity(len(sigmas), format="csr")
        return Reach(Q, sigmas, coordinates, _Shared.of(Q.U / sigmas, each), _Shared.of(Q.U, coordinates), position)

    def furthest(self, right: sparse.csc_matrix) -> Furthest:
        """For right-hand sides (n, k) of the normal equations."""
        own, y = (self.Q.own @ right).tocsc(), np.asarray((right.T @ self.Q.U.T).T)
        near = np.union1d(own.indices, np.flatnonzero(self.Q.member < 0))
        dx = own[near].toarray() + self.Q.U[:, near].T @ y
        out = furthest_of(dx, self.sigmas[near], self.coordinates[:, near])
        out.unknown[:] = near[out.unknown]
        for j in range(len(out.ratio)):
            touched = own.indices[own.indptr[j] : own.indptr[j + 1]]
            further = self.unknowns.beyond(y[:, j], out.ratio[j], touched)
            if further is not None:
                out.unknown[j], out.ratio[j] = further
                out.shift[j] = self.Q.U[:, further[0]] @ y[:, j]
            positions = self.position[touched]
            further = self.positions.beyond(y[:, j], out.length[j], positions[positions >= 0])
            if further is not None:
                out.position[j], out.length[j] = further
        return out


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
    rows = np.flatnonzero(used & (of_row != most))
    squares = np.zeros((n_sources, len(index)))
    if not len(rows):
        squares[most] = system.sigmas[index] ** 2
        return squares
    Q = covariance_columns(system, index)
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
