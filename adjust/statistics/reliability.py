"""Tests, minimal detectable biases and external reliability of every observation of an adjusted survey."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from adjust.model.arrays import largest
from adjust.model.frozen import frozen
from adjust.model.names import numbered
from adjust.model.result import Adjustment, ReadingResiduals
from adjust.model.survey import FloatArray, IntArray
from adjust.native.point_tests import AdjustedPoints, controlled_directions, external_reliability, point_tests
from adjust.observations.pair_arrays import upper_inverse
from adjust.precision.precision import Precision, precision_of
from adjust.statistics.condensed import CondensedSystem, condensed_system
from adjust.statistics.effects import influences
from adjust.statistics.result import Influence, ObservationTests, Reliability, TestColumns
from adjust.statistics.rows import groups_of_others
from adjust.testing.criteria import Criteria, LevelOptions, criteria
from adjust.testing.single_tests import Whitened, component_tests, whitened

DEFAULT_LEVELS = LevelOptions()
LARGEST_NETWORK = 3000
"""Pairs and priors of a pose network above which no influences are named."""
_OF_ROWS = ("redundancy", "least", "statistic", "detectable", "external")
_OF_COMPONENTS = ("w", "error", "detectable_component", "bias")
"""Columns as :func:`adjust.native.point_tests.point_tests` fills them."""


@frozen(eq=False)
class _Batch:
    """Observations of the same number of components: their rows in the table, what they are whitened with."""

    rows: IntArray
    x: Whitened
    W: FloatArray
    back: FloatArray


def reliability(
    adjustment: Adjustment, options: LevelOptions = DEFAULT_LEVELS, most_influences: int = 300,
    system: CondensedSystem | None = None,
) -> Reliability:  # fmt: skip
    """Test every observation. most_influences: of how many the influence on the unknowns is named, worst first.

    system: of this adjustment, where it is known already.
    """
    precision = system.system.precision if system is not None else precision_of(adjustment)
    points, batches = precision.image_points, [*_others(precision), *_readings(precision, adjustment.reading_residuals)]
    n_image = len(points.v)
    sizes = np.full(n_image + sum(len(b.rows) for b in batches), 2, dtype=np.int64)
    freedom = np.empty_like(sizes)
    controlled_directions(points, freedom[:n_image])
    for batch in batches:
        sizes[batch.rows], freedom[batch.rows] = batch.x.g.shape[1], batch.x.freedom
    found = criteria(options, int(np.count_nonzero(freedom)), int(sizes.max(initial=1)))
    tests = _table(adjustment, _Made(points, batches, sizes, adjustment.reading_residuals, found), freedom)
    if adjustment.survey.is_pose_network and len(sizes) > LARGEST_NETWORK:
        most_influences = 0
    return Reliability(
        found, tests, _influences(adjustment, tests, points, batches, most_influences, system),
        _uncontrolled(adjustment, tests), adjustment.sigma0, adjustment.redundancy,
    )  # fmt: skip


def observation_name(adjustment: Adjustment, row: int) -> tuple[str, tuple[str, ...]]:
    """Kind and ids of a row of ``ObservationTests``; of an image point (camera, epoch, target or "points", point)."""
    ptr = adjustment.image_residuals.block_ptr
    n_image = int(ptr[-1])
    if row >= n_image:
        o = adjustment.other_residuals[row - n_image]
        return o.kind, o.ids
    b = int(np.searchsorted(ptr, row, side="right")) - 1
    block = adjustment.survey.image_blocks[b]
    point = int(block.point_idx[row - int(ptr[b])])
    if block.target_id is None:
        return "image", (block.camera_id, block.epoch_id, "points", adjustment.survey.points[point].point_id)
    target = adjustment.survey.targets_by_id[block.target_id]
    return "image", (block.camera_id, block.epoch_id, block.target_id, target.point_ids[point])


def _others(precision: Precision) -> list[_Batch]:
    """All other observations, those with the same number of components together."""
    n_image = len(precision.graph.survey.image_points.uv)
    found: dict[int, list[tuple[int, FloatArray, FloatArray, FloatArray, FloatArray, bool]]] = {}
    for i, item in zip(precision.graph.single, precision.graph.singles, strict=True):
        x = precision.rows(item)
        found.setdefault(len(x.e), []).append((n_image + i, x.e, x.influence, x.W, x.root, item.used))
    out = []
    for same in found.values():
        rows, e, M, W, back = (np.array([x[i] for x in same]) for i in range(5))
        used = np.array([x[5] for x in same], dtype=np.bool_)
        out.append(_Batch(rows, whitened(e, M, used), W, back))
    return out + _pairs(precision, n_image)


def _pairs(precision: Precision, n_image: int) -> list[_Batch]:
    """Pairs between fixed stations, poses and rotations."""
    batch, out = precision.graph.pairs, list[_Batch]()
    if batch is None:
        return out
    stats, arrays = precision.pairs, batch.arrays
    for k, kind in ((6, arrays.is_pose), (3, ~arrays.is_pose)):
        chosen = np.flatnonzero(kind)
        if len(chosen):
            W = arrays.whitening[chosen, :k, :k]
            M = W @ stats.adjusted_cov[chosen, :k, :k] @ W.transpose(0, 2, 1)
            x = whitened(stats.whitened[chosen, :k], M, np.asarray(arrays.used[chosen], dtype=np.bool_))
            rows = n_image + precision.graph.first_pair + batch.rows[chosen]
            out.append(_Batch(rows, x, W, upper_inverse(W)))
    return out


def _readings(precision: Precision, known: ReadingResiduals | None) -> list[_Batch]:
    """All readings, one component each; those with a joint covariance by a bias of each alone (Baarda 1968)."""
    batch = precision.graph.terrestrial
    if batch is None or known is None:
        return []
    e = batch.unweighted(precision.solved.values).copy() if batch.correlated else known.residual / known.sigma
    M, W = known.influence, 1.0 / known.sigma
    K, g = np.where(batch.used, 1.0 - M, 1.0 / (1.0 + M)), np.where(batch.used, e, e / (1.0 + M))
    for c in batch.correlated:
        chunk = batch.layout.chunks[c]
        rows, whitener = chunk.rows, np.asarray(chunk.whitener)
        A, eye = batch.jacobian(c), np.eye(len(chunk.rows))
        influence = A @ precision.tree.joint(chunk.keys) @ A.T
        used = bool(batch.used[rows].all())
        Q = eye - influence if used else np.linalg.inv(eye + influence)
        W[rows] = np.linalg.norm(whitener, axis=0)
        K[rows] = np.einsum("ji,jk,ki->i", whitener, Q, whitener) / W[rows] ** 2
        g[rows] = whitener.T @ (e[rows] if used else Q @ e[rows]) / W[rows]
    n, first = len(e), sum(len(b.uv) for b in precision.graph.survey.image_blocks) + precision.graph.n_others
    x = Whitened(g[:, None], K[:, None, None], K[:, None], np.ones((n, 1, 1)), batch.used)
    return [_Batch(first + np.arange(n), x, W[:, None, None], 1.0 / W[:, None, None])]


@frozen(eq=False)
class _Made:
    """What the tests of all observations are made of. n_components: (M,) of each."""

    points: AdjustedPoints
    batches: Sequence[_Batch]
    n_components: IntArray
    readings: ReadingResiduals | None
    criteria: Criteria

    @cached_property
    def _of_batches(self) -> list[dict[str, FloatArray]]:
        return [_columns(batch, self.criteria) for batch in self.batches]

    @property
    def lambda0(self) -> FloatArray:
        """(2,) of tests with one and two components."""
        return np.ascontiguousarray(self.criteria.lambda0[:2])

    def of(self, observations: IntArray | None = None) -> TestColumns:
        """Of some in ascending order, or of all."""
        number = np.arange(len(self.n_components)) if observations is None else observations
        ptr, n_image = np.append(0, np.cumsum(self.n_components[number])), len(self.points.v)
        columns = {x: np.empty(len(number)) for x in _OF_ROWS} | {x: np.empty(int(ptr[-1])) for x in _OF_COMPONENTS}
        n = int(np.searchsorted(number, n_image))
        points = self.points if n == n_image else self.points.at(number[:n])
        outs = [columns[name][:n] for name in _OF_ROWS]
        outs += [columns[name][: 2 * n].reshape(-1, 2) for name in _OF_COMPONENTS]
        point_tests(points, self.lambda0, tuple(outs))
        for batch, found in zip(self.batches, self._of_batches, strict=True):
            some = np.flatnonzero(np.isin(batch.rows, number))
            rows = np.searchsorted(number, batch.rows[some])
            parts = (ptr[rows][:, None] + np.arange(batch.x.g.shape[1])).ravel()
            for name, values in found.items():
                columns[name][rows if values.ndim == 1 else parts] = values[some].ravel()
        if self.readings is not None:  # of joint ones: the shares of the degrees of freedom, not of a bias that shows
            first = len(self.n_components) - len(self.readings.used)
            mine = number[number >= first]
            columns["redundancy"][len(number) - len(mine) :] = self.readings.redundancy[mine - first]
        return TestColumns(ptr, **columns)

    def external(self) -> FloatArray:
        """External reliability (M,) of all."""
        out = np.empty(len(self.n_components))
        external_reliability(self.points, self.lambda0, out[: len(self.points.v)])
        for batch, found in zip(self.batches, self._of_batches, strict=True):
            out[batch.rows] = found["external"]
        return out


def _table(adjustment: Adjustment, made: _Made, freedom: IntArray) -> ObservationTests:
    n_image = len(made.points.v)
    used = np.empty(len(freedom), dtype=np.bool_)
    used[:n_image] = made.points.used
    for batch in made.batches:
        used[batch.rows] = batch.x.used
    sizes, others = np.diff(adjustment.image_residuals.block_ptr), groups_of_others(precision_of(adjustment).graph)
    blocks = [(b.group, n) for b, n in zip(adjustment.survey.image_blocks, sizes.tolist(), strict=True) if n]
    names, group = numbered([*(g for g, _ in blocks), *others])
    counts: IntArray = np.array([*(n for _, n in blocks), *[1] * len(others)], dtype=np.int64)
    return ObservationTests(
        n_image=n_image, runs=(group, counts), group_names=tuple(names), used=used, n_components=made.n_components,
        freedom=freedom, external=made.external(), of=made.of, criteria=made.criteria,
        omega=adjustment.omega, total_redundancy=adjustment.redundancy, sigma0=adjustment.sigma0,
    )  # fmt: skip


def _columns(batch: _Batch, found: Criteria) -> dict[str, FloatArray]:
    """By name, of rows (n,) and of components (n, k)."""
    x, (weakest, direction), some = batch.x, batch.x.weakest(), batch.x.freedom > 0
    least = np.where(some, weakest, 1.0)
    size, (w, information) = np.sqrt(found.lambda0[np.maximum(x.freedom, 1) - 1] / least), component_tests(x, batch.W)
    moved = np.where(some, size * np.sqrt(np.maximum(1.0 - least, 0.0)), np.inf)
    error, bias = (np.where(some[:, None], np.einsum("nij,nj->ni", batch.back, along), np.nan)
                   for along in (x.error, direction * size[:, None]))  # fmt: skip
    with np.errstate(divide="ignore"):
        detectable = np.sqrt(found.lambda0[0] / information)
    return {
        "redundancy": np.where(x.used, np.trace(x.K, axis1=1, axis2=2), 0.0),
        "least": np.clip(x.values.min(axis=1), 0.0, 1.0),
        "statistic": np.where(some, x.statistic, np.nan),
        "detectable": np.where(some, size, np.inf),
        "external": np.where(x.used, moved, 0.0),
        "w": w, "error": error, "detectable_component": detectable, "bias": bias,
    }  # fmt: skip


def _influences(
    adjustment: Adjustment, tests: ObservationTests, points: AdjustedPoints, batches: Sequence[_Batch], most: int,
    system: CondensedSystem | None,
) -> tuple[Influence, ...]:  # fmt: skip
    if most <= 0:
        return ()
    worth = np.where(tests.freedom > 0, tests.external, 0.0)
    rows = largest(worth, most)
    rows = rows[worth[rows] > 0.0]
    if not len(rows):
        return ()
    order = np.sort(rows)
    found, at = tests.of(order), np.searchsorted(order, rows).tolist()
    W_of = {int(b.rows[i]): b.W[i] for b in batches for i in np.flatnonzero(np.isin(b.rows, rows))}
    bias = {}
    for row, i in zip(rows.tolist(), at, strict=True):
        W = np.insert(points.W[row], 2, 0.0).reshape(2, 2) if row < tests.n_image else W_of[row]
        bias[row] = W @ found.bias[found.ptr[i] : found.ptr[i + 1]]
    moved = influences(system or condensed_system(precision_of(adjustment)), rows.tolist(), bias)
    return tuple(replace(x, detectable=float(found.detectable[i]), external=float(found.external[i]))
                 for x, i in zip(moved, at, strict=True))  # fmt: skip


def _uncontrolled(adjustment: Adjustment, tests: ObservationTests) -> tuple[str, ...]:
    """In use, with nothing that checks them; partly controlled ones count only where they are no image points."""
    out = []
    for row in np.flatnonzero(tests.used & (tests.freedom < tests.n_components)).tolist():
        if row < tests.n_image and tests.freedom[row] > 0:
            continue  # every point that two images show is checked across the epipolar lines alone
        kind, ids = observation_name(adjustment, row)
        missing = int(tests.n_components[row] - tests.freedom[row])
        part = "" if tests.freedom[row] == 0 else f" ({missing} of {int(tests.n_components[row])} directions)"
        out.append(f"{kind} {' '.join(ids)}{part}")
    return tuple(out)
