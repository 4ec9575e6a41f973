"""Images that are cropped or resized: the lens of every model against pixels, derivatives, and whole adjustments."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.frames.lens_times import LensTimes, whole_images
from adjust.lenses.crops import cropped_lens, whole_image
from adjust.lenses.models import MODELS, lens_constants, project
from adjust.model.errors import SurveyError
from adjust.model.survey import CROP, FloatArray, ImageCrop, LensDrift, Survey, VectorParameter, VectorPrior
from survey.simulate import Truth, beacons, resample, stereo
from tests.adjust import helpers as h
from tests.adjust.test_lens_drift import begins, check_gradient

TRUE = np.array([0.75, 120.0, 80.5])


def cropped(
    survey: Survey, truth: Truth, free: tuple[str, ...], given: FloatArray = TRUE, seed: int = 3
) -> tuple[Survey, Truth]:
    """The second camera's images are cropped from the middle of the session on, in truth by ``TRUE``."""
    camera = survey.cameras[1]
    (since,) = begins(survey, 1)
    crops = {since: ImageCrop(VectorParameter(CROP, given, free), (840, 640))}
    survey = replace(survey, cameras=(survey.cameras[0], replace(camera, lens=replace(camera.lens, crops=crops)),
                                      *survey.cameras[2:]))  # fmt: skip
    truth = truth | {("lens_crop", camera.camera_id, since): TRUE}
    return resample(survey, truth, seed), truth


@pytest.mark.parametrize("model", list(MODELS))
def test_every_model_images_what_the_crop_of_its_image_shows(model: str) -> None:
    """Projection by the lens of the crop against the crop of the projection, and derivatives against differences."""
    lens, size, pixel = h.lens_values(model), (1280, 1024), 0.006
    constants = lens_constants(model, size, pixel)
    x = np.random.default_rng(1).uniform((-0.3, -0.25, 1.0), (0.3, 0.25, 1.5), (50, 3))
    seen = project(MODELS[model], lens, constants, x)
    small = cropped_lens(MODELS[model], lens, constants, TRUE)
    uv = project(MODELS[model], small.values, constants, x)
    np.testing.assert_allclose(uv, TRUE[0] * (seen + 0.5 - TRUE[1:]) - 0.5, atol=1e-6)
    np.testing.assert_allclose(whole_image(uv, TRUE), seen, atol=1e-6)
    for by, values, crop in ((small.by_crop, lens, TRUE), (np.diag(small.by_lens), lens, TRUE)):
        for j in range(by.shape[1]):
            step = np.zeros(by.shape[1])
            step[j] = 1e-5 * max(abs((crop if by is small.by_crop else values)[j]), 1e-4)
            ends = [cropped_lens(MODELS[model], values, constants, crop + s * step) if by is small.by_crop
                    else cropped_lens(MODELS[model], values + s * step, constants, crop) for s in (1, -1)]  # fmt: skip
            numeric = (ends[0].values - ends[1].values) / (2 * step[j])
            np.testing.assert_allclose(by[:, j], numeric, rtol=1e-5, atol=1e-7 * max(1.0, np.abs(numeric).max()))


@pytest.mark.slow
@pytest.mark.parametrize("free", [(), ("scale",), CROP])
@pytest.mark.parametrize("lab", ["boards", "beacons"])
def test_derivatives_by_lens_and_crop(lab: str, free: tuple[str, ...]) -> None:
    base = stereo(4, n_pairs=10) if lab == "boards" else beacons(4, n_table_epochs=2, n_free_epochs=2, n_night_epochs=6)
    survey, truth = cropped(*base, free)
    camera = survey.cameras[1]
    drift = LensDrift(("fx",), begins(survey, 2)[:1])  # another block, which begins earlier
    cameras = (survey.cameras[0], replace(camera, lens=replace(camera.lens, drift=drift)), *survey.cameras[2:])
    graph = h.build(replace(survey, cameras=cameras), h.start_at(truth))
    assert len(graph.state.lens_states.states) == len(survey.cameras) + 2
    values = gtsam.Values(graph.start)
    for name, unknown in graph.unknowns.by_name.items():
        if name[0] == "lens_drift":
            values.update(unknown.key, np.array([1.5]))
    check_gradient(graph, values)


def test_start_values_see_whole_images() -> None:
    survey, truth = cropped(*stereo(4, n_pairs=10), ())
    plain = replace(survey, cameras=tuple(replace(c, lens=replace(c.lens, crops={})) for c in survey.cameras))
    for a, b in zip(whole_images(survey).image_blocks, resample(plain, truth, 3).image_blocks, strict=True):
        np.testing.assert_allclose(a.uv, b.uv, atol=2.0)  # the noise of a smaller image is larger in the whole one


@pytest.mark.slow
@pytest.mark.parametrize(
    ("free", "given"), [((), TRUE), (CROP, TRUE + [0.2, 0.0, 0.0]), (CROP, TRUE + [0.0, 250.0, 100.0])],
    ids=["given", "another size", "another region"],
)
def test_crops_are_found_within_their_sigmas(free: tuple[str, ...], given: FloatArray) -> None:
    survey, _ = cropped(*stereo(4, n_pairs=16), free, given)
    result = adjust(survey)
    assert result.global_test is not None
    assert result.global_test.passed
    (name,) = [n for n in result.estimates if n[0] == "lens_crop"]
    found = result.estimates[name]
    np.testing.assert_allclose(np.asarray(found.value)[[x not in free for x in CROP]],
                               given[[x not in free for x in CROP]])  # fmt: skip
    if free:
        d = np.asarray(found.value) - TRUE
        assert float(d @ np.linalg.solve(found.cov, d)) < 21.1  # chi-square with 3 degrees of freedom, 1e-4
        assert found.cov[0, 0] < 0.01**2


def test_a_prior_on_a_crop_is_an_observation() -> None:
    survey, truth = cropped(*stereo(4, n_pairs=10), CROP)
    camera = survey.cameras[1]
    ((since, crop),) = camera.lens.crops.items()
    prior = VectorPrior(("left",), np.array([121.0]), np.array([[1e-8]]))
    crops = {since: replace(crop, parameters=replace(crop.parameters, prior=prior))}
    cameras = (survey.cameras[0], replace(camera, lens=replace(camera.lens, crops=crops)))
    graph = h.build(replace(survey, cameras=cameras), h.start_at(truth))
    solved = h.solve(graph, h.SolveOptions())
    value = graph.unknowns.vectors["lens_crop", "right", since].full(solved.values)
    assert value[1] == pytest.approx(121.0, abs=1e-3)


def test_the_lens_at_an_epoch_is_that_of_its_images() -> None:
    survey, truth = cropped(*stereo(4, n_pairs=10), CROP)
    graph = h.build(survey, h.start_at(truth))
    times, states = LensTimes(survey), graph.state.lens_states
    for camera in survey.cameras:
        for epoch in (b.epoch_id for b in survey.image_blocks if b.camera_id == camera.camera_id):
            lens = times.lens(camera, epoch, lambda n: truth.get(n))
            np.testing.assert_allclose(lens, states.full(states.of(camera.camera_id, epoch), graph.start), rtol=1e-12)
    assert times.size(survey.cameras[1], None) == (840, 640)
    assert times.size(survey.cameras[0], None) == survey.cameras[0].image_size


@pytest.mark.parametrize(
    ("free", "since", "said"),
    [(("zoom",), "", "a crop has no parameter 'zoom'"), ((), "never", "to change at epoch 'never'.*crops")],
)
def test_what_is_no_crop_is_refused(free: tuple[str, ...], since: str, said: str) -> None:
    survey, truth = cropped(*stereo(4, n_pairs=9), ())
    camera = survey.cameras[1]
    ((first, crop),) = camera.lens.crops.items()
    crops = {since or first: replace(crop, parameters=replace(crop.parameters, free=free))}
    cameras = (survey.cameras[0], replace(camera, lens=replace(camera.lens, crops=crops)))
    with pytest.raises(SurveyError, match=said):
        h.build(replace(survey, cameras=cameras), h.start_at(truth))


def test_an_epoch_without_image_has_the_lens_of_the_last_image_before_it() -> None:
    survey, truth = cropped(*stereo(4, n_pairs=10), CROP)
    camera, times = survey.cameras[1], LensTimes(survey)
    ((since, _),) = camera.lens.crops.items()
    whole, part = (times.lens(camera, epoch, truth.get) for epoch in ("e01", since))
    assert not np.allclose(whole, part)
    for epoch, lens in (("e00", whole), ("e01b", whole), (f"{since}b", part), ("e99", part), (None, part)):
        np.testing.assert_array_equal(times.lens(camera, epoch, truth.get), lens)
