"""Covariances of all cliques of a Bayes tree in one pass from the roots to the leaves.

With a clique's conditional R x_f + S x_s: T = -R^-1 S, Q_fs = T Q_ss, Q_ff = R^-1 R^-T + T Q_ss T' (the sparse inverse
subset of Takahashi, Fagan and Chen 1973; Golub and Plemmons 1980 for geodetic networks). The unknowns of every factor
lie together in one clique, so all redundancy numbers follow from it.
"""

from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property

import gtsam
import numpy as np
from scipy import sparse

from adjust.model.survey import FloatArray, IntArray
from adjust.native.elimination import PoseTree
from adjust.native.trees import (
    TreeArrays,
    clique_covariance,
    covariance_rows,
    fill_block,
    invert_cliques,
    joint_blocks,
    solve_cliques,
)  # fmt: skip
from adjust.observations.images.reduction import Leaves

_COLUMNS = 96
"""Columns that go through the tree at once."""


class TreeCovariance:
    """Marginal and joint covariances. ``dims`` gives the dimension of every key; keys are also counted 0, 1, ..."""

    def __init__(
        self, tree: gtsam.GaussianBayesTree | PoseTree, dims: Mapping[int, int], leaves: Leaves | None = None
    ) -> None:
        self.dims = dims
        if isinstance(tree, PoseTree):
            self._take(tree)
        else:
            self._flatten(tree, leaves)
        self._first = np.concatenate([[0], np.cumsum(self._dims)]).astype(np.int64)
        if invert_cliques(self._front, self._width, self._at, self._data) >= 0:
            raise ZeroDivisionError("the Bayes tree is singular")
        self.arrays = TreeArrays(self._home, self._key_ptr, self._keys, self._dims, self._front, self._width, self._at,
                                 np.empty_like(self._data))  # fmt: skip
        """What the compiled look-up of two keys' covariance needs."""
        self._across: dict[tuple[int, int], FloatArray] = {}
        """Blocks of keys in different cliques that were asked for together, by number."""
        covariance_rows(self.arrays, self._n_front, self._data)

    def _take(self, tree: PoseTree) -> None:
        pattern = tree.pattern
        self.number = {key: i for i, key in enumerate(tree.keys.tolist())}
        self._dims = np.full(len(tree.keys), 6)
        self._keys, self._key_ptr, self._n_front = pattern.keys, pattern.key_ptr, pattern.n_front
        self._front, self._width, self._at = pattern.front, pattern.width, pattern.at[:-1]
        self._parents, self._home, self._data = pattern.parents, pattern.home, tree.data.copy()

    def _flatten(self, tree: gtsam.GaussianBayesTree, leaves: Leaves | None) -> None:
        dims = self.dims
        blocks, clique_keys, fronts, parents = _collect(tree)
        front, width = ([b.shape[i] for b in blocks] for i in (0, 1))
        data = [b.ravel() for b in blocks]
        if leaves is not None:
            home: dict[int, int] = {}
            for c, keys in enumerate(clique_keys):  # parents first: a key is frontal where it first appears
                for k in keys:
                    home.setdefault(k, c)
            parents += [max(home[k] for k in keys[1:]) for keys in leaves.keys]
            fronts += leaves.front.tolist()
            front, width, data = front + leaves.front.tolist(), width + leaves.width.tolist(), [*data, leaves.data]
            clique_keys = clique_keys + leaves.keys
        order = list(dict.fromkeys(k for keys in clique_keys for k in keys))
        self.number = {key: i for i, key in enumerate(order)}
        self._dims = np.array([dims[k] for k in order], dtype=np.int64)
        self._keys = np.array([self.number[k] for keys in clique_keys for k in keys], dtype=np.int64)
        self._key_ptr = np.cumsum([0] + [len(keys) for keys in clique_keys]).astype(np.int64)
        self._front, self._width = np.array(front, dtype=np.int64), np.array(width, dtype=np.int64)
        self._at = np.cumsum(np.append(0, self._front * self._width))[:-1].astype(np.int64)
        self._data = np.concatenate(data) if data else np.zeros(0)
        self._parents = np.array(parents, dtype=np.int64)
        self._n_front = self._frontal_keys(fronts)
        self._home = np.zeros(len(order), dtype=np.int64)
        for c in range(len(front)):
            start = self._key_ptr[c]
            self._home[self._keys[start : start + self._n_front[c]]] = c

    def _frontal_keys(self, fronts: list[int]) -> IntArray:
        """Number of frontal keys of every clique, from the number of its frontal rows."""
        out = np.empty(len(fronts), dtype=np.int64)
        dims, ptr = self._dims[self._keys].tolist(), self._key_ptr.tolist()
        for c, rows in enumerate(fronts):
            n, total = 0, 0
            while total < rows:
                total += dims[ptr[c] + n]
                n += 1
            out[c] = n
        return out

    def _block(self, a: int, b: int) -> FloatArray | None:
        out = np.empty((self._dims[a], self._dims[b]))
        if fill_block(self.arrays, a, b, out):
            return out
        if (b, a) in self._across:
            return self._across[b, a].T
        return self._across.get((a, b))

    def bring_together(self, pairs: Iterable[tuple[int, int]]) -> None:
        """Find what :meth:`joint` of these pairs of keys takes, of those in different cliques, many columns at once."""
        apart: dict[int, list[int]] = {}
        for a, b in ((self.number[i], self.number[j]) for i, j in pairs):
            if self._block(a, b) is None:
                apart.setdefault(a, []).append(b)
        left = sorted(apart, key=lambda a: int(self._home[a]))  # neighbours in the tree side by side
        while left:
            n = max(1, int(np.searchsorted(np.cumsum(self._dims[left]), _COLUMNS, side="right")))
            some, left = left[:n], left[n:]
            others = [b for a in some for b in apart[a]]
            up, down = (self._ancestors(set(self._home[of].tolist())) for of in (some, some + others))
            first, rows = self._gathered(down)
            columns = np.concatenate([np.arange(first[a], first[a] + self._dims[a]) for a in some])
            x = np.zeros((rows, len(columns)))
            x[columns, np.arange(len(columns))] = 1.0
            solve_cliques(self.arrays, up, down, first, self._data, x)
            at = 0
            for a in some:
                own = slice(at, at := at + int(self._dims[a]))
                for b in apart[a]:
                    self._across[a, b] = x[first[b] : first[b] + self._dims[b], own].T.copy()

    def marginal(self, key: int) -> FloatArray:
        """Covariance (dim, dim) of one unknown."""
        return np.asarray(self.marginals(np.array([key]), int(self.dims[key]))[0])

    def marginals(self, keys: IntArray, dim: int) -> FloatArray:
        """Covariances (n, dim, dim) of unknowns of one dimension."""
        n, along = np.array([self.number[k] for k in keys.tolist()], dtype=np.int64), np.arange(dim)
        first, width = self._own[n], self._width[self._home[n]]
        cov: FloatArray = self.arrays.cov[first[:, None, None] + width[:, None, None] * along[:, None] + along]
        return cov

    @cached_property
    def _own(self) -> IntArray:
        """Where the covariance of every key begins, in the rows of its home."""
        tree = self.arrays
        clique, dims = np.repeat(np.arange(len(tree.front)), np.diff(tree.key_ptr)), tree.dims[tree.keys]
        before = np.cumsum(dims) - dims
        at_home = tree.home[tree.keys] == clique
        clique, key = clique[at_home], tree.keys[at_home]
        column = before[at_home] - before[tree.key_ptr[clique]]
        out = np.zeros(len(tree.dims), dtype=np.int64)
        out[key] = tree.at[clique] + column * (tree.width[clique] + 1)
        return out

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of any unknowns, stacked in this order; fast where they share a clique."""
        numbers = [self.number[k] for k in keys]
        deepest = numbers[int(np.argmax(self._home[numbers]))]
        c = int(self._home[deepest])
        inside = set(self._keys[self._key_ptr[c] : self._key_ptr[c + 1]].tolist())
        if not inside.issuperset(numbers) and not self._across:
            return self._apart(numbers)
        at = np.concatenate([[0], np.cumsum(self._dims[numbers])])
        out = np.empty((at[-1], at[-1]))
        for i, a in enumerate(numbers):
            for j, b in enumerate(numbers[: i + 1]):
                block = self._block(a, b)
                if block is None:
                    return self._apart(numbers)
                out[at[i] : at[i + 1], at[j] : at[j + 1]] = block
                out[at[j] : at[j + 1], at[i] : at[i + 1]] = block.T
        return out

    def _apart(self, numbers: list[int]) -> FloatArray:
        """Joint covariance of unknowns of different cliques: columns of the inverse, on their ways to the root only.

        Of the last one none: its own covariance is known, and the rest is in the columns of the others.
        """
        rows = [np.arange(self._first[k], self._first[k + 1]) for k in numbers]
        every, asked = np.concatenate(rows), np.concatenate(rows[:-1])
        home, n = self._home[numbers].tolist(), len(asked)
        up, down = self._ancestors(set(home[:-1])), self._ancestors(set(home))
        out = np.empty((len(every),) * 2)
        for i in range(0, n, _COLUMNS):
            some = asked[i : i + _COLUMNS]
            x = np.zeros((self.n, len(some)))
            x[some, np.arange(len(some))] = 1.0
            self._solve(up, down, x)
            out[:, i : i + len(some)] = x[every]
        out[:n, n:] = out[n:, :n].T
        out[n:, n:] = self._block(numbers[-1], numbers[-1])
        out += out.T.copy()
        out *= 0.5
        return out

    def _ancestors(self, cliques: set[int], top: int = -1) -> IntArray:
        """These and all above them, but for those from ``top`` on, which is on the way of all."""
        found: set[int] = set()
        for start in cliques:
            c = start
            while c > top and c not in found:
                found.add(c)
                c = int(self._parents[c])
        return np.array(sorted(found), dtype=np.int64)

    @cached_property
    def _key_of(self) -> IntArray:
        """Key of every row in a stacked vector of all unknowns."""
        return np.repeat(np.arange(len(self._dims)), self._dims)

    def _gathered(self, cliques: IntArray, top: int = -1) -> tuple[IntArray, int]:
        """Row (K,) at which a key begins where only the own ones of these cliques are kept, and how many these are.

        Those of ``top`` come after.
        """
        shift, front = np.zeros(len(self._front), dtype=np.int64), self._front[cliques]
        shift[cliques] = np.cumsum(front) - front - self._first[self._keys[self._key_ptr[cliques]]]
        first, n = self._first[:-1] + shift[self._home], int(front.sum())
        if top >= 0:
            keys = self._keys[self._key_ptr[top] : self._key_ptr[top + 1]]
            first[keys] = n + np.cumsum(self._dims[keys]) - self._dims[keys]
        return first, n

    def _solve(self, up: IntArray, down: IntArray, x: FloatArray) -> None:
        solve_cliques(self.arrays, up, down, self._first, self._data, x)

    def rows(self, keys: Sequence[int]) -> IntArray:
        """Rows of these keys in a stacked vector of all unknowns, as :meth:`times` takes it."""
        return np.concatenate([np.arange(self._first[k], self._first[k + 1]) for k in (self.number[q] for q in keys)])

    def places(self) -> dict[int, slice]:
        """Rows of every key in a stacked vector of all unknowns."""
        first = self._first.tolist()
        return {key: slice(first[i], first[i + 1]) for key, i in self.number.items()}

    @property
    def n(self) -> int:
        """Length of a stacked vector of all unknowns."""
        return int(self._first[-1])

    def columns_for(self, eliminations: float) -> float:
        """How many columns go up the deepest way at the price of so many eliminations of the whole."""
        own, way = (self._front * self._width).tolist(), list[int]()
        for numbers, parent in zip(own, self._parents.tolist(), strict=True):  # parents first
            way.append(numbers + (way[parent] if parent >= 0 else 0))
        return eliminations * float(self._front @ self._width.astype(float) ** 2) / max(way, default=1)

    def times(self, columns: FloatArray) -> FloatArray:
        """The whole covariance matrix times columns (n, m), without forming it."""
        x = np.array(columns, dtype=float, order="C")
        every = np.arange(len(self._front), dtype=np.int64)
        self._solve(every, every, x)
        return x

    def among(self, A: sparse.csr_array) -> FloatArray:
        """A Q A' (m, m) of the rows of A (m, n), without forming Q.

        U'U with R'U = A', on the ways to the first clique that holds all that is left of A', and this with the joint
        covariance of its keys; to the roots where there is none.
        """
        home, m = self._home[self._key_of], A.shape[0]
        top = self._common(np.unique(self._key_of[A.indices]))
        of_row = np.maximum.reduceat(np.append(home[A.indices], 0), A.indptr[:-1]) if m else np.zeros(0)
        order = np.argsort(of_row, kind="stable")  # neighbours in the tree side by side
        A, out = A[order], np.zeros((m, m))
        Q = np.zeros((0, 0)) if top < 0 else clique_covariance(self.arrays, self._n_front, top)
        none, done = np.zeros(0, dtype=np.int64), list[tuple[IntArray, FloatArray, FloatArray]]()
        for i in range(0, m, _COLUMNS):
            mine = A[i : i + _COLUMNS]
            up = self._ancestors(set(home[mine.indices].tolist()), top)
            first, n = self._gathered(up, top)
            entries = mine.data, (first - self._first[:-1])[self._key_of[mine.indices]] + mine.indices, mine.indptr
            x = np.ascontiguousarray(sparse.csr_array(entries, (mine.shape[0], n + len(Q))).toarray().T)
            solve_cliques(self.arrays, up, none, first, self._data, x)
            U, left = x[:n], x[n:]
            out[i : i + _COLUMNS, i : i + _COLUMNS] = U.T @ U + left.T @ (Q @ left)
            if m <= _COLUMNS:
                break
            way = np.zeros(len(self._front), dtype=np.bool_)
            way[up] = True
            rows = np.flatnonzero(way[home])
            for k, (before, V, held) in enumerate(done):
                _, here, there = np.intersect1d(rows, before, assume_unique=True, return_indices=True)
                out[i : i + _COLUMNS, k * _COLUMNS : (k + 1) * _COLUMNS] = U[here].T @ V[there] + left.T @ held
            done.append((rows, U, Q @ left))
        back = np.argsort(order)
        return np.asarray((np.tril(out) + np.tril(out, -1).T)[np.ix_(back, back)])

    def _common(self, keys: IntArray) -> int:
        """The first clique, from the leaves up, that has all these keys, or those left of the cliques below; or -1."""
        left: list[int] = sorted(set(self._home[keys].tolist()))
        met, wanted = set[int](), set(keys.tolist())
        while left:
            c = left.pop()  # parents have lower numbers
            inside = self._keys[self._key_ptr[c] : self._key_ptr[c + 1]].tolist()
            if met.isdisjoint(left) and wanted.issubset(inside):
                return c
            wanted.difference_update(inside[: self._n_front[c]])
            parent = int(self._parents[c])
            if parent < 0:
                return -1
            met.add(parent)
            at = bisect_left(left, parent)
            if at == len(left) or left[at] != parent:
                left.insert(at, parent)
        return -1

    def given_separators(self, columns: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What does not follow from the separator of its clique, as all between it and the cliques that are not below.

        Of columns (n, k) that part, and of every unknown the variance (n,) that is left: inf where a clique has others
        of its own, with which it may share anything.
        """
        left, own = np.array(columns), np.full(self.n, np.inf)
        rows = self._first[self._keys] - np.cumsum(self._dims[self._keys]) + self._dims[self._keys]
        ends = np.cumsum(self._width)
        rows = np.repeat(rows, self._dims[self._keys]) + np.arange(ends[-1] if len(ends) else 0)
        for c, (nf, n, at, end) in enumerate(zip(*(x.tolist() for x in (self._front, self._width, self._at, ends)),
                                                 strict=True)):  # fmt: skip
            A, mine = self._data[at : at + nf * n].reshape(nf, n), rows[end - n : end]
            left[mine[:nf]] -= A[:, nf:] @ columns[mine[nf:]]
            if self._n_front[c] == 1:
                own[mine[:nf]] = (np.triu(A[:, :nf]) ** 2).sum(axis=1)
        return left, own

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


def _collect(tree: gtsam.GaussianBayesTree) -> tuple[list[FloatArray], list[list[int]], list[int], list[int]]:
    """Blocks [R S] (nf, n), keys, frontal rows and parent of every clique, parents first."""
    blocks: list[FloatArray] = []
    keys: list[list[int]] = []
    parents: list[int] = []
    stack: list[tuple[gtsam.GaussianBayesTreeClique, int]] = [(root, -1) for root in tree.roots()]
    while stack:
        clique, parent = stack.pop()
        conditional = clique.conditional()
        A = conditional.getA()
        model = conditional.get_model()
        if model is not None:
            A = A / model.sigmas()[:, None]
        me = len(blocks)
        blocks.append(np.ascontiguousarray(A))
        keys.append(list(conditional.keys()))
        parents.append(parent)
        stack += [(clique[j], me) for j in range(clique.nrChildren())]
    return blocks, keys, [len(b) for b in blocks], parents
