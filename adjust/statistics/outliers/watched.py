"""Snooping in a large survey: only what fails, or nearly so, is followed; all that share one elimination.

Of the observations watched the whole matrix ``A Q A'`` is taken from the Bayes tree of the solution, a few columns at a
time; every step of the search, and every weight of a robust solution, is then algebra of that size. What is not watched
stays as it is until the survey is solved again.
"""

from collections.abc import Sequence

import numpy as np

from adjust.model.names import numbered
from adjust.model.result import Adjustment
from adjust.model.survey import BoolArray, FloatArray, IntArray
from adjust.precision.precision import ObservationRows, Precision, precision_of
from adjust.statistics.outliers.snooping import Snooping
from adjust.statistics.rows import Entries, groups_of_others

FOLLOWED = 120
"""Observations that fail, or that are out, of which so many are watched at once."""
_NEAREST, _NEAR = 30, 0.5
"""Of the others those with the largest tests, from this share of their limit."""
_LARGE = 3e7
"""Rows times unknowns from which only a part is followed."""


def large(n_rows: int, n_unknowns: int) -> bool:
    """Whether the search must not follow all of a survey."""
    return n_rows * n_unknowns > _LARGE


def watchable(now: Adjustment) -> bool:
    """Whether a survey is so large that the search must not follow all of it, and has nothing but single rows."""
    rows = int(now.other_arrays.n_components.sum()) if now.reading_residuals is None else 0
    return large(rows, now.n_unknowns) and not len(now.image_residuals.used) and not precision_of(now).hidden


def watched(over: FloatArray, used: BoolArray, allowed: BoolArray, before: IntArray) -> IntArray:
    """Whom to watch, by their tests over the limit (M,): what fails, what is out, the nearest, and ``before`` again."""
    wrong = np.where(used, over > 1.0, over <= 1.0)
    urgent = np.lexsort((-np.where(used, over, 1.0 / np.maximum(over, 1e-300)), ~wrong))
    urgent = urgent[(allowed & (wrong | ~used))[urgent]][:FOLLOWED]
    near = np.flatnonzero(allowed & used & ~wrong & (over > _NEAR))
    near = near[np.argsort(-over[near], kind="stable")][:_NEAREST]
    return np.unique(np.concatenate([urgent, near, before]))


class WatchedSnooping(Snooping):
    """The tests of the observations ``index`` of an adjustment, which counts them as its graph's others.

    given: (M,) those that the survey uses, of which the solution may have left out some.
    """

    rounds = 20

    def __init__(self, now: Adjustment, index: IntArray, given: BoolArray) -> None:
        precision = precision_of(now)
        others = [precision.graph.other(o) for o in index.tolist()]
        rows = [precision.rows(item) for item in others]
        names, group = numbered(groups_of_others(precision.graph))
        self.group_names, self.group = tuple(names), group[index]
        self.sizes = np.array([len(r.e) for r in rows], dtype=np.int64)
        self.ptr = np.concatenate([[0], np.cumsum(self.sizes)]).astype(np.int64)
        self.row_of = np.repeat(np.arange(len(index)), self.sizes)
        self.used, self.candidates = given[index], np.ones(len(index), dtype=np.bool_)
        self.joint, self.joint_of = [], {}
        self.alike = [np.flatnonzero(self.sizes == k) for k in np.unique(self.sizes)]
        back = given[index] & ~np.array([item.used for item in others], dtype=np.bool_)
        M, e = _influences(precision, rows), np.concatenate([np.zeros(0), *(r.e for r in rows)])
        # with those that the solution left out taken back
        r = np.flatnonzero(back[self.row_of])
        gained = np.linalg.solve(np.eye(len(r)) + M[np.ix_(r, r)], np.column_stack([M[r], e[r]]))
        self.omega = now.omega + float(e[r] @ gained[:, -1])
        self.left = now.redundancy + len(r)
        self._M, self.g = M - M[:, r] @ gained[:, :-1], e - M[:, r] @ gained[:, -1]
        self.R = [np.eye(k) - self._M[at[:, :, None], at[:, None, :]]
                  for at in map(self.rows, self.alike) if (k := at.shape[1])]  # fmt: skip
        self.out: list[int] = []
        self.columns: dict[int, tuple[FloatArray, FloatArray]] = {}

    def start_columns(self, columns: IntArray, rows: IntArray | slice = slice(None)) -> FloatArray:
        """Columns (m, k) of R at the start, or some rows of them."""
        own = np.arange(len(self._M))
        return np.asarray((own[rows][:, None] == own[columns]) - self._M[rows][:, columns])

    def _linearised(self) -> FloatArray:
        return self.g

    def _reweighted(self, weights: FloatArray, factor: FloatArray) -> FloatArray:
        """With what is not watched as it is: e(w) = inv(I - M (1 - w)) e."""
        less = np.where(self.used, 1.0 - weights, 0.0)[self.row_of]
        return np.asarray(np.linalg.solve(np.eye(len(self.g)) - self._M * less, self.g))


def _influences(precision: Precision, rows: Sequence[ObservationRows]) -> FloatArray:
    """Whitened A Q A' (m, m) of all rows together."""
    place, entries, m = precision.tree.places(), Entries(), 0
    for each in rows:
        at = [np.arange(place[k].start, place[k].stop) for k in each.keys]
        k = len(each.e)
        entries.add(np.arange(m, m + k), np.concatenate([np.zeros(0, dtype=np.int64), *at]), each.A)
        m += k
    return precision.tree.among(entries.matrix((m, precision.tree.n)))
