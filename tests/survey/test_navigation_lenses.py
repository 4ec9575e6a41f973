"""Navigation with lenses that change and images that are cropped: which lens is taken, and when none can be."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.frames.lens_times import LensTimes
from adjust.lenses.crops import cropped_lens
from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.survey import CROP, ImageCrop, LensDrift, Survey, VectorParameter
from adjust.navigation import Beacons, head_and_beacons
from survey.interop.cameras.values import mapped_lens
from survey.jobs.navigating.lenses import lenses_taken, with_images_left
from survey.jobs.navigating.task import require_one_time
from survey.simulate import Truth, resample, stereo
from tests.adjust.moving import clock

NAVIGATED = ["e07", "e08"]
GIVEN = ImageCrop(VectorParameter(CROP, np.array([0.5, 40.0, 20.0])), (500, 420))


def changing(drift: LensDrift | None, crops: dict[str, ImageCrop], n: int = 8) -> tuple[Survey, Survey, Truth]:
    """The survey, and the one that calibrates: without the navigated epochs."""
    survey, truth = stereo(3, n_pairs=n)
    lens = replace(survey.cameras[1].lens, drift=drift, crops=crops)
    survey = replace(survey, cameras=(survey.cameras[0], replace(survey.cameras[1], lens=lens)))
    survey = resample(survey, truth, 1)
    return survey, left(survey), truth


def left(survey: Survey) -> Survey:
    blocks = tuple(b for b in survey.image_blocks if b.epoch_id not in NAVIGATED)
    return with_images_left(survey, replace(survey, image_blocks=blocks))


def test_blocks_that_lose_their_first_images_begin_later_and_empty_ones_are_gone() -> None:
    survey, _, _ = changing(LensDrift(("fx",), ("e03", "e07")), {"e07": GIVEN})
    blocks = tuple(b for b in survey.image_blocks if b.epoch_id not in (*NAVIGATED, "e03"))
    after = with_images_left(survey, replace(survey, image_blocks=blocks)).cameras[1].lens
    assert after.drift is not None
    assert after.drift.begins == ("e04",)
    assert after.crops == {}


def test_the_lens_of_the_last_block_and_the_crop_that_is_given() -> None:
    survey, calibrating, _ = changing(LensDrift(("fx", "u0"), ("e04",)), {"e07": GIVEN})
    taken = lenses_taken(survey, calibrating, "bar", NAVIGATED)
    assert taken.epochs == {"right": "e06"}
    assert taken.crops == {"right": GIVEN}
    result = adjust(calibrating)
    none = Beacons(("-",), np.zeros((1, 3)), np.zeros((3, 3)))
    whole, _ = head_and_beacons(result, "bar", none, taken.epochs)
    head, _ = head_and_beacons(result, "bar", none, taken.epochs, taken.crops)
    right = calibrating.cameras[1]
    values = {n: np.asarray(e.value) for n, e in result.estimates.items()}
    lens = LensTimes(calibrating).lens(right, "e06", values.get)
    np.testing.assert_allclose(whole.cameras[1].lens, lens)
    assert not np.allclose(lens, values["lens", "right"])
    small = cropped_lens(MODELS["brown"], lens, head.cameras[1].constants, GIVEN.parameters.values)
    np.testing.assert_allclose(head.cameras[1].lens, small.values)
    assert head.cameras[1].image_size == (500, 420)
    at = len(lens) + 6 + MODELS["brown"].names.index("fx")
    own = result.estimates["lens", "right"]
    joint = np.asarray(result.precision.joint([("lens", "right"), ("lens_drift", "right", "e04")]))
    rows = [own.components.index("fx"), len(result.precision.graph.unknowns.by_name["lens", "right"].components)]
    expected = joint[np.ix_(rows, rows)].sum()
    assert whole.cov[at, at] == pytest.approx(expected, rel=1e-9)
    assert head.cov[at, at] == pytest.approx(0.25 * expected, rel=1e-9)


@pytest.mark.parametrize(
    ("drift", "crops", "said"),
    [
        (LensDrift(("fx",), ("e07",)), {}, "changes at epoch 'e07', between epoch 'e06'"),
        (None, {"e07": replace(GIVEN, parameters=replace(GIVEN.parameters, free=("left",)))}, "changes at epoch 'e07'"),
        (None, {"e03": GIVEN, "e08": GIVEN}, "changes at epoch 'e08'"),
        (None, {"e08": GIVEN}, "by themselves"),
    ],
)
def test_a_lens_that_nothing_calibrates_is_named(
    drift: LensDrift | None, crops: dict[str, ImageCrop], said: str
) -> None:
    survey, calibrating, _ = changing(drift, crops)
    with pytest.raises(SurveyError, match=said):
        lenses_taken(survey, calibrating, "bar", NAVIGATED)


def test_an_export_says_which_lens_it_holds() -> None:
    survey, _, truth = changing(LensDrift(("fx",), ("e04",)), {"e07": GIVEN})
    left_one, right = (mapped_lens(c, np.asarray(truth["lens", c.camera_id]), {"brown": MODELS["brown"].names})
                       for c in survey.cameras)  # fmt: skip
    assert left_one.note is None
    assert right.note == "camera right: its lens is written as it is of the first block of epochs and of whole images"


def test_epochs_that_were_seen_at_several_times_are_refused() -> None:
    """One camera that is late has its pose when it exposed; two would need two poses, and rows many."""
    survey, _ = stereo(3, n_pairs=4)
    assert require_one_time(survey, "bar") == ()
    left, right = survey.cameras
    late, rows = (replace(right, clock=clock(**{name: 0.01})) for name in ("offset", "line_time"))
    with pytest.raises(SurveyError, match=r"cameras\.right a clock.*one pose an epoch"):
        require_one_time(replace(survey, cameras=(left, late)), "bar")
    with pytest.raises(SurveyError, match="seen at different times"):
        require_one_time(replace(survey, cameras=(rows,)), "bar")
    (note,) = require_one_time(replace(survey, cameras=(late,)), "bar")
    assert "poses are those when it exposed" in note
