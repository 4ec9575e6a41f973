"""Parameters of lenses that cameras share: one unknown, full lenses for all, a test of what is shared."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from adjust.adjustment import adjust
from adjust.lenses.models import MODELS
from adjust.model.errors import SurveyError
from adjust.model.survey import LensDrift, LensSharing, Survey
from survey.simulate import Truth, beacons, resample, stereo
from tests.adjust import helpers as h
from tests.adjust.test_lens_drift import begins, check_gradient, drifting

SHARED = ("fx", "fy", "k1", "k2", "p1", "p2")


def sharing(survey: Survey, truth: Truth, names: tuple[str, ...] = SHARED, seed: int = 3) -> tuple[Survey, Truth]:
    """The second camera's lens is in these the first one's, in truth too."""
    first, second, *others = survey.cameras
    lens = replace(second.lens, shared=LensSharing(first.camera_id, names))
    survey = replace(survey, cameras=(first, replace(second, lens=lens), *others))
    a, b = (np.array(truth["lens", c.camera_id]) for c in (first, second))
    at = [MODELS["brown"].names.index(x) for x in names]
    b[at] = a[at]
    truth = truth | {("lens", second.camera_id): b}
    return resample(survey, truth, seed), truth


def everything_shared(survey: Survey, truth: Truth) -> tuple[Survey, Truth]:
    return sharing(survey, truth, survey.cameras[0].lens.free)


@pytest.mark.parametrize("lab", ["boards", "beacons"])
@pytest.mark.parametrize("whole", [False, True])
def test_derivatives_by_what_is_shared(lab: str, whole: bool) -> None:
    base = stereo(4, n_pairs=10) if lab == "boards" else beacons(4, n_table_epochs=2, n_free_epochs=2, n_night_epochs=6)
    survey, truth = everything_shared(*base) if whole else sharing(*base)
    graph = h.build(survey, h.start_at(truth))
    name = ("lens", survey.cameras[1].camera_id)
    assert (name in graph.unknowns.by_name) == (not whole)
    check_gradient(graph, gtsam.Values(graph.start))


def test_a_shared_lens_may_change_too() -> None:
    base = sharing(*stereo(4, n_pairs=10))
    survey, truth = drifting(*base, LensDrift(("v0", "fx"), begins(base[0], 2)))
    graph = h.build(survey, h.start_at(truth))
    check_gradient(graph, gtsam.Values(graph.start))


@pytest.mark.slow
def test_every_camera_has_its_full_lens_with_the_covariance_of_one() -> None:
    survey, truth = sharing(*stereo(4, n_pairs=14))
    result = adjust(survey)
    assert result.global_test is not None
    assert result.global_test.passed
    left, right = (result.estimates["lens", name] for name in ("left", "right"))
    at = [left.components.index(x) for x in SHARED]
    np.testing.assert_array_equal(np.asarray(left.value)[at], np.asarray(right.value)[at])
    np.testing.assert_allclose(left.cov[np.ix_(at, at)], right.cov[np.ix_(at, at)], rtol=1e-9)
    alone = adjust(replace(survey, cameras=tuple(replace(c, lens=replace(c.lens, shared=None))
                                                 for c in survey.cameras)))  # fmt: skip
    assert result.n_unknowns == alone.n_unknowns - len(SHARED)
    assert np.all(np.diag(right.cov)[at] < np.diag(alone.estimates["lens", "right"].cov)[at])
    free = [i for i, s in enumerate(right.status) if s != "held"]
    d = (np.asarray(right.value) - np.asarray(truth["lens", "right"]))[free]
    assert float(d @ np.linalg.solve(right.cov[np.ix_(free, free)], d)) < 35.0  # chi-square of 11 freedoms, 2e-4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"shared": LensSharing("left", ("k3",))}, "k3 is not free in both"),
        ({"model": "fisheye", "free": ("fx", "fy", "u0", "v0"), "shared": LensSharing("left", ("fx",))}, "one model"),
    ],
)
def test_what_cannot_be_shared_is_refused(change: dict[str, object], said: str) -> None:
    survey, _ = stereo(4, n_pairs=9)
    first, second = survey.cameras
    with pytest.raises(SurveyError, match=said):
        adjust(replace(survey, cameras=(first, replace(second, lens=replace(second.lens, **change)))))


def test_a_camera_that_shares_does_not_lend() -> None:
    survey, _ = stereo(4, n_pairs=9)
    cameras = tuple(replace(c, lens=replace(c.lens, shared=LensSharing(other.camera_id, ("fx",))))
                    for c, other in zip(survey.cameras, survey.cameras[::-1], strict=True))  # fmt: skip
    with pytest.raises(SurveyError, match="which shares its own; name"):
        adjust(replace(survey, cameras=cameras))


def test_those_that_are_left_share_where_the_camera_is_gone() -> None:
    survey, truth = sharing(*stereo(4, n_pairs=9))
    right = survey.cameras[1]
    third = replace(right, camera_id="third")
    mine = tuple(b for b in survey.image_blocks if b.camera_id == "right")
    blocks = mine + tuple(replace(b, camera_id="third") for b in mine)
    left = replace(survey, cameras=(right, third), image_blocks=blocks)
    start = h.start_at(truth | {("lens", "third"): truth["lens", "right"],
                                ("station_from_camera", "third"): truth["station_from_camera", "right"]})  # fmt: skip
    graph = h.build(left, start)
    assert len(graph.unknowns.by_name["lens", "right"].components) == len(right.lens.free)
    assert set(graph.unknowns.by_name["lens", "third"].components) == set(right.lens.free) - set(SHARED)
