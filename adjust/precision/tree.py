"""Covariances of all cliques of a Bayes tree in one pass from the roots to the leaves.

With a clique's conditional R x_f + S x_s: T = -R^-1 S, Q_fs = T Q_ss, Q_ff = R^-1 R^-T + T Q_ss T' (the sparse inverse
subset of Takahashi, Fagan and Chen 1973; Golub and Plemmons 1980 for geodetic networks). The unknowns of every factor
lie together in one clique, so all redundancy numbers follow from it.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
from scipy import sparse

from adjust.graph.cliques import Cliques
from adjust.model.survey import FloatArray, IntArray
from adjust.native.trees import (
    clique_covariance,
    covariance_rows,
    fill_block,
    joint_blocks,
    sets_among,
    solve_cliques,
)  # fmt: skip

_COLUMNS = 96
"""Columns that go up the tree at once."""
_ROOM = 2**30
"""Bytes of such columns that are kept."""
_MANY = 20
"""Keys that are looked up one by one, of a joint covariance."""


def unit_rows(at: IntArray, n: int) -> sparse.csr_array:
    """(k, n): in each row nothing but a one, in these columns (k,)."""
    return sparse.csr_array((np.ones(len(at)), at, np.arange(len(at) + 1)), (len(at), n))


Half: TypeAlias = tuple[IntArray, FloatArray]
"""Of rows A (m, n): U (k, m) with U'U = A Q A', after which (k,) of all its rows these are; the others are zero."""


def squares(half: Callable[[sparse.csr_array], Half], A: sparse.csr_array) -> FloatArray:
    """A Q A' (m, m) by halves of some rows at once, anew for as many others as there is room for."""
    out = np.zeros((A.shape[0],) * 2)
    parts = [slice(i, i + _COLUMNS) for i in range(0, A.shape[0], _COLUMNS)]
    while parts:
        kept, place = list[tuple[slice, IntArray, FloatArray]](), np.full(A.shape[1], -1)
        for i, part in enumerate(parts):
            rows, U = half(A[part])
            place[rows] = np.arange(len(rows))
            for other, before, V in kept:
                there = np.flatnonzero(place[before] >= 0)
                across = U[place[before[there]]].T @ V[there]
                out[part, other], out[other, part] = across, across.T
            place[rows] = -1
            if i == len(kept) and sum(V.nbytes for _, _, V in kept) < _ROOM:
                kept.append((part, rows, U))
                out[part, part] = U.T @ U
        parts = parts[len(kept) :]
    return out


def squares_of_sums(half: Callable[[sparse.csr_array], Half], A: sparse.csr_array, n: int, q: int) -> FloatArray:
    """A_j Q A_j' (J, q, q) with A_j the sum of the J sets of q rows of A from the j-th on; n: rows of all of U."""
    out, total, later = np.empty((A.shape[0] // q, q, q)), np.zeros((q, q)), np.zeros((q, n))
    some = max(_COLUMNS // q, 1)
    for end in range(len(out), 0, -some):
        first = max(end - some, 0)
        rows, U = half(A[first * q : end * q])
        each = np.ascontiguousarray(U.T).reshape(-1, q, len(rows))
        sums = np.concatenate([each, later[None, :, rows]])[::-1].cumsum(axis=0)[::-1]
        # (s + u) (s + u)' - s s' = u (s + u + s)', made symmetric
        more = each @ (sums[:-1] + sums[1:]).transpose(0, 2, 1)
        out[first:end] = total + 0.5 * (more + more.transpose(0, 2, 1))[::-1].cumsum(axis=0)[::-1]
        later[:, rows], total = sums[0], out[first]
    return out


class TreeCovariance:
    """Marginal and joint covariances. ``dims`` gives the dimension of every key; keys are also counted 0, 1, ..."""

    def __init__(self, cliques: Cliques, dims: Mapping[int, int]) -> None:
        self.dims, self.cliques, self.number = dims, cliques, cliques.number
        self.arrays = cliques.arrays(np.empty_like(cliques.data))
        """What the compiled look-up of two keys' covariance needs."""
        covariance_rows(self.arrays, cliques.n_front, cliques.data)

    def shared(self, a: int, b: int) -> FloatArray | None:
        """Covariance (dim a, dim b) of two keys; None where they share no clique."""
        i, j = self.number[a], self.number[b]
        out = np.empty((self.cliques.dims[i], self.cliques.dims[j]))
        return out if fill_block(self.arrays, i, j, out) else None

    def marginal(self, key: int) -> FloatArray:
        """Covariance (dim, dim) of one unknown."""
        return np.asarray(self.marginals(np.array([key]), int(self.dims[key]))[0])

    def marginals(self, keys: IntArray, dim: int) -> FloatArray:
        """Covariances (n, dim, dim) of unknowns of one dimension."""
        n, along = np.array([self.number[k] for k in keys.tolist()], dtype=np.int64), np.arange(dim)
        first, width = self.cliques.own[n], self.cliques.width[self.cliques.home[n]]
        cov: FloatArray = self.arrays.cov[first[:, None, None] + width[:, None, None] * along[:, None] + along]
        return cov

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of any unknowns, stacked in this order; fast where they share a clique."""
        c, numbers = self.cliques, np.array([self.number[k] for k in keys], dtype=np.int64)
        deepest = int(c.home[numbers].max())
        together = set(c.keys_in(deepest).tolist()).issuperset(numbers.tolist())
        if not together:
            return self._apart(c.rows_of(numbers))
        at = np.concatenate([[0], np.cumsum(c.dims[numbers])])
        if together and len(numbers) > _MANY and 2 * at[-1] >= c.width[deepest]:  # all of the clique at once
            inside, first = c.keys_in(deepest), np.zeros(len(c.dims), dtype=np.int64)
            first[inside] = np.cumsum(c.dims[inside]) - c.dims[inside]
            rows = c.rows_of(numbers, first)
            return np.asarray(clique_covariance(self.arrays, c.n_front, deepest)[np.ix_(rows, rows)])
        out = np.empty((at[-1], at[-1]))
        for i, a in enumerate(keys):
            for j, b in enumerate(keys[: i + 1]):
                block = self.shared(a, b)
                if block is None:  # both are frontal further up
                    return self._apart(c.rows_of(numbers))
                out[at[i] : at[i + 1], at[j] : at[j + 1]] = block
                out[at[j] : at[j + 1], at[i] : at[i + 1]] = block.T
        return out

    def _apart(self, rows: IntArray) -> FloatArray:
        """Joint covariance of rows of a stacked vector; of most unknowns the whole matrix is less work."""
        if 2 * len(rows) > self.n:
            return np.asarray(self.full()[np.ix_(rows, rows)])
        return self.among(unit_rows(rows, self.n))

    def rows(self, keys: Sequence[int]) -> IntArray:
        """Rows of these keys in a stacked vector of all unknowns, as :meth:`times` takes it."""
        return self.cliques.rows_of(np.array([self.number[k] for k in keys], dtype=np.int64))

    def places(self) -> dict[int, slice]:
        """Rows of every key in a stacked vector of all unknowns."""
        first = self.cliques.first.tolist()
        return {key: slice(first[i], first[i + 1]) for key, i in self.number.items()}

    @property
    def n(self) -> int:
        """Length of a stacked vector of all unknowns."""
        return int(self.cliques.first[-1])

    def multiply(self, x: FloatArray) -> None:
        """Multiply the whole covariance matrix by columns (n, m), in place, without forming it."""
        self.cliques.multiply(x)

    def drawn(self, w: FloatArray) -> FloatArray:
        """R^-1 w (n, m): errors with the whole covariance matrix, where w are independent with unit variance."""
        x, c = np.array(w), self.cliques
        none, every = np.zeros(0, dtype=np.int64), np.arange(len(c), dtype=np.int64)
        solve_cliques(self.arrays, none, every, c.first, c.data, x)
        return x

    def each_among(self, A: sparse.csr_array, ptr: IntArray) -> list[FloatArray]:
        """A Q A' (m, m) of sets of the rows of A, set i from ``ptr[i]`` on, without forming Q.

        U'U with R'U = A', on the ways to the first clique that holds all that is left of A', and this with the joint
        covariance of its keys; to the roots where there is none.
        """
        c, i8 = self.cliques, np.int64
        rows = ptr.astype(i8), A.indptr.astype(i8), A.indices.astype(i8), np.asarray(A.data, dtype=float)
        return sets_among(*rows, self.arrays, c.parents, c.n_front, c.key_of, c.first, c.data)

    def among(self, A: sparse.csr_array) -> FloatArray:
        """The same of all rows of A (m, n): of many some at once, on their ways to the roots."""
        c = self.cliques
        if A.shape[0] <= _COLUMNS:
            return self.each_among(A, np.array([0, A.shape[0]]))[0]
        of_row = np.maximum.reduceat(np.append(c.home[c.key_of[A.indices]], 0), A.indptr[:-1])
        order = np.argsort(of_row, kind="stable")  # neighbours in the tree side by side
        back = np.argsort(order)
        return np.asarray(squares(self.half, A[order])[np.ix_(back, back)])

    def half(self, A: sparse.csr_array) -> Half:
        """R^-T A' of some rows A (m, n): on the ways to the roots."""
        c = self.cliques
        up = c.ancestors(set(c.home[c.key_of[A.indices]].tolist()))
        first, n = c.gathered(up)
        entries = A.data, (first - c.first[:-1])[c.key_of[A.indices]] + A.indices, A.indptr
        U = np.ascontiguousarray(sparse.csr_array(entries, (A.shape[0], n)).toarray().T)
        solve_cliques(self.arrays, up, np.zeros(0, dtype=np.int64), first, c.data, U)
        way = np.zeros(len(c), dtype=np.bool_)
        way[up] = True
        return np.flatnonzero(way[c.home[c.key_of]]), U

    def full(self) -> FloatArray:
        """The whole covariance matrix (n, n) of all unknowns, rows as :meth:`places` says, parents before children.

        From the roots down: with Q of all that comes before, Q_f, = T Q_s, and Q_ff = R^-1 R^-T + T Q_sf. Costs the
        size of the factor times n, by matrix products.
        """
        Q, cliques = np.zeros((self.n, self.n)), self.cliques
        for c in range(len(cliques)):
            nf, n, at = int(cliques.front[c]), int(cliques.width[c]), int(cliques.at[c])
            rows = cliques.rows_of(cliques.keys_in(c))
            done = int(rows[0])  # frontal keys are numbered where they first appear, cliques in their order
            A = cliques.data[at : at + nf * n].reshape(nf, n)
            own = slice(done, done + nf)
            inverse = np.triu(A[:, :nf])
            Q[own, own] = inverse @ inverse.T
            if n > nf:
                T = A[:, nf:]
                across = T @ Q[rows[nf:], :done]
                Q[own, :done] = across
                Q[:done, own] = across.T
                Q[own, own] += across[:, rows[nf:]] @ T.T
        return Q

    def pairs(self, first: IntArray, second: IntArray, dim: int) -> FloatArray:
        """Joint covariances (p, 2 dim, 2 dim) of pairs of keys that share a factor; -1 stands for a constant.

        Raises KeyError for a pair that shares none.
        """
        known = np.array(list(self.number), dtype=np.int64)
        order = np.argsort(known)
        a, b = (np.where(keys < 0, -1, order[np.searchsorted(known, np.maximum(keys, known.min()), sorter=order)])
                for keys in (first, second))  # fmt: skip
        out = np.empty((len(a), 2 * dim, 2 * dim))
        lost = joint_blocks(self.arrays, a, b, out)
        if lost >= 0:
            raise KeyError((int(first[lost]), int(second[lost])))
        return out
