"""Tests, minimal detectable biases and external reliability of every observation of an adjusted survey."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, IntArray
from adjust.native.parallel import side_by_side
from adjust.observations.terrestrial.statistics import influences as influences_of_readings
from adjust.precision.precision import Precision
from adjust.statistics.condensed import CondensedSystem, condensed_system
from adjust.statistics.influence import influences
from adjust.statistics.result import ImageEllipses, Influence, ObservationTests, Reliability
from adjust.statistics.system import groups_of_others, precision_of
from adjust.testing.criteria import Criteria, LevelOptions, criteria
from adjust.testing.single_tests import (
    Whitened,
    component_tests,
    eigen2,
    p_normal,
    p_posterior,
    p_prior,
    p_tau,
    whitened,
)

DEFAULT_LEVELS = LevelOptions()
_AT_ONCE = 50_000
"""Image points that are tested in one go."""
LARGEST_NETWORK = 3000
"""Pairs and priors of a pose network above which no influences are named."""
_OF_ROWS = ("redundancy", "least", "statistic", "p", "p_posterior", "detectable", "external")
_OF_COMPONENTS = ("w", "p_w", "p_tau", "error", "detectable_component", "bias")


@dataclass(frozen=True, eq=False)
class _Batch:
    """Observations of the same number of components: their rows in the table, what they are whitened with.

    weakest: their weakest controlled directions, as :meth:`Whitened.weakest` has them.
    """

    rows: IntArray
    x: Whitened
    W: FloatArray
    back: FloatArray
    weakest: tuple[FloatArray, FloatArray]


def _batch(rows: IntArray, x: Whitened, W: FloatArray, back: FloatArray) -> _Batch:
    return _Batch(rows, x, W, back, x.weakest())


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
        found, tests, _ellipses(batches, tests.n_image, found),
        _influences(adjustment, tests, batches, found, most_influences, system), _uncontrolled(adjustment, tests),
        adjustment.sigma0, adjustment.redundancy,
    )  # fmt: skip


def _batches(adjustment: Adjustment, system: CondensedSystem | None) -> list[_Batch]:
    """Image points first."""
    precision = system.system.precision if system is not None else precision_of(adjustment)
    return [*_images(precision), *_others(precision), *_readings(precision)]


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
    images = graph.images
    v, M3 = images.statistics(precision.tree)
    parts = [(v, M3, images.W_all)]
    for b, influence in zip(graph.bundles, precision.bundle_influence, strict=True):
        b.whitened_squares()
        parts.append((b.unsorted(b.residuals_px()), b.unsorted(influence), b.unsorted(b.W_all)))
    v, M3, W3 = (graph.joined(of_images, of_bundles) for of_images, *of_bundles in zip(*parts, strict=True))
    W = np.zeros((len(v), 2, 2))
    W[:, 0, 0], W[:, 0, 1], W[:, 1, 1] = W3.T
    M = np.stack([M3[:, :2], M3[:, 1:]], axis=1)
    return np.einsum("nij,nj->ni", W, v), M, W


def _images(precision: Precision) -> list[_Batch]:
    """All image points, so many in each."""
    e, M, every = image_whitened(precision)
    used = precision.graph.used()

    def batch(first: int) -> _Batch:
        part = slice(first, first + _AT_ONCE)
        W = every[part]
        back = np.zeros_like(W)
        back[:, 0, 0], back[:, 1, 1] = 1.0 / W[:, 0, 0], 1.0 / W[:, 1, 1]
        back[:, 0, 1] = -W[:, 0, 1] * back[:, 0, 0] * back[:, 1, 1]
        return _batch(np.arange(first, first + len(W)), whitened(e[part], M[part], used[part]), W, back)

    return side_by_side(batch, range(0, len(e), _AT_ONCE))


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
        out.append(_batch(rows, whitened(e, M, used), W, back))
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
            out.append(_batch(rows, x, W, np.asarray(np.linalg.inv(W))))
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
    return [_batch(first + np.arange(n), x, W[:, None, None], 1.0 / W[:, None, None])]


def _table(
    adjustment: Adjustment, batches: Sequence[_Batch], ptr: IntArray, found: Criteria
) -> ObservationTests:
    M, K = len(ptr) - 1, int(ptr[-1])
    of_row = {name: np.zeros(M) for name in _OF_ROWS}
    of_part = {name: np.full(K, np.nan) for name in _OF_COMPONENTS}
    freedom, used = np.zeros(M, dtype=np.int64), np.zeros(M, dtype=np.bool_)

    def fill(batch: _Batch) -> None:
        rows = batch.rows
        parts = (ptr[rows][:, None] + np.arange(batch.x.g.shape[1])).ravel()
        freedom[rows], used[rows] = batch.x.freedom, batch.x.used
        for name, values in _of_rows(batch, adjustment, found).items():
            of_row[name][rows] = values
        for name, values in _of_components(batch, adjustment, found).items():
            of_part[name][parts] = values.ravel()

    side_by_side(fill, batches)
    readings = adjustment.reading_residuals
    if readings is not None:  # of joint readings: the shares of the degrees of freedom, not of a bias that shows
        of_row["redundancy"][M - len(readings.used) :] = readings.redundancy
    level = found.alpha[np.maximum(freedom, 1) - 1]
    blocks = adjustment.survey.image_blocks
    groups, counts = [b.group for b in blocks], [len(b.uv) for b in blocks]
    others = groups_of_others(precision_of(adjustment).graph)
    groups += others
    names = tuple(dict.fromkeys(g for g, n in zip(groups, counts + [1] * len(others), strict=True) if n))
    number = {g: i for i, g in enumerate(names)}
    with np.errstate(invalid="ignore"):
        fails, fails_posterior = of_row["p"] < level, of_row["p_posterior"] < level
    sigma0 = adjustment.sigma0 if adjustment.sigma0 > 0.0 else np.nan
    return ObservationTests(
        n_image=sum(counts), ptr=ptr,
        group=np.repeat(np.array([number.get(g, 0) for g in groups], dtype=np.int64), counts + [1] * len(others)),
        group_names=names, used=used, n_components=np.diff(ptr), freedom=freedom, fails=fails,
        fails_posterior=fails_posterior, tau=of_part["w"] / sigma0, **of_row, **of_part,
    )  # fmt: skip


def _of_rows(batch: _Batch, adjustment: Adjustment, found: Criteria) -> dict[str, FloatArray]:
    x, (weakest, _), statistic = batch.x, batch.weakest, batch.x.statistic
    lambda0 = found.lambda0[np.maximum(x.freedom, 1) - 1]
    some = x.freedom > 0
    least = np.where(some, weakest, 1.0)
    size = np.sqrt(lambda0 / least)
    detectable = np.where(some, size, np.inf)
    moved = np.where(some, size * np.sqrt(np.maximum(1.0 - least, 0.0)), np.inf)
    return {
        "redundancy": np.where(x.used, np.trace(x.K, axis1=1, axis2=2), 0.0),
        "least": np.clip(x.values.min(axis=1), 0.0, 1.0),
        "statistic": np.where(some, statistic, np.nan),
        "p": p_prior(statistic, x.freedom),
        "p_posterior": p_posterior(statistic, x.freedom, x.used, adjustment.omega, adjustment.redundancy),
        "detectable": detectable,
        "external": np.where(x.used, moved, 0.0),
    }


def _of_components(batch: _Batch, adjustment: Adjustment, found: Criteria) -> dict[str, FloatArray]:
    x = batch.x
    single = component_tests(x, batch.W)
    sigma0 = adjustment.sigma0 if adjustment.sigma0 > 0.0 else np.nan
    weakest, direction = batch.weakest
    size = np.sqrt(found.lambda0[np.maximum(x.freedom, 1) - 1] / weakest)
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


def _ellipses(batches: Sequence[_Batch], n_image: int, found: Criteria) -> ImageEllipses:
    """Of all image points, which the first batches hold."""
    parts = side_by_side(lambda b: _ellipses_of(b, found), [b for b in batches if b.rows[0] < n_image])
    return ImageEllipses(*(np.concatenate([np.zeros(0), *(p[i] for p in parts)]) for i in range(3)))


def _ellipses_of(batch: _Batch, found: Criteria) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Major and minor axis (px), direction (rad) of biases b with b' W'KW b = lambda0.

    They are the axes of lambda0 inv(W'KW), inf where uncontrolled.
    """
    x = batch.x
    inverse = np.divide(1.0, x.values, out=np.full_like(x.values, 1e300), where=x.controlled)
    root = np.einsum("nij,njk->nik", batch.back, x.vectors * np.sqrt(inverse)[:, None, :])
    largest = np.maximum(np.abs(root).max(axis=(1, 2)), 1e-300)
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
    return axes[:, 0], axes[:, 1], np.arctan2(vectors[:, 1, 0], vectors[:, 0, 0])


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
            weakest, direction = (x[chosen] for x in batch.weakest)
            size = np.sqrt(found.lambda0[np.maximum(batch.x.freedom[chosen], 1) - 1] / weakest)
            bias |= dict(zip(batch.rows[chosen].tolist(), direction * size[:, None], strict=True))
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


