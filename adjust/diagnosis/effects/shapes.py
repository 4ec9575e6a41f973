"""Targets that are a little larger than their owner says, stretched or sheared."""

from collections.abc import Iterator

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, of_shape
from adjust.diagnosis.hypothesis import Hypothesis, Place, ScaleKey, SetKey
from adjust.diagnosis.prediction import Linear
from adjust.diagnosis.targets.size import reshaped, well_known
from adjust.model.result import Adjustment
from adjust.model.rewriting import Fields
from adjust.model.survey import FloatArray, Survey, Target
from adjust.statistics.score import Score

_SCALE = "target scaled"
_FAR = 0.3
"""Share by which no change of values is small any more: closed forms tell such a size."""
_SHAPES: tuple[tuple[str, FloatArray, str, str], ...] = (
    ("target stretched", np.diag([1.0, 0.0, 0.0]),
     "its columns stand {:.6g} times as far from each other against its rows as they should", "scale_x"),
    ("target sheared", np.outer([1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
     "its rows and columns are not at right angles: they lean by {:.6g} of their length", "shear"),
    (_SCALE, np.eye(3), "it is {:.6g} times as large as its definition says", ""),
)  # fmt: skip
"""Names, the change of points (3, 3) by one unit, words, and the component of the warp that takes it."""


def shapes(case: Case, linear: Linear) -> Iterator[Effect]:
    """Each change of each target."""
    for target in case.survey.targets:
        if len(target.point_ids) >= 3:
            every = (_of(case, linear, target, *shape) for shape in _SHAPES)
            yield from (e for e in every if not (np.abs(e.first.theta) > _FAR).any())


def _of(case: Case, linear: Linear, given: Target, name: str, by: FloatArray, what: str, component: str) -> Effect:
    target = given.target_id

    def scored(at: Linear) -> Score:
        now = at.result.survey.targets_by_id[target]
        return of_shape(at, target, (now.x_in_target @ by.T)[:, :, None])

    def known(theta: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, Fields] | None:
        if name != _SCALE:
            return None
        factor, why = well_known(1.0 + float(theta[0]), float(sigmas[0]))
        return np.array([factor - 1.0]), {
            "cause": f"target {target}: {what.format(factor)}{why}", "parameters": 1 if why else 2,
            "edits": (ScaleKey(("targets", target), factor),),
        }  # fmt: skip

    remedy = (
        "multiply its square or marker size by that"
        if name == _SCALE
        else f'let the adjustment find it: warp = {{ free = ["{component}"] }}; or measure it in both directions'
    )
    edits = (SetKey(("targets", target, "warp", "free"), (component,)),) if component and given.warp is None else ()
    hypothesis = Hypothesis(name, "", remedy, Place("target", (target,), "square_mm" if name == _SCALE else "warp"),
                            case.survey, edits, 1.0, 0)  # fmt: skip

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        value = float(theta[0]) + float(np.trace(by) > 0.0)
        return f"target {target}: {what.format(value)} (+- {float(sigmas[0]):.2g})"

    def mended(_: Adjustment, theta: FloatArray) -> Survey:
        return reshaped(case.survey, target, np.eye(3) + float(theta[0]) * by)

    return Effect(hypothesis, scored(linear), scored, mended, said, known=known)
