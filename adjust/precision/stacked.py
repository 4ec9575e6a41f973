"""The covariance matrix of all unknowns as a factor: of those of the tree, and of what bundles hide."""

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import sparse

from adjust.frames.unknowns import Unknowns
from adjust.model.survey import FloatArray, IntArray
from adjust.observations.images.bundle_hidden import BundleHidden
from adjust.precision.s_transformation import STransformation
from adjust.precision.tree import Half, TreeCovariance, squares, squares_of_sums, unit_rows

AT_ONCE = 64
"""Columns that the matrix is multiplied by in one go."""
_PAIRS = 64
"""Pairs of unknowns of which some are hidden that are brought together in one go."""


class Stacked:
    """Products with the covariance, a priori; vectors (n,) stack the tree's unknowns, then what each bundle hides."""

    def __init__(self, tree: TreeCovariance, hidden: Sequence[BundleHidden], unknowns: Unknowns) -> None:
        self.tree, self.hidden, self.unknowns = tree, tuple(hidden), unknowns
        self.n = tree.n + sum(below.n for below in hidden)
        self._datum: tuple[FloatArray, FloatArray] | None = None

    def move_to(self, datum: STransformation, rows: Mapping[int, FloatArray]) -> None:
        """Let the survey's datum be this one, of these rows (d, dim per key)."""
        self._datum_rows = np.zeros((len(datum.core), self.n))
        for key, row in rows.items():
            self._datum_rows[:, self.places[key]] = row
        both = [np.concatenate([of[key] for key in self.places]) for of in (datum.motions, datum.spread)]
        self._datum = np.concatenate(both, axis=1), datum.core

    @cached_property
    def places(self) -> dict[int, slice]:
        """Rows of every key."""
        keys = [key for below in self.hidden for key in below.keys]
        ends = self.tree.n + np.cumsum([0, *(self.unknowns.by_key[key].dim for key in keys)])
        return self.tree.places() | {k: slice(a, b) for k, (a, b) in zip(keys, pairwise(ends.tolist()), strict=True)}

    def rows(self, key: int) -> IntArray:
        """The same (dim,)."""
        return np.arange(self.places[key].start, self.places[key].stop)

    @cached_property
    def _parts(self) -> list[tuple[BundleHidden, slice, IntArray]]:
        """What every bundle hides, its rows, and the rows of its interface."""
        ends = np.cumsum([self.tree.n, *(below.n for below in self.hidden)]).tolist()
        return [(below, slice(a, b), self.tree.rows(below.batch.interface))
                for below, (a, b) in zip(self.hidden, pairwise(ends), strict=True)]  # fmt: skip

    def times(self, right: FloatArray) -> FloatArray:
        """Covariance, as solved, times columns (n, k)."""
        out = np.array(right, order="C")
        tree = out[: self.tree.n]
        some = [np.flatnonzero(out[mine].any(axis=0)) for _, mine, _ in self._parts]
        on_poses = [below.on_poses(out[mine, at]) for (below, mine, _), at in zip(self._parts, some, strict=True)]
        for (below, _, interface), at, u in zip(self._parts, some, on_poses, strict=True):
            tree[np.ix_(interface, at)] += below.on_interface(u)
        self.tree.multiply(tree)
        for (below, mine, interface), at, u in zip(self._parts, some, on_poses, strict=True):
            below.multiply(out[mine], tree[interface], at, u)
        return out

    def times_in_datum(self, right: FloatArray) -> FloatArray:
        """The same of the covariance in the survey's datum: S Q S' times columns."""
        out = self.times(right)
        if self._datum is not None:
            both, core = self._datum
            by_motions, by_spread = np.split(both.T @ right, 2)
            out += both @ np.concatenate([core @ by_motions - by_spread, -by_motions])
        return out

    def joint(self, keys: Sequence[int]) -> FloatArray:
        """Joint covariance of any unknowns, as solved, stacked in this order."""
        rows = np.concatenate([self.rows(k) for k in keys])
        return self.among(unit_rows(rows, self.n))

    def each_joint(self, pairs: Sequence[tuple[int, int]]) -> list[FloatArray]:
        """The same of many pairs of unknowns."""
        hidden = {key for below in self.hidden for key in below.keys}
        apart = [pair for pair in pairs if not hidden.isdisjoint(pair)]
        in_tree = [pair for pair in pairs if hidden.isdisjoint(pair)] if apart else pairs
        ends = np.array([(p.start, p.stop) for pair in in_tree for p in map(self.places.__getitem__, pair)],
                        dtype=np.int64).reshape(-1, 2)  # fmt: skip
        sizes = np.diff(ends).ravel()
        rows = np.arange(sizes.sum()) + np.repeat(ends[:, 1] - np.cumsum(sizes), sizes)
        ptr = np.append(0, np.cumsum(sizes)[1::2])
        found = iter(self.tree.each_among(unit_rows(rows, self.tree.n), ptr))
        below = (Q for i in range(0, len(apart), _PAIRS) for Q in self._among_some(apart[i : i + _PAIRS]))
        return [next(found if hidden.isdisjoint(pair) else below) for pair in pairs]

    def _among_some(self, pairs: Sequence[tuple[int, int]]) -> list[FloatArray]:
        """The same from the joint covariance of all that are in them."""
        keys = list(dict.fromkeys(key for pair in pairs for key in pair))
        ends = np.cumsum([0, *(self.unknowns.by_key[key].dim for key in keys)])
        at = {key: np.arange(*ends[i : i + 2]) for i, key in enumerate(keys)}
        Q, rows = self.joint(keys), [np.concatenate([at[a], at[b]]) for a, b in pairs]
        return [Q[np.ix_(mine, mine)] for mine in rows]

    def by_key(
        self, rows: Mapping[int, FloatArray], times: Callable[[FloatArray], FloatArray]
    ) -> dict[int, FloatArray]:
        """The transpose of ``rows`` (k, dim per key) through :meth:`times` or another: (dim, k) for every unknown."""
        right = np.zeros((self.n, len(next(iter(rows.values())))))
        for key, row in rows.items():
            right[self.places[key]] = row.T
        found = times(right)
        return {key: found[place] for key, place in self.places.items()}

    def among(self, A: sparse.csr_array) -> FloatArray:
        """A Q A' (m, m) of rows A (m, n): in any datum, where they are of observations."""
        return squares(self._half, A) if self.hidden else self.tree.among(A)

    def among_sums(self, A: sparse.csr_array, q: int) -> FloatArray:
        """The same (J, q, q) of the sums of the J sets of q rows from each on."""
        return squares_of_sums(self._half, A, self.n, q)

    def _half(self, A: sparse.csr_array) -> Half:
        """Of some rows."""
        if not self.hidden:
            return self.tree.half(A)
        by_column, rows, parts = A.tocsc(), list[IntArray](), list[FloatArray]()
        in_tree = by_column[:, : self.tree.n].tocsr()
        for below, mine, interface in self._parts:
            if by_column.indptr[mine.start] == by_column.indptr[mine.stop]:
                continue
            at, U, over = below.half(by_column[:, mine].T.toarray())
            some = np.flatnonzero(over.any(axis=1))
            places = np.repeat(some, len(interface)), np.tile(interface, len(some))
            in_tree = in_tree + sparse.csr_array((over[some].ravel(), places), in_tree.shape)
            parts.append(U)
            rows.append(mine.start + at)
        at, U = self.tree.half(in_tree)
        return np.concatenate([at, *rows]), np.concatenate([U, *parts])

    def drawn(self, k: int) -> FloatArray:
        """Errors (n, k) of k solutions, drawn with the covariance in the survey's datum; always the same."""
        w = np.random.default_rng(0).standard_normal((self.n, k))
        tree = self.tree.drawn(w[: self.tree.n])
        hidden = (below.drawn(tree[interface], w[mine]) for below, mine, interface in self._parts)
        out = np.concatenate([tree, *hidden])
        if self._datum is not None:
            R = self._datum_rows
            G = self._datum[0][:, : len(R)]
            out -= G @ np.linalg.solve(R @ G, R @ out)
        return out
