"""What is told beforehand of planted weaknesses of several sizes and kinds, and what is not told of sound surveys."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from gtsam import Pose3, Rot3

from adjust.diagnosis.beforehand import Finding, coverage, look_beforehand
from adjust.model.observations import Coordinates, Distance, ImageBlock, PositionRef
from adjust.model.survey import FloatArray, PointParameter, PoseParameter, Survey
from survey.simulate import beacons, head_on_table, resample, single_camera, stereo
from tests.adjust.planted import hall, reread
from tests.sizes import size


def found(survey: Survey) -> dict[str, Finding]:
    return {f.kind: f for f in look_beforehand(survey).findings}


def views(tilts_deg: Sequence[float], distances_m: Sequence[float], seed: int = 1) -> Survey:
    """One camera before a board, turned by these angles about axes across the line of sight, at these distances."""
    survey, truth = single_camera(seed, n_images=len(tilts_deg))
    rng, x = np.random.default_rng(seed), survey.targets[0].x_in_target
    middle, new = 0.5 * (x.min(axis=0) + x.max(axis=0)), dict(truth)
    for block, tilt, distance in zip(survey.image_blocks, np.radians(tilts_deg), distances_m, strict=True):
        axis = rng.uniform(0.0, 2.0 * np.pi)
        R = Rot3.Expmap(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
        off = distance * np.append(rng.uniform(-0.15, 0.15, 2), 1.0)
        new["carrier_from_target", "board", block.epoch_id] = Pose3(R, off - R.matrix() @ middle)
    return resample(survey, new, seed)


def test_sound_views_of_this_kind_tell_nothing() -> None:
    kinds = found(views([25.0, 35.0, 45.0, 20.0, 40.0, 30.0, 50.0, 38.0], np.linspace(0.5, 0.8, 8).tolist()))
    assert not {"target too flat", "only frontal views", "focal length hardly known", "few views"} & set(kinds)


@pytest.mark.parametrize("tilt", [70.0, 75.0, 80.0])
def test_a_target_that_is_seen_too_flat(tilt: float) -> None:
    survey = views([25.0, 35.0, 45.0, tilt, 20.0, 40.0], [0.6] * 6)
    assert found(survey)["target too flat"].ids == ("C1/e04",)


@pytest.mark.parametrize("tilt", [0.0, 3.0, 7.0])
def test_only_frontal_views_cannot_tell_focal_length_from_distance(tilt: float) -> None:
    kinds = found(views([tilt] * 8, np.linspace(0.5, 0.9, 8).tolist()))
    assert kinds["only frontal views"].level == "problem"
    assert kinds["only frontal views"].ids == ("C1",)


def test_a_focal_length_that_few_views_hardly_tell() -> None:
    """Boards tilted by little more than what is called frontal, small in the image."""
    kinds = found(views([11.0, 12.0, 10.5, 11.5, 12.0], [2.5] * 5))
    assert kinds["focal length hardly known"].ids == ("C1",)
    assert "target small in the image" in kinds


@pytest.mark.parametrize("distance", [2.5, 4.0, 8.0])
def test_a_board_too_far(distance: float) -> None:
    survey = views([25.0, 35.0, 45.0, 30.0, 20.0, 40.0], [0.6] * 5 + [distance])
    assert found(survey)["target small in the image"].ids == ("C1/e06",)
    if distance > 3.0:
        assert found(survey)["target too far"].ids == ("C1/e06",)


def without(survey: Survey, gone: Callable[[FloatArray], FloatArray]) -> Survey:
    def part(b: ImageBlock) -> ImageBlock:
        return b.part(~np.asarray(gone(b.uv), dtype=np.bool_))

    return replace(survey, image_blocks=tuple(part(b) for b in survey.image_blocks))


@pytest.mark.parametrize(("corner", "su", "sv"), [("top left", -1, -1), ("bottom right", 1, 1)])
def test_a_corner_without_points(corner: str, su: int, sv: int) -> None:
    survey, _ = single_camera(1)
    middle = (np.array(survey.cameras[0].image_size) - 1.0) / 2.0
    empty = without(survey, lambda uv: ((uv - middle) * [su, sv] > 0.3 * middle).all(axis=1))
    finding = found(empty)["corner not covered"]
    assert corner in finding.found
    said = coverage(empty)["C1"]
    assert said["corners_empty"] == [corner]
    assert said["share"] > 0.5
    assert set(said["images"]) == {b.epoch_id for b in empty.image_blocks}
    assert all(0.0 < share < 1.0 for share in said["images"].values())


def still(survey: Survey, amount: float) -> Survey:
    """The board is said to stand still; its poses differ from the first one by this share of what they do."""
    truth = stereo(1)[1]
    names = [n for n in truth if n[0] == "carrier_from_target"]
    first = truth[names[0]]
    assert isinstance(first, Pose3)
    new = truth | {n: first.compose(Pose3.Expmap(amount * Pose3.Logmap(first.between(truth[n])))) for n in names}
    made = resample(survey, new, 1)
    board = replace(made.targets[0], motion="fixed", epochs={}, carrier_from_target=PoseParameter())
    return replace(made, targets=(board,))


@pytest.mark.parametrize("amount", [1.0, 0.3, 0.1])
def test_a_forgotten_motion(amount: float) -> None:
    finding = found(still(stereo(1)[0], amount))["motion forgotten"]
    assert finding.ids == ("board",)
    assert 'motion = "epoch"' in finding.remedy


def test_a_board_that_stands_still_is_not_said_to_move() -> None:
    assert "motion forgotten" not in found(still(stereo(1)[0], 0.0))


@pytest.mark.parametrize("factor", [10.0, 0.1, 0.01])
@pytest.mark.parametrize("kind", ["slope_distance", "direction", "zenith"])
@pytest.mark.parametrize("seed", [1, 2])
def test_a_reading_whose_decimal_point_slipped(kind: str, factor: float, seed: int) -> None:
    good = hall(seed)
    mine = [r for r in good.readings if r.kind == kind and abs(r.value) > 0.3 and abs(factor * r.value) < 1e3]
    chosen = mine[len(mine) // 2].reading_id
    wrong = reread(good, lambda r: r.reading_id == chosen, lambda v: factor * v)
    assert found(wrong)["slipped decimal"].ids == (chosen,)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [10.0, 0.1, 100.0])
def test_a_distance_and_a_coordinate_whose_decimal_point_slipped(factor: float) -> None:
    good = hall(1)
    expected = look_beforehand(good).expected
    assert expected is not None
    x = {p.point_id: np.asarray(p.x_in_world.value) for p in expected.survey.points}
    a, b = sorted(x)[2:4]  # free ones
    length = float(np.linalg.norm(x[b] - x[a]))
    tape = Distance("tape", PositionRef(a), PositionRef(b), factor * length, 1e-3)
    assert found(replace(good, distances=(tape,)))["slipped decimal"].ids == ("tape",)
    slipped = x[a].copy()
    slipped[0] *= factor
    seen = Coordinates((PositionRef(a),), slipped[None], 1e-6 * np.eye(3))
    told = found(replace(good, coordinates=(seen,))).get("slipped decimal")
    assert told is None or told.ids == (a,)  # start values come from it: what else is named is innocent


@pytest.mark.parametrize("factor", [10.0, 0.1])
def test_a_given_coordinate_whose_decimal_point_slipped(factor: float) -> None:
    good = hall(1)
    point = next(p for p in good.points if p.x_in_world.treatment != "free"
                 and abs(np.asarray(p.x_in_world.value)[:2]).max() > 2.0)  # fmt: skip
    x = np.array(point.x_in_world.value)
    x[np.argmax(abs(x[:2]))] *= factor
    given = PointParameter(x, point.x_in_world.treatment, point.x_in_world.prior_cov)
    points = tuple(replace(p, x_in_world=given) if p is point else p for p in good.points)
    assert found(replace(good, points=points))["slipped decimal"].ids == (point.point_id,)


def test_a_target_that_a_single_image_shows() -> None:
    survey, _ = stereo(1)
    spare = replace(survey.targets[0], target_id="plate", motion="fixed")
    block = replace(survey.image_blocks[0], target_id="plate")
    lonely = replace(survey, targets=(*survey.targets, spare), image_blocks=(*survey.image_blocks, block))
    assert found(lonely)["id appears once"].ids == ("plate",)


@pytest.mark.parametrize("seed", range(1, 9))
def test_sound_surveys_have_no_findings_but_the_stereo_pair_that_covers_too_little(seed: int) -> None:
    for survey in (hall(seed), hall(seed, plane=True), single_camera(seed)[0]):
        assert look_beforehand(survey).findings == ()
    assert {f.kind for f in look_beforehand(stereo(seed)[0]).findings} <= {"image not covered", "corner not covered"}


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 1 + size(8, 3)))  # laying out a head takes a second
def test_sound_heads_on_tables_have_no_problem(seed: int) -> None:
    for survey in (head_on_table(seed)[0], beacons(seed)[0]):
        assert [f for f in look_beforehand(survey).findings if f.level == "problem"] == []
