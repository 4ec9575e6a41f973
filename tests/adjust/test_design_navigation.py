"""Beacons for navigation, tolerances of its parts, and the error figures: against re-solving, exhaustive search,
navigation's own prediction, and closed forms."""

from itertools import combinations

import numpy as np
import pytest
from gtsam import Pose3, Rot3
from scipy.stats import chi2

from adjust.design.error_analysis import ERROR_KINDS, BeaconField
from adjust.design.error_figures import SIZES, error_figure
from adjust.design.placement import PlacementOptions, place_beacons
from adjust.design.pose_budget import pose_budget, pose_tolerances, simulate_poses
from adjust.model.errors import SurveyError
from adjust.navigation import Beacons, expected_precision
from tests.adjust.navigation import block_diagonal, mfns_head, scattered_beacons, turned, wide_head

SIGMA = 0.4e-3
REQUIRED = np.array([np.radians(0.17)] * 3 + [1e-3] * 3)


def poses(n=6, seed=1):
    rng = np.random.default_rng(seed)
    return [Pose3(Rot3(turned(a).rotation().matrix()), rng.normal(0, 0.03, 3)) for a in np.linspace(0, 6, n)]


def walls(n, seed=2):
    """Places on the walls of a room of 3 m."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(-1.5, 1.5, (n, 3))
    x[np.arange(n), rng.integers(0, 3, n)] = 1.5 * rng.choice([-1, 1], n)
    return x


def measured(head, at, x, chosen, options):
    """What navigation itself predicts for a set, in units of the requirement."""
    ids = tuple(f"p{i}" for i in range(len(chosen)))
    beacons = Beacons(ids, x[list(chosen)], SIGMA**2 * np.eye(3 * len(chosen)))
    found = expected_precision(head, beacons, at, options.sigma_px)
    if min(len(e.beacon_ids) for e in found) < options.at_least:
        return np.inf
    weight = 1.0 / (6 * np.array([options.required_rotation] * 3 + [options.required_translation] * 3) ** 2)
    values = np.array([np.diag(e.cov) @ weight for e in found])
    return values.max() if options.criterion == "worst" else values.mean()


@pytest.mark.parametrize("criterion", ["worst", "mean"])
def test_placement_is_measured_as_navigation_predicts_it(criterion):
    head, at, x = wide_head(), poses(4), walls(60)
    options = PlacementOptions(criterion=criterion)
    found = place_beacons(head, at, x, SIGMA, 10, options)
    assert len(set(found.chosen)) == 10
    assert min(found.seen) >= 3
    assert found.final == pytest.approx(measured(head, at, x, found.chosen, options), rel=1e-4)
    assert found.final <= found.measure[-1] * (1 + 1e-9)
    assert found.per_pose.max() == pytest.approx(found.final if criterion == "worst" else found.per_pose.max())
    rng = np.random.default_rng(3)
    sets = [rng.choice(len(x), 24, replace=False) for _ in range(8)]  # random ones need far more to see enough
    others = [measured(head, at, x, some, options) for some in sets]
    assert np.sum(np.isfinite(others)) > 2
    assert found.final < np.median(others)


def measured_together(head, at, there, x, options):
    """What navigation itself predicts for beacons that are there and others at x (k, 3), all errors as they are."""
    k, joint = len(x), block_diagonal([there.cov, SIGMA**2 * np.eye(3 * len(x))])
    cross = np.hstack([there.cross_cov, np.zeros((len(head.cov), 3 * k))])
    ids = (*there.beacon_ids, *(f"p{i}" for i in range(k)))
    both = Beacons(ids, np.vstack([there.x_in_world, x]), joint, cross)
    weight = 1.0 / (6 * np.array([options.required_rotation] * 3 + [options.required_translation] * 3) ** 2)
    found = expected_precision(head, both, at, options.sigma_px)
    return max(np.diag(e.cov) @ weight for e in found), tuple(len(e.beacon_ids) for e in found)


def correlated_beacons(head, x, seed=7):
    """Beacons at x (m, 3) that share some of their errors, also with the calibration of the head."""
    rng, p, m = np.random.default_rng(seed), len(head.cov), 3 * len(x)
    scale = np.concatenate([np.sqrt(np.diag(head.cov)), np.full(m, 0.6 * SIGMA)])
    mix = rng.standard_normal((m, 12)) / 6
    F = np.zeros((p + m, p + 12 + m))
    F[:p, :p] = np.linalg.cholesky(head.cov + 1e-30 * np.eye(p))
    F[p:, :p] = scale[p:, None] * rng.standard_normal((m, p)) / (2 * np.sqrt(p))
    F[p:, p : p + 12], F[p:, p + 12 :] = scale[p:, None] * mix, np.diag(scale[p:])
    joint = F @ F.T
    return Beacons(tuple(f"B{i}" for i in range(len(x))), x, joint[p:, p:], joint[:p, p:])


def test_beacons_that_are_there_count_as_placed():
    head, at, x = wide_head(), poses(4), walls(60)
    there = correlated_beacons(head, x[:8])
    options = PlacementOptions(spacing=0.2)
    found = place_beacons(head, at, x, SIGMA, 5, options, there)
    measure, seen = measured_together(head, at, there, x[list(found.chosen)], options)
    assert found.final == pytest.approx(measure, rel=1e-4)
    assert found.seen == seen
    gaps = np.linalg.norm(x[list(found.chosen), None] - there.x_in_world, axis=2)
    assert gaps.min() > 0.2
    blind = place_beacons(head, at, x[8:], SIGMA, 5, PlacementOptions(at_least=0))  # as if nothing were there
    assert found.final < measured_together(head, at, there, x[8:][list(blind.chosen)], options)[0]
    one = place_beacons(head, at[:1], x, SIGMA, 1, PlacementOptions(at_least=2), there)
    assert one.seen[0] >= 2


def test_placement_beside_exhaustive_search():
    head, at, x = wide_head(), poses(1), walls(40, seed=5)
    options = PlacementOptions()
    lit = expected_precision(head, Beacons(tuple(map(str, range(40))), x, np.zeros((120, 120))), at, 0.2)[0].beacon_ids
    x = x[[int(i) for i in lit[:8]]]
    assert len(x) == 8
    found = place_beacons(head, at, x, SIGMA, 4, options)
    best = min(measured(head, at, x, some, options) for some in combinations(range(len(x)), 4))
    assert np.isfinite(best)
    assert found.final >= best * (1 - 1e-4)  # a vague prior makes the search's own number a trifle better
    assert found.final <= 1.3 * best


def test_placement_keeps_the_spacing():
    head, at, x = wide_head(), poses(4), walls(40)
    found = place_beacons(head, at, x, SIGMA, 6, PlacementOptions(spacing=0.3))
    assert found.final == pytest.approx(measured(head, at, x, found.chosen, PlacementOptions()), rel=1e-4)
    gaps = [np.linalg.norm(a - b) for a, b in combinations(x[list(found.chosen)], 2)]
    assert min(gaps) > 0.3


def test_impossible_placements_say_why():
    head, at = wide_head(), poses(3)
    with pytest.raises(SurveyError, match="offer more places, or turn the head less"):
        place_beacons(head, at, np.array([[5.0, 5, 5], [-5, -5, -5]]), SIGMA, 4, PlacementOptions())
    with pytest.raises(SurveyError, match="every pose has to see 3"):
        place_beacons(head, at, walls(60), SIGMA, 2, PlacementOptions())
    with pytest.raises(SurveyError, match="3 beacons are too few"):
        place_beacons(head, poses(8), walls(60), SIGMA, 3, PlacementOptions())


# -- tolerances --------------------------------------------------------------------------------------------------------


def with_pose_errors(head, position, attitude):
    """The head with independent errors of the cameras' places and attitudes alone."""
    from dataclasses import replace

    blocks = [np.diag([0.0] * len(c.lens) + [attitude**2] * 3 + [position**2] * 3) for c in head.cameras]
    return replace(head, cov=block_diagonal(blocks))


def test_parts_are_those_of_navigation_one_at_a_time():
    beacons = scattered_beacons(24, seed=4)
    at = poses(4)
    found = pose_budget(wide_head(), beacons, at)
    # with spots alone navigation's pose is this very estimator
    exact = Beacons(beacons.beacon_ids, beacons.x_in_world, np.zeros_like(beacons.cov))
    only = expected_precision(with_pose_errors(wide_head(), 0.0, 0.0), exact, at, 0.3)
    for k, e in enumerate(only):
        np.testing.assert_allclose(found.covariances(np.array([0.3, 0, 0, 0]))[k], e.cov, rtol=1e-6, atol=1e-15)
    # with everything it is weighted and better, but not by much
    sigmas = np.array([0.3, SIGMA, 0.2e-3, np.radians(0.02)])
    whole = Beacons(beacons.beacon_ids, beacons.x_in_world, SIGMA**2 * np.eye(72))
    full = expected_precision(with_pose_errors(wide_head(), sigmas[2], sigmas[3]), whole, at, 0.3)
    for k, e in enumerate(full):
        ratio = np.diag(e.cov) / found.variances(sigmas)[k]
        assert np.all(ratio <= 1.0 + 1e-9)
        assert np.all(ratio > 0.4)


@pytest.mark.slow
def test_tolerances_keep_the_requirement_in_simulation():
    beacons, at = scattered_beacons(24, seed=4), poses(3)
    found = pose_budget(wide_head(), beacons, at)
    planned = np.array([0.2, 0.1e-3, 0.1e-3, np.radians(0.01)])
    tolerances = pose_tolerances(found, REQUIRED, planned)
    for s, t in enumerate(tolerances):
        alone = np.zeros(4)
        alone[s] = t.alone
        assert np.max(found.variances(alone) / REQUIRED**2) == pytest.approx(1.0)
        beside = planned.copy()
        beside[s] = t.beside
        assert np.max(found.variances(beside) / REQUIRED**2) == pytest.approx(1.0)
    shared = np.array([t.shared for t in tolerances])
    assert np.all(found.variances(shared) <= REQUIRED**2 * (1 + 1e-9))
    n = 2000
    errors = simulate_poses(found, shared, n, seed=3)
    predicted = found.covariances(shared)
    for e, C in zip(errors, predicted, strict=True):
        mean = np.mean(np.einsum("ti,ij,tj->t", e, np.linalg.inv(C), e))
        low, high = chi2.ppf([0.001, 0.999], 6 * n) / n
        assert low < mean < high
        assert np.all(np.sqrt(np.mean(e**2, axis=0)) < REQUIRED * 1.05)
    none = pose_tolerances(found, REQUIRED * 1e-3, planned)
    assert all(np.isnan(t.beside) for t in none)


def test_an_open_pose_is_refused():
    beacons = scattered_beacons(2, seed=4)
    with pytest.raises(SurveyError, match="do not determine it"):
        pose_budget(mfns_head(), beacons, poses(1))


# -- figures 4 to 6 ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ERROR_KINDS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_figures_agree_within_one_percent_at_every_point(kind, seed):
    figure = error_figure(kind, BeaconField(nearest_m=0.1), seed=seed)
    assert np.abs(figure.deviation).max() < 0.01
    assert figure.controlled_se.max() < 0.004 * figure.controlled.max()
    # the plain simulation is as uncertain as it says
    assert np.abs((figure.rms - figure.analytic) / figure.rms_se).max() < 4.5
    assert figure.slope_monte_carlo == pytest.approx(figure.slope, rel=4 * figure.slope_se / figure.slope)


@pytest.mark.slow
def test_standard_errors_are_the_scatter_of_repeated_figures(monkeypatch):
    for kind, near in (("camera attitude", 0.1), ("beacon position", 0.3)):
        field = BeaconField(nearest_m=near)
        monkeypatch.setitem(SIZES, kind, np.array([1e-3]))
        runs = [error_figure(kind, field, 4000, seed) for seed in range(200)]
        plain, controlled = (np.array([getattr(r, a)[0] for r in runs]) for a in ("rms", "controlled"))
        said = np.mean([r.rms_se[0] for r in runs])
        assert np.std(plain) == pytest.approx(said, rel=0.2)
        assert np.std(controlled) == pytest.approx(np.mean([r.controlled_se[0] for r in runs]), rel=0.25)
        assert np.mean(plain) == pytest.approx(np.mean(controlled), abs=4 * said / np.sqrt(200))
        assert np.std(controlled) < 0.3 * np.std(plain)


def test_without_a_nearest_depth_few_trials_carry_the_sum():
    figure = error_figure("beacon position", BeaconField())
    assert np.isnan(figure.controlled).all()
    assert np.median(figure.effective) < 200  # of 10,000
    assert np.median(error_figure("camera attitude", BeaconField()).effective) > 9000
    far = error_figure("beacon position", BeaconField(nearest_m=0.5))
    assert np.median(far.effective) > 5000
