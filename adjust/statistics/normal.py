"""The normal matrix of a linear system, factored by the structure that surveys have."""

from collections.abc import Callable
from functools import cached_property
from typing import NamedTuple

import numpy as np
import scipy
from scipy import sparse

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.precision.s_transformation import without_datum_rows

DENSE = 3000
"""Unknowns up to which the normal matrix is factored as a full one."""
FEW = 200
"""Unknowns up to which it is inverted at once."""
PLAIN = 600
"""Unknowns up to which nothing is gained by their structure."""
_SMALL_SET = 100
"""Unknowns of one epoch, or one point, up to which they are eliminated by themselves."""
_PIECE = 4096
"""Unknowns of small sets that are solved in one go: what stays in a core's own memory."""
_ROOM, _WIDEST = 20_000_000, 500
"""Numbers that the shared part of an inverse may need, and unknowns of a core: more are faster through a tree."""


@frozen(eq=False)
class Inverse:
    """An inverse (n, n) as a sum: ``own + U' U``.

    own: of small sets of unknowns, each by itself. U: (c, n), what all unknowns share through c of them. member: (n,)
    the set of an unknown, -1 for the c.
    """

    own: sparse.csr_matrix
    U: FloatArray
    member: IntArray

    def times(self, right: FloatArray) -> FloatArray:
        """The same times (n, k) or (n,), which may be sparse."""
        return np.asarray(self.own @ right + self.U.T @ (self.U @ right))


def structured_inverse(N: sparse.csc_matrix, scale: FloatArray) -> Inverse | None:
    """The inverse of a symmetric matrix (n, n), its unknowns in these scales (n,), where it is an arrow; else None.

    An arrow has few unknowns that most others touch, the core, and small sets that touch nothing but these: a survey of
    many epochs, or of many points seen from a few places. Linear in n.
    """
    degree, n = np.diff(N.indptr), N.shape[0]
    core = np.flatnonzero(degree > 2 * np.median(degree))
    rest = np.flatnonzero(degree <= 2 * np.median(degree))
    if not 0 < len(core) <= min(_WIDEST, _ROOM // n):
        return None
    by_row = N.T  # the same, for it is symmetric
    of_rest = by_row[rest]
    own, across = of_rest[:, rest], of_rest[:, core]
    label = sets_apart(own)
    sizes = np.bincount(label)
    if sizes.max() > _SMALL_SET:
        return None
    head, pieces = by_row[core][:, core].toarray(), list[tuple[IntArray, FloatArray, FloatArray]]()
    for k in np.unique(sizes).tolist():
        sets = np.argsort(label, kind="stable")[np.repeat(sizes, sizes) == k].reshape(-1, k)
        for mine in np.array_split(sets, -(-sets.size // _PIECE)):
            B: FloatArray = across[mine.ravel()].toarray()
            inverse: FloatArray = np.linalg.inv(_blocks(own, mine)).astype(np.float64, copy=False)
            T = np.matmul(inverse, B.reshape(*mine.shape, -1)).reshape(B.shape)
            head -= B.T @ T
            pieces.append((rest[mine], inverse, T))
    lower = np.linalg.cholesky(head)
    U, member, first = np.empty((len(core), n)), np.full(n, -1), 0
    of_core = np.linalg.inv(lower)
    U[:, core] = of_core * scale[core]
    entries = [(np.zeros(0, dtype=np.int64),) * 2 + (np.zeros(0),)]
    for rows, inverse, T in pieces:
        at, k = rows.ravel(), rows.shape[1]
        U[:, at] = -(of_core @ T.T) * scale[at]
        member[rows] = first + np.arange(len(rows))[:, None]
        first += len(rows)
        values = inverse * scale[rows][:, :, None] * scale[rows][:, None, :]
        entries.append((np.repeat(at, k), np.tile(rows, k).ravel(), values.ravel()))
    i, j, values = (np.concatenate(x) for x in zip(*entries, strict=True))
    return Inverse(sparse.csr_matrix((values, (i, j)), (n, n)), U, member)


def sets_apart(N: sparse.csr_matrix) -> IntArray:
    """Number (n,) of the set of unknowns that each belongs to, where those of different sets have nothing in common.

    ``scipy.sparse.csgraph`` takes longer to load than this to run.
    """
    label, before = np.arange(N.shape[0]), np.zeros(0, dtype=np.int64)
    while not np.array_equal(label, before):  # each takes the least of those it touches, and what that one has by now
        before = label
        label = np.minimum.reduceat(label[N.indices], N.indptr[:-1])
        label = label[label]
    return np.asarray(np.unique(label, return_inverse=True)[1])


def _blocks(N: sparse.csr_matrix, sets: IntArray) -> FloatArray:
    """Blocks (p, k, k) of a matrix; sets (p, k), which have nothing with others."""
    p, k = sets.shape
    place, number = np.zeros(N.shape[0], dtype=np.int64), np.repeat(np.arange(p), k)
    place[sets] = np.arange(k)
    entries, out = N[sets.ravel()].tocoo(), np.zeros((p, k, k))
    out[number[entries.row], entries.row % k, place[entries.col]] = entries.data
    return out


class Solver(NamedTuple):
    """Of a normal matrix N with a unit diagonal: solution; inverse, and half a solution H b with H'H the inverse."""

    solve: Callable[[FloatArray], FloatArray]
    inverse: Callable[[], FloatArray] | None = None
    half: Callable[[FloatArray], FloatArray] | None = None


def _solver(scaled: sparse.csc_matrix) -> Solver:
    """Raises LinAlgError where the matrix is singular."""
    n = scaled.shape[0]
    if n <= FEW:  # its inverse: SciPy's linear algebra takes longer to load
        inverse = np.linalg.inv(scaled.toarray())
        return Solver(lambda b: inverse @ b, lambda: inverse)
    if n <= DENSE or scaled.nnz > n**2 // 4:  # as the rows of a free datum over all points fill it
        factor, lower = scipy.linalg.cho_factor(scaled.toarray())

        def half(b: FloatArray) -> FloatArray:
            return np.asarray(scipy.linalg.solve_triangular(factor, b, trans=0 if lower else 1, lower=lower))

        return Solver(lambda b: np.asarray(scipy.linalg.cho_solve((factor, lower), b)),
                      lambda: inverse_of_factor(factor, lower), half)  # fmt: skip
    from scipy.sparse.linalg import splu  # here: as above

    try:
        lu = splu(scaled, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    except RuntimeError as error:
        raise np.linalg.LinAlgError(str(error)) from error
    return Solver(lu.solve)


def inverse_of_factor(factor: FloatArray, lower: bool) -> FloatArray:
    """From a Cholesky factor: a third of the work of n solutions."""
    half, _ = scipy.linalg.lapack.dpotri(factor, lower=lower)
    half = np.tril(half) if lower else np.triu(half)
    return np.asarray(half + half.T - np.diag(np.diag(half)))


class Normal:
    """A normal matrix (n, n), factored: solutions, and its inverse in the datum of the survey."""

    def __init__(self, N: sparse.csc_matrix, motions: FloatArray) -> None:
        """N: is scaled where it is, and not to be used any more."""
        self.motions, self.n = motions, N.shape[0]
        self.scale = 1.0 / np.sqrt(np.maximum(N.diagonal(), 1e-300))
        N.data *= self.scale[N.indices]
        N.data *= np.repeat(self.scale, np.diff(N.indptr))
        self._scaled = N
        self.structured = structured_inverse(self._scaled, self.scale) if self.n > PLAIN else None
        """The inverse as a sum, where many small sets of unknowns share few others; None for others."""

    @cached_property
    def _of_scaled(self) -> Solver:
        return _solver(self._scaled)

    def solve(self, right: FloatArray) -> FloatArray:
        """The solution (n, k) or (n,) of N x = right, with the datum's rows fulfilled where ``right`` is seen."""
        if self.structured is not None:
            return self.structured.times(right)
        scale = self.scale if right.ndim == 1 else self.scale[:, None]
        out = self._of_scaled.solve(scale * right)
        out *= scale
        return out

    def squares(self, rows: FloatArray) -> FloatArray:
        """(J, q, q) of sets of rows (J, q, n): A N^-1 A' of each."""
        columns = rows.reshape(-1, self.n).T
        half = self._of_scaled.half if self.structured is None else None
        if half is None:
            return np.asarray(rows @ self.solve(columns).T.reshape(rows.shape).transpose(0, 2, 1))
        mine = half(self.scale[:, None] * columns).T.reshape(rows.shape)
        return np.asarray(mine @ mine.transpose(0, 2, 1))

    @cached_property
    def inverse(self) -> FloatArray:
        """Inverse (n, n) of the matrix with its datum rows."""
        inverse = self._of_scaled.inverse if self.structured is None else None
        if inverse is None:
            return self.solve(np.eye(self.n))
        return np.asarray(inverse() * self.scale * self.scale[:, None])

    def covariance(self, datum: sparse.csr_matrix) -> FloatArray:
        """Covariance (n, n) of the unknowns: the inverse less what the datum's own rows add (S-transformation)."""
        if self.motions.shape[1] == 0:
            return self.inverse
        return without_datum_rows(self.inverse, self.motions, datum @ self.motions)
