"""The seven motions that images and pairs cannot see, and inner constraints against them.

Inner constraints are rows ``G' dx = 0`` over the datum's unknowns, as many as the survey has defects. They alone decide
on the defects, so the adjusted shape does not depend on their weight; what their variance adds to the covariances is
known exactly and taken off again (S-transformation; Baarda 1973, Koch 1999 section 3.3.6).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import gtsam
import numpy as np
from gtsam import Pose3

from adjust.errors import SurveyError
from adjust.factors import Jacobians, custom
from adjust.geometry.motions import MOVED, vector_motions
from adjust.graph import AdjustmentGraph, inner_datum_keys
from adjust.model import FloatArray, IntArray
from adjust.motions import motions_of
from adjust.result import ParameterName
from adjust.unknowns import Unknown

BLIND = 1e-8
"""Length of the whitened Jacobian times a scaled direction that is not seen; rounding reaches 1e-13."""


def gauge(graph: AdjustmentGraph, unknown: Unknown, values: gtsam.Values) -> FloatArray:
    """How an unknown moves (dim, 7) with the whole survey: translations, rotations (about the world origin), scale."""
    if unknown.name[0] in MOVED:
        return vector_motions(graph.survey, graph.unknowns, unknown, values)
    return motions_of(unknown, values, in_world(graph, unknown.name))


def in_world(graph: AdjustmentGraph, name: ParameterName) -> bool:
    """Whether a pose parameter is the pose of something in the world."""
    if name[0] == "carrier_from_target":
        return next(t.station_id for t in graph.survey.targets if t.target_id == name[1]) is None
    return name[0] in ("world_from_station", "world_from_table")


def visible_keys(graph: AdjustmentGraph) -> list[int]:
    """The unknowns that GTSAM sees, in a fixed order."""
    seen = set(graph.graph.keyVector())
    return [u.key for u in graph.unknowns.by_name.values() if u.key in seen]


@dataclass(frozen=True, eq=False)
class Stacking:
    """Where each key stands in a stacked vector of length ``n``."""

    at: dict[int, slice]
    n: int

    def index(self, keys: Iterable[int]) -> IntArray:
        """Positions of the components of ``keys``, one key after the other."""
        return np.concatenate([np.arange(self.at[k].start, self.at[k].stop) for k in keys])


def stacking(graph: AdjustmentGraph, keys: Sequence[int]) -> Stacking:
    """Stack ``keys`` in this order."""
    at, n = {}, 0
    for key in keys:
        at[key] = slice(n, n + graph.unknowns.by_key[key].dim)
        n = at[key].stop
    return Stacking(at, n)


def times(linear: gtsam.GaussianFactorGraph, stack: Stacking, V: FloatArray) -> FloatArray:
    """The whitened Jacobian times V (n, k), row after row."""
    out = []
    for i in range(linear.size()):
        factor = linear.at(i)
        out.append(factor.jacobian()[0] @ V[stack.index(factor.keys())])
    return np.concatenate(out)


def normal_diagonal(linear: gtsam.GaussianFactorGraph, stack: Stacking) -> FloatArray:
    """Diagonal (n,) of the normal matrix."""
    out = np.zeros(stack.n)
    for i in range(linear.size()):
        factor = linear.at(i)
        np.add.at(out, stack.index(factor.keys()), (factor.jacobian()[0] ** 2).sum(axis=0))
    return out


@dataclass(frozen=True, eq=False)
class InnerDatum:
    """Inner constraints: rows (k, dim) per key, relative to ``base``; ``directions`` (7, k) are the defects there."""

    keys: list[int]
    rows: dict[int, FloatArray]
    base: gtsam.Values
    kinds: dict[int, str]
    directions: FloatArray
    sigma: float
    addition: FloatArray  # (k, k): what the rows' own variance adds, in terms of the defect motions

    @property
    def defect(self) -> int:
        """Number of undetermined motions."""
        return int(self.directions.shape[1])

    def factor(self) -> gtsam.NonlinearFactor:
        """The constraint rows as a factor."""
        base, kinds, rows = self.base, self.kinds, self.rows

        def residual(values: gtsam.Values) -> tuple[FloatArray, Jacobians]:
            r, blocks = np.zeros(self.defect), []
            for key, row in rows.items():
                if kinds[key] == "point":
                    r += row @ (np.asarray(values.atPoint3(key)) - np.asarray(base.atPoint3(key)))
                    blocks.append((key, row))
                else:
                    D = np.zeros((6, 6), order="F")
                    r += row @ Pose3.Logmap(base.atPose3(key).between(values.atPose3(key)), D)
                    blocks.append((key, row @ D))
            return r, blocks

        return custom(self.keys, np.eye(self.defect) * self.sigma**2, residual)

    def excess(self, gauge_rows: FloatArray) -> FloatArray:
        """What to take off the covariance of an unknown whose motions are ``gauge_rows`` (dim, 7)."""
        B = gauge_rows @ self.directions
        return np.asarray(B @ self.addition @ B.T)


def defects(graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph, values: gtsam.Values) -> FloatArray:
    """Directions (7, k) of the whole-survey motions that the observations do not see."""
    keys = visible_keys(graph)
    stack = stacking(graph, keys)
    B = np.concatenate([gauge(graph, graph.unknowns.by_key[k], values) for k in keys])
    d = np.sqrt(normal_diagonal(linear, stack))
    lengths = np.linalg.norm(d[:, None] * B, axis=0)
    usable = lengths > 0.0
    scaled = times(linear, stack, B[:, usable] / lengths[usable])
    _, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    null = Vt[s < BLIND].T
    out = np.zeros((7, null.shape[1]))
    out[usable] = null / lengths[usable, None]
    return out


def inner_datum(graph: AdjustmentGraph, base: gtsam.Values) -> InnerDatum | None:
    """The inner constraints about ``base`` that the survey asks for, or None where its datum is given.

    Raises SurveyError where nothing named can carry them.
    """
    if graph.survey.datum.kind != "inner":
        return None
    keys = inner_datum_keys(graph.survey, graph.unknowns)
    if not keys:
        raise SurveyError("datum kind 'inner' needs free points or free fixed stations; name some, or hold something")
    graph.prepare(base, jacobians=True)
    linear = graph.graph.linearize(base)
    directions = defects(graph, linear, base)
    if directions.shape[1] == 0:
        return None
    by_key = graph.unknowns.by_key
    stacked = np.concatenate([gauge(graph, by_key[k], base) @ directions for k in keys])
    Q, triangular = np.linalg.qr(stacked)
    if np.abs(np.diag(triangular)).min() < 1e-9 * np.abs(triangular).max():
        raise SurveyError("the points and stations named for the inner datum cannot carry it; name three points")
    stack = stacking(graph, visible_keys(graph))
    held = {stack.at[k].start + i for k in keys for i in graph.unknowns.held.get(k, ())}
    mine = normal_diagonal(linear, stack)[[int(i) for i in stack.index(keys) if int(i) not in held]]
    sigma = float(1.0 / np.sqrt(np.median(mine)))
    rows, o = {}, 0
    for key in keys:
        rows[key] = Q[o : o + by_key[key].dim].T.copy()
        o += by_key[key].dim
    inverse = np.linalg.inv(triangular)
    kinds = {k: by_key[k].kind for k in keys}
    addition = sigma**2 * inverse @ inverse.T
    return InnerDatum(keys, rows, base, kinds, directions, sigma, addition)
