"""Targets that are a little larger than their owner says, stretched or sheared."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, of_shifts
from adjust.diagnosis.hypothesis import Hypothesis, Place, ScaleKey, SetKey
from adjust.diagnosis.prediction import Prediction, adjusted_values
from adjust.diagnosis.score import Linear, Score
from adjust.diagnosis.targets.size import reshaped, well_known
from adjust.model.survey import FloatArray, Survey

_STEP = 1e-4


def _stretch(a: float) -> FloatArray:
    return np.diag([1.0 + a, 1.0, 1.0])


def _shear(a: float) -> FloatArray:
    return np.array([[1.0, a, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def _scale(a: float) -> FloatArray:
    return (1.0 + a) * np.eye(3)


_SHAPES: tuple[tuple[str, Callable[[float], FloatArray], str, str], ...] = (
    ("target stretched", _stretch,
     "its columns stand {:.6g} times as far from each other against its rows as they should", "scale_x"),
    ("target sheared", _shear, "its rows and columns are not at right angles: they lean by {:.6g} of their length",
     "shear"),
    ("target scaled", _scale, "it is {:.6g} times as large as its definition says", ""),
)  # fmt: skip


def shapes(case: Case) -> Iterator[Effect]:
    """Each change of each target."""
    linear = case.linear
    if linear is not None:
        for target in case.survey.targets:
            if len(target.point_ids) >= 3:
                yield from (_of(case, linear, target.target_id, *shape) for shape in _SHAPES)


def _of(
    case: Case, linear: Linear, target: str, name: str, shape: Callable[[float], FloatArray], what: str, component: str
) -> Effect:
    def scored(at: Linear) -> Score:
        survey = at.result.survey
        values = adjusted_values(at.result)
        now, then = (Prediction(s, values) for s in (survey, reshaped(survey, target, shape(_STEP))))
        shifts = {}
        for i, block in enumerate(survey.image_blocks):
            if block.target_id == target:
                a, b = now.uv(block), then.uv(block)
                if a is not None and b is not None:
                    shifts[i] = ((b - a) / _STEP)[:, :, None]
        return of_shifts(at, shifts)

    def known(theta: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, Mapping[str, Any]] | None:
        if shape is not _scale:
            return None
        factor, why = well_known(1.0 + float(theta[0]), float(sigmas[0]))
        return np.array([factor - 1.0]), {
            "cause": f"target {target}: {what.format(factor)}{why}", "parameters": 1 if why else 2,
            "edits": (ScaleKey(("targets", target), factor),),
        }  # fmt: skip

    remedy = ("multiply its square or marker size by that" if shape is _scale else
              f'let the adjustment find it: warp = {{ free = ["{component}"] }}; or measure it in both directions')
    given = next(t for t in case.survey.targets if t.target_id == target).warp
    edits = (SetKey(("targets", target, "warp", "free"), (component,)),) if component and given is None else ()
    hypothesis = Hypothesis(name, "", remedy, Place("target", (target,), "square_mm" if shape is _scale else "warp"),
                            case.survey, edits, 1.0, 0)  # fmt: skip

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        value = float(theta[0]) + (0.0 if shape is _shear else 1.0)
        return f"target {target}: {what.format(value)} (+- {float(sigmas[0]):.2g})"

    def mended(_: Any, theta: FloatArray) -> Survey:
        return reshaped(case.survey, target, shape(float(theta[0])))

    return Effect(hypothesis, scored(linear), scored, mended, said, known=known)
