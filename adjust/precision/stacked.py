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
from adjust.precision.tree import TreeCovariance

AT_ONCE = 64
"""Columns that the matrix is multiplied by in one go."""
_SAME = 1e-6
"""Share of the longest motion below which one is told from another."""


class Stacked:
    """Products with the covariance, a priori; vectors (n,) stack the tree's unknowns, then what each bundle hides."""

    def __init__(self, tree: TreeCovariance, hidden: Sequence[BundleHidden], unknowns: Unknowns) -> None:
        self.tree, self.hidden, self.unknowns = tree, tuple(hidden), unknowns
        self.n = tree.n + sum(below.n for below in hidden)
        self._datum: tuple[FloatArray, FloatArray, FloatArray] | None = None

    def move_to(self, datum: STransformation) -> None:
        """Let the survey's datum be this one."""
        G, W = (np.concatenate([of[key] for key in self.places]) for of in (datum.motions, datum.spread))
        self._datum = G, W, datum.core

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
        tree = np.array(right[: self.tree.n])
        on_poses = [below.on_poses(right[mine]) if right[mine].any() else None for below, mine, _ in self._parts]
        for (below, _, interface), some in zip(self._parts, on_poses, strict=True):
            if some is not None:
                tree[interface] += below.on_interface(some)
        found = self.tree.times(tree)
        hidden = (below.products(found[interface], right[mine], some)
                  for (below, mine, interface), some in zip(self._parts, on_poses, strict=True))  # fmt: skip
        return np.concatenate([found, *hidden])

    def times_in_datum(self, right: FloatArray) -> FloatArray:
        """The same of the covariance in the survey's datum: S Q S' times columns."""
        out = self.times(right)
        if self._datum is not None:
            G, W, core = self._datum
            moved = G.T @ right
            out += G @ (core @ moved - W.T @ right)
            out -= W @ moved
        return out

    def columns(self, columns: IntArray) -> FloatArray:
        """Some columns (n, k), as solved."""
        out = np.empty((self.n, len(columns)))
        for i in range(0, len(columns), AT_ONCE):
            some = columns[i : i + AT_ONCE]
            right = np.zeros((self.n, len(some)))
            right[some, np.arange(len(some))] = 1.0
            out[:, i : i + AT_ONCE] = self.times(right)
        return out

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
        out, in_tree = np.zeros((A.shape[0],) * 2), A[:, : self.tree.n]
        for below, mine, interface in self._parts:
            hidden = A[:, mine]
            rows = np.flatnonzero(np.diff(hidden.indptr))
            if len(rows):
                own, over = below.among(hidden[rows].toarray())
                out[np.ix_(rows, rows)] += own
                places = np.repeat(rows, len(interface)), np.tile(interface, len(rows))
                in_tree = in_tree + sparse.csr_array((over.ravel(), places), in_tree.shape)
        return out + self.tree.among(in_tree)

    def most_correlated(self, sigmas: FloatArray) -> FloatArray:
        """Bounds (n,): components of two unknowns correlate no more than the larger of theirs, in the survey's datum.

        An unknown is ``T s + e``, s what stands between it and all that is eliminated later, e its own: with that it
        correlates no more than ``T s`` may make it. sigmas: (n,) in the survey's datum. inf where nothing is known.
        """
        none = np.zeros((self.n, 0))
        G, W = (none, none) if self._datum is None else self._datum[:2]
        d, columns = G.shape[1], np.hstack([G, W])
        left, own = self.tree.given_separators(columns[: self.tree.n])
        hidden = [below.given_interface(columns[mine], columns[at]) for below, mine, at in self._parts]
        left, own = (np.concatenate(x) for x in zip((left, own), *hidden, strict=True))
        scale = np.where(sigmas > 0.0, sigmas, np.inf)[:, None]
        # the datum moves all, and what is left of its motions is nothing but where it was chosen; e moves the datum
        moved = (np.abs(left[:, :d]) > _SAME * np.abs(G).max(axis=0)).any(axis=1)
        most = np.abs(left[:, d:] / scale) @ np.abs(G / scale).max(axis=0)
        through = sigmas**2 - own + 2.0 * np.einsum("ij,ij->i", G, left[:, d:])
        bound = np.sqrt(np.maximum(through, 0.0)) / scale[:, 0] + most
        return np.where(moved | np.isinf(own), np.inf, bound)
