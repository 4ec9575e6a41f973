"""Whether lenses that are shared are the same: the difference that a camera's own parameters would have.

The score at the solution gives it with its covariance, without another adjustment (:mod:`adjust.statistics.score`).
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.frames.lens_states import lenders
from adjust.model.result import Adjustment
from adjust.model.survey import Survey
from adjust.statistics.score import own_score, shared_lenses
from adjust.testing.distributions import chi2

_ALPHA = 1e-4


def untied(case: Case) -> Iterator[Hypothesis]:
    """Every camera with a lens of its own that shares parameters which clearly differ."""
    linear, shared = case.linear, lenders(case.survey)
    if linear is None:
        return
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
            yield replace(hypothesis, follow=_told(hypothesis, linear.result, camera))


def _told(hypothesis: Hypothesis, tied: Adjustment, camera: str) -> Callable[[Adjustment], list[Hypothesis]]:
    def told(_: Adjustment) -> list[Hypothesis]:
        found = next((s for s in shared_lenses(tied, True) if s.camera == camera), None)
        return [] if found is None else [replace(hypothesis, cause=f"{hypothesis.cause}: {found.said()}")]

    return told


def _freed(survey: Survey, camera_id: str) -> Survey:
    """With all parameters of one camera its own."""
    lenses = [replace(c.lens, shared=None) if c.camera_id == camera_id else c.lens for c in survey.cameras]
    return replace(survey, cameras=tuple(replace(c, lens=x) for c, x in zip(survey.cameras, lenses, strict=True)))
