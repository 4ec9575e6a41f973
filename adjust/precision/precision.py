"""Covariances, redundancy numbers and standardized residuals of a solved survey.

Redundancy numbers and residual covariances follow Baarda (1968) and Foerstner (1979): Q_vv = Q_ll - A Q A', r = diag of
Q_vv P. For an image point both components are tested together: v' Q_vv^-1 v, chi-square with two degrees of freedom.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cached_property
from itertools import compress
from typing import TYPE_CHECKING

import gtsam
import numpy as np
from gtsam import Pose3, Rot3

from adjust.frames.unknowns import Unknowns
from adjust.graph.assembly import AdjustmentGraph
from adjust.graph.datum import survey_motions
from adjust.graph.solver import Solved
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.result import (
    Adjustment,
    GlobalTest,
    GroupSummary,
    ImageResiduals,
    JointCovariances,
    ObservationResidual,
    ParameterName,
    ReadingResiduals,
    arrays_of,
)
from adjust.model.survey import FloatArray, IntArray
from adjust.native.point_tests import AdjustedPoints, residual_tests, sums_of_blocks
from adjust.observations.factors import ObservationFactor
from adjust.observations.images.bundle_hidden import BundleHidden
from adjust.precision.s_transformation import STransformation, moved, s_transformation
from adjust.precision.stacked import Stacked
from adjust.precision.tree import TreeCovariance
from adjust.testing.distributions import chi2

if TYPE_CHECKING:
    from adjust.observations.pairs import PairStatistics


@frozen(eq=False)
class ObservationRows:
    """An observation over its keys: A (k, n) and its residual e (k,), both whitened.

    W: square root information (k, k), of which root is the inverse.
    """

    keys: list[int]
    A: FloatArray
    e: FloatArray
    W: FloatArray
    root: FloatArray
    tree: TreeCovariance
    datum: STransformation | None

    @cached_property
    def influence(self) -> FloatArray:
        """Whitened A Q A' (k, k), zero of what is held. Dear where the keys share no clique: what is not in use."""
        if not self.keys:
            return np.zeros((len(self.e),) * 2)
        return np.asarray(self.A @ _in_datum(self.datum, self.keys, self.tree.joint(self.keys)) @ self.A.T)


def _in_datum(datum: STransformation | None, keys: Sequence[int], Q: FloatArray) -> FloatArray:
    return Q if datum is None else datum.apply(keys, Q)


class Covariances(JointCovariances):
    """Those of the ``unknowns``; whoever has them says how :meth:`joint` is found, and may prepare it for many."""

    unknowns: Unknowns

    def whole(self, names: Sequence[ParameterName], sizes: Sequence[int]) -> FloatArray:
        """The same of all components, so many of each of these parameters; zero where one is held."""
        return self.following([self.unknowns.spread(name) for name in names], sizes)

    def following(self, spreads: Sequence[Mapping[int, FloatArray]], sizes: Sequence[int]) -> FloatArray:
        """Joint covariance of quantities that follow from unknowns: each (n, dim) by key; n of each in ``sizes``."""
        unknowns = [self.unknowns.by_key[key] for key in dict.fromkeys(key for by_key in spreads for key in by_key)]
        rows, columns = np.cumsum([0, *sizes]).tolist(), np.cumsum([0, *(u.dim for u in unknowns)]).tolist()
        at = {u.key: slice(*columns[i : i + 2]) for i, u in enumerate(unknowns)}

        def spread(Q: FloatArray) -> FloatArray:
            """J Q of the quantities' derivatives J, each of which has but a few unknowns."""
            out = np.zeros((rows[-1], Q.shape[1]))
            for first, by_key in zip(rows, spreads, strict=False):
                for key, part in by_key.items():
                    out[first : first + len(part)] += part @ Q[at[key]]
            return out

        return spread(spread(self.joint([u.name for u in unknowns])).T) if unknowns else np.zeros((rows[-1],) * 2)


class Precision(Covariances):
    """The same from the tree of a solution, with all that else can be had from it."""

    def __init__(self, graph: AdjustmentGraph, solved: Solved) -> None:
        self.graph, self.solved, self.unknowns = graph, solved, graph.unknowns
        self._rows: dict[ObservationFactor, ObservationRows] = {}
        self.tree = TreeCovariance(solved.tree.cliques, solved.tree.dims)
        self.hidden: dict[int, FloatArray] = {}
        self._together: dict[tuple[int, int], FloatArray] = {}
        """Joint covariances, as solved, of pairs of keys that were brought together."""
        self.bundle_influence: list[FloatArray] = []
        """Whitened A Q A' (K, 3) of the image points of every bundle, in its sorted order."""
        self._hidden = [BundleHidden(bundle) for bundle in graph.bundles]
        for hidden in self._hidden:
            self._add_hidden(hidden)
        self.stacked = Stacked(self.tree, self._hidden, graph.unknowns)
        """The covariance of all unknowns, of the tree and hidden, as a factor."""
        self.by_conditions: Mapping[str, FloatArray] = {}
        """Covariances (k, k) of adjusted pairs by id, where they are from the conditions of their loops."""
        self.transformation: STransformation | None = None
        if solved.datum is not None:
            motions = survey_motions(graph, solved.values, solved.datum.directions)
            self.transformation = s_transformation(
                solved.datum.rows, motions, lambda rows: self.stacked.by_key(rows, self.stacked.times)
            )
            self.stacked.move_to(self.transformation, solved.datum.rows)

    def datum_products(self, rows: Mapping[int, FloatArray]) -> dict[int, FloatArray]:
        """Covariance times the transpose of ``rows`` (k, dim per key): (dim, k) for every unknown."""
        return self.stacked.by_key(rows, self.stacked.times_in_datum)

    def _add_hidden(self, hidden: BundleHidden) -> None:
        bundle = hidden.batch
        Q, points, influence = hidden.covariances(self.tree.joint(bundle.interface))
        self.bundle_influence.append(influence)
        for key in bundle.hidden_poses:
            at = bundle.key_at[key]
            self.hidden[key] = Q[at : at + 6, at : at + 6]
        for j, i in enumerate(bundle.reduced):
            self.hidden[bundle.point_key[i]] = points[j]

    def joint(self, names: Sequence[ParameterName]) -> FloatArray:
        """See :class:`Covariances`."""
        keys = [self.graph.unknowns.by_name[name].key for name in names]
        if tuple(keys) in self._together:
            Q = self._together[keys[0], keys[1]]
        elif not any(k in self.hidden for k in keys):
            Q = self.tree.joint(keys)
        else:
            Q = self.stacked.joint(keys)
        return _in_datum(self.transformation, keys, Q)

    def bring_together(self, pairs: Iterable[tuple[ParameterName, ParameterName]]) -> None:
        """See :class:`Covariances`."""
        by_name = self.unknowns.by_name
        keys = [(by_name[a].key, by_name[b].key) for a, b in pairs]
        self._together |= dict(zip(keys, self.stacked.each_joint(keys), strict=True))

    def whole_pairs(self, pairs: Sequence[tuple[ParameterName, ParameterName]], size: int) -> FloatArray:
        """See :class:`Covariances`."""
        plain = {n: u.key for n, u in self.unknowns.by_name.items() if u.dim == size and n not in self.unknowns.vectors}
        mine = np.array([a in plain and b in plain for a, b in pairs], dtype=np.bool_)
        out = np.empty((len(pairs), 2 * size, 2 * size))
        out[~mine] = super().whole_pairs(list(compress(pairs, ~mine)), size)
        keys = [(plain[a], plain[b]) for a, b in compress(pairs, mine)]
        found = np.array(self.stacked.each_joint(keys)).reshape(-1, 2 * size, 2 * size)
        out[mine] = self._moved(np.array(keys, dtype=np.int64).reshape(-1, 2), found, size)
        return out

    def rows(self, item: ObservationFactor) -> ObservationRows:
        """An observation that is neither image point nor reading, linearised at the solution: built once, and kept."""
        found = self._rows.get(item)
        if found is None:
            linear = item.factor.linearize(self.solved.values)
            (A, b), keys = linear.jacobian(), list(linear.keys())
            W = np.asarray(noise_of(item).R())
            found = self._rows[item] = ObservationRows(
                keys, A, -b, W, np.asarray(np.linalg.inv(W)), self.tree, self.transformation
            )  # fmt: skip
        return found

    @cached_property
    def _images(self) -> tuple[FloatArray, FloatArray]:
        graph = self.graph
        v, M = graph.images.statistics(self.tree)
        influence = zip(graph.bundles, self.bundle_influence, strict=True)
        return (graph.joined(v, [b.unsorted(b.residuals_px()) for b in graph.bundles]),
                graph.joined(M, [b.unsorted(of_b) for b, of_b in influence]))  # fmt: skip

    @property
    def image_points(self) -> AdjustedPoints:
        """All image points, in the order of ``Survey.image_blocks``, with what their tests take."""
        return AdjustedPoints(*self._images, self.graph.square_roots(), self.graph.used())

    @cached_property
    def image_residuals(self) -> ImageResiduals:
        """Residuals and their statistics of all image points, in the order of ``Survey.image_blocks``."""
        points = self.image_points
        return ImageResiduals(self.graph.survey.image_points.ptr, points.v, *residual_tests(points), points.used)

    @cached_property
    def image_sums(self) -> FloatArray:
        """Of every image block (B, 3): components in use, their redundancy, their weighted square sum."""
        return sums_of_blocks(self.graph.survey.image_points.ptr, self.image_points)

    @cached_property
    def pairs(self) -> "PairStatistics":
        """Statistics of the pairs between fixed stations. Raises ValueError where there are none."""
        if self.graph.pairs is None:
            raise ValueError("the survey has no pairs between fixed stations")
        return self.graph.pairs.statistics(self.tree, self.solved.values)

    def covs(self, keys: IntArray, dim: int) -> FloatArray:
        """Covariances (n, dim, dim) of many unknowns of the same dimension."""
        Q = np.empty((len(keys), dim, dim))
        below = np.isin(keys, list(self.hidden))
        Q[below] = np.array([self.hidden[k] for k in keys[below].tolist()]).reshape(-1, dim, dim)
        Q[~below] = self.tree.marginals(keys[~below], dim)
        return self._moved(keys[:, None], Q, dim)

    def _moved(self, keys: IntArray, Q: FloatArray, dim: int) -> FloatArray:
        """Covariances Q (n, k, k) as solved, of sets of unknowns (n, m), in the datum; zero of what is held."""
        t, shape = self.transformation, Q.shape[:2]
        if t is not None and keys.size:
            every = keys.ravel().tolist()
            G, W = (np.array([of[k] for k in every]).reshape(*shape, -1) for of in (t.motions, t.spread))
            Q = moved(Q, G, W, t.core)
        free = np.ones((keys.size, dim), dtype=np.bool_)
        for i in np.flatnonzero(np.isin(keys, list(self.unknowns.held))).tolist():
            free[i, list(self.unknowns.held[int(keys.flat[i])])] = False
        kept = free.reshape(shape)
        return np.asarray(np.where(kept[:, :, None] & kept[:, None], Q, 0.0))

    def every_cov(self) -> dict[int, FloatArray]:
        """Covariance (dim, dim) of every unknown."""
        of_dim = grouped((unknown.dim, key) for key, unknown in self.unknowns.by_key.items())
        return {k: Q for dim, keys in of_dim.items() for k, Q in zip(keys, self.covs(np.array(keys), dim), strict=True)}

    def pair_covariances(self, ids: Sequence[str]) -> tuple[FloatArray, IntArray]:
        """Covariances (E, 6, 6) of these adjusted pairs, a priori, in the tangent in frame a; their components (E,).

        Zero beyond these: the last three of a rotation, all of a pair that was not adjusted.
        """
        graph, cov, size = self.graph, np.zeros((len(ids), 6, 6)), np.zeros(len(ids), dtype=np.int64)
        number = {name: e for e, name in enumerate(ids)}
        if graph.pairs is not None:
            rows, sizes = graph.pairs.rows.tolist(), np.where(graph.pairs.arrays.is_pose, 6, 3)
            of = np.array([number.get(graph.survey.pairs[row].pair_id, -1) for row in rows], dtype=np.int64)
            kept = of >= 0
            within = np.arange(6) < sizes[kept, None]
            size[of[kept]] = sizes[kept]
            cov[of[kept]] = np.where(within[:, :, None] & within[:, None], self.pairs.adjusted_cov[kept], 0.0)
        others = {item.ids[0]: self.rows(item) for item in graph.singles if item.kind == "pair"}
        found = {name: x.root @ x.influence @ x.root.T for name, x in others.items()} | dict(self.by_conditions)
        for name in found.keys() & number.keys():
            e, k = number[name], len(found[name])
            cov[e], size[e] = 0.0, k
            cov[e, :k, :k] = found[name]
        return cov, size


def precision_of(adjustment: Adjustment) -> Precision:
    """The precision of an adjustment from its solution; raises SurveyError where that was moved to another datum."""
    if not isinstance(adjustment.precision, Precision):
        raise SurveyError("this solution was moved to another datum; take the one it was moved from")
    return adjustment.precision


def rotations_only(adjustment: Adjustment) -> bool:
    """Whether nothing but rotations was measured, so that nothing is where it seems to be."""
    found = adjustment.precision
    if not isinstance(found, Precision) or found.graph.pairs is None or found.graph.pairs.arrays.is_pose.any():
        return False
    unknowns = found.graph.unknowns
    return all(unknowns.held.get(key) == (3, 4, 5) for key in unknowns.by_key)


def in_conditions(adjustment: Adjustment) -> bool:
    """Whether what the adjustment says of pairs is from the conditions of their loops, not from the poses of frames."""
    return isinstance(adjustment.precision, Precision) and bool(adjustment.precision.by_conditions)


def noise_of(item: ObservationFactor) -> gtsam.noiseModel.Gaussian:
    """The factor's noise; GTSAM's stubs give it only to some factors, the library to all that have one."""
    noise: gtsam.noiseModel.Gaussian = item.factor.noiseModel()  # type: ignore[attr-defined]  # see above
    return noise


def residual_of(item: ObservationFactor, values: gtsam.Values) -> FloatArray:
    """The factor's residual (k,), predicted minus observed, at these values; as above."""
    return np.asarray(item.factor.unwhitenedError(values))  # type: ignore[attr-defined]  # see above


def other_residuals(precision: Precision) -> Sequence[ObservationResidual]:
    """The same for every observation that is neither an image point nor a reading."""
    graph, out = precision.graph, dict[int, ObservationResidual]()
    if graph.pairs is not None:
        of_pairs = graph.pairs.residuals(precision.pairs, graph.survey.pairs)
        if not graph.singles:
            return of_pairs
        out |= dict(zip((graph.first_pair + graph.pairs.rows).tolist(), of_pairs, strict=True))
    for i, item in zip(graph.single, graph.singles, strict=True):
        x = precision.rows(item)
        e, M, root = x.e, x.influence, x.root
        n = len(e)
        Q = np.eye(n) - M if item.used else np.eye(n) + M
        v = root @ e
        cov_v = root @ Q @ root.T
        own = np.sqrt(np.maximum(0.0, np.diag(cov_v)))
        sigma = np.sqrt(np.diag(root @ root.T))
        with np.errstate(divide="ignore", invalid="ignore"):
            standardized = np.where(own > 1e-6 * sigma, v / own, np.nan)
        test = float(e @ np.linalg.pinv(Q, rcond=1e-9) @ e)
        redundancy = np.diag(Q) if item.used else np.zeros(n)
        adjusted = adjusted_motion(item.observed, v) if item.kind == "pair" else np.asarray(item.observed + v)
        out[i] = ObservationResidual(item.kind, item.group, item.ids, item.components, item.units, item.observed,
                                     adjusted, v, sigma, redundancy, standardized, test, item.used)  # fmt: skip
    return tuple(out[i] for i in range(graph.n_others))


def adjusted_motion(observed: FloatArray, v: FloatArray) -> FloatArray:
    """Logarithm (3 or 6,) of an adjusted rotation or pose: that of ``observed`` times that of the residual."""
    if len(v) == 3:
        return np.asarray(Rot3.Logmap(Rot3.Expmap(observed) * Rot3.Expmap(v)))
    return np.asarray(Pose3.Logmap(Pose3.Expmap(observed) * Pose3.Expmap(v)))


def group_summaries(
    precision: Precision, others: Sequence[ObservationResidual], readings: ReadingResiduals | None = None
) -> tuple[GroupSummary, ...]:
    """Observations, redundancy and weighted square sum of every group, in order of appearance."""
    graph, arrays, squares = precision.graph, arrays_of(others), np.zeros(len(others))
    for i, item in zip(graph.single, graph.singles, strict=True):
        e = precision.rows(item).e
        squares[i] = e @ e
    if graph.pairs is not None:
        squares[graph.first_pair + graph.pairs.rows] = np.square(precision.pairs.whitened).sum(axis=1)
    shares = np.bincount(arrays.observation, arrays.redundancies, len(others))
    names = [block.group for block in graph.survey.image_blocks]
    names += compress(graph.of_others(lambda o: o.group, lambda p: p.group), arrays.used.tolist())
    rows = [precision.image_sums, np.stack([arrays.n_components, shares, squares], axis=1)[arrays.used]]
    if readings is not None:
        names += [reading.group for reading in graph.survey.readings]
        of_readings = np.ones(len(readings.used)), readings.redundancy, readings.weighted_square
        rows.append(np.where(readings.used, of_readings, 0.0).T)
    number: dict[str, int] = {}
    group = [number.setdefault(name, len(number)) for name in names]
    sums = np.zeros((len(number), 3))
    np.add.at(sums, np.array(group, dtype=np.int64), np.concatenate(rows))
    return tuple(GroupSummary(name, int(n), *of) for name, (n, *of) in zip(number, sums.tolist(), strict=True))


def global_test(omega: float, redundancy: int, alpha: float) -> GlobalTest | None:
    """Two-sided chi-square test of the weighted square sum; None without redundancy."""
    if redundancy <= 0:
        return None
    lower, upper = chi2.ppf([alpha / 2, 1 - alpha / 2], redundancy)
    return GlobalTest(omega, redundancy, alpha, float(lower), float(upper))
