"""A lens that is another one from some epoch on, from the images of each camera alone."""

from collections.abc import Iterator
from dataclasses import replace

from adjust.adjustment import adjust
from adjust.diagnosis.bodies.series import Step
from adjust.diagnosis.case import Case
from adjust.diagnosis.table.views import single_camera_survey
from adjust.diagnosis.trial import misfit_of
from adjust.model.errors import SurveyError
from adjust.model.survey import Survey
from adjust.testing.distributions import chi2

_LEAST = 3  # images on either side
_CUTS = 7


def lens_steps(case: Case) -> Iterator[Step]:
    """For every camera that does not even fit by itself: where two lenses explain its images best."""
    for camera in case.survey.cameras:
        alone = single_camera_survey(case.survey, camera.camera_id)
        n = len(alone.image_blocks)
        if n < 2 * _LEAST or not camera.lens.free:
            continue
        whole = _misfit(alone)
        if whole < _limit(alone):
            continue
        costs = {k: _both(alone, k) for k in range(_LEAST, n - _LEAST + 1, max(1, (n - 2 * _LEAST) // _CUTS))}
        best = min(costs, key=lambda k: costs[k])
        near = {k: _both(alone, k) for k in range(best - 2, best + 3) if _LEAST <= k <= n - _LEAST and k not in costs}
        costs |= near
        best = min(costs, key=lambda k: costs[k])
        mine = [i for i, b in enumerate(case.survey.image_blocks)
                if b.camera_id == camera.camera_id and b.target_id is not None]  # fmt: skip
        if whole - costs[best] > 0.5 * (whole - _limit(alone)):
            yield Step(("station_from_camera", camera.camera_id), mine[best], whole - costs[best], len(costs))


def _both(alone: Survey, cut: int) -> float:
    parts = (alone.image_blocks[:cut], alone.image_blocks[cut:])
    return sum(_misfit(replace(alone, image_blocks=part)) for part in parts)


def _misfit(survey: Survey) -> float:
    try:
        return misfit_of(adjust(survey), survey).omega
    except SurveyError:
        return misfit_of(None, survey).omega


def _limit(survey: Survey) -> float:
    n = 2 * sum(len(b.uv) for b in survey.image_blocks) - 6 * len(survey.image_blocks)
    return float(chi2.isf(1e-6, n))
