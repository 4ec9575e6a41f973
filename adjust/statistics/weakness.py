"""What is badly determined, by name: correlations, unknowns that replace each other, the weakest deformation."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.precision.stacked import AT_ONCE
from adjust.statistics.normal import DENSE, FEW, PLAIN, Inverse
from adjust.statistics.result import Correlation, WeakDirection, WeakPart
from adjust.statistics.system import LinearSystem, linear_system

_MOST = 200
_SHARE = 0.1
_WHOLE = 10_000
"""Unknowns up to which all are compared that may correlate."""
_WORK = 20_000_000
"""Correlations that are looked at in surveys of still more, or of hidden ones."""
_KRYLOV, _RESTARTS = 40, 50


def covariance_columns(system: LinearSystem, columns: IntArray) -> FloatArray:
    """Columns (n, k) of the covariance matrix of all unknowns, a priori, in the survey's datum."""
    return system.times_covariance(_units(system, columns))


def _units(system: LinearSystem, columns: IntArray) -> FloatArray:
    out = np.zeros((len(system.columns), len(columns)))
    out[columns, np.arange(len(columns))] = 1.0
    return out


def compared_columns(system: LinearSystem, limit: float = 0.95) -> tuple[IntArray, int]:
    """Columns that are compared with all others, and how many correlations as large as ``limit`` would take.

    That is all of them in small surveys, and in large ones those that may correlate so. Where these are too many: first
    what is there once, then points, last what is there at one epoch alone, as many as ``_WORK`` allows.
    """
    n, columns = len(system.columns), system.columns
    if _as_a_whole(system) or _structure(system, limit) is not None:
        return np.arange(n), n
    sizes = [len(at) for at in columns.at.values() if len(at)]
    first = np.cumsum([0, *sizes])[:-1]
    possible = np.repeat(np.maximum.reduceat(system.most_correlated, first) >= limit, sizes)
    whole = n <= _WHOLE and not system.precision.hidden
    needed, most = int(np.count_nonzero(possible)), n if whole else max(_WORK // n, 1)
    if needed <= most:
        return np.flatnonzero(possible), needed
    epochs = {b.epoch_id for b in system.precision.graph.survey.image_blocks}
    rank = {name: 2 if len(name) == 3 and name[2] in epochs else 1 if name[0] == "point" else 0 for name in columns.at}
    ordered = columns.of(sorted(columns.at, key=lambda name: rank[name]))
    return ordered[possible[ordered]][:most], needed


def _as_a_whole(system: LinearSystem) -> bool:
    """Whether the covariance matrix is at hand."""
    n = len(system.columns)
    return n <= PLAIN or (n <= DENSE and system.structured is not None)


def correlations(
    adjustment: Adjustment, limit: float = 0.95, system: LinearSystem | None = None
) -> tuple[Correlation, ...]:
    """Pairs of components whose correlation is at least ``limit`` in size, largest first, 200 at most.

    Where unknowns are too many and share too much, of the :func:`compared_columns` with all, and of the components of
    every unknown with each other.
    """
    system = system or linear_system(adjustment)
    index = compared_columns(system, limit)[0]
    whole = system.covariance if _as_a_whole(system) else None
    sigma = np.maximum(system.sigmas if whole is None else np.sqrt(np.maximum(np.diag(whole), 0.0)), 1e-150)
    structure = _structure(system, limit)
    if structure is not None:
        return _named(system, _of_structure(structure, sigma, limit))
    bound = system.most_correlated if whole is None else np.full(len(sigma), np.inf)
    ordered = index[np.argsort(-bound[index], kind="stable")]
    return _named(system, _within(system, limit) + _of_columns(system, whole, sigma, ordered, bound, limit))


_Found = list[tuple[int, int, float]]


def _named(system: LinearSystem, found: _Found) -> tuple[Correlation, ...]:
    c, order = system.columns, sorted(found, key=lambda x: (-abs(x[2]), x[0], x[1]))[:_MOST]
    return tuple(Correlation(c.names[i], c.components[i], c.names[j], c.components[j], x) for i, j, x in order)


def _of_columns(
    system: LinearSystem, whole: FloatArray | None, sigma: FloatArray, index: IntArray, bound: FloatArray, limit: float
) -> _Found:
    """Of these columns with those of other unknowns: those among the largest. index: by ``bound`` (n,) on any of it.

    What is below the last of the largest that are known is not looked at.
    """
    least, unknown = limit, np.empty(len(sigma), dtype=np.int64)
    for i, at in enumerate(system.columns.at.values()):
        unknown[at] = i

    def above(first: int) -> _Found:
        nonlocal least
        part = index[first : first + AT_ONCE]
        part = part[bound[part] >= least]
        if not len(part):
            return []
        C = system.through_tree(_units(system, part)) if whole is None else whole[:, part]
        C = C / sigma[part]
        C /= sigma[:, None]
        size = np.abs(C)
        size[index[:first]] = 0.0  # each pair once, nothing with itself
        size[part] = np.tril(size[part], -1)
        high = size >= least
        if (k := int(np.count_nonzero(high))) > _MOST:
            least = max(least, float(np.partition(size[high], k - _MOST)[k - _MOST]))
            high &= size >= least
        a, b = np.nonzero(high) if k else np.zeros((2, 0), dtype=np.int64)
        other = unknown[a] != unknown[part[b]]
        a, b = a[other], b[other]
        pairs = np.sort([a, part[b]], axis=0)
        return list(zip(*pairs.tolist(), C[a, b].tolist(), strict=True))

    return [x for found in side_by_side(above, range(0, len(index), AT_ONCE)) for x in found]


@dataclass(frozen=True, eq=False)
class _Structure:
    """A covariance matrix as a sum, its U over the sigmas, and the components (k,) that share enough with others."""

    Q: Inverse
    V: FloatArray
    sharing: IntArray


def _structure(system: LinearSystem, limit: float = 0.95) -> _Structure | None:
    """Of a system of small sets that meet in few unknowns; None for others, and where too many share too much.

    Components of different sets have a covariance U' U alone: a correlation is at most the product of two lengths.
    """
    Q = system.structured if not system.motions.shape[1] and len(system.columns) > _WHOLE else None
    if Q is None:
        return None
    V = Q.U / np.maximum(system.sigmas, 1e-150)
    lengths = np.sqrt(np.einsum("cn,cn->n", V, V))
    sharing = np.flatnonzero(lengths * lengths.max(initial=0.0) >= limit)
    return _Structure(Q, V, sharing) if len(sharing) <= _WHOLE else None


def _of_structure(found: _Structure, sigma: FloatArray, limit: float) -> _Found:
    """All pairs of components: within a set from its block, of different sets those that share enough."""
    Q, V, sharing = found.Q, found.V, found.sharing
    own = sparse.triu(Q.own, 1).tocoo()
    C = own.data / (sigma[own.row] * sigma[own.col]) + np.einsum("ck,ck->k", V[:, own.row], V[:, own.col])
    high = np.abs(C) >= limit
    out: _Found = list(zip(own.row[high].tolist(), own.col[high].tolist(), C[high].tolist(), strict=True))

    def above(first: int) -> _Found:
        i = sharing[first : first + AT_ONCE]
        C = V[:, i].T @ V[:, sharing]
        other = (i[:, None] < sharing) & ((Q.member[i][:, None] != Q.member[sharing]) | (Q.member[sharing] < 0))
        a, b = np.nonzero((np.abs(C) >= limit) & other)
        return list(zip(i[a].tolist(), sharing[b].tolist(), C[a, b].tolist(), strict=True))

    return out + [x for part in side_by_side(above, range(0, len(sharing), AT_ONCE)) for x in part]


def _within(system: LinearSystem, limit: float) -> _Found:
    """Pairs of components of one unknown."""
    apart = [at for at in system.columns.at.values() if len(at) > 1]
    out: _Found = []
    for k in sorted({len(at) for at in apart}):
        columns = np.array([at for at in apart if len(at) == k])
        C = system.own_covariances(columns)
        d = np.sqrt(np.maximum(np.diagonal(C, axis1=1, axis2=2), 1e-300))
        C = np.triu(C / (d[:, :, None] * d[:, None, :]), 1)
        i, a, b = np.nonzero(np.abs(C) >= limit)
        out += zip(columns[i, a].tolist(), columns[i, b].tolist(), C[i, a, b].tolist(), strict=True)
    return out


def weak_directions(
    adjustment: Adjustment, most: int = 5, least_inflation: float = 10.0, system: LinearSystem | None = None
) -> tuple[WeakDirection, ...]:
    """Directions in which unknowns err together, worst first.

    Every component is counted in the sigma it would have if it were the only unknown; the eigenvectors of the
    covariance so scaled with large eigenvalues are the directions in which the unknowns replace each other (Belsley,
    Kuh and Welsch 1980, chapter 3).
    """
    system = system or linear_system(adjustment)
    A, used = system.A, system.used[system.row_of]
    squares = A.data**2 * np.repeat(used, np.diff(A.indptr))
    alone = np.sqrt(np.maximum(np.bincount(A.indices, squares, A.shape[1]), 1e-300))
    values, vectors = _largest(system, np.arange(len(alone)), alone, most)
    c, out = system.columns, []
    for inflation, shares, order in inflated(values, vectors, least_inflation, _SHARE):
        amount = inflation * shares / np.linalg.norm(shares) / alone * np.sign(shares[order[0]])
        parts = tuple(WeakPart(c.names[i], c.components[i], c.units[i], float(amount[i])) for i in order)
        out.append(WeakDirection(inflation, parts))
    return tuple(out)


def inflated(
    values: FloatArray, moves: FloatArray, least: float, share: float
) -> Iterator[tuple[float, FloatArray, list[int]]]:
    """Of directions by eigenvalue (k,), largest first, those that inflate a sigma at least so much, and by how much.

    moves: (n, k), how components move in each; with it their shares (n,) of the largest one, and the components of
    which more than ``share`` is there, the largest first.
    """
    for value, move in zip(values, moves.T, strict=True):
        if value < least**2:
            return
        shares = move / np.abs(move).max()
        large = np.flatnonzero(np.abs(shares) > share)
        yield float(np.sqrt(value)), shares, large[np.argsort(-np.abs(shares[large]), kind="stable")].tolist()


def _largest(system: LinearSystem, index: IntArray, scale: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Largest eigenvalues (k,), the first first, and vectors (n, k) of the covariance of these columns times scales.

    In large surveys by Lanczos' method, every step of it one solution of the normal equations (Golub and Van Loan 2013,
    chapter 10): the few directions that are asked for, and not all n.
    """
    n = len(index)
    if n <= FEW:
        Q = covariance_columns(system, index)[index] * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(0.5 * (Q + Q.T))
        return values[::-1][:most], vectors[:, ::-1][:, :most]
    from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigsh  # here: they take long to load

    inside = np.zeros(len(system.columns))

    def times(x: FloatArray) -> FloatArray:
        inside[index] = scale * x.ravel()
        return np.asarray(scale * system.times_covariance(inside)[index])

    operator = LinearOperator((n, n), matvec=times, dtype=np.float64)
    first = 1.0 + 0.1 * np.cos(np.arange(n))  # the same every time, at right angles to nothing in particular
    try:
        values, vectors = eigsh(operator, most, which="LA", v0=first, ncv=_KRYLOV, tol=1e-6, maxiter=_RESTARTS)
    except ArpackNoConvergence as found:  # those that came out are right
        values, vectors = found.eigenvalues, found.eigenvectors
    order = np.argsort(-values, kind="stable")
    return np.asarray(values)[order], np.asarray(vectors)[:, order]
