import numpy as np
import pytest

from adjust.lenses.conversion import convert, rebalance_aicon
from adjust.lenses.models import MODELS, default_start, lens_constants, project
from adjust.model.errors import SurveyError
from tests.adjust.lenses import IMAGE_SIZE, NAMES, PIXEL_SIZE_MM, R0_MM, lens, slopes

# an ordinary lens: 3 px of barrel in the corners, a little of everything else
BROWN = np.array([800.0, 800.4, 0.3, 322, 241, -0.08, 0.02, 0.0003, -0.0002, 0, 0, 0, 0])
PIXELS = lens_constants(MODELS["brown"], IMAGE_SIZE)


def constants_of(name, r0_mm=R0_MM):
    return lens_constants(MODELS[name], IMAGE_SIZE, PIXEL_SIZE_MM, r0_mm)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_a_lens_converted_to_its_own_model_is_itself(name):
    model, values, constants = lens(name)
    if name == "brown":
        values[10:] = 0.0
    converted = convert(model, values, constants, model, constants, IMAGE_SIZE)
    np.testing.assert_allclose(converted.values, values, rtol=1e-7, atol=1e-12)
    assert converted.largest_difference_px < 1e-9


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "allowed_px"),
    [("brown_backward", 0.02), ("brown_backward_dbat", 0.15), ("aicon", 0.02), ("fisheye", 0.25)],
)
def test_brown_converts_there_and_back_within_the_stated_difference(name, allowed_px):
    there = convert(MODELS["brown"], BROWN, PIXELS, MODELS[name], constants_of(name), IMAGE_SIZE)
    assert there.rms_px < there.largest_difference_px < allowed_px
    back = convert(MODELS[name], there.values, constants_of(name), MODELS["brown"], PIXELS, IMAGE_SIZE)
    uv = np.random.default_rng(4).uniform([0, 0], [639, 479], (300, 2))
    q = np.column_stack([slopes(MODELS["brown"], BROWN, PIXELS, uv), np.ones(300)])
    seen = project(MODELS[name], there.values, constants_of(name), q)
    assert np.linalg.norm(seen - uv, axis=1).max() <= there.largest_difference_px
    returned = project(MODELS["brown"], back.values, PIXELS, q)
    assert np.linalg.norm(returned - uv, axis=1).max() <= there.largest_difference_px + back.largest_difference_px


def test_the_largest_difference_is_where_it_is_said_to_be():
    there = convert(MODELS["brown"], BROWN, PIXELS, MODELS["fisheye"], PIXELS, IMAGE_SIZE)
    uv = np.array([there.largest_at])
    q = np.column_stack([slopes(MODELS["brown"], BROWN, PIXELS, uv), [1.0]])
    difference = np.linalg.norm(project(MODELS["fisheye"], there.values, PIXELS, q) - uv)
    assert difference == pytest.approx(there.largest_difference_px, rel=1e-9)


@pytest.mark.parametrize("name", ["brown_backward", "aicon"])
def test_affinity_and_skew_convert_exactly(name):
    values = default_start(MODELS["brown"], IMAGE_SIZE, 800.0)
    values[:5] = 800.0, 820.0, 5.0, 330.0, 235.0
    there = convert(MODELS["brown"], values, PIXELS, MODELS[name], constants_of(name), IMAGE_SIZE)
    assert there.largest_difference_px < 1e-9
    assert there.values[0] == pytest.approx(8.2)
    expected = (820 / 800 - 1, 5 / 800) if name == "brown_backward" else (800 / 820 - 1, -5 / 820)
    np.testing.assert_allclose(there.values[8:10], expected, rtol=1e-10)
    back = convert(MODELS[name], there.values, constants_of(name), MODELS["brown"], PIXELS, IMAGE_SIZE)
    np.testing.assert_allclose(back.values, values, atol=1e-9)


def test_skew_is_lost_in_dbats_model_and_the_difference_says_so():
    values = default_start(MODELS["brown"], IMAGE_SIZE, 800.0)
    values[2] = 5.0
    there = convert(
        MODELS["brown"], values, PIXELS, MODELS["brown_backward_dbat"], constants_of("brown_backward_dbat"), IMAGE_SIZE
    )
    assert 0.2 < there.rms_px < 5 * 240 / 800


@pytest.mark.parametrize("r0_mm", [0.0, 1.0, 3.0])
def test_aicon_keeps_its_image_when_it_is_balanced_elsewhere(r0_mm):
    model, values, constants = lens("aicon")
    other = constants_of("aicon", r0_mm)
    moved = rebalance_aicon(values, R0_MM, r0_mm)
    q = np.column_stack([slopes(model, values, constants, np.array([[0, 0], [500, 30], [639, 479.0]])), np.ones(3)])
    np.testing.assert_allclose(project(model, moved, other, q), [[0, 0], [500, 30], [639, 479.0]], atol=1e-9)
    assert convert(model, values, constants, model, other, IMAGE_SIZE).largest_difference_px < 1e-9
    np.testing.assert_allclose(rebalance_aicon(moved, r0_mm, R0_MM), values, rtol=1e-13)


def test_aicon_that_cannot_be_balanced_says_so():
    _, values, _ = lens("aicon")
    with pytest.raises(SurveyError, match="cannot be balanced at r0 = 30"):
        rebalance_aicon(values * [1, 1, 1, 1e3, 0, 0, 1, 1, 1, 1], R0_MM, 30.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brown_backward", "aicon", "fisheye"])
def test_jacobian_is_the_change_of_the_converted_values(name):
    constants = constants_of(name)
    there = convert(MODELS["brown"], BROWN, PIXELS, MODELS[name], constants, IMAGE_SIZE)
    steps = np.array([0.1, 0.1, 0.1, 0.1, 0.1, 1e-4, 1e-4, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-4])
    measured = np.zeros_like(there.jacobian)
    for i, step in enumerate(steps):
        ends = []
        for sign in (1, -1):
            moved = BROWN.copy()
            moved[i] += sign * step
            ends.append(convert(MODELS["brown"], moved, PIXELS, MODELS[name], constants, IMAGE_SIZE).values)
        measured[:, i] = (ends[0] - ends[1]) / (2 * step)
    # the fisheye misses the decentring by 0.17 px, so its second-order terms count (10 % of fx by p1)
    scale = np.abs(measured).max(axis=1, keepdims=True)
    assert np.all(scale[there.values != 0] > 0)
    scale[scale == 0] = 1.0
    np.testing.assert_allclose(there.jacobian / scale, measured / scale, atol=2e-5)


def test_covariance_goes_through_the_jacobian_and_keeps_the_precision_of_rays():
    rng = np.random.default_rng(5)
    root = np.zeros((13, 13))
    root[:9, :9] = rng.normal(size=(9, 9)) * np.array([0.1] * 5 + [1e-4] * 2 + [1e-5] * 2)[:, None]
    cov = root @ root.T
    model = MODELS["brown_backward"]
    constants = constants_of(model.name)
    there = convert(MODELS["brown"], BROWN, PIXELS, model, constants, IMAGE_SIZE, cov=cov)
    np.testing.assert_allclose(there.cov, there.jacobian @ cov @ there.jacobian.T)
    # a change of the old lens moves the image of a fixed ray as the converted change of the new one does
    uv = rng.uniform([0, 0], [639, 479], (20, 2))
    q = np.column_stack([slopes(MODELS["brown"], BROWN, PIXELS, uv), np.ones(20)])
    d_old = root[:, 3] * 0.1
    d_new = there.jacobian @ d_old
    old = project(MODELS["brown"], BROWN + d_old, PIXELS, q) - uv
    new = project(model, there.values + d_new, constants, q) - project(model, there.values, constants, q)
    assert np.abs(old).max() > 5e-3
    np.testing.assert_allclose(new, old, atol=0.03 * np.abs(old).max())


def test_free_names_limit_the_fit():
    there = convert(
        MODELS["brown"], BROWN, PIXELS, MODELS["brown_backward"], constants_of("brown_backward"), IMAGE_SIZE,
        free=("c", "xp", "yp", "K1"),
    )  # fmt: skip
    assert np.all(there.values[4:] == 0)
    assert np.all(there.jacobian[4:] == 0)


def test_errors_of_a_conversion_name_the_cause():
    arguments = (MODELS["brown"], BROWN, PIXELS)
    with pytest.raises(SurveyError, match="no parameter \\['K9'\\]"):
        convert(*arguments, MODELS["brown_backward"], constants_of("brown_backward"), IMAGE_SIZE, free=("c", "K9"))
    with pytest.raises(SurveyError, match="c of the brown_backward lens must be among"):
        convert(*arguments, MODELS["brown_backward"], constants_of("brown_backward"), IMAGE_SIZE, free=("K1",))
    wide = default_start(MODELS["fisheye"], IMAGE_SIZE, 150.0)
    with pytest.raises(SurveyError, match="look 90 deg or more off the axis"):
        convert(MODELS["fisheye"], wide, PIXELS, MODELS["brown"], PIXELS, IMAGE_SIZE)
