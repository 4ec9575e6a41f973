"""The seven motions that images, pairs and readings cannot see, and inner constraints against them.

The normal equations are solved with a minimal datum: as many single components as there are defects, held at no cost
to the sparsity. Steps and covariances are then brought into the survey's datum, inner constraints ``R dx = 0`` over any
number of unknowns, by an S-transformation (Baarda 1973; Koch 1999 section 3.3.6): ``S = I - G (R G)^-1 R`` with the
motions G. The adjusted shape does not depend on either datum.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from gtsam import Pose3
from scipy import sparse

from adjust.frames.tree import in_world
from adjust.frames.unknowns import Unknown
from adjust.graph.assembly import AdjustmentGraph, Evaluation
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.survey import FloatArray, IntArray
from adjust.observations.motions import MOVED, READINGS_MOVED, orientation_motions, reading_motions, vector_motions
from adjust.spatial.motions import motions_of, points_motions, poses_at, poses_motions

if TYPE_CHECKING:
    from adjust.graph.pair_normals import PairLinear

BLIND = 1e-8
"""Length of the whitened Jacobian times a scaled direction that is not seen; rounding reaches 1e-13."""


def gauges(graph: AdjustmentGraph, keys: Sequence[int], values: gtsam.Values) -> FloatArray:
    """How unknowns move, one after the other (n, 7), with the whole survey.

    By translations, rotations (about the world origin), scale.
    """
    of = [graph.unknowns.by_key[key] for key in keys]
    points, poses = ([u for u in of if u.kind == kind] for kind in ("point", "pose"))
    x = np.array([values.atPoint3(u.key) for u in points]).reshape(-1, 3)
    world = np.array([in_world(graph.survey, u.name) for u in poses], dtype=np.bool_)
    moved = [*points_motions(x), *poses_motions(*poses_at(values, [u.key for u in poses]), world)]
    out = dict(zip([u.key for u in [*points, *poses]], moved, strict=True))
    if graph.terrestrial is not None and any(u.name[0] == "orientation" for u in of):
        out |= orientation_motions(graph.survey, graph.unknowns, graph.terrestrial, values)
    out |= {u.key: _vector_gauge(graph, u, values) for u in of if u.key not in out}
    return np.concatenate([out[key] for key in keys]) if keys else np.zeros((0, 7))


def _vector_gauge(graph: AdjustmentGraph, unknown: Unknown, values: gtsam.Values) -> FloatArray:
    if unknown.name[0] in MOVED:
        return vector_motions(graph.survey, graph.unknowns, unknown, values)
    if unknown.name[0] in READINGS_MOVED:
        return reading_motions(graph.unknowns, unknown, values)
    return motions_of(unknown, values, False)


def visible_keys(graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph) -> list[int]:
    """The unknowns of a linearised system of the graph, in a fixed order."""
    seen = set(linear.keyVector())
    return [u.key for u in graph.unknowns.by_name.values() if u.key in seen]


@frozen(eq=False)
class Stacking:
    """Where each key stands in a stacked vector of length ``n``."""

    at: dict[int, slice]
    n: int

    def index(self, keys: Iterable[int]) -> IntArray:
        """Positions of the components of ``keys``, one key after the other."""
        places = [self.at[k] for k in keys]
        start = np.array([p.start for p in places], dtype=np.int64)
        dims = np.array([p.stop for p in places], dtype=np.int64) - start
        first = np.cumsum(dims) - dims
        return np.asarray(np.repeat(start - first, dims) + np.arange(int(dims.sum())))


def stacking(graph: AdjustmentGraph, keys: Sequence[int]) -> Stacking:
    """Stack ``keys`` in this order."""
    at, n = {}, 0
    for key in keys:
        at[key] = slice(n, n + graph.unknowns.by_key[key].dim)
        n = at[key].stop
    return Stacking(at, n)


def whitened_rows(linear: gtsam.GaussianFactorGraph, stack: Stacking) -> sparse.csr_matrix:
    """The whitened Jacobian (m, n), columns as stacked; ``stack`` has all keys of ``linear``."""
    i, j, value = _entries(linear, stack)
    return sparse.csr_matrix((value, (i, j)), (int(i.max(initial=-1)) + 1, stack.n + 1))[:, : stack.n]


def _entries(linear: gtsam.GaussianFactorGraph, stack: Stacking) -> tuple[IntArray, IntArray, FloatArray]:
    """Rows, columns as stacked, and values of the whitened Jacobian; the right side is the column after the last."""
    i, j, value = np.asarray(linear.sparseJacobian_())  # counted from 1; keys in ascending order, then the right side
    place = np.append(stack.index(sorted(stack.at)), stack.n)
    return i.astype(np.int64) - 1, place[j.astype(np.int64) - 1], value


def times(linear: gtsam.GaussianFactorGraph, stack: Stacking, V: FloatArray) -> FloatArray:
    """The whitened Jacobian times V (n, k), row after row."""
    return np.asarray(whitened_rows(linear, stack) @ V)


def normal_diagonal(linear: gtsam.GaussianFactorGraph, stack: Stacking) -> FloatArray:
    """Diagonal (n,) of the normal matrix."""
    _, j, value = _entries(linear, stack)
    return np.asarray(np.bincount(j, value**2, stack.n + 1)[: stack.n], dtype=np.float64)


@frozen(eq=False)
class InnerDatum:
    """Inner constraints: rows (k, dim) per key, relative to ``base``; ``directions`` (7, k) are the defects there.

    minimal: per key the components that the normal equations hold, and their weights. sigma: of a datum component.
    """

    keys: list[int]
    rows: dict[int, FloatArray]
    base: gtsam.Values
    kinds: dict[int, str]
    directions: FloatArray
    sigma: float
    minimal: Mapping[int, tuple[IntArray, FloatArray]]

    @property
    def defect(self) -> int:
        """Number of undetermined motions."""
        return int(self.directions.shape[1])

    def add_to(self, linear: "gtsam.GaussianFactorGraph | PairLinear") -> None:
        """Hold the minimal datum's components at their values."""
        for key, (components, weights) in self.minimal.items():
            dim = self.rows[key].shape[1] if key in self.rows else 3 if self.kinds[key] == "point" else 6
            A = np.zeros((len(components), dim))
            A[np.arange(len(components)), components] = weights
            linear.add(key, A, np.zeros(len(components)), gtsam.noiseModel.Unit.Create(len(components)))

    def completed(
        self, values: gtsam.Values, delta: gtsam.VectorValues, motions: Mapping[int, FloatArray]
    ) -> gtsam.VectorValues:
        """The step ``delta`` of all unknowns from ``values``, moved into this datum.

        motions: by :func:`survey_motions` from there with its ``directions``.
        """
        offset, seen = np.zeros(self.defect), np.zeros((self.defect, self.defect))
        for key, row in self.rows.items():
            if self.kinds[key] == "point":
                offset += row @ (np.asarray(values.atPoint3(key)) - np.asarray(self.base.atPoint3(key)) + delta.at(key))
                seen += row @ motions[key]
            else:
                D = np.zeros((6, 6), order="F")
                local = Pose3.Logmap(self.base.atPose3(key).between(values.atPose3(key)), D)
                offset += row @ (local + D @ delta.at(key))
                seen += row @ D @ motions[key]
        shift = np.linalg.solve(seen, offset)
        out = gtsam.VectorValues()
        for key, moved in motions.items():
            out.insert(key, delta.at(key) - moved @ shift)
        return out


def survey_motions(graph: AdjustmentGraph, values: gtsam.Values, directions: FloatArray) -> dict[int, FloatArray]:
    """How every unknown moves (dim, k) with the motions ``directions`` (7, k) of the whole survey."""
    unknowns = list(graph.unknowns.by_name.values())
    moved = gauges(graph, [u.key for u in unknowns], values) @ directions
    ends = np.cumsum([u.dim for u in unknowns])
    out = dict(zip([u.key for u in unknowns], np.split(moved, ends[:-1]), strict=True))
    for u in unknowns:
        for i in graph.unknowns.held.get(u.key, ()):
            out[u.key][i] = 0.0
    return out


def defects(graph: AdjustmentGraph, linear: gtsam.GaussianFactorGraph, values: gtsam.Values) -> FloatArray:
    """Directions (7, k) of the whole-survey motions that the observations do not see."""
    keys = visible_keys(graph, linear)
    stack = stacking(graph, keys)
    B = gauges(graph, keys, values)
    d = np.sqrt(normal_diagonal(linear, stack))
    lengths = np.linalg.norm(d[:, None] * B, axis=0)
    usable = lengths > 0.0
    scaled = times(linear, stack, B[:, usable] / lengths[usable])
    _, s, Vt = np.linalg.svd(scaled, full_matrices=False)
    null = Vt[s < BLIND].T
    out = np.zeros((7, null.shape[1]))
    out[usable] = null / lengths[usable, None]
    return out


def inner_datum(graph: AdjustmentGraph, at: Evaluation) -> InnerDatum | None:
    """The inner constraints about the values evaluated that the survey asks for, or None where its datum is given.

    Raises SurveyError where nothing named can carry them.
    """
    if graph.survey.datum.kind != "inner":
        return None
    keys = _inner_datum_keys(graph)
    if not keys:
        raise SurveyError("datum kind 'inner' needs free points or free fixed stations; name some, or hold something")
    base, linear = at.values, graph.linearized(at)
    stack = stacking(graph, visible_keys(graph, linear))
    weights = normal_diagonal(linear, stack)
    directions = defects(graph, linear, base)
    if directions.shape[1] == 0:
        return None
    by_key = graph.unknowns.by_key
    motions = survey_motions(graph, base, directions)
    rows = datum_rows(keys, motions)
    minimal = minimal_datum(graph, stack, weights, motions)
    kinds = {k: by_key[k].kind for k in [*keys, *minimal]}
    sigma = float(1.0 / np.median(np.concatenate([w for _, w in minimal.values()])))
    return InnerDatum(keys, rows, base, kinds, directions, sigma, minimal)


def datum_rows(keys: Sequence[int], motions: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
    """Orthonormal rows (k, dim per key) that forbid the motions (dim, k) of ``keys``; raises SurveyError."""
    stacked = np.concatenate([motions[k] for k in keys])
    Q, triangular = np.linalg.qr(stacked)
    if len(stacked) < stacked.shape[1] or np.abs(np.diag(triangular)).min() < 1e-9 * np.abs(triangular).max():
        raise SurveyError("the points and stations named for the inner datum cannot carry it; name three points")
    rows, o = {}, 0
    for key in keys:
        dim = len(motions[key])
        rows[key] = Q[o : o + dim].T.copy()
        o += dim
    return rows


def independent_rows(B: FloatArray) -> IntArray:
    """As many rows of B (n, k) as it has columns, each the one furthest from the span of those before it.

    Source: QR factorisation with pivots, of the transpose (Golub and Van Loan, Matrix Computations, 5.4.2).
    """
    rest, chosen = B.copy(), []
    for _ in range(B.shape[1]):
        chosen.append(int(np.argmax(np.einsum("ij,ij->i", rest, rest))))
        direction = rest[chosen[-1]] / max(float(np.linalg.norm(rest[chosen[-1]])), 1e-300)
        rest -= np.outer(rest @ direction, direction)
    return np.array(chosen, dtype=np.int64)


def minimal_datum(
    graph: AdjustmentGraph, stack: Stacking, diagonal: FloatArray, motions: Mapping[int, FloatArray]
) -> dict[int, tuple[IntArray, FloatArray]]:
    """As many components of points and poses as there are defects, those that tell the motions apart best.

    diagonal: of the normal matrix, stacked. The components are independent rows of the motions in units of the
    components' own sigmas.
    """
    root = np.sqrt(diagonal)
    by_key = graph.unknowns.by_key
    keys = [k for k in stack.at if by_key[k].kind in ("point", "pose") and np.abs(motions[k]).max() > 0.0]
    if not keys:
        raise SurveyError("an inner datum needs free points or poses of the world; free some, or set no inner datum")
    index = stack.index(keys)
    B = np.concatenate([motions[k] for k in keys]) * root[index][:, None]
    chosen = independent_rows(np.linalg.qr(B)[0])
    out: dict[int, tuple[IntArray, FloatArray]] = {}
    owner = np.repeat(np.arange(len(keys)), [by_key[k].dim for k in keys])
    for number in dict.fromkeys(owner[chosen].tolist()):
        mine = np.sort(index[chosen][owner[chosen] == number])
        out[keys[number]] = (mine - stack.at[keys[number]].start, root[mine])
    return out


def _inner_datum_keys(graph: AdjustmentGraph) -> list[int]:
    """The unknowns that the survey names (or all points, else all stations) for inner constraints."""
    survey, by_name = graph.survey, graph.unknowns.by_name
    datum = survey.datum
    points = datum.points or (() if datum.stations else tuple(p.point_id for p in survey.points))
    keys = [u.key for p in points if (u := by_name.get(("point", p)))]
    stations = datum.stations
    if not datum.points and not datum.stations and not keys:
        stations = tuple(s.station_id for s in survey.stations)
    named = set(stations)
    keys += [u.key for name, u in by_name.items() if name[0] == "world_from_station" and name[1] in named]
    return keys
