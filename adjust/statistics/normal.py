"""The normal matrix of a linear system, factored by the structure that surveys have."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import scipy
from scipy import sparse

from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.precision.s_transformation import without_datum_rows

DENSE = 3000
"""Unknowns up to which the normal matrix is factored as a full one."""
FEW = 200
"""Unknowns up to which it is inverted at once."""
PLAIN = 600
"""Unknowns up to which nothing is gained by their structure."""
_SMALL_SET = 100
"""Unknowns of one epoch, or one point, up to which they are eliminated by themselves."""
_AT_ONCE = 64
"""Right-hand sides that are solved in one go."""
_PIECE = 4096
"""Unknowns of small sets that are solved in one go: what stays in a core's own memory."""
_ROOM, _WIDEST = 20_000_000, 500
"""Numbers that the shared part of an inverse may need, and unknowns of a core: more are faster through a tree."""


@dataclass(frozen=True, eq=False)
class Inverse:
    """An inverse (n, n) as a sum: ``own + U' U``.

    own: of small sets of unknowns, each by itself. U: (c, n), what all unknowns share through c of them. member: (n,)
    the set of an unknown, -1 for the c.
    """

    own: sparse.csr_matrix
    U: FloatArray
    member: IntArray


@dataclass(frozen=True, eq=False)
class _Piece:
    """Small sets of k unknowns: where they are (p k,), their inverses (p, k, k), their rows over the core (p k, c)."""

    rows: IntArray
    inverse: FloatArray
    across: FloatArray

    @cached_property
    def at(self) -> IntArray | slice:
        """The rows, as a slice where they follow each other: then nothing is copied."""
        first, n = int(self.rows[0]), len(self.rows)
        return slice(first, first + n) if np.array_equal(self.rows, np.arange(first, first + n)) else self.rows

    def own(self, b: FloatArray) -> FloatArray:
        """Inverses times (p k, r)."""
        return np.asarray(np.matmul(self.inverse, b.reshape(*self.inverse.shape[:2], -1)).reshape(b.shape))


class Arrow:
    """A matrix (n, n) of few unknowns that most others touch, the core, and small sets that touch nothing but these.

    That is a survey of many epochs, or of many points seen from a few places.
    """

    def __init__(self, core: IntArray, head: FloatArray, pieces: list[_Piece]) -> None:
        self.core, self.pieces, self.n = core, pieces, len(core) + sum(len(p.rows) for p in pieces)
        for p in pieces:
            head -= p.across.T @ p.own(p.across)
        self.lower = np.linalg.cholesky(head)

    def solve(self, b: FloatArray) -> FloatArray:
        """The solution (n, k) or (n,), some columns in one go."""
        columns = b.reshape(len(b), -1)
        parts = [columns[:, i : i + _AT_ONCE] for i in range(0, columns.shape[1], _AT_ONCE)]
        solved = side_by_side(self._solve, parts)
        return (solved[0] if len(solved) == 1 else np.concatenate(solved, axis=1)).reshape(b.shape)

    def _solve(self, b: FloatArray) -> FloatArray:
        x, y = np.empty_like(b), b[self.core]
        for p in self.pieces:
            x[p.at] = own = p.own(b[p.at])
            y -= p.across.T @ own
        x[self.core] = y = scipy.linalg.cho_solve((self.lower, True), y)
        for p in self.pieces:
            x[p.at] -= p.own(p.across @ y)
        return x

    def inverse(self, scale: FloatArray) -> Inverse:
        """Of the matrix whose unknowns are counted in these (n,) scales."""
        U, member = np.empty((len(self.core), self.n)), np.full(self.n, -1)
        U[:, self.core] = scipy.linalg.solve_triangular(self.lower, np.diag(scale[self.core]), lower=True)
        entries, first = [(np.zeros(0, dtype=np.int64),) * 2 + (np.zeros(0),)], 0
        for p in self.pieces:
            T, (n, k, _) = p.own(p.across), p.inverse.shape
            U[:, p.rows] = -scipy.linalg.solve_triangular(self.lower, T.T, lower=True) * scale[p.rows]
            member[p.rows] = first + np.repeat(np.arange(n), k)
            rows, first = p.rows.reshape(n, k), first + n
            values = p.inverse * scale[rows][:, :, None] * scale[rows][:, None, :]
            entries.append((np.repeat(rows, k), np.tile(rows, k).ravel(), values.ravel()))
        i, j, values = (np.concatenate(x) for x in zip(*entries, strict=True))
        return Inverse(sparse.csr_matrix((values, (i, j)), (self.n, self.n)), U, member)


def _arrow(scaled: sparse.csc_matrix) -> Arrow | None:
    """The matrix as an arrow, where it is one."""
    from scipy.sparse.csgraph import connected_components

    degree = np.diff(scaled.indptr)
    core = np.flatnonzero(degree > 2 * np.median(degree))
    rest = np.flatnonzero(degree <= 2 * np.median(degree))
    if not 0 < len(core) <= _WIDEST:
        return None
    N = scaled.tocsr()
    own, across = N[rest][:, rest], N[rest][:, core]
    _, label = connected_components(own, directed=False)
    sizes = np.bincount(label)
    if sizes.max() > _SMALL_SET:
        return None
    pieces = list[_Piece]()
    for k in np.unique(sizes).tolist():
        sets = np.argsort(label, kind="stable")[np.repeat(sizes, sizes) == k].reshape(-1, k)
        for mine in np.array_split(sets, -(-sets.size // _PIECE)):
            rows = mine.ravel()
            inverse: FloatArray = np.linalg.inv(_blocks(own, mine)).astype(np.float64, copy=False)
            pieces.append(_Piece(rest[rows], inverse, across[rows].toarray()))
    return Arrow(core, N[core][:, core].toarray(), pieces)


def _blocks(N: sparse.csr_matrix, sets: IntArray) -> FloatArray:
    """Blocks (p, k, k) of a matrix; sets (p, k), which have nothing with others."""
    p, k = sets.shape
    place, number = np.zeros(N.shape[0], dtype=np.int64), np.repeat(np.arange(p), k)
    place[sets] = np.arange(k)
    entries, out = N[sets.ravel()].tocoo(), np.zeros((p, k, k))
    out[number[entries.row], entries.row % k, place[entries.col]] = entries.data
    return out


Solver = tuple[Callable[[FloatArray], FloatArray], Callable[[], FloatArray] | None]
"""Of a normal matrix with a unit diagonal: solution, inverse where there is a way."""


def _solver(scaled: sparse.csc_matrix) -> Solver:
    n = scaled.shape[0]
    if n <= FEW:  # its inverse: SciPy's linear algebra takes longer to load
        inverse = np.linalg.inv(scaled.toarray())
        return lambda b: inverse @ b, lambda: inverse
    if n <= DENSE or scaled.nnz > n**2 // 4:  # as the rows of a free datum over all points fill it
        factor = scipy.linalg.cho_factor(scaled.toarray())
        return lambda b: np.asarray(scipy.linalg.cho_solve(factor, b)), lambda: inverse_of_factor(*factor)
    from scipy.sparse.linalg import splu  # here: as above

    lu = splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    return lu.solve, None


def inverse_of_factor(factor: FloatArray, lower: bool) -> FloatArray:
    """From a Cholesky factor: a third of the work of n solutions."""
    half, _ = scipy.linalg.lapack.dpotri(factor, lower=lower)
    half = np.tril(half) if lower else np.triu(half)
    return np.asarray(half + half.T - np.diag(np.diag(half)))


class Normal:
    """A normal matrix (n, n), factored: solutions, and its inverse in the datum of the survey."""

    def __init__(self, N: sparse.csc_matrix, motions: FloatArray) -> None:
        self.N, self.motions, self.n = N, motions, N.shape[0]
        self.scale = 1.0 / np.sqrt(np.maximum(N.diagonal(), 1e-300))
        self._scaled = N.copy()
        self._scaled.data *= self.scale[N.indices] * np.repeat(self.scale, np.diff(N.indptr))
        self._arrow = _arrow(self._scaled) if self.n > PLAIN else None

    @cached_property
    def _of_scaled(self) -> Solver:
        return _solver(self._scaled) if self._arrow is None else (self._arrow.solve, None)

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution (n, k) or (n,) of N x = right, with the datum's rows fulfilled where ``right`` is seen."""
        if (sums := self.structured) is not None:
            return np.asarray(sums.own @ right + sums.U.T @ (sums.U @ right))
        scale = self.scale if right.ndim == 1 else self.scale[:, None]
        out = self._of_scaled[0](scale * right)
        out *= scale
        return out

    @cached_property
    def inverse(self) -> FloatArray:
        """Inverse (n, n) of the matrix with its datum rows."""
        inverse = self._of_scaled[1]
        if inverse is None:
            return self.solve(np.eye(self.n))
        return np.asarray(inverse() * self.scale * self.scale[:, None])

    @cached_property
    def structured(self) -> Inverse | None:
        """The same as a sum, where many small sets of unknowns share few others: linear in n. None for others."""
        if self._arrow is None or len(self._arrow.core) * self.n > _ROOM:
            return None
        return self._arrow.inverse(self.scale)

    def covariance(self, datum: sparse.csr_matrix) -> FloatArray:
        """Covariance (n, n) of the unknowns: the inverse less what the datum's own rows add (S-transformation)."""
        if self.motions.shape[1] == 0:
            return self.inverse
        return without_datum_rows(self.inverse, self.motions, datum @ self.motions)
