"""Redundancy numbers, standardized residuals and tests of all readings, from the covariances in a Bayes tree.

Q_vv = Q_ll - A Q A'; r = diag(Q_vv P); the test of one reading is w^2 with w = (P v)_i / sqrt((P Q_vv P)_ii), which is
the standardized residual where readings are not correlated (Baarda 1968; Foerstner 1979).
"""

from collections.abc import Iterator, Sequence
from typing import overload

import gtsam
import numpy as np

from adjust.model import BoolArray, FloatArray, IntArray, Survey
from adjust.native.trees import TreeArrays
from adjust.observation_factor import position_text
from adjust.result import ObservationResidual, ReadingResiduals
from adjust.terrestrial.batch import TerrestrialBatch
from adjust.tree_covariance import TreeCovariance

_ANGLES = ("direction", "angle", "zenith", "azimuth")


def influences(batch: TerrestrialBatch, tree: TreeCovariance) -> FloatArray:
    """Whitened a Q a' (N,) of all readings; the batch serves its rows unweighted. Order of ``Survey.readings``."""
    chunks = batch.layout.chunks
    rows, keys = np.array([(len(c.rows), len(c.keys)) for c in chunks], dtype=np.int64).reshape(-1, 2).T
    of = np.repeat(np.arange(len(chunks)), keys)
    key = np.array([tree.number[k] for chunk in chunks for k in chunk.keys], dtype=np.int64)
    dim = np.array([d for chunk in chunks for d in chunk.dims], dtype=np.int64)
    first, row_ptr = np.cumsum(keys) - keys, np.cumsum(rows) - rows
    before = np.cumsum(dim) - dim
    at = np.array([chunk.start for chunk in chunks], dtype=np.int64)[of] + rows[of] * (before - before[first[of]])
    # every key of a chunk with itself and with those before it
    number = np.arange(len(key)) - first[of] + 1
    i = np.repeat(np.arange(len(key)), number)
    j = first[of[i]] + np.arange(len(i)) - np.repeat(np.cumsum(number) - number, number)
    found, lost, blocks = np.zeros(int(rows.sum())), np.zeros(len(chunks), dtype=np.bool_), _Blocks(tree.arrays)
    most = int(dim.max(initial=0)) + 1
    kinds, kind = np.unique((rows[of[i]] * most + dim[i]) * most + dim[j], return_inverse=True)
    for n, shape in enumerate(kinds.tolist()):
        e, (m, da), db = np.flatnonzero(kind == n), divmod(shape // most, most), shape % most
        Q, there = blocks(key[i[e]], key[j[e]], da, db)
        lost[of[i[e[~there]]]] = True
        A, B = (batch.J[at[k[e], None] + np.arange(m * d)].reshape(-1, m, d) for k, d in ((i, da), (j, db)))
        share = np.where(i[e] == j[e], 1.0, 2.0)[:, None] * ((A @ Q) * B).sum(axis=2)
        np.add.at(found, row_ptr[of[i[e]], None] + np.arange(m), share)
    for c in np.flatnonzero(lost):
        A = batch.jacobian(int(c))
        found[row_ptr[c] : row_ptr[c] + rows[c]] = np.einsum("ip,pq,iq->i", A, tree.joint(chunks[c].keys), A)
    out = np.empty(len(found))
    out[np.concatenate([chunk.rows for chunk in chunks])] = found
    return out


class _Blocks:
    """Covariances of many pairs of keys that share a clique of a tree, at once."""

    def __init__(self, tree: TreeArrays) -> None:
        self.tree = tree
        clique, dims = np.repeat(np.arange(len(tree.front)), np.diff(tree.key_ptr)), tree.dims[tree.keys]
        before = np.cumsum(dims) - dims
        place = clique * len(tree.dims) + tree.keys
        order = np.argsort(place)
        self.place, self.column = place[order], (before - before[tree.key_ptr[clique]])[order]

    def __call__(self, a: IntArray, b: IntArray, da: int, db: int) -> tuple[FloatArray, BoolArray]:
        """Blocks (p, da, db) of keys a, b (p,) of these dimensions, and which (p,) there are.

        The key whose home lies deeper was eliminated first, so that its clique holds the other one.
        """
        tree = self.tree
        flip = tree.home[b] > tree.home[a]
        clique = np.maximum(tree.home[a], tree.home[b])
        row, column = self._columns(clique, np.where(flip, b, a)), self._columns(clique, np.where(flip, a, b))
        start, width = tree.at[clique] + row * tree.width[clique] + column, tree.width[clique]
        down, along = np.arange(da)[:, None], np.arange(db)
        flipped, wide = flip[:, None, None], width[:, None, None]
        places = start[:, None, None] + np.where(flipped, along * wide + down, down * wide + along)
        there = column >= 0
        return tree.cov[np.where(there[:, None, None], places, 0)], there

    def _columns(self, clique: IntArray, key: IntArray) -> IntArray:
        """Columns (p,) at which keys begin in cliques, -1 where they are not in them."""
        wanted = clique * len(self.tree.dims) + key
        found = np.minimum(np.searchsorted(self.place, wanted), len(self.place) - 1)
        return np.where(self.place[found] == wanted, self.column[found], -1)


def reading_residuals(batch: TerrestrialBatch, tree: TreeCovariance, values: gtsam.Values) -> ReadingResiduals:
    """Residuals and their statistics of all readings at ``values``."""
    e = batch.unweighted(values)
    used = batch.used
    influence = influences(batch, tree)
    sigma = batch.sigma.copy()
    q = np.where(used, 1.0 - influence, 1.0 + influence)
    redundancy = np.where(used, q, 0.0)
    own = np.sqrt(np.maximum(q, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        standardized = np.where(own > 1e-6, e / own, np.nan)
    test = standardized**2
    for c in batch.correlated:
        chunk = batch.layout.chunks[c]
        if chunk.whitener is not None:
            rows, W = chunk.rows, chunk.whitener
            A = batch.jacobian(c)
            M = A @ tree.joint(chunk.keys) @ A.T
            Q = np.eye(len(rows)) - M if used[rows].all() else np.eye(len(rows)) + M
            _correlated(W, Q, batch.residual[rows], e[rows], used[rows].all(),
                        rows, redundancy, own, standardized, test)  # fmt: skip
    observed = batch.layout.arrays.observed
    return ReadingResiduals(
        observed, observed + batch.residual, batch.residual.copy(), sigma, own * sigma, redundancy, standardized, test,
        e**2, used,
    )  # fmt: skip


def _correlated(
    W: FloatArray, Q: FloatArray, v: FloatArray, e: FloatArray, used: np.bool_, rows: IntArray, redundancy: FloatArray,
    own: FloatArray, standardized: FloatArray, test: FloatArray,
) -> None:  # fmt: skip
    root = np.linalg.inv(W)
    sigma = np.sqrt(np.diag(root @ root.T))
    sigma_v = np.sqrt(np.maximum(0.0, np.diag(root @ Q @ root.T)))
    scale = np.sqrt(np.maximum(0.0, np.diag(W.T @ Q @ W)))
    with np.errstate(divide="ignore", invalid="ignore"):
        standardized[rows] = np.where(sigma_v > 1e-6 * sigma, v / sigma_v, np.nan)
        test[rows] = np.where(scale * sigma > 1e-6, (W.T @ e) / scale, np.nan) ** 2
    own[rows] = sigma_v / sigma
    redundancy[rows] = np.diag(root @ Q @ W) if used else 0.0


class JoinedResiduals(Sequence[ObservationResidual]):
    """Residuals of single observations, followed by those of all readings, each made when it is asked for."""

    def __init__(self, first: tuple[ObservationResidual, ...], survey: Survey, readings: ReadingResiduals) -> None:
        self.first, self.survey, self.readings = first, survey, readings

    def __len__(self) -> int:
        return len(self.first) + len(self.survey.readings)

    @overload
    def __getitem__(self, index: int) -> ObservationResidual: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[ObservationResidual, ...]: ...

    def __getitem__(self, index: int | slice) -> ObservationResidual | tuple[ObservationResidual, ...]:
        if isinstance(index, slice):
            return tuple(self[i] for i in range(*index.indices(len(self))))
        i = index + len(self) if index < 0 else index
        if not 0 <= i < len(self):
            raise IndexError(index)
        return self.first[i] if i < len(self.first) else self._reading(i - len(self.first))

    def __iter__(self) -> Iterator[ObservationResidual]:
        yield from self.first
        for i in range(len(self.survey.readings)):
            yield self._reading(i)

    def _reading(self, i: int) -> ObservationResidual:
        reading, a, one = self.survey.readings[i], self.readings, slice(i, i + 1)
        ids: tuple[str, ...] = (reading.reading_id, position_text(reading.at), position_text(reading.to))
        if reading.second is not None:
            ids = (*ids, position_text(reading.second))
        return ObservationResidual(
            reading.kind, reading.group, ids, (reading.kind,), ("rad" if reading.kind in _ANGLES else "m",),
            a.observed[one], a.adjusted[one], a.residual[one], a.sigma[one], a.redundancy[one], a.standardized[one],
            float(a.test[i]), bool(a.used[i]),
        )  # fmt: skip
