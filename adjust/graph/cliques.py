"""A Bayes tree as arrays: its cliques one after the other, parents first, and the ways through them."""

from collections.abc import Mapping
from functools import cached_property

import gtsam
import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.elimination import PoseTree
from adjust.native.trees import TreeArrays, invert_cliques, solve_cliques
from adjust.observations.images.reduction import Leaves


@frozen(eq=False)
class Cliques:
    """C cliques of K keys, which are numbered where they first appear: in the clique that has them as frontal ones.

    number: of every key. dims: (K,) its dimension. home: (K,) its clique. keys[key_ptr[c]:key_ptr[c + 1]]: of clique c,
    the first n_front[c] frontal. front, width: (C,) rows and columns of its [R^-1, -R^-1 S] of [R S], which begins at
    at[c] in ``data``. parents: (C,), -1: none.
    """

    number: Mapping[int, int]
    dims: IntArray
    home: IntArray
    key_ptr: IntArray
    keys: IntArray
    n_front: IntArray
    front: IntArray
    width: IntArray
    at: IntArray
    parents: IntArray
    data: FloatArray

    @staticmethod
    def of(
        tree: gtsam.GaussianBayesTree | PoseTree, dims: Mapping[int, int], leaves: Leaves | None = None
    ) -> "Cliques":
        """Of a tree, with the cliques that were reduced before it below it. Raises ZeroDivisionError: singular."""
        c = Cliques._of_poses(tree) if isinstance(tree, PoseTree) else Cliques._of_tree(tree, dims, leaves)
        if invert_cliques(c.front, c.width, c.at, c.data) >= 0:
            raise ZeroDivisionError("the Bayes tree is singular")
        return c

    @staticmethod
    def _of_poses(tree: PoseTree) -> "Cliques":
        p, number = tree.pattern, {key: i for i, key in enumerate(tree.keys.tolist())}
        return Cliques(number, np.full(len(number), 6), p.home, p.key_ptr, p.keys, p.n_front, p.front, p.width,
                       p.at[:-1], p.parents, tree.data.copy())  # fmt: skip

    @staticmethod
    def _of_tree(tree: gtsam.GaussianBayesTree, dims: Mapping[int, int], leaves: Leaves | None) -> "Cliques":
        blocks, clique_keys, parents = _collected(tree)
        rows, columns = (np.array([b.shape[i] for b in blocks], dtype=np.int64) for i in (0, 1))
        sizes, data = np.array([len(keys) for keys in clique_keys], dtype=np.int64), [b.ravel() for b in blocks]
        names = [k for keys in clique_keys for k in keys]
        if leaves is not None:
            names, data = names + leaves.keys.tolist(), [*data, leaves.data]
            sizes, columns = np.append(sizes, np.diff(leaves.key_ptr)), np.append(columns, leaves.width)
            rows = np.append(rows, np.full(len(leaves.width), 6))
        number = {k: i for i, k in enumerate(dict.fromkeys(names))}  # parents first: frontal where it first appears
        of_key = np.array([dims[k] for k in number], dtype=np.int64)
        keys, clique = np.array([number[k] for k in names], dtype=np.int64), np.repeat(np.arange(len(rows)), sizes)
        key_ptr = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
        ends = np.concatenate([[0], np.cumsum(of_key[keys])])
        frontal = ends[1:] - ends[key_ptr[clique]] <= rows[clique]
        home = np.zeros(len(number), dtype=np.int64)
        home[keys[frontal]] = clique[frontal]
        n_front = np.bincount(clique[frontal], minlength=len(rows))
        deepest = np.full(len(rows), -1, dtype=np.int64)
        np.maximum.at(deepest, clique[~frontal], home[keys[~frontal]])
        every_parent = np.append(np.array(parents, dtype=np.int64), deepest[len(parents) :])
        at = np.cumsum(np.append(0, rows * columns))[:-1].astype(np.int64)
        numbers = np.concatenate(data) if data else np.zeros(0)
        return Cliques(number, of_key, home, key_ptr, keys, n_front, rows, columns, at, every_parent, numbers)

    def __len__(self) -> int:
        return len(self.front)

    def arrays(self, cov: FloatArray) -> TreeArrays:
        """The same for the compiled look-up of covariances, which stand in ``cov``, as long as ``data``."""
        return TreeArrays(self.home, self.key_ptr, self.keys, self.dims, self.front, self.width, self.at, cov)

    def multiply(self, x: FloatArray) -> None:
        """Multiply the whole covariance matrix by columns (n, m), in place, without forming it."""
        every = np.arange(len(self), dtype=np.int64)
        begun = set(self.home[self.key_of[x.any(axis=1)]].tolist())
        up = every if 2 * len(begun) > len(self) else self.ancestors(begun)
        solve_cliques(self.arrays(self.data), up, every, self.first, self.data, x)

    def keys_in(self, c: int) -> IntArray:
        """Of one clique, the frontal ones first."""
        return self.keys[self.key_ptr[c] : self.key_ptr[c + 1]]

    @cached_property
    def first(self) -> IntArray:
        """Where every key begins in a stacked vector of all unknowns, and its length (K + 1,)."""
        return np.concatenate([[0], np.cumsum(self.dims)]).astype(np.int64)

    @cached_property
    def key_of(self) -> IntArray:
        """Key of every row in a stacked vector of all unknowns."""
        return np.repeat(np.arange(len(self.dims)), self.dims)

    def rows_of(self, keys: IntArray, first: IntArray | None = None) -> IntArray:
        """Rows of keys in a stacked vector of all unknowns, or in one where they begin elsewhere, at first (K,)."""
        dims = self.dims[keys]
        start = np.repeat((self.first if first is None else first)[keys], dims)
        return np.asarray(start + np.arange(len(start)) - np.repeat(np.cumsum(dims) - dims, dims))

    @cached_property
    def own(self) -> IntArray:
        """Where the covariance of every key begins (K,), in the rows of its home."""
        clique, dims = np.repeat(np.arange(len(self)), np.diff(self.key_ptr)), self.dims[self.keys]
        before = np.cumsum(dims) - dims
        at_home = self.home[self.keys] == clique
        clique, key = clique[at_home], self.keys[at_home]
        column = before[at_home] - before[self.key_ptr[clique]]
        out = np.zeros(len(self.dims), dtype=np.int64)
        out[key] = self.at[clique] + column * (self.width[clique] + 1)
        return out

    def ancestors(self, cliques: set[int]) -> IntArray:
        """These and all above them."""
        found: set[int] = set()
        for start in cliques:
            c = start
            while c >= 0 and c not in found:
                found.add(c)
                c = int(self.parents[c])
        return np.array(sorted(found), dtype=np.int64)

    def gathered(self, cliques: IntArray) -> tuple[IntArray, int]:
        """Row (K,) at which a key begins where only the own ones of these cliques are kept, and how many these are."""
        shift, front = np.zeros(len(self), dtype=np.int64), self.front[cliques]
        shift[cliques] = np.cumsum(front) - front - self.first[self.keys[self.key_ptr[cliques]]]
        return self.first[:-1] + shift[self.home], int(front.sum())

    def columns_for(self, eliminations: float) -> float:
        """How many columns go up the deepest way at the price of so many eliminations of the whole."""
        own, way = (self.front * self.width).tolist(), list[int]()
        for numbers, parent in zip(own, self.parents.tolist(), strict=True):  # parents first
            way.append(numbers + (way[parent] if parent >= 0 else 0))
        return eliminations * float(self.front @ self.width.astype(float) ** 2) / max(way, default=1)


@frozen(eq=False)
class SolvedTree:
    """What a system was eliminated to; ``dims`` of every key, and the poses that were reduced before."""

    tree: gtsam.GaussianBayesTree | PoseTree
    dims: Mapping[int, int]
    leaves: Leaves | None = None

    @cached_property
    def cliques(self) -> Cliques:
        """The same as arrays. Raises ZeroDivisionError where it is singular."""
        return Cliques.of(self.tree, self.dims, self.leaves)


def _collected(tree: gtsam.GaussianBayesTree) -> tuple[list[FloatArray], list[list[int]], list[int]]:
    """Blocks [R S] (nf, n), keys and parent of every clique, parents first."""
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
    return blocks, keys, parents
