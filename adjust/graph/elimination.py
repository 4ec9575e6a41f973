"""In which order, and how, a linear system is eliminated: by Cholesky, or by QR where that resolves what it refuses."""

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, TypeVar

import gtsam
import numpy as np
from scipy import sparse

from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.native.elimination import CliquePattern, clique_pattern

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU

_Found = TypeVar("_Found")
EXACT = 1e-6
"""Share of its variance that the weakest motion may lose before rows are eliminated instead of their squares."""
_LARGE = 2000
"""Poses of networks from which their order is looked for in a second way: smaller ones take no time in either."""


@frozen(eq=False)
class Elimination:
    """An order of elimination and its method."""

    ordering: gtsam.Ordering
    use_qr: bool = False

    def of(self, run: Callable[..., _Found]) -> _Found | None:
        """What an algorithm of GTSAM's finds in this way; None where it takes the system for indeterminate."""
        try:
            return run(*((self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)))
        except RuntimeError as error:  # GTSAM's exception for it has no type of its own in Python
            if "ndetermin" not in str(error):
                raise
            return None

    def solution(self, linear: gtsam.GaussianFactorGraph) -> tuple[gtsam.VectorValues, float] | None:
        """The solution and by how much it lowers chi-square; None where this method finds the system indeterminate."""
        delta = self.of(linear.optimize)
        return None if delta is None else (delta, -float(delta.dot(linear.gradientAtZero())))

    def tree(self, linear: gtsam.GaussianFactorGraph) -> tuple[gtsam.GaussianBayesTree, gtsam.VectorValues] | None:
        """The Bayes tree and its solution; None as above."""
        try:
            how = (self.ordering, gtsam.EliminateQR) if self.use_qr else (self.ordering,)
            tree = linear.eliminateMultifrontal(*how)
            return tree, tree.optimize()
        except RuntimeError:
            return None


def force_on(diagonal: FloatArray) -> FloatArray:
    """On every unknown, by the diagonal of the normal matrix: as much as one sigma of it alone, either way."""
    return np.asarray(np.sqrt(diagonal) * np.random.default_rng(0).choice([-1.0, 1.0], diagonal.shape))


def lost(force: FloatArray, x: FloatArray, square: float) -> float:
    """Of a force, the x by which it moves the unknowns, and the square sum of the whitened rows along x."""
    work = float(np.sum(force * x))
    return abs(square - work) / work if work > 0.0 else np.inf


def positive_definite_lu(N: sparse.csc_array) -> "SuperLU":
    """The factor of a sparse matrix (n, n), positive definite: pivots stay on the diagonal, whatever their size."""
    from scipy.sparse.linalg import splu  # here: small surveys start without it

    return splu(N, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def pose_cliques(
    alone: Iterable[int], a: IntArray, b: IntArray, last: Sequence[int] = ()
) -> tuple[IntArray, CliquePattern]:
    """Poses (N,) as their cliques number them, of pairs with ends a, b (E,), of which -1 is a constant.

    alone: poses that something else tells of. last: those that are eliminated last. The order is COLAMD's or, in large
    networks, that of METIS (nested dissection; Karypis and Kumar 1998): the one that is less work.
    """
    return _pose_cliques(tuple(alone), a.tobytes(), b.tobytes(), tuple(last), _LARGE)


@lru_cache(4)  # a search solves the same network many times over
def _pose_cliques(
    alone: tuple[int, ...], ends_a: bytes, ends_b: bytes, last: tuple[int, ...], large: int
) -> tuple[IntArray, CliquePattern]:
    a, b = (np.frombuffer(ends, dtype=np.int64) for ends in (ends_a, ends_b))
    symbolic = gtsam.SymbolicFactorGraph()
    for key in alone:
        symbolic.push_factor(key)
    for ends in zip(b.tolist(), a.tolist(), strict=True):
        symbolic.push_factor(*(k for k in ends if k >= 0))
    orders = [gtsam.Ordering.ColamdConstrainedLastSymbolicFactorGraph(symbolic, list(last))]
    if orders[0].size() > large:
        orders.append(gtsam.Ordering.MetisSymbolicFactorGraph(symbolic))
    found = list[tuple[IntArray, CliquePattern]]()
    for order in orders:
        keys = np.array([order.at(i) for i in range(order.size())], dtype=np.int64)
        keys = keys[np.argsort(np.isin(keys, last), kind="stable")]
        both = (a >= 0) & (b >= 0)
        pattern = clique_pattern(len(keys), *(numbers(keys, ends[both]) for ends in (b, a)))
        found.append((keys[pattern.order], pattern))
    return min(found, key=lambda x: x[1].work)


def numbers(keys: IntArray, of: IntArray) -> IntArray:
    """Where each of these stands in ``keys``; -1 stays."""
    order = np.argsort(keys)
    return np.where(of < 0, -1, order[np.searchsorted(keys, np.maximum(of, keys.min()), sorter=order)])
