"""Tests, minimal detectable biases and external reliability of every observation of an adjusted survey."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, IntArray
from adjust.observations.terrestrial.statistics import influences as influences_of_readings
from adjust.precision.precision import Precision
from adjust.statistics.condensed import CondensedSystem, condensed_system
from adjust.statistics.criteria import criteria
from adjust.statistics.influence import influences
from adjust.statistics.result import (
    Criteria,
    ImageEllipses,
    Influence,
    LevelOptions,
    ObservationTests,
    Reliability,
)
from adjust.statistics.single_tests import (
    Whitened,
    component_tests,
    eigen2,
    p_normal,
    p_posterior,
    p_prior,
    p_tau,
    whitened,
)
from adjust.statistics.system import precision_of

DEFAULT_LEVELS = LevelOptions()
LARGEST_NETWORK = 3000
"""Pairs and priors of a pose network above which no influences are named."""
_OF_ROWS = ("redundancy", "least", "statistic", "p", "p_posterior", "detectable", "external")
_OF_COMPONENTS = ("w", "p_w", "p_tau", "error", "detectable_component", "bias")


@dataclass(frozen=True, eq=False)
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
    batches = _batches(adjustment, system)
    sizes = np.zeros(sum(len(b.rows) for b in batches), dtype=np.int64)
    for batch in batches:
        sizes[batch.rows] = batch.x.g.shape[1]
    ptr = np.concatenate([[0], np.cumsum(sizes)]).astype(np.int64)
    n_tests = int(sum(np.count_nonzero(b.x.freedom) for b in batches))
    found = criteria(options, n_tests, int(sizes.max(initial=1)))
    tests = _table(adjustment, batches, ptr, found)
    if adjustment.survey.is_pose_network and len(ptr) > LARGEST_NETWORK:
        most_influences = 0
    return Reliability(
        found, tests, _ellipses(batches[0], found),
        _influences(adjustment, tests, batches, found, most_influences, system), _uncontrolled(adjustment, tests),
        adjustment.sigma0, adjustment.redundancy,
    )  # fmt: skip


def _batches(adjustment: Adjustment, system: CondensedSystem | None) -> list[_Batch]:
    """Image points first."""
    precision = system.system.precision if system is not None else precision_of(adjustment)
    return [_images(precision), *_others(precision), *_readings(precision)]


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
    target = next(t for t in adjustment.survey.targets if t.target_id == block.target_id)
    return "image", (block.camera_id, block.epoch_id, block.target_id, target.point_ids[point])


def image_whitened(precision: Precision) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of all image points whitened residuals (N, 2), whitened A Q A' and square root information (N, 2, 2)."""
    graph, values = precision.graph, precision.solved.values
    graph.prepare(values, jacobians=True)
    images, bundle = graph.images, graph.bundle
    v, M3 = images.statistics(precision.tree)
    parts = [(v, M3, images.W_all)]
    if bundle is not None:
        bundle.whitened_squares(values)
        found = bundle.residuals_px(), precision.bundle_influence, bundle.W_all
        parts.append((bundle.unsorted(found[0]), bundle.unsorted(found[1]), bundle.unsorted(found[2])))
    order = _image_order(precision)
    v, M3, W3 = (np.concatenate([p[i] for p in parts])[order] for i in range(3))
    W = np.zeros((len(v), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = W3.T
    M = np.stack([M3[:, :2], M3[:, 1:]], axis=1)
    return np.einsum("nij,nj->ni", W, v), M, W


def _image_order(precision: Precision) -> IntArray:
    """Where the image points (N,), in the order of the survey's blocks, stand: known targets first, then the bundle."""
    graph = precision.graph
    out: list[IntArray] = [np.zeros(0, dtype=np.int64)]
    at = [0, graph.images.n_points]
    for i, free in graph.image_order:
        n = len(graph.survey.image_blocks[i].uv)
        out.append(np.arange(at[int(free)], at[int(free)] + n))
        at[int(free)] += n
    return np.concatenate(out)


def _images(precision: Precision) -> _Batch:
    e, M, W = image_whitened(precision)
    back = np.zeros_like(W)
    back[:, 0, 0], back[:, 1, 1] = 1.0 / W[:, 0, 0], 1.0 / W[:, 1, 1]
    back[:, 0, 1] = -W[:, 0, 1] * back[:, 0, 0] * back[:, 1, 1]
    return _Batch(np.arange(len(e)), whitened(e, M, precision.graph.used()), W, back)


def _others(precision: Precision) -> list[_Batch]:
    """All other observations, those with the same number of components together."""
    n_image = sum(len(b.uv) for b in precision.graph.survey.image_blocks)
    found: dict[int, list[tuple[int, FloatArray, FloatArray, FloatArray, FloatArray]]] = {}
    for i in precision.single:
        x = precision.rows(precision.graph.others[i])
        found.setdefault(len(x.e), []).append((n_image + i, x.e, x.influence, x.W, x.root))
    out = []
    for same in found.values():
        rows, e, M, W, back = (np.array([x[i] for x in same]) for i in range(5))
        used = np.array([precision.graph.others[i - n_image].used for i in rows], dtype=np.bool_)
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
            out.append(_Batch(rows, x, W, np.asarray(np.linalg.inv(W))))
    return out


def _readings(precision: Precision) -> list[_Batch]:
    """All readings, one component each; those with a joint covariance by a bias of each alone (Baarda 1968)."""
    batch = precision.graph.terrestrial
    if batch is None:
        return []
    e = batch.unweighted(precision.solved.values).copy()
    M, W = influences_of_readings(batch, precision.tree), 1.0 / batch.sigma
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
    n, first = len(e), sum(len(b.uv) for b in precision.graph.survey.image_blocks) + len(precision.graph.others)
    x = Whitened(g[:, None], K[:, None, None], K[:, None], np.ones((n, 1, 1)), batch.used)
    return [_Batch(first + np.arange(n), x, W[:, None, None], 1.0 / W[:, None, None])]


def _table(
    adjustment: Adjustment, batches: Sequence[_Batch], ptr: IntArray, found: Criteria
) -> ObservationTests:
    M, K = len(ptr) - 1, int(ptr[-1])
    of_row = {name: np.zeros(M) for name in _OF_ROWS}
    of_part = {name: np.full(K, np.nan) for name in _OF_COMPONENTS}
    freedom, used = np.zeros(M, dtype=np.int64), np.zeros(M, dtype=np.bool_)
    for batch in batches:
        x, rows = batch.x, batch.rows
        parts = (ptr[rows][:, None] + np.arange(x.g.shape[1])).ravel()
        freedom[rows], used[rows] = x.freedom, x.used
        for name, values in _of_rows(x, found).items():
            of_row[name][rows] = values
        of_row["p_posterior"][rows] = p_posterior(
            x.statistic, x.freedom, x.used, adjustment.omega, adjustment.redundancy
        )
        for name, values in _of_components(batch, adjustment, found).items():
            of_part[name][parts] = values.ravel()
    readings = adjustment.reading_residuals
    if readings is not None:  # of joint readings: the shares of the degrees of freedom, not of a bias that shows
        of_row["redundancy"][M - len(readings.used) :] = readings.redundancy
    level = found.alpha[np.maximum(freedom, 1) - 1]
    groups = [b.group for b in adjustment.survey.image_blocks for _ in range(len(b.uv))]
    groups += [o.group for o in adjustment.other_residuals]
    names = tuple(dict.fromkeys(groups))
    number = {g: i for i, g in enumerate(names)}
    with np.errstate(invalid="ignore"):
        fails, fails_posterior = of_row["p"] < level, of_row["p_posterior"] < level
    sigma0 = adjustment.sigma0 if adjustment.sigma0 > 0.0 else np.nan
    return ObservationTests(
        n_image=len(batches[0].rows), ptr=ptr, group=np.array([number[g] for g in groups], dtype=np.int64),
        group_names=names, used=used, n_components=np.diff(ptr), freedom=freedom, fails=fails,
        fails_posterior=fails_posterior, tau=of_part["w"] / sigma0, **of_row, **of_part,
    )  # fmt: skip


def _of_rows(x: Whitened, found: Criteria) -> dict[str, FloatArray]:
    weakest, _ = x.weakest()
    lambda0 = found.lambda0[np.maximum(x.freedom, 1) - 1]
    some = x.freedom > 0
    least = np.where(some, weakest, 1.0)
    size = np.sqrt(lambda0 / least)
    detectable = np.where(some, size, np.inf)
    moved = np.where(some, size * np.sqrt(np.maximum(1.0 - least, 0.0)), np.inf)
    return {
        "redundancy": np.where(x.used, np.trace(x.K, axis1=1, axis2=2), 0.0),
        "least": np.clip(x.values.min(axis=1), 0.0, 1.0),
        "statistic": np.where(some, x.statistic, np.nan),
        "p": p_prior(x.statistic, x.freedom),
        "detectable": detectable,
        "external": np.where(x.used, moved, 0.0),
    }


def _of_components(batch: _Batch, adjustment: Adjustment, found: Criteria) -> dict[str, FloatArray]:
    x = batch.x
    single = component_tests(x, batch.W)
    sigma0 = adjustment.sigma0 if adjustment.sigma0 > 0.0 else np.nan
    _, direction = x.weakest()
    lambda0 = found.lambda0[np.maximum(x.freedom, 1) - 1]
    size = np.sqrt(lambda0 / x.weakest()[0])
    with np.errstate(divide="ignore"):
        detectable = np.sqrt(found.lambda0[0] / single.information)
    some = (x.freedom > 0)[:, None]
    return {
        "w": single.w,
        "p_w": p_normal(single.w),
        "p_tau": p_tau(single.w / sigma0, x.used, adjustment.redundancy),
        "error": np.where(some, np.einsum("nij,nj->ni", batch.back, x.error), np.nan),
        "detectable_component": detectable,
        "bias": np.where(some, np.einsum("nij,nj->ni", batch.back, direction * size[:, None]), np.nan),
    }


def _ellipses(batch: _Batch, found: Criteria) -> ImageEllipses:
    """Of biases b with b' W'KW b = lambda0: axes of lambda0 inv(W'KW), inf where uncontrolled."""
    x = batch.x
    inverse = np.divide(1.0, x.values, out=np.full_like(x.values, 1e300), where=x.controlled)
    root = np.einsum("nij,njk->nik", batch.back, x.vectors * np.sqrt(inverse)[:, None, :])
    largest = np.maximum(np.abs(root).max(axis=(1, 2)), 1e-300) if len(root) else np.ones(0)
    unit = root / largest[:, None, None]  # so that what is not controlled does not overflow
    values, vectors = eigen2(np.einsum("nij,nkj->nik", unit, unit))
    size = np.sqrt(found.lambda0[np.maximum(x.freedom, 1) - 1])
    axes = size[:, None] * largest[:, None] * np.sqrt(np.maximum(values, 0.0))
    axes = np.where(axes > 1e100, np.inf, axes)
    lost = x.freedom == 1
    if lost.any():  # the minor axis drowns beside an infinite major one: it is that of the controlled direction
        normal = np.stack([-vectors[lost, 1, 0], vectors[lost, 0, 0]], axis=1)
        K = np.einsum("nji,njk,nkl->nil", batch.W[lost], x.K[lost], batch.W[lost])
        axes[lost, 1] = size[lost] / np.sqrt(np.einsum("ni,nij,nj->n", normal, K, normal))
    return ImageEllipses(axes[:, 0], axes[:, 1], np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0]))


def _influences(
    adjustment: Adjustment, tests: ObservationTests, batches: Sequence[_Batch], found: Criteria, most: int,
    system: CondensedSystem | None,
) -> tuple[Influence, ...]:  # fmt: skip
    if most <= 0:
        return ()
    worth = np.where(tests.used & (tests.freedom > 0), tests.external, -1.0)
    rows = np.argsort(-worth, kind="stable")[:most]
    rows = rows[worth[rows] > 0.0]
    if not len(rows):
        return ()
    bias: dict[int, FloatArray] = {}
    for batch in batches:
        chosen = np.isin(batch.rows, rows)
        if chosen.any():
            weakest, direction = batch.x.weakest()
            size = np.sqrt(found.lambda0[np.maximum(batch.x.freedom, 1) - 1] / weakest)
            bias |= {int(r): d for r, d in zip(batch.rows[chosen], (direction * size[:, None])[chosen], strict=True)}
    return influences(system or condensed_system(precision_of(adjustment)), [int(r) for r in rows], bias)


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


