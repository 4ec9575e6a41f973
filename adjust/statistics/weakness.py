"""What is badly determined, by name: correlations, unknowns that replace each other, the weakest deformation."""

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from scipy import sparse

from adjust.model.frozen import frozen
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.native.point_tests import UnitVectors
from adjust.precision.stacked import AT_ONCE
from adjust.statistics.normal import DENSE, FEW, PLAIN, Inverse
from adjust.statistics.result import Correlation, WeakDirection, WeakPart
from adjust.statistics.system import LinearSystem, linear_system

_MOST, _KEPT = 200, 4000
"""Correlations that are named, and that are looked at for these."""
_SHARE = 0.1
_WHOLE = 10_000
"""Unknowns up to which all may share something, where small sets meet in few others."""
_WORK, _SOLVED = 1_000_000_000, 5_000_000
"""Correlations that are looked at in drawn solutions, and those in columns of the covariance matrix."""
_DRAWS, _SURE = 64, 7.0
"""Drawn solutions, and by how many sigmas what they tell may be wrong."""
_SIZES = (0.99, 0.96, 0.9)
"""Correlations in drawn solutions that are looked for first: mostly there are enough of them."""
_COMPARED, _TOGETHER = 256, 8
"""Components that are compared with all others in one go, and how often that is done side by side."""
_BLOCK, _STEPS, _EXACT = 8, 40, 1e-10
"""Directions that are sought together, in at most so many steps; of an eigenvalue, what its vector leaves."""
_Found = list[tuple[int, int, float]]
"""Two components and their correlation."""


def covariance_columns(system: LinearSystem, columns: IntArray) -> FloatArray:
    """Columns (n, k) of the covariance matrix of all unknowns, a priori, in the survey's datum."""
    return system.times_covariance(_units(system, columns))


def _units(system: LinearSystem, columns: IntArray) -> FloatArray:
    out = np.zeros((len(system.columns), len(columns)))
    out[columns, np.arange(len(columns))] = 1.0
    return out


def compared_columns(system: LinearSystem) -> IntArray:
    """Columns that are compared with all others.

    That is all of them where ``_WORK`` allows; else what is there once, then points, last what is there at one epoch.
    """
    n, columns = len(system.columns), system.columns
    if n * n <= _WORK or _structure(system) is not None:
        return np.arange(n)
    epochs = {b.epoch_id for b in system.precision.graph.survey.image_blocks}
    rank = {name: 2 if len(name) == 3 and name[2] in epochs else 1 if name[0] == "point" else 0 for name in columns.at}
    return columns.of(sorted(columns.at, key=lambda name: rank[name]))[: _WORK // n]


def correlations(
    adjustment: Adjustment, limit: float = 0.95, system: LinearSystem | None = None
) -> tuple[Correlation, ...]:
    """Pairs of components whose correlation is at least ``limit`` in size, largest first, 200 at most.

    Where unknowns are too many, of the :func:`compared_columns` with all, and of the components of every unknown with
    each other.
    """
    system = system or linear_system(adjustment)
    n, index, structure = len(system.columns), compared_columns(system), _structure(system, limit)
    if structure is not None:
        return _named(system, _of_structure(structure, np.maximum(system.sigmas, 1e-150), limit))
    if n <= PLAIN or (n <= DENSE and system.structured is not None):
        sigma = np.sqrt(np.maximum(np.diag(system.covariance), 1e-300))
        C = system.covariance / sigma / sigma[:, None]
        pairs = _largest(partial(_larger, C), n, n, limit)
        return _named(system, _above(pairs, C[pairs[:, 0], pairs[:, 1]], limit))
    pairs = _likely(system, index, limit)
    columns = np.array(list(dict.fromkeys(pairs[:, 1].tolist()))[: max(_SOLVED // n, AT_ONCE)], dtype=np.int64)
    number = np.full(n, -1)
    number[columns] = np.arange(len(columns))

    def of(first: int) -> _Found:
        some = pairs[number[pairs[:, 1]] // AT_ONCE == first // AT_ONCE]
        Q = system.through_tree(_units(system, columns[first : first + AT_ONCE]))
        return _above(some, Q[some[:, 0], number[some[:, 1]] - first] / system.sigmas[some].prod(axis=1), limit)

    found = [x for part in side_by_side(of, range(0, len(columns), AT_ONCE)) for x in part]
    return _named(system, found + (_within(system, index, limit) if len(index) < n else []))


def _above(pairs: IntArray, C: FloatArray, limit: float) -> _Found:
    """Of pairs (k, 2) with correlations (k,) those that are so large."""
    high = np.abs(C) >= limit
    return list(zip(*np.sort(pairs[high], axis=1).T.tolist(), C[high].tolist(), strict=True))


def _larger(C: FloatArray, first: int, last: int, end: int, least: float) -> FloatArray:
    """Of columns of a matrix what is below its diagonal, to row ``end``, and so large: as ``_largest`` asks for it."""
    size = np.abs(np.tril(C[first:end, first:last], -1))
    at = np.flatnonzero(size >= least)
    i, j = np.divmod(at, last - first)
    return np.stack([first + i, first + j, size.ravel()[at]], axis=1)


def _likely(system: LinearSystem, index: IntArray, limit: float) -> IntArray:
    """Pairs (k, 2) that may correlate so, the likeliest first, by errors of drawn solutions.

    Fisher's z of a correlation from k draws, atanh r, is normal with variance 1 / (k - 2): one of 1e11 is overlooked.
    """
    drawn = system.drawn(_DRAWS)
    drawn /= np.maximum(np.linalg.norm(drawn, axis=1), 1e-150)[:, None]
    order = np.concatenate([index, np.delete(np.arange(len(drawn)), index)])
    u, z = UnitVectors(drawn[order]), np.arctanh(limit) - _SURE / np.sqrt(_DRAWS - 2.0)
    for size in (*_SIZES, 0.0):  # seldom down to the last
        found = _largest(u.parallel, len(order), len(index), max(size, float(np.tanh(max(z, 1e-9)))))
        if len(found) == _KEPT:
            break
    pairs = order[found]
    often = np.bincount(pairs.ravel(), minlength=len(order))[pairs]
    return np.where(often[:, :1] > often[:, 1:], pairs[:, ::-1], pairs)


def _largest(above: Callable[[int, int, int, float], FloatArray], total: int, n: int, least: float) -> IntArray:
    """Pairs (k, 2) of n columns with each other and with all others, those at least of a size, the largest first.

    above: of columns from .. to with the rows behind each, to a last one, of at least a size: row, column, size (k, 3).
    total: rows. What is smaller than enough others is not looked for.
    """
    parts = [(first, min(first + _COMPARED, n)) for first in range(0, n, _COMPARED)]
    out = np.zeros((0, 3))
    for k in range(0, len(parts), _TOGETHER):
        some = [(*part, total, least) for part in parts[k : k + _TOGETHER]]
        out = _first(np.concatenate([out, *side_by_side(lambda part: _first(above(*part)), some)]))
        least = max(least, float(out[-1, 2])) if len(out) == _KEPT else least
    return out[:, :2].astype(np.int64)


def _first(found: FloatArray) -> FloatArray:
    """Rows (k, 3) by their last number, the largest first; as many as are looked at."""
    if len(found) > _KEPT:
        found = found[found[:, 2] >= np.partition(found[:, 2], -_KEPT)[-_KEPT]]
    return found[np.argsort(-found[:, 2], kind="stable")[:_KEPT]]


def _named(system: LinearSystem, found: _Found) -> tuple[Correlation, ...]:
    c, order = system.columns, sorted(found, key=lambda x: (-abs(x[2]), x[0], x[1]))[:_MOST]
    return tuple(Correlation(c.names[i], c.components[i], c.names[j], c.components[j], x) for i, j, x in order)


@frozen(eq=False)
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


def _within(system: LinearSystem, index: IntArray, limit: float) -> _Found:
    """Pairs of components of one unknown that is not compared with others."""
    others = {system.columns.names[i] for i in index.tolist()}
    apart = [at for name, at in system.columns.at.items() if len(at) > 1 and name not in others]
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
    values, vectors = _eigen(system, alone, most)
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


def _eigen(system: LinearSystem, scale: FloatArray, most: int) -> tuple[FloatArray, FloatArray]:
    """Largest eigenvalues (k,), the first first, and vectors (n, k) of the covariance times the scales (n,) of columns.

    In large surveys by Lanczos' method with a block of vectors (Golub and Van Loan 2013, 10.3.6), every step of it one
    solution of the normal equations: it begins with drawn errors, in which the directions sought are large already.
    """
    n = len(scale)
    if n <= FEW:
        Q = covariance_columns(system, np.arange(n)) * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(0.5 * (Q + Q.T))
        return values[::-1][:most], vectors[:, ::-1][:, :most]
    kept, X, m = np.empty((_BLOCK * _STEPS, n)), system.drawn(_BLOCK) * scale[:, None], 0
    X, left = _orthonormal(X, kept[:0])
    H, values, moves, exact = np.zeros((len(kept),) * 2), np.zeros(0), np.empty((0, 0)), np.zeros(0, dtype=np.bool_)
    for _ in range(_STEPS):
        own = slice(m, m := m + X.shape[1])
        kept[own] = X.T
        X = system.times_covariance(X * scale[:, None]) * scale[:, None]
        H[:m, own] = kept[:m] @ X
        H[own, :m] = H[:m, own].T
        X, left = _orthonormal(X, kept[:m])
        values, moves = (x[..., : -most - 1 : -1] for x in np.linalg.eigh(H[:m, :m]))
        exact = np.linalg.norm(left @ moves[own], axis=0) <= _EXACT * values
        if exact.all():
            break
    return values[exact], kept[:m].T @ moves[:, exact]


def _orthonormal(X: FloatArray, kept: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Unit vectors U (n, j) at right angles with what X (n, k) spans besides kept (m, n), and R with X = U R there."""
    R = np.eye(X.shape[1])
    for _ in range(2):
        X = X - kept.T @ (kept @ X)
        G = X.T @ X
        size = np.sqrt(np.diag(G)) + 1e-300
        values, vectors = np.linalg.eigh(G / size[:, None] / size)
        some, root = values > 1e-12, np.sqrt(np.abs(values))
        X, R = X @ (vectors / root / size[:, None])[:, some], (vectors * root * size[:, None])[:, some].T @ R
    return X, R
