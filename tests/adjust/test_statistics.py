"""Tests, reliability and influences against one dense matrix and textbook formulas."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import chi2, ncx2, norm
from scipy.stats import f as fisher
from scipy.stats import t as student

from adjust.adjustment import AdjustOptions, adjust, assemble
from adjust.graph.assembly import StartValues
from adjust.model.observations import FrameRef, Pair
from adjust.model.result import Adjustment
from adjust.model.survey import Datum, FloatArray, PointParameter, PoseParameter, Station, Survey
from adjust.precision.precision import precision_of
from adjust.statistics.changes import ChangeSearch
from adjust.statistics.condensed import condensed_system
from adjust.statistics.effects import shifts
from adjust.statistics.relative_precision import relative_precision
from adjust.statistics.reliability import observation_name, reliability
from adjust.statistics.screened_adjustment import adjust_cleaned
from adjust.statistics.system import linear_system
from adjust.testing.criteria import LevelOptions, criteria, noncentrality, sidak
from survey.simulate import head_on_table, resample, stereo
from tests.adjust import helpers as h
from tests.benchmarks.data import Calibration, matrix, pixels, rough_start
from tests.benchmarks.data import survey as survey_of


def both(survey: Survey, start: StartValues) -> tuple[Adjustment, h.Dense, FloatArray]:
    """The adjustment, the whole survey in one matrix, and its inverse."""
    graph, done = h.solved(survey, start)
    full = h.dense(graph, dict(start.lenses), done.values)
    Q = full.inverse(h.inner_rows(graph, full, done))
    return assemble(graph, done, AdjustOptions()), full, Q


def known_targets() -> tuple[Survey, StartValues]:
    survey, truth = stereo(1, n_pairs=3)
    rng = np.random.default_rng(1)
    blocks = [replace(b, point_idx=b.point_idx[::4], uv=b.uv[::4], cov=h.point_covs(rng, len(b.uv[::4])),
                      used=np.arange(len(b.uv[::4])) % 5 != 2) for b in survey.image_blocks]  # fmt: skip
    return resample(replace(survey, image_blocks=tuple(blocks)), truth, 3), h.start_at(truth)


def bundle() -> tuple[Survey, StartValues]:
    survey, truth = h.network(4, n_epochs=4, n_points=10, coordinates=2, unused=0.1)
    return survey, h.start_at(truth)


def free_network() -> tuple[Survey, StartValues]:
    survey, start = bundle()
    points = tuple(replace(p, x_in_world=PointParameter()) for p in survey.points)
    return replace(survey, points=points, coordinates=(), datum=Datum("inner")), start


def table() -> tuple[Survey, StartValues]:
    survey, truth = head_on_table(1, n_cameras=1, n_table_epochs=3, n_free_epochs=1)
    blocks = tuple(replace(b, point_idx=b.point_idx[::9], uv=b.uv[::9], cov=b.cov[::9]) for b in survey.image_blocks)
    return replace(survey, image_blocks=blocks), h.start_at(truth)


@pytest.mark.slow
@pytest.mark.parametrize("case", [known_targets, bundle, free_network, table])
def test_the_whole_reliability_against_one_dense_matrix(case: Callable[[], tuple[Survey, StartValues]]) -> None:
    survey, start = case()
    adjustment, full, Q = both(survey, start)
    system = linear_system(adjustment)
    columns = np.concatenate([np.arange(full.place[n].start, full.place[n].stop) for n in system.columns.at])
    length = np.linalg.norm(full.A, axis=0)
    np.testing.assert_allclose(system.A.toarray() / length[columns], full.A[:, columns] / length[columns], atol=2e-7)
    np.testing.assert_allclose(system.e, full.e, atol=1e-6)
    mine = system.normal.covariance(system.datum)
    assert h.relative(mine, Q[np.ix_(columns, columns)]) < 1e-6
    np.testing.assert_allclose(system.sigmas, np.sqrt(np.diag(mine)), rtol=1e-6)
    found = reliability(adjustment, most_influences=10**6)
    check_tests(adjustment, full, Q, found)
    check_influences(adjustment, full, Q, found, columns, system.columns.names)


def four_corners() -> tuple[Survey, StartValues]:
    """Of a board that is as it is and before a lens that is known: fewer rows in an image than columns."""
    survey, truth = stereo(1, n_pairs=6)
    x = survey.targets[0].x_in_target
    corners = np.array([np.argmax(a * x[:, 0] + b * x[:, 1]) for a in (-1.0, 1.0) for b in (-1.0, 1.0)])
    blocks = [replace(b, point_idx=corners, uv=b.uv[corners], cov=b.cov[corners]) for b in survey.image_blocks]
    assert all((b.point_idx == np.arange(len(b.uv))).all() for b in survey.image_blocks)
    known = tuple(replace(c, lens=replace(c.lens, free=())) for c in survey.cameras)
    return replace(survey, cameras=known, image_blocks=tuple(blocks)), h.start_at(truth)


@pytest.mark.slow
@pytest.mark.parametrize("case", [known_targets, bundle, free_network, table, four_corners])
def test_the_condensed_system_is_the_same_system(case: Callable[[], tuple[Survey, StartValues]]) -> None:
    adjustment, _, _ = both(*case())
    full = linear_system(adjustment)
    condensed = condensed_system(full.precision)
    small = condensed.system
    for a, b in ((full, small), (small, full)):
        assert a.columns.names == b.columns.names
    A, B = full.A[full.used[full.row_of]], small.A[small.used[small.row_of]]
    scale = 1.0 / np.sqrt((A.T @ A).diagonal())
    np.testing.assert_allclose((B.T @ B).toarray() * np.outer(scale, scale),
                               (A.T @ A).toarray() * np.outer(scale, scale), atol=1e-9)  # fmt: skip
    e, f = full.e[full.used[full.row_of]], small.e[small.used[small.row_of]]
    assert float(f @ f) == pytest.approx(float(e @ e), rel=1e-9)
    np.testing.assert_allclose(scale * (B.T @ f), scale * (A.T @ e), atol=1e-7)
    some = np.flatnonzero(full.used[: full.n_image])[::7][::-1]
    for row, (columns, rows) in zip(some.tolist(), condensed.point_rows(some), strict=True):
        whole = np.zeros((2, A.shape[1]))
        whole[:, columns] = rows
        np.testing.assert_allclose(whole * scale, full.A[2 * row : 2 * row + 2].toarray() * scale, atol=1e-9)


def long_lens() -> Calibration:
    """A board at two metres, seen by a lens of 16,000 px: an image hardly tells its distance from the focal length."""
    rng, n = np.random.default_rng(1), 12
    v, u = (index.ravel() for index in np.mgrid[:10, :10])
    board, lens = np.column_stack([u, v, 0 * u]) * 0.01, np.array([16e3, 16e3, 640.0, 512.0, 0.0, 0.0, 0.0, 0.0])
    poses = np.array([
        matrix(np.zeros(3), np.array([*rng.uniform(-0.01, 0.01, 2), rng.uniform(1.9, 2.1)]))
        @ matrix(np.array([*rng.uniform(-0.6, 0.6, 2), 0.0]), np.zeros(3))
        @ matrix(np.array([0.0, 0.0, rng.uniform(-3.0, 3.0)]), np.zeros(3))
        @ matrix(np.zeros(3), -board.mean(axis=0)) for _ in range(n)
    ])  # fmt: skip
    uv = np.array([pixels(board @ m[:3, :3].T + m[:3, 3], lens) for m in poses])
    uv += 0.05 * rng.normal(size=uv.shape)
    return Calibration(board, uv, np.zeros(n, dtype=np.int64), np.arange(n), np.array(0.05), np.array([10, 10]),
                       lens[None], np.eye(4)[None], poses)  # fmt: skip


@pytest.mark.slow
def test_condensing_images_that_tell_little_loses_nothing() -> None:
    """Normal equations of every image to the last digits; score tests as from all rows, as far as Q has digits."""
    case = long_lens()
    adjustment = adjust(survey_of(case), rough_start(case))
    full, condensed = linear_system(adjustment), condensed_system(precision_of(adjustment))
    A, B = full.A.toarray(), condensed.system.A.toarray()
    for b in range(len(case.epoch)):
        own, mine = slice(200 * b, 200 * b + 200), condensed.block == b
        every = np.c_[A[own], full.e[own]].astype(np.longdouble)
        few = np.c_[B[mine], condensed.e[mine]].astype(np.longdouble)
        some = np.abs(every).sum(axis=0) > 0.0
        length = np.sqrt((every[:, some] ** 2).sum(axis=0))
        every, few = every[:, some] / length, few[:, some] / length
        assert np.linalg.cond(every.astype(float)) > 3e5
        assert np.abs(every.T @ every - few.T @ few).max() < 4e-15
    basis = np.linalg.qr(A / np.linalg.norm(A, axis=0))[0]
    search = ChangeSearch(adjustment, condensed)
    found = next(c for c in search.candidates if c.unit.what == "lens")
    epoch = np.repeat([search.epochs.index(b.epoch_id) for b in adjustment.survey.image_blocks], 200)
    of_lens, e = A[:, full.columns.at["lens", "c0"]], full.e - basis @ (basis.T @ full.e)
    for j, (M, g, scale) in enumerate(zip(found.M, found.g, found.scale, strict=True), 1):
        later = np.where(epoch[:, None] >= j, of_lens, 0.0) * scale
        np.testing.assert_allclose(later.T @ e, g, atol=1e-11)
        later -= basis @ (basis.T @ later)
        np.testing.assert_allclose(later.T @ later, M, atol=2e-7)


def check_tests(adjustment: Adjustment, full: h.Dense, Q: FloatArray, found) -> None:
    t, at, sigma0, f = found.tests, 0, adjustment.sigma0, adjustment.redundancy
    checked = 0
    for k in range(len(t.used)):
        rows = slice(at, at + len(full.W[k]))
        at = rows.stop
        assert (t.ptr[k], t.ptr[k + 1]) == (rows.start, rows.stop)
        used, n = bool(full.used[rows.start]), rows.stop - rows.start
        assert t.used[k] == used
        root = np.linalg.inv(full.W[k])
        v, P = full.v[rows], full.W[k].T @ full.W[k]
        Ql, Qx = root @ root.T, root @ full.A[rows] @ Q @ full.A[rows].T @ root.T
        # the model with a bias in the observation itself (Teunissen 2006): its normal matrix and right-hand side
        N = P @ (Ql - Qx) @ P if used else np.linalg.inv(Ql + Qx)
        b = -P @ v if used else -N @ v
        lengths = np.linalg.eigvalsh(root.T @ N @ root)
        if lengths[0] < 1e-5:
            continue
        checked += 1
        estimate = np.linalg.solve(N, b)
        T = b @ estimate
        parts = slice(t.ptr[k], t.ptr[k + 1])
        tolerance = {"rtol": 2e-5, "atol": 1e-6}
        assert t.freedom[k] == n
        np.testing.assert_allclose(t.statistic[k], T, **tolerance)
        np.testing.assert_allclose(t.p[k], chi2.sf(T, n), rtol=1e-3, atol=1e-12)
        np.testing.assert_allclose(t.least[k], lengths[0], rtol=1e-4, atol=1e-7)
        size = np.sqrt(np.abs(estimate) + np.sqrt(np.diag(np.linalg.inv(N))))
        np.testing.assert_allclose(t.error[parts] / size, estimate / size, rtol=1e-4, atol=1e-5)
        w = b / np.sqrt(np.diag(N))
        np.testing.assert_allclose(t.w[parts], w, **tolerance)
        np.testing.assert_allclose(t.tau[parts], w / sigma0, **tolerance)
        np.testing.assert_allclose(t.p_w[parts], 2.0 * norm.sf(np.abs(w)), rtol=1e-3, atol=1e-12)
        lambda0 = found.criteria.lambda0
        np.testing.assert_allclose(t.detectable_component[parts], np.sqrt(lambda0[0] / np.diag(N)), rtol=1e-5)
        bias = t.bias[parts]
        np.testing.assert_allclose(bias @ N @ bias, lambda0[n - 1], rtol=1e-5)
        np.testing.assert_allclose(np.linalg.norm(full.W[k] @ bias), t.detectable[k], rtol=1e-5)
        omega, left = (adjustment.omega - T, f - n) if used else (adjustment.omega, f)
        np.testing.assert_allclose(t.p_posterior[k], fisher.sf(T / n / (omega / left), n, left), rtol=1e-3, atol=1e-12)
        moved = Q @ full.A[rows].T @ full.W[k] @ bias
        expected = np.sqrt(moved @ full.normal @ moved) if used else 0.0
        np.testing.assert_allclose(t.external[k], expected, rtol=1e-4, atol=1e-6)
    assert checked > 0.5 * len(t.used)


def check_influences(adjustment, full, Q, found, columns, names) -> None:
    t = found.tests
    sigma = np.sqrt(np.diag(Q))
    assert len(found.influences) == np.count_nonzero(t.used & (t.freedom > 0) & (t.external > 0))
    worst = [t.external[i.row] for i in found.influences]
    assert worst == sorted(worst, reverse=True)
    for i in found.influences[:: max(1, len(found.influences) // 40)]:
        rows = slice(t.ptr[i.row], t.ptr[i.row + 1])
        W = full.W[i.row]
        moved = Q @ full.A[rows].T @ W @ t.bias[rows]
        ratio = (np.abs(moved) / sigma)[columns]
        assert i.ratio == pytest.approx(ratio.max(), rel=1e-3)
        assert i.ratio <= t.external[i.row] * (1 + 1e-6)
        near = [names[j] for j in np.flatnonzero(ratio > ratio.max() * (1 - 1e-3))]
        assert i.name in near


def test_unused_observations_and_names() -> None:
    survey, start = bundle()
    adjustment, _, _ = both(survey, start)
    found = reliability(adjustment).tests
    assert not found.used.all()
    assert found.external[~found.used].max() == 0.0
    assert found.redundancy[~found.used].max() == 0.0
    assert found.redundancy.sum() == pytest.approx(adjustment.redundancy, abs=1e-6)
    block = survey.image_blocks[1]
    row = len(survey.image_blocks[0].uv) + 2
    assert observation_name(adjustment, row) == (
        "image", (block.camera_id, block.epoch_id, "points", survey.points[int(block.point_idx[2])].point_id)
    )  # fmt: skip
    assert observation_name(adjustment, found.n_image)[0] == "distance"


@pytest.mark.slow
def test_tau_is_student_of_the_rest() -> None:
    """Pope's tau against its definition: the distance's t-test with sigma0 from the adjustment without it."""
    survey, start = bundle()
    adjustment, _, _ = both(survey, start)
    found = reliability(adjustment).tests
    row = found.n_image
    without, _, _ = both(replace(survey, distances=(replace(survey.distances[0], used=False), *survey.distances[1:])),
                         start)  # fmt: skip
    d = without.other_residuals[0]
    t = d.standardized[0] / without.sigma0
    p = 2.0 * student.sf(abs(t), without.redundancy)
    assert found.p_tau[found.ptr[row]] == pytest.approx(found.p_posterior[row], rel=1e-9)
    assert found.p_tau[found.ptr[row]] == pytest.approx(p, rel=0.05)  # the images are not quite linear


def test_levels_and_noncentralities() -> None:
    """Baarda's nomogram (1968): alpha0 0.1 %, power 80 % gives lambda0 17.075, so 4.13 sigmas / sqrt(r)."""
    assert noncentrality(0.001, 0.80, 1) == pytest.approx(17.075, abs=1e-3)
    assert np.sqrt(noncentrality(0.001, 0.80, 1)) == pytest.approx(norm.isf(0.0005) + norm.isf(0.2), abs=1e-3)
    b = criteria(LevelOptions(alpha0=0.001, power=0.8), 100)
    np.testing.assert_allclose(b.lambda0, b.lambda0[0])
    np.testing.assert_allclose(ncx2.sf(b.critical, np.arange(1, 7), b.lambda0), 0.8, rtol=1e-9)
    assert b.alpha[0] == pytest.approx(0.001)
    assert np.all(np.diff(b.alpha) > 0)
    s = criteria(LevelOptions(family_alpha=0.05), 100)
    assert 1.0 - (1.0 - s.alpha[2]) ** 100 == pytest.approx(0.05)
    assert sidak(0.05, 1) == pytest.approx(0.05)
    np.testing.assert_allclose(ncx2.sf(s.critical, np.arange(1, 7), s.lambda0), s.options.power, rtol=1e-9)


@pytest.mark.slow
def test_a_bias_moves_the_unknowns_as_predicted() -> None:
    """Against a second adjustment with the bias put in; curvature times residuals makes some percent."""
    survey, start = bundle()
    adjustment, _, _ = both(survey, start)
    system = linear_system(adjustment)
    row = system.n_image + 1
    d = survey.distances[1]
    moved = shifts(condensed_system(system.precision), [row], {row: np.array([0.1])})[:, 0]
    wrong = (survey.distances[0], replace(d, value=d.value + 0.1 * d.sigma))
    after, _, _ = both(replace(survey, distances=wrong), start)
    for point in ("P9", "P8"):
        at = system.columns.at["point", point]
        change = np.asarray(after.estimates["point", point].value) - adjustment.estimates["point", point].value
        np.testing.assert_allclose(change, moved[at], atol=0.06 * np.abs(moved[at]).max())


@pytest.mark.parametrize("turning", [False, True])
def test_pose_networks_have_the_same_reliability_as_the_graph(turning: bool) -> None:
    """A network of pairs, solved as a network and through the graph; of rotations alone where ``turning``."""
    rng, cov = np.random.default_rng(1), np.diag([2e-5] * 3 + [1e-4] * 3) ** 2
    poses = [h.pose(rng, 1.0) for _ in range(5)]
    pairs = []
    for i in range(5):
        for j in range(i):
            motion = poses[j].inverse() * poses[i] * Pose3.Expmap(rng.multivariate_normal(np.zeros(6), cov))
            a, b = FrameRef("station", f"R{i}"), FrameRef("station", f"R{j}")
            k = 3 if turning else 6
            pairs.append(Pair(f"{i}-{j}", a, b, motion.rotation() if turning else motion, cov[:k, :k]))
    stations = tuple(Station(f"R{i}", world_from_station=PoseParameter(p, "free" if i else "held"))
                     for i, p in enumerate(poses))  # fmt: skip
    survey = Survey(stations=stations, pairs=tuple(pairs))
    network = adjust_cleaned(survey)
    found = reliability(network)
    if turning:
        poses, axes = [Pose3(p.rotation(), np.zeros(3)) for p in poses], ("tx", "ty", "tz")
        parameters = [PoseParameter(p, "free" if i else "held", held=axes if i else ()) for i, p in enumerate(poses)]
        stations = tuple(Station(f"R{i}", world_from_station=p) for i, p in enumerate(parameters))
    start = StartValues({}, {("world_from_station", f"R{i}"): p for i, p in enumerate(poses)}, {})
    expected = reliability(adjust(replace(survey, stations=stations), start))
    for name in ("statistic", "redundancy", "external", "detectable", "p_posterior"):
        np.testing.assert_allclose(getattr(found.tests, name), getattr(expected.tests, name), rtol=1e-3, atol=1e-7)
    np.testing.assert_allclose(found.tests.w, expected.tests.w, rtol=1e-2, atol=1e-3)
    assert len(found.influences) == len(pairs)
    (pair,) = relative_precision(network, [(("world_from_station", "R1"), ("world_from_station", "R3"))])
    assert pair.rotation_cov is not None
    assert np.isfinite(pair.rotation_cov).all()
    assert np.isfinite(pair.sigma_distance) == (not turning)
    assert all(0.0 < i.ratio <= found.tests.external[i.row] * (1.0 + 1e-6) for i in found.influences)
