"""Redundancy numbers, standardized residuals and tests of all readings, from the covariances in a Bayes tree.

Q_vv = Q_ll - A Q A'; r = diag(Q_vv P); the test of one reading is w^2 with w = (P v)_i / sqrt((P Q_vv P)_ii), which is
the standardized residual where readings are not correlated (Baarda 1968; Foerstner 1979).
"""

from collections.abc import Sequence
from dataclasses import fields
from functools import partial

import gtsam
import numpy as np

from adjust.model.observations import Reading, position_text
from adjust.model.result import Named, ObservationResidual, OtherArrays, ReadingResiduals, Residuals, arrays_of
from adjust.model.survey import FloatArray, Survey
from adjust.native.trees import KeyCovariances, row_influences
from adjust.observations.terrestrial.batch import TerrestrialBatch

_ANGLES = ("direction", "angle", "zenith", "azimuth")


def influences(batch: TerrestrialBatch, tree: KeyCovariances) -> FloatArray:
    """Whitened a Q a' (N,) of all readings; the batch serves its rows unweighted. Order of ``Survey.readings``."""
    chunks = batch.layout.chunks
    rows, keys = np.array([(len(c.rows), len(c.keys)) for c in chunks], dtype=np.int64).reshape(-1, 2).T
    row_ptr, key_ptr = (np.concatenate([[0], np.cumsum(n)]) for n in (rows, keys))
    key = np.array([tree.number[k] for chunk in chunks for k in chunk.keys], dtype=np.int64)
    start = np.array([chunk.start for chunk in chunks], dtype=np.int64)
    found, lost = row_influences(row_ptr, key_ptr, key, start, batch.J, tree.arrays)
    for c in np.flatnonzero(lost):
        A = batch.jacobian(int(c))
        found[row_ptr[c] : row_ptr[c + 1]] = np.einsum("ip,pq,iq->i", A, tree.joint(chunks[c].keys), A)
    out = np.empty(len(found))
    out[np.concatenate([chunk.rows for chunk in chunks])] = found
    return out


def reading_residuals(batch: TerrestrialBatch, tree: KeyCovariances, values: gtsam.Values) -> ReadingResiduals:
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
            rows, A = chunk.rows, batch.jacobian(c)
            M = A @ tree.joint(chunk.keys) @ A.T
            in_use = bool(used[rows].all())
            Q = np.eye(len(rows)) - M if in_use else np.eye(len(rows)) + M
            own[rows], standardized[rows], test[rows], found = _correlated(
                chunk.whitener, Q, batch.residual[rows], e[rows]
            )
            redundancy[rows] = found if in_use else 0.0
    observed = batch.layout.arrays.observed
    return ReadingResiduals(
        observed, observed + batch.residual, batch.residual.copy(), sigma, redundancy, standardized, test,
        e**2, used, influence,
    )  # fmt: skip


def _correlated(
    W: FloatArray, Q: FloatArray, v: FloatArray, e: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Of readings v with whitener W, e = W v of covariance Q: sigma of v over theirs, v standardized, w^2, redundancy.

    Each (k,); nan where nothing controls a reading.
    """
    root = np.linalg.inv(W)
    sigma = np.sqrt(np.diag(root @ root.T))
    sigma_v = np.sqrt(np.maximum(0.0, np.diag(root @ Q @ root.T)))
    scale = np.sqrt(np.maximum(0.0, np.diag(W.T @ Q @ W)))
    with np.errstate(divide="ignore", invalid="ignore"):
        standardized = np.where(sigma_v > 1e-6 * sigma, v / sigma_v, np.nan)
        test = np.where(scale * sigma > 1e-6, (W.T @ e) / scale, np.nan) ** 2
    return sigma_v / sigma, standardized, test, np.diag(root @ Q @ W)


def reading_names(reading: Reading) -> tuple[str, ...]:
    """Its id, and the positions it joins."""
    refs = (reading.at, reading.to) if reading.second is None else (reading.at, reading.to, reading.second)
    return (reading.reading_id, *map(position_text, refs))


def reading_unit(kind: str) -> str:
    """Of the values of a kind of reading: rad or m."""
    return "rad" if kind in _ANGLES else "m"


def joined_residuals(
    first: Sequence[ObservationResidual], survey: Survey, readings: ReadingResiduals
) -> Sequence[ObservationResidual]:
    """Residuals of single observations, followed by those of all readings."""
    n, a, r = len(first), arrays_of(first), readings
    components = "observed", "adjusted", "residual", "sigma", "redundancy", "standardized"
    last = np.ones(len(r.used), dtype=np.int64), r.used, r.test, r.redundancy, *(getattr(r, x) for x in components)
    arrays = OtherArrays(*(np.concatenate([getattr(a, f.name), x]) for f, x in zip(fields(a), last, strict=True)))
    return Residuals(arrays, partial(_named, first, survey.readings), n)


def _named(first: Sequence[ObservationResidual], readings: Sequence[Reading], i: int) -> Named:
    if i < len(first):
        o = first[i]
        return o.kind, o.group, o.ids, o.components, o.units
    x = readings[i - len(first)]
    return x.kind, x.group, reading_names(x), (x.kind,), (reading_unit(x.kind),)
