"""A lens that is another one from some epoch on, from the images of each camera alone."""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import numpy as np

from adjust.diagnosis.alone import own_lenses, single_camera_survey, single_views, squares_alone, squares_of
from adjust.diagnosis.bodies.series import Step
from adjust.diagnosis.case import Case
from adjust.diagnosis.sequences import costs_of_cuts
from adjust.diagnosis.trial import misfit_of
from adjust.model.errors import SurveyError
from adjust.model.survey import FloatArray, Survey
from adjust.testing.distributions import chi2

_LEAST = 3  # images on either side
_NEAR = 1
_BOUND = 100.0  # of the misfit of an image, times that of the typical one


@lru_cache(maxsize=2)
def misfits(case: Case) -> dict[str, tuple[Survey, list[int]]]:
    """Cameras that do not fit by themselves, as the search for their lenses leaves them: alone, and their images."""
    squares, out = squares_of(case.survey, case.views.values()), {}
    for camera in case.survey.cameras:
        mine = [i for i, b in enumerate(case.survey.image_blocks)
                if b.camera_id == camera.camera_id and b.target_id is not None]  # fmt: skip
        if len(mine) >= 2 * _LEAST and camera.lens.free:
            alone = single_camera_survey(case.survey, camera.camera_id)
            if not case.views.keys() >= {*mine} or squares[mine].sum() > _limit(alone):
                out[camera.camera_id] = alone, mine
    return out


def by_themselves(case: Case) -> bool:
    """Whether cameras are looked at first: where the values of all are lost, and only some do not fit by themselves.

    Where none of several does, it is what they see that is wrong.
    """
    if not case.is_lost:
        return False
    cameras = {b.camera_id for b in case.survey.image_blocks if b.target_id is not None}
    return len(misfits(case)) < max(2, len(cameras))


def lens_steps(case: Case) -> Iterator[Step]:
    """For every camera that does not even fit by itself: where two lenses explain its images best.

    The lens of its first images and that of its last ones tell which of the others are of either.
    """
    for camera_id, (alone, mine) in misfits(case).items():
        n = len(mine)
        now = [float(case.views[i].error_px[0]) if i in case.views else np.inf for i in mine]
        cut = _cut(case, alone, np.array(now))
        whole = _misfit(case, alone) if cut else 0.0
        if whole < _limit(alone):
            continue
        best, cost = _split(case, alone, cut)
        if whole - cost > 0.5 * (whole - _limit(alone)):
            yield Step(("station_from_camera", camera_id), mine[best], whole - cost, n - 2 * _LEAST + 1)


def _cut(case: Case, alone: Survey, now: FloatArray) -> int:
    """Before which image the lens of the last ones explains them better than that of the first ones does.

    Zero where these leave more than half of what one lens for all leaves beyond noise: now (n,) px, of each image.
    """
    n, blocks = len(alone.image_blocks), alone.image_blocks
    third = max(_LEAST, n // 3)
    errors = []
    for part in (blocks[:third], blocks[n - third :]):
        try:
            lenses = own_lenses(replace(alone, image_blocks=part), case.lenses)
        except SurveyError:
            return 0
        found = {v.block_idx: float(v.error_px[0]) for v in single_views(alone, lenses)}
        errors.append(np.array([found.get(i, np.inf) for i in range(n)]))
    first, last = errors
    typical = max(float(np.median(np.minimum(first, last))), 1e-3)
    if not np.isfinite(typical):
        return 0
    first, last, now = (np.minimum((e / typical) ** 2, _BOUND) for e in (first, last, now))
    costs = costs_of_cuts(first, last)
    return int(np.argmin(costs)) if costs.min() - n < 0.5 * (now.sum() - n) else 0


def _split(case: Case, alone: Survey, cut: int) -> tuple[int, float]:
    """Before which image the other lens begins, near to a cut, and what is left; infinite where there are none.

    The images next to the cut belong to the lens that fits them better, of those that the images beyond them give.
    """
    n, camera = len(alone.image_blocks), alone.cameras[0].camera_id
    near = range(max(_LEAST, cut - _NEAR), min(n - _LEAST, cut + _NEAR))
    if not _LEAST <= cut <= n - _LEAST:
        return 0, np.inf
    middle = replace(alone, image_blocks=tuple(alone.image_blocks[i] for i in near))
    left, squares = 0.0, list[FloatArray]()
    for part in (alone.image_blocks[: near.start], alone.image_blocks[near.stop :]):
        omega, lens = _fitted(case, replace(alone, image_blocks=part))
        if lens is None:
            return 0, np.inf
        left += omega
        squares.append(squares_alone(middle, {camera: lens}))
    first, last = squares
    costs = costs_of_cuts(first, last)
    return near.start + int(np.argmin(costs)), left + float(costs.min())


def _fitted(case: Case, alone: Survey) -> tuple[float, FloatArray | None]:
    """What the lens of some images leaves of them, and that lens: as it is started where they are too few for it."""
    camera = alone.cameras[0].camera_id
    try:
        result = case.run(alone)
        return misfit_of(result, alone).omega, np.asarray(result.estimates["lens", camera].value)
    except SurveyError:
        lenses = own_lenses(alone, case.lenses)
        return float(squares_alone(alone, lenses).sum()), lenses.get(camera)


def _misfit(case: Case, survey: Survey) -> float:
    try:
        return misfit_of(case.run(survey), survey).omega
    except SurveyError:
        return misfit_of(None, survey).omega


def _limit(survey: Survey) -> float:
    n = 2 * sum(len(b.uv) for b in survey.image_blocks) - 6 * len(survey.image_blocks)
    return float(chi2.isf(1e-6, n))
