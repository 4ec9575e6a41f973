"""Sparse factors of the normal equations of poses that pairs join, clique by clique; see ``elimination.h``.

By Cholesky, supernodal: what is eliminated in a clique is subtracted directly from those above it. Or by reflections of
the rows of the pairs, multifrontal (``reflections.h``): more work, and digits where Cholesky has none left. The
symbolic part is that of Davis (2005, algorithm 849).
"""

from functools import cached_property

import numpy as np

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.library import Function

_CLIQUES = "home[N] key_ptr[C+1] keys[*] n_front[C] at[C] data[*]"
_elimination_tree = Function("elimination_tree", "ptr[N+1] neighbour[*] parent[N] count[N] mark[N]")
_gather_cliques = Function("gather_cliques", "parent[N] count[N] clique[N] above[N] first[N]")
_clique_nodes = Function(
    "clique_nodes", "ptr[N+1] neighbour[*] clique[N] above[C] key_ptr[C+1] n_front[C] keys[*] child[C] next[C] mark[N]"
)
_elimination_room = Function("elimination_room", "key_ptr[C+1] n_front[C]")
_eliminate = Function(
    "eliminate",
    f"{_CLIQUES} rank[N] first[E] second[E] by_first[E,6,6] by_second[E,6,6] own[N,6,6] work[*] where[N] diagonal[D]",
)
_eliminate_rows = Function(
    "eliminate_rows",
    f"{_CLIQUES} parents[C] order[C] pair_ptr[C+1] pairs[*] first[E] second[E] by_first[E,6,6] by_second[E,6,6] "
    "own[N,6,6] rest[*] work[*] row[2,*] where[N] pending[C] diagonal[D]",
)
_pair_gradient = Function(
    "pair_gradient", "first[E] second[E] white[E,6] by_first[E,6,6] by_second[E,6,6] g[N,6]"
)  # fmt: skip
_solve_poses = Function("solve_poses", f"{_CLIQUES} x[N,6] room[*]")


@frozen(eq=False)
class CliquePattern:
    """Cliques of a Bayes tree of N poses, parents first; poses are numbered by the clique in which they are eliminated.

    order: (N,) which of the poses given each number is, which is also its rank. home: (N,) clique of each pose.
    keys[key_ptr[c]:key_ptr[c + 1]]: poses of clique c, the first n_front[c] eliminated there. parents: (C,), -1: none.
    """

    order: IntArray
    home: IntArray
    key_ptr: IntArray
    keys: IntArray
    n_front: IntArray
    parents: IntArray

    @property
    def front(self) -> IntArray:
        """Rows (C,) of every clique."""
        return 6 * self.n_front

    @property
    def width(self) -> IntArray:
        """Columns (C,) of every clique."""
        return 6 * np.diff(self.key_ptr)

    @property
    def at(self) -> IntArray:
        """Where the numbers of every clique begin (C + 1,)."""
        return np.concatenate([[0], np.cumsum(self.front * self.width)])

    @cached_property
    def leaves_first(self) -> IntArray:
        """Cliques (C,), each after all that are below it, which stand side by side."""
        parents, size, last = self.parents.tolist(), [1] * len(self.parents), list[int]()
        for c in range(len(parents) - 1, -1, -1):
            if parents[c] >= 0:
                size[parents[c]] += size[c]
        free = [len(parents)]  # of everything, then of every clique: above the next one below it
        for parent, n in zip(parents, size, strict=True):
            last.append(free[parent + 1] - 1)
            free[parent + 1] -= n
            free.append(last[-1])
        return np.argsort(np.array(last, dtype=np.int64))

    @property
    def work(self) -> float:
        """Multiplications that a factor takes, and a multiple of those of its covariances."""
        return float(self.front @ self.width.astype(float) ** 2)


def clique_pattern(n: int, a: IntArray, b: IntArray) -> CliquePattern:
    """The cliques of ``n`` poses, given in the order of elimination, that pairs with ends a, b (E,) join."""
    ends, others = np.concatenate([a, b]), np.concatenate([b, a])
    neighbour = others[np.argsort(ends, kind="stable")]
    ptr = np.concatenate([[0], np.cumsum(np.bincount(ends, minlength=n))])
    parent, count, mark, clique, above, first = np.empty((6, n), dtype=np.int64)
    _elimination_tree(ptr, neighbour, parent, count, mark)
    n_cliques = _gather_cliques(parent, count, clique, above, first)
    above, first = above[:n_cliques].copy(), first[:n_cliques]
    n_front = np.bincount(clique, minlength=n_cliques)
    size = count[first] + 1
    key_ptr = np.concatenate([[0], np.cumsum(size)])
    keys, (child, after) = np.empty(key_ptr[-1], dtype=np.int64), np.empty((2, n_cliques), dtype=np.int64)
    _clique_nodes(ptr, neighbour, clique, above, key_ptr, n_front, keys, child, after, mark)
    order = keys[np.arange(len(keys)) - np.repeat(key_ptr[:-1], size) < np.repeat(n_front, size)]
    number = np.empty(n, dtype=np.int64)
    number[order] = np.arange(n)
    return CliquePattern(order, clique[order], key_ptr, number[keys], n_front, above)


@frozen(eq=False)
class PoseTree:
    """A Bayes tree of poses: its cliques, GTSAM's variable of every number (N,), and [R S] of all cliques."""

    pattern: CliquePattern
    keys: IntArray
    data: FloatArray


class PoseFactor:
    """[R S] of all cliques of a pattern, of the normal equations eliminated last."""

    def __init__(self, pattern: CliquePattern) -> None:
        self.pattern, at = pattern, pattern.at
        self.data = np.empty(at[-1])
        self._cliques = pattern.home, pattern.key_ptr, pattern.keys, pattern.n_front, at[:-1], self.data
        self._work = np.empty(_elimination_room(pattern.key_ptr, pattern.n_front))
        self._room = np.empty(int(pattern.width.max(initial=0)))

    def eliminate(
        self, first: IntArray, second: IntArray, by_first: FloatArray, by_second: FloatArray, own: FloatArray
    ) -> int:
        """Factor the normal matrix of pairs and of single poses; the first pose without a pivot, or -1.

        first, second: (E,) poses of each pair, -1 for a constant; by_first, by_second: (E, 6, 6) their whitened
        derivatives; own: (N, 6, 6) what is known of single poses.
        """
        n = len(own)
        return _eliminate(*self._cliques, self.pattern.order, first, second, by_first, by_second, own, self._work,
                          np.empty(n, dtype=np.int64), np.empty(6 * n))  # fmt: skip

    def eliminate_rows(
        self, first: IntArray, second: IntArray, by_first: FloatArray, by_second: FloatArray, own: FloatArray
    ) -> int:
        """The same by reflections; only a pose that nothing tells of is without a pivot."""
        p, n, C = self.pattern, len(own), len(self.pattern.parents)
        home = np.append(p.home, -1)
        clique = np.maximum(home[first], home[second])
        pairs = np.argsort(clique, kind="stable")
        pair_ptr = np.searchsorted(clique[pairs], np.arange(C + 1))
        left = p.width - p.front
        m, room = p.front + 6 * np.diff(pair_ptr), left**2
        below = np.flatnonzero(p.parents >= 0)
        np.add.at(m, p.parents[below], left[below])
        np.subtract.at(room, p.parents[below], left[below] ** 2)
        rest = np.zeros(int(np.cumsum(room[p.leaves_first]).max(initial=0)))
        work = np.empty(int(((m + 1) * p.width).max(initial=0)))
        rows = np.empty((2, int(m.max(initial=0))), dtype=np.int64)
        return _eliminate_rows(*self._cliques, p.parents, p.leaves_first, pair_ptr, pairs, first, second, by_first,
                               by_second, own, rest, work, rows, np.empty(n, dtype=np.int64),
                               np.empty(C, dtype=np.int64), np.empty(6 * n))  # fmt: skip

    def solve(self, x: FloatArray) -> None:
        """From the right hand side (N, 6) to the solution, in place."""
        _solve_poses(*self._cliques, x, self._room)


def pair_gradient(
    first: IntArray, second: IntArray, white: FloatArray, by_first: FloatArray, by_second: FloatArray, g: FloatArray
) -> None:
    """Add the right hand side -A'e of pairs, as in :meth:`PoseFactor.eliminate`, with residuals ``white`` (E, 6)."""
    _pair_gradient(first, second, white, by_first, by_second, g)
