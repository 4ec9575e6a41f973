"""The prediction of images by an adjustment: that of the adjustment itself, with all its terms."""

from dataclasses import replace

import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.diagnosis.prediction import Prediction, adjusted_values
from adjust.model.survey import LensDrift, Tie, VectorParameter
from survey.simulate import resample, stereo
from tests.adjust.moving import board_before_cameras, clock, head_on_moving_table

FREE = ("warp_x", "scale_y", "expansion")


@pytest.mark.parametrize("drift", [LensDrift(("fx", "u0"), ("e05",)), LensDrift(("fx",), (), None, 20.0)])
def test_images_are_predicted_with_warp_and_drift(drift: LensDrift) -> None:
    survey, truth = stereo(3, n_pairs=9)
    (left, right), (board,) = survey.cameras, survey.targets
    free = tuple(x for x in right.lens.free if x != "fy")
    right = replace(right, lens=replace(right.lens, drift=drift, free=free, ties=(Tie("fy", "fx", 1.001),)))
    warp = VectorParameter(FREE, np.zeros(3), FREE)
    survey = replace(survey, cameras=(left, right), targets=(replace(board, warp=warp),),
                     temperatures={b.epoch_id: 15.0 + int(b.epoch_id[1:]) for b in survey.image_blocks})  # fmt: skip
    true = {("warp", "board"): np.array([4e-4, -8e-4, 60e-6]), ("lens_drift", "right", "e05"): np.array([5.0, -3.0]),
            ("lens_drift", "right"): np.array([0.8])}  # fmt: skip
    result = adjust(resample(survey, truth | true, 2))
    predicted, ptr = Prediction(result.survey, adjusted_values(result)), result.image_residuals.block_ptr
    for i, block in enumerate(result.survey.image_blocks):
        uv = predicted.uv(block)
        assert uv is not None
        v = result.image_residuals.residuals[ptr[i] : ptr[i + 1]]
        np.testing.assert_allclose(uv - block.uv, v, atol=1e-6)


@pytest.mark.parametrize(
    ("made", "tolerance"),
    [
        (lambda: board_before_cameras(10, {"right": clock(0.01, offset=0.03, drift=0.01)},
                                      {("camera_clock", "right"): np.array([0.03, 0.01])}), 1e-6),
        (lambda: head_on_moving_table(12, {"left": clock(offset=0.03)}, {("camera_clock", "left"): np.array([0.03])}),
         0.02),  # poses between readings, not angles
    ],
    ids=["board", "table"],
)  # fmt: skip
def test_images_are_predicted_when_cameras_expose(made, tolerance: float) -> None:
    result = adjust(made()[0])
    predicted, ptr = Prediction(result.survey, adjusted_values(result)), result.image_residuals.block_ptr
    for i, block in enumerate(result.survey.image_blocks):
        uv = predicted.uv(block)
        assert uv is not None
        v = result.image_residuals.residuals[ptr[i] : ptr[i + 1]]
        np.testing.assert_allclose(uv - block.uv, v, atol=tolerance)
