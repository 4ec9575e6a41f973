"""Designs: predicted covariances against adjustments and re-solves, selection against exhaustive search, budgets."""

from dataclasses import replace
from functools import cache
from itertools import combinations, pairwise

import numpy as np
import pytest

from adjust.adjustment import AdjustOptions, adjust
from adjust.design import (
    Candidate,
    Component,
    Seeing,
    budget,
    components_of,
    exact,
    expect,
    group_redundancy,
    predict,
    run_trials,
    select,
    shared_names,
    tolerances,
    weak_directions,
    with_candidates,
)
from adjust.design.candidates import design_matrix, inform
from adjust.model.errors import IndeterminateError, SurveyError
from adjust.model.observations import Coordinates, Distance, ImageBlock, PositionRef
from adjust.model.survey import Point, PointParameter
from survey.simulate import LabSize, beacons, full_lab, single_camera
from survey.simulate.labs import WITHOUT_COORDINATES
from survey.simulate.scene import Scene
from tests.adjust.helpers import start_at

SIZE = LabSize(n_table_epochs=6, n_free_epochs=3, n_wall_epochs=4, n_night_epochs=3, n_charuco_epochs=4)
LENS = ("lens", "X")
MOUNT = ("station_from_camera", "X")


@pytest.fixture(scope="module")
def lab():
    survey, truth = full_lab(1, size=SIZE)
    return survey, start_at(truth), truth


@pytest.fixture(scope="module")
def walls():
    """Head, table, board and ten beacons, with night images; small."""
    survey, truth = beacons(3, n_table_epochs=6, n_free_epochs=3, n_night_epochs=5)
    return survey, start_at(truth), truth


def all_blocks(survey):
    """Every block with all points there are, visible or not."""
    sizes = {None: len(survey.points), **{t.target_id: len(t.point_ids) for t in survey.targets}}
    out = []
    for b in survey.image_blocks:
        n = sizes[b.target_id]
        out.append(replace(b, point_idx=np.arange(n), uv=np.zeros((n, 2)), cov=np.tile(0.01 * np.eye(2), (n, 1, 1))))
    return out


@pytest.mark.slow
def test_predicted_images_are_those_of_opencv_and_what_it_sees_is_seen(lab):
    survey, start, truth = lab
    scene = Scene(survey, truth)
    found = {(b.camera_id, b.epoch_id, b.target_id): b for b in predict(survey, start, all_blocks(survey), Seeing())}
    assert len(found) == len(survey.image_blocks)
    for block in survey.image_blocks:
        b = found[block.camera_id, block.epoch_id, block.target_id]
        x = scene.world_points() if b.target_id is None else scene.target_points(b.target_id, b.epoch_id)
        assert b.point_idx.tolist() == block.point_idx.tolist()
        np.testing.assert_allclose(b.uv, scene.project(b.camera_id, b.epoch_id, x[b.point_idx]), atol=1e-9)


@pytest.mark.slow
def test_visibility_obeys_depth_incidence_side_and_number(walls):
    survey, start, truth = walls
    scene = Scene(survey, truth)
    wanted = [b for b in all_blocks(survey) if b.target_id is not None]
    seen = predict(survey, start, wanted, Seeing())
    angles, depths = {}, {}
    for b in seen:
        in_camera = np.linalg.inv(scene.world_from_camera(b.camera_id, b.epoch_id)) @ scene.world_from_target("board")
        x = np.column_stack([survey.targets[0].x_in_target[b.point_idx], np.ones(len(b.point_idx))]) @ in_camera.T
        sight = x[:, :3] / np.linalg.norm(x[:, :3], axis=1)[:, None]
        key = (b.camera_id, b.epoch_id)
        angles[key], depths[key] = np.degrees(np.arccos(sight @ in_camera[:3, 2])), x[:, 2]
    limit = float(np.median(np.concatenate(list(angles.values()))))
    seeing = Seeing(widest_incidence=np.radians(limit), fewest_points=1)
    partly = predict(survey, start, wanted, seeing)
    assert sum(len(b.uv) for b in partly) == sum(int((a <= limit).sum()) for a in angles.values())
    deep = float(np.median(np.concatenate(list(depths.values()))))
    near = predict(survey, start, wanted, Seeing(farthest_m=deep, fewest_points=1))
    assert sum(len(b.uv) for b in near) == sum(int((d <= deep).sum()) for d in depths.values())
    few = predict(survey, start, wanted, Seeing(farthest_m=deep, fewest_points=20))
    assert {(b.camera_id, b.epoch_id) for b in few} == {k for k, d in depths.items() if (d <= deep).sum() >= 20}
    flipped = tuple(replace(t, x_in_target=t.x_in_target * (1, -1, 1)) for t in survey.targets)
    turned = replace(survey, targets=flipped)
    pose = start.poses["carrier_from_target", "board"]
    from gtsam import Pose3, Rot3

    over = {**start.poses, ("carrier_from_target", "board"): pose * Pose3(Rot3.Rx(np.pi), np.zeros(3))}
    targets = tuple(
        replace(t, carrier_from_target=replace(t.carrier_from_target, value=over["carrier_from_target", "board"]))
        for t in flipped
    )
    turned = replace(turned, targets=targets)
    assert predict(turned, replace(start, poses=over), wanted, Seeing()) == ()
    both = predict(turned, replace(start, poses=over), wanted, Seeing(two_sided=("board",)))
    assert sum(len(b.uv) for b in both) == sum(len(b.uv) for b in seen)


def test_expectation_is_the_covariance_of_an_adjustment_and_of_the_dense_design(lab):
    survey, start, _ = lab
    planned = expect(survey, start)
    assert planned.omega == 0.0
    assert planned.redundancy == adjust(survey, start, AdjustOptions(reject_blocks=False)).redundancy
    ideal = exact(survey, start)
    solved = adjust(ideal, start)  # the same design, its observations at the truth
    assert solved.omega < 1e-12
    dense = design_matrix(ideal, start)
    Q = np.linalg.inv((dense.A.T @ dense.A).toarray())
    for name, estimate in planned.estimates.items():
        np.testing.assert_allclose(estimate.cov, solved.estimates[name].cov, rtol=1e-7, atol=1e-22)
        if name in dense.columns.at and len(estimate.cov) == len(dense.columns.at[name]):
            s = np.sqrt(np.diag(estimate.cov))
            at = dense.columns.at[name]
            np.testing.assert_allclose(Q[np.ix_(at, at)] / np.outer(s, s), estimate.cov / np.outer(s, s), atol=1e-6)
    groups = group_redundancy(planned)
    assert sum(n for n, _, _ in groups.values()) == planned.n_observations
    assert sum(r for _, r, _ in groups.values()) == pytest.approx(planned.redundancy, abs=1e-5)
    assert all(low > -1e-9 and high < 1.0 + 1e-9 for _, _, (low, _, high) in groups.values())


def test_values_of_observations_do_not_matter(walls):
    survey, start, _ = walls
    rng = np.random.default_rng(1)
    moved = replace(
        survey,
        image_blocks=tuple(replace(b, uv=b.uv + rng.normal(0, 50, b.uv.shape)) for b in survey.image_blocks),
        distances=tuple(replace(d, value=1.0) for d in survey.distances),
        table_readings=tuple(replace(r, angles=r.angles + 1.0) for r in survey.table_readings),
    )
    a, b = expect(survey, start), expect(moved, start)
    for name in a.estimates:
        np.testing.assert_array_equal(a.estimates[name].cov, b.estimates[name].cov)


def test_what_is_not_determined_is_named(walls):
    survey, start, _ = walls
    loose = tuple(
        replace(t, carrier_from_target=replace(t.carrier_from_target, treatment="free")) for t in survey.targets
    )
    day = tuple(b for b in survey.image_blocks if b.target_id is not None)
    with pytest.raises(IndeterminateError, match="position along world x, y, z and the rotation about world x, y, z"):
        expect(replace(survey, targets=loose, coordinates=(), distances=(), points=(), image_blocks=day), start)


def test_weak_directions_are_named_by_what_moves(walls):
    survey, start, _ = walls
    planned = expect(survey, start)
    found = weak_directions(planned, least=1.0)
    names = shared_names(planned)
    Q = planned.precision.joint(names)
    N = np.linalg.inv(Q)
    # of the direction v: v' Q v over what v would have if the unknowns were independent with their own N_ii
    s = 1.0 / np.sqrt(np.diag(N))
    largest = np.linalg.eigvalsh(Q / np.outer(s, s))[-1]
    assert found[0].factor == pytest.approx(np.sqrt(largest), rel=1e-3)
    assert all(a.factor >= b.factor for a, b in pairwise(found))
    assert all(abs(p[2]) <= 1.0 for d in found for p in d.parts)
    assert max(abs(p[2]) for p in found[0].parts) == 1.0


# -- selection ---------------------------------------------------------------------------------------------------------


def split(survey, epochs):
    """The survey without these epochs, and a candidate for each of them."""
    base = replace(
        survey,
        image_blocks=tuple(b for b in survey.image_blocks if b.epoch_id not in epochs),
        table_readings=tuple(r for r in survey.table_readings if r.epoch_id not in epochs),
    )
    out = [
        Candidate(
            e, "epoch",
            tuple(b for b in survey.image_blocks if b.epoch_id == e),
            tuple(r for r in survey.table_readings if r.epoch_id == e),
        )
        for e in epochs
    ]  # fmt: skip
    return base, out


def new_beacon(survey, start, number, epochs, sigma_m=None):
    """A beacon that nobody planned, seen in some night images, with surveyed coordinates or without."""
    rng = np.random.default_rng(number)
    name = f"N{number}"
    old = start.points["B01"]
    x = old + rng.normal(0.0, 0.15, 3)
    start = replace(start, points={**start.points, name: x})
    night = [b for b in survey.image_blocks if b.target_id is None and b.epoch_id in epochs]
    n = len(survey.points)
    point = Point(name, PointParameter(x))
    blocks = [
        ImageBlock(b.camera_id, b.epoch_id, None, np.array([n]), np.zeros((1, 2)), 0.01 * np.eye(2)[None])
        for b in {(b.camera_id, b.epoch_id): b for b in night}.values()
    ]
    coordinates = ()
    if sigma_m is not None:
        coordinates = (Coordinates((PositionRef(name),), x[None], sigma_m**2 * np.eye(3)),)
    one = Candidate(name, "beacon", tuple(blocks), coordinates=coordinates, points=(point,))
    seen = predict(with_candidates(survey, [one]), start, one.image_blocks, Seeing(margin_px=0))
    return replace(one, image_blocks=seen), start


@pytest.fixture(scope="module")
def choices(walls):
    """A base design and seven candidates of all kinds."""
    survey, start, _ = walls
    table = [r.epoch_id for r in survey.table_readings]
    by_hand = [b.epoch_id for b in survey.image_blocks if b.epoch_id not in table]
    rough = {i for i, p in enumerate(survey.points) if p.point_id in WITHOUT_COORDINATES}
    images = [b for b in survey.image_blocks if b.target_id is None]
    needed = {b.epoch_id for b in images if rough & set(b.point_idx.tolist())}
    spare = next(b.epoch_id for b in images if b.epoch_id not in needed)
    base, candidates = split(survey, [table[1], by_hand[0], spare, table[3]])
    kept = list({b.epoch_id: None for b in images if b.epoch_id != spare})
    for number, sigma in ((1, 3e-4), (2, None)):
        beacon, start = new_beacon(base, start, number, kept, sigma)
        candidates.append(beacon)
    ends = (PositionRef("B02"), PositionRef("B07"))
    candidates.append(Candidate("tape", "distance", distances=(Distance("tape", *ends, 1.0, 2e-4),)))
    return base, start, candidates


def ln_det(adjustment, wanted):
    names = tuple(dict.fromkeys(c.name for c in wanted))
    labels = [(n, c) for n in names for c in adjustment.precision.graph.unknowns.by_name[n].components]
    index = [labels.index((c.name, c.component)) for c in wanted]
    Q = adjustment.precision.joint(names)[np.ix_(index, index)]
    return np.linalg.slogdet(Q)[1], np.diag(Q)


@pytest.mark.slow
def test_updates_are_what_solving_again_gives(choices):
    base, start, candidates = choices
    planned = expect(base, start)
    wanted = (*components_of(planned, [LENS, MOUNT]), Component(("point", "B03"), "z", "m"))
    everything = components_of(planned, inform(base, start, candidates, [LENS, MOUNT, ("point", "B03")]).names)
    found = select(base, start, candidates, wanted, 1, "D", planned)
    before, variances = ln_det(planned, wanted)
    np.testing.assert_allclose(found.sigmas, np.sqrt(variances), rtol=1e-6)
    for gain in found.first:
        again = expect(with_candidates(base, [candidates[gain.candidate_idx]]), start)
        after, new = ln_det(again, wanted)
        assert gain.ln_det == pytest.approx(before - after, abs=2e-6)
        assert gain.ln_det_all == pytest.approx(ln_det(planned, everything)[0] - ln_det(again, everything)[0], abs=2e-5)
        np.testing.assert_allclose(gain.sigmas, np.sqrt(new), rtol=1e-6)
        assert gain.mean_variance == pytest.approx(np.mean(1.0 - new / variances), abs=1e-6)
        assert gain.ln_det_all >= gain.ln_det - 1e-6
    assert [g.ln_det for g in found.first] == sorted((g.ln_det for g in found.first), reverse=True)


@pytest.fixture(scope="module")
def told(choices):
    """``ln_det`` of LENS and MOUNT with some of the candidates: found once, whatever is asked of it."""
    base, start, candidates = choices

    @cache
    def of(chosen):
        adjustment = expect(with_candidates(base, [candidates[i] for i in chosen]), start)
        return ln_det(adjustment, components_of(adjustment, [LENS, MOUNT]))

    return of


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["D", "A"])
def test_greedy_choice_beside_exhaustive_search(choices, told, criterion):
    base, start, candidates = choices
    planned = expect(base, start)
    wanted = components_of(planned, [LENS, MOUNT])
    found = select(base, start, candidates, wanted, 3, criterion, planned)
    before, variances = ln_det(planned, wanted)

    def worth(chosen):
        after, new = told(tuple(chosen))
        return before - after if criterion == "D" else float(np.mean(1.0 - new / variances))

    singles = [worth([i]) for i in range(len(candidates))]
    assert found.steps[0].candidate_idx == int(np.argmax(singles))
    taken = [g.candidate_idx for g in found.steps]
    assert len(set(taken)) == 3
    assert sum(g.value(criterion) for g in found.steps) == pytest.approx(worth(taken), rel=1e-5)
    best = max(worth(list(c)) for c in combinations(range(len(candidates)), 2))
    two = sum(g.value(criterion) for g in found.steps[:2])
    assert two >= (1 - 1 / np.e) * best  # what greedy choice of a submodular gain is sure of; here it is far better
    assert two >= 0.95 * best


def test_free_networks_are_updated_in_their_own_datum(walls):
    """Inner constraints leave the covariance singular; a distance between its points is judged all the same."""
    survey, start, _ = walls
    free = replace(
        survey, image_blocks=tuple(b for b in survey.image_blocks if b.target_id is None), coordinates=(),
        targets=(), datum=replace(survey.datum, kind="inner"),
    )  # fmt: skip
    night = {b.epoch_id for b in free.image_blocks}
    free = replace(free, table_readings=tuple(r for r in free.table_readings if r.epoch_id in night),
                   cameras=tuple(replace(c, lens=replace(c.lens, free=(), values=start.lenses[c.camera_id]))
                                 for c in free.cameras))  # fmt: skip
    ends = (PositionRef("B02"), PositionRef("B07"))
    tape = Candidate("tape", "distance", distances=(Distance("tape", *ends, 1.0, 2e-5),))
    planned = expect(free, start)
    assert planned.datum_defect == 6
    wanted = components_of(planned, [("point", "B03"), ("point", "B08")])
    found = select(free, start, [tape], wanted, 1, "A", planned)
    again = expect(with_candidates(free, [tape]), start)
    np.testing.assert_allclose(found.after**2, ln_det(again, wanted)[1], rtol=1e-6)
    assert np.all(found.after < found.sigmas)


def test_candidates_that_share_something_new_are_refused(choices):
    base, start, candidates = choices
    epoch = next(c for c in candidates if c.table_readings)
    twin = Candidate("again", "epoch", epoch.image_blocks[:1])
    with pytest.raises(SurveyError, match="both bring the new unknown table_angles turntable"):
        inform(base, start, [epoch, twin], [LENS])
    with pytest.raises(SurveyError, match="nothing to choose from"):
        select(base, start, [], components_of(expect(base, start), [LENS]), 1)


# -- budgets and trials ------------------------------------------------------------------------------------------------


def scaled(survey, group, factor):
    return replace(
        survey,
        image_blocks=tuple(
            replace(b, cov=b.cov * factor**2) if b.group == group else b for b in survey.image_blocks
        ),
        table_readings=tuple(
            replace(r, cov=r.cov * factor**2) if r.group == group else r for r in survey.table_readings
        ),
        coordinates=tuple(
            replace(c, cov=c.cov * factor**2) if c.group == group else c for c in survey.coordinates
        ),
        distances=tuple(
            replace(d, sigma=d.sigma * factor) if d.group == group else d for d in survey.distances
        ),
    )  # fmt: skip


@pytest.mark.slow
def test_budget_adds_up_and_tolerances_keep_the_requirement(walls):
    survey, start, _ = walls
    planned = expect(survey, start)
    wanted = components_of(planned, [MOUNT])
    shares = budget(planned, wanted)
    np.testing.assert_allclose(shares.sigmas, np.sqrt(np.diag(planned.estimates[MOUNT].cov)), rtol=1e-6)
    assert set(shares.groups) == {"image", "table", "coordinates", "distance"}
    required = {k: 1.5 * s for k, s in enumerate(shares.sigmas)}
    for t in tolerances(shares, required):
        again = expect(scaled(survey, t.group, t.alone), start)
        sigma = np.sqrt(np.diag(again.estimates[MOUNT].cov))
        assert np.all(sigma <= 1.5 * shares.sigmas * (1 + 1e-9))  # weighed anew it is better still
        # with the weights as they were, the requirement is just met: an estimator that is told the old sigmas
        factor = np.array([t.alone if g == t.group else 1.0 for g in shares.groups])
        total = np.sqrt(np.sum(factor[:, None] ** 2 * shares.variances, axis=0))
        assert np.max(total / (1.5 * shares.sigmas)) == pytest.approx(1.0)
    together = np.array([t.together for t in tolerances(shares, required)])
    total = np.sqrt(np.sum(together[:, None] ** 2 * shares.variances, axis=0))
    assert np.all(total <= 1.5 * shares.sigmas * (1 + 1e-9))
    impossible = tolerances(shares, {0: 1e-9})
    assert all(np.isnan(t.alone) for t in impossible)
    with pytest.raises(SurveyError, match="no precision is required"):
        tolerances(shares, {})


@pytest.mark.slow
def test_scatter_of_simulated_surveys_is_the_predicted_covariance(walls):
    survey, start, _ = walls
    ideal = exact(survey, start)
    planned = expect(survey, start)
    done = []
    found = run_trials(ideal, start, planned, 16, seed=5, n_workers=1, progress=done.append)
    assert not found.failed
    assert done[-1] == 16
    assert found.passed, (found.mean_square, found.band)
    assert found.dof == found.errors.shape[1]
    assert np.mean(found.omega) == pytest.approx(planned.redundancy, abs=4 * np.sqrt(2 * planned.redundancy / 16))
    assert np.median(found.ratios) == pytest.approx(1.0, abs=0.1)
    # a covariance that is a third too small is noticed
    loud = run_trials(exact(scaled(survey, "image", 1.2), start), start, planned, 8, seed=5, n_workers=1)
    assert not loud.passed


@pytest.mark.slow
def test_trials_are_the_same_whoever_shares_them():
    survey, truth = single_camera(1, n_images=4)
    start = start_at(truth)
    ideal, planned = exact(survey, start), expect(survey, start)
    one = run_trials(ideal, start, planned, 12, seed=9, n_workers=1)
    two = run_trials(ideal, start, planned, 12, seed=9, n_workers=2)
    np.testing.assert_array_equal(one.errors, two.errors)
    np.testing.assert_array_equal(one.omega, two.omega)
    other = run_trials(ideal, start, planned, 12, seed=10, n_workers=1)
    assert not np.array_equal(one.errors, other.errors)


@pytest.mark.slow
def test_trials_that_cannot_be_adjusted_are_said():
    survey, truth = single_camera(1, n_images=3)
    start = start_at(truth)
    ideal = exact(scaled(survey, "image", 3e4), start)
    with pytest.raises(SurveyError, match="of 2 simulated surveys could be adjusted: the adjustment did not converge"):
        run_trials(ideal, start, expect(survey, start), 2, n_workers=1)
