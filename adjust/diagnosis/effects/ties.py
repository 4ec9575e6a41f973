"""Whether lenses that are shared are the same: the difference that a camera's own parameters would have.

The score at the solution gives it with its covariance, without another adjustment (:mod:`adjust.statistics.score`).
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.prediction import Linear
from adjust.frames.lens_states import lenders
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.statistics.score import own_score, shared_lenses
from adjust.testing.distributions import chi2

_ALPHA = 1e-4


def untied(case: Case, linear: Linear) -> Iterator[Hypothesis]:
    """Every camera with a lens of its own that shares parameters which clearly differ."""
    shared = lenders(case.survey)
    for camera, (lender, parameters) in shared.items():
        score = own_score(linear, camera, lender, parameters)
        if score.seen and score.drop > linear.scale * float(chi2.isf(_ALPHA / len(shared), score.seen)):
            hypothesis = Hypothesis(
                "lens not shared", f"camera {camera}: its lens is not that of camera {lender}",
                f"give it parameters of its own: parameters = [] in cameras.{camera}.lens.shared",
                Place("camera", (camera,), "shared"), _freed(case.survey, camera),
                (SetKey(("cameras", camera, "lens", "shared", "parameters"), ()),),
                evidence=linear.ratio(score.drop), parameters=score.seen, looked_at=len(shared), scored=True,
            )  # fmt: skip
            yield hypothesis.told(partial(_difference, hypothesis.cause, linear.result, camera))


def _difference(cause: str, tied: Adjustment, camera: str, _: Adjustment) -> str:
    found = next((s for s in shared_lenses(tied, True) if s.camera == camera), None)
    return "" if found is None else f"{cause}: {found.said()}"


def _freed(survey: Survey, camera_id: str) -> Survey:
    """With all parameters of one camera its own."""
    lenses = [replace(c.lens, shared=None) if c.camera_id == camera_id else c.lens for c in survey.cameras]
    return replace(survey, cameras=tuple(replace(c, lens=x) for c, x in zip(survey.cameras, lenses, strict=True)))
