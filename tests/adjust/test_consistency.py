"""Parts of a survey tested each for itself, and what a camera, target or table has of its own."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3
from scipy.stats import chi2

from adjust.adjustment import adjust
from adjust.model.names import natural_key
from adjust.model.result import GlobalTest
from adjust.model.survey import FloatArray, PoseParameter, Survey
from adjust.precision.precision import precision_of
from adjust.statistics.changes import ChangeSearch
from adjust.statistics.condensed import condensed_system
from adjust.statistics.consistency import consistency, eigenvalues, parts_of
from adjust.statistics.result import Change, Consistency
from adjust.statistics.system import linear_system
from adjust.testing.criteria import sidak
from adjust.testing.quadratic_forms import upper_tail, upper_tail_bound
from survey.simulate import head_on_table
from tests.adjust import helpers as h
from tests.adjust import statistics_networks as net
from tests.benchmarks import bundle
from tests.benchmarks.data import calibration, rough_start
from tests.benchmarks.data import survey as long_session

ARCSEC = np.pi / 180.0 / 3600.0


def lab(seed: int = 1, n_cameras: int = 2) -> tuple[Survey, h.StartValues]:
    survey, truth = head_on_table(seed, n_cameras=n_cameras, n_table_epochs=12, n_free_epochs=3)
    return survey, h.start_at(truth)


def consistent(survey: Survey, start: h.StartValues) -> Consistency:
    adjustment = adjust(survey, start)
    return consistency(adjustment, condensed_system(precision_of(adjustment)))


@pytest.mark.slow
@pytest.mark.parametrize(
    "weights",
    [np.r_[1.0, np.full(20, 0.1)], np.array([0.9, 0.5, 0.45, 0.2, 0.05]), np.r_[np.ones(40), np.linspace(0, 1, 20)]],
)
def test_the_tail_of_a_sum_of_weighted_squares(weights: FloatArray) -> None:
    """Against draws, far out too, where chi-square with the same two moments is several times too small."""
    drawn = (np.random.default_rng(1).standard_normal((200_000, len(weights))) ** 2) @ weights
    for p in (0.5, 0.05, 0.01, 0.001):
        x = float(np.quantile(drawn, 1.0 - p))
        assert upper_tail(x, weights) == pytest.approx(p, rel=0.05 + 3.0 / np.sqrt(p * 200_000))
        if p < 0.1:
            assert upper_tail_bound(x, float(weights.sum())) > 0.98 * p
    assert upper_tail(float(weights.sum()), weights) == pytest.approx(np.mean(drawn > weights.sum()), abs=0.03)
    assert upper_tail(-1.0, weights) == 1.0
    assert upper_tail(11.0, np.array([0.5, 0.5, 0.0])) == pytest.approx(chi2.sf(22.0, 2))


def test_mean_and_variance_of_a_part_are_those_of_its_quadratic_form() -> None:
    adjustment = adjust(*net.hall(3))
    condensed = condensed_system(precision_of(adjustment))
    system = condensed.system
    full = linear_system(adjustment)
    A = full.A.toarray()
    R = np.eye(len(A)) - A @ np.linalg.inv(A.T @ A) @ A.T
    for part in parts_of(adjustment, system, condensed.numbers):
        rows = np.flatnonzero(np.isin(full.row_of, part.members))
        own = R[np.ix_(rows, rows)]
        found = eigenvalues(system, rows, len(rows))
        assert found.sum() == pytest.approx(np.trace(own), rel=1e-6)
        assert found.sum() == pytest.approx(part.redundancy, rel=1e-6)
        assert (found**2).sum() == pytest.approx(np.sum(own**2), rel=1e-6)
        assert part.omega == pytest.approx(float(full.e[rows] @ full.e[rows]), rel=1e-6)


@pytest.mark.slow
def test_false_alarms_stay_within_the_level_of_the_family() -> None:
    """Of 60 networks without a fault 5 % fail one of their seven parts; 9 or more do with a probability of 0.3 %."""
    found = [consistent(*net.hall(seed)) for seed in range(60)]
    assert found[0].n_tests == 7
    assert found[0].level == pytest.approx(sidak(0.05, 7))
    assert sum(not x.fits for x in found) < 9
    p = np.array([part.p for x in found for part in x.parts])
    assert 0.4 < np.mean(p < 0.5) < 0.6
    assert np.mean(p < 0.05) < 0.08


def test_a_group_a_set_up_and_a_camera_with_larger_noise_are_named() -> None:
    """One of four kinds of readings has sigmas twice as large as said; then all readings of one set-up."""
    survey, start = net.hall(5, factors={"zenith": 4.0})
    found = consistent(survey, start)
    assert found.failing[0].kind == "group"
    assert found.failing[0].name == "zenith"
    assert "group zenith does not fit: its residuals are" in found.failing[0].text()

    survey, start = net.hall(6)
    exact, _ = net.hall(6, noise=False)
    wrong = tuple(
        replace(r, value=e.value + 2.5 * (r.value - e.value)) if r.setup_id == "setup S2" else r
        for r, e in zip(survey.readings, exact.readings, strict=True)
    )
    found = consistent(replace(survey, readings=wrong), start)
    assert (found.failing[0].kind, found.failing[0].name) == ("set-up", "setup S2")


def test_where_the_whole_does_not_fit_parts_are_tested_against_the_rest() -> None:
    """All sigmas half of what they should be: everything is too large, and nothing stands out."""
    survey, start = net.hall(4, factors=dict.fromkeys(net.SIGMAS, 4.0))
    adjustment = adjust(survey, start)
    assert adjustment.global_test is not None
    assert adjustment.global_test.status == "failed"
    found = consistent(survey, start)
    assert found.relative
    assert found.fits


@pytest.mark.slow
def test_a_lens_that_changes_is_named_with_its_epoch() -> None:
    """One camera's image 1 px to the right in the second half of its table epochs, as after another crop."""
    survey, start = lab()
    assert consistent(survey, start).fits
    readings = {r.epoch_id for r in survey.table_readings}
    camera = survey.image_blocks[-1].camera_id
    mine = sorted({b.epoch_id for b in survey.image_blocks if b.camera_id == camera} & readings, key=natural_key)
    late = mine[len(mine) // 2 :]
    moved = tuple(
        replace(b, uv=b.uv + np.array([1.0, 0.0])) if b.camera_id == camera and b.epoch_id in late else b
        for b in survey.image_blocks
    )
    found = consistent(replace(survey, image_blocks=moved), start)
    assert not found.fits
    worst = found.changes[0]
    assert (worst.kind, worst.name, worst.what, worst.epoch) == ("camera", camera, "lens", late[0])
    (u0,) = (s for s in worst.shifts if s.component == "u0")
    assert u0.amount == pytest.approx(1.0, abs=4 * u0.sigma)


@pytest.mark.slow
def test_a_change_is_looked_for_at_every_border_of_a_long_session() -> None:
    """400 epochs: from one of them on the lens distorts otherwise, 3 sigmas (0.3 px) at the edge of the image."""
    given, late = long_session(calibration(1, 400)), "e301"

    def distorted(uv: FloatArray) -> FloatArray:
        x = (uv - (640.0, 512.0)) / 640.0
        return uv + 0.3 * x * (x**2).sum(axis=1, keepdims=True)

    moved = tuple(
        replace(b, uv=distorted(b.uv)) if natural_key(b.epoch_id) >= natural_key(late) else b
        for b in given.image_blocks
    )
    adjustment = adjust(replace(given, image_blocks=moved))
    found = consistency(adjustment, condensed_system(precision_of(adjustment)))
    assert not found.left_out
    assert found.n_changes > 2 * 399
    assert (found.changes[0].what, found.changes[0].epoch) == ("lens", late)


@pytest.mark.slow
def test_a_table_that_slips_and_one_whose_circle_is_eccentric() -> None:
    survey, start = lab()
    wave = tuple(
        replace(r, angles=r.angles + 150.0 * ARCSEC * np.array([np.sin(r.angles[0] + 0.7), 0.0]))
        for r in survey.table_readings
    )
    found = consistent(replace(survey, table_readings=wave), start)
    worst = found.changes[0]
    assert (worst.kind, worst.what) == ("table", "reading of axis1")
    assert not found.fits
    epochs = sorted((r.epoch_id for r in survey.table_readings), key=natural_key)
    late = epochs[3 * len(epochs) // 4 :]
    slipped = tuple(
        replace(r, angles=r.angles + np.array([0.0, 90.0 * ARCSEC])) if r.epoch_id in late else r
        for r in survey.table_readings
    )
    adjustment = adjust(replace(survey, table_readings=slipped), start)
    search = ChangeSearch(adjustment, condensed_system(precision_of(adjustment)))
    (zero,) = (c for c in search.candidates if c.unit.what == "zero")
    j = zero.unit.epochs.index(late[0]) - 1
    # cameras that see a board in few directions might have changed as well: the estimate is what is asked here
    inverse = np.linalg.inv(zero.M[j])
    amount, sigma = -inverse @ zero.g[j] * zero.scale[j], np.sqrt(np.diag(inverse)) * zero.scale[j]
    np.testing.assert_array_less(np.abs(amount - np.array([0.0, 90.0 * ARCSEC])), 4.0 * sigma)
    assert amount[1] > 4.0 * sigma[1]
    assert not consistency(adjustment, search.condensed).fits


def with_a_prior(survey: Survey, pose: FloatArray) -> Survey:
    """Where the board was at one epoch is known beforehand, to a centimetre and 10 mrad."""
    (board,) = survey.targets
    known = PoseParameter(Pose3(pose), "prior", 1e-4 * np.eye(6))
    return replace(survey, targets=(replace(board, epochs={"e3": known}),))


def test_a_change_of_place_is_left_out_where_poses_of_its_own_take_it_over_and_only_there() -> None:
    """What all rows at once leave of a motion of each camera and target in the later epochs."""
    boards, hall = calibration(2, 6, (4, 4)), bundle.simulated(8, 30, 6)
    session, found = long_session(boards), []
    for survey, start in ((session, rough_start(boards)), (bundle.survey(hall), bundle.start(hall)),
                          (with_a_prior(session, boards.head_from_board[3]), rough_start(boards))):  # fmt: skip
        adjustment = adjust(survey, start)
        condensed = condensed_system(precision_of(adjustment))
        A, seen = condensed.system.A.toarray(), [survey.image_blocks[b] for b in condensed.block]
        search = {(c.unit.kind, c.unit.name) for c in ChangeSearch(adjustment, condensed).candidates
                  if c.unit.what == "position"}  # fmt: skip
        own = condensed.own
        of_target = [("target", t.target_id, own.target) for t in survey.targets]
        for kind, name, by_motion in [("camera", c.camera_id, own.camera) for c in survey.cameras] + of_target:
            mine = [name in (b.camera_id, b.target_id) and int(b.epoch_id[1:]) > 2 for b in seen]
            B = np.zeros((len(A), 6))
            B[: len(seen)][mine] = by_motion[mine]
            left = B - A @ np.linalg.lstsq(A, B, rcond=1e-12)[0]
            found.append(bool(np.linalg.norm(left) > 1e-6 * np.linalg.norm(B)))
            assert ((kind, name) in search) == found[-1]
    assert found == [True, True, False, False, True, True, True]


def test_the_status_of_a_global_test() -> None:
    for omega, status in ((50.0, "cautious"), (100.0, "passed"), (200.0, "failed")):
        test = GlobalTest(omega, 100, 0.05, 74.2, 129.6)
        assert test.status == status
        assert test.passed == (status == "passed")
        assert (test.warning(1.0) == "") == test.passed
    assert GlobalTest(50.0, 100, 0.05, 74.2, 129.6).warning(0.7).startswith("cautious sigmas: sigma0 = 0.700")


def test_names_are_sorted_as_people_do() -> None:
    assert sorted(["e10", "e2", "t1", "e2b"], key=natural_key) == ["e2", "e2b", "e10", "t1"]


def test_texts_of_changes() -> None:
    nothing = Change("camera", "A", "lens", "e7", 30.0, 2, 1e-7, ())
    assert nothing.text().startswith("camera A: its lens is not the one of the other epochs from e7 on")
