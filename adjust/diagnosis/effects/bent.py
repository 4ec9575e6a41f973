"""A target that is bent: its sag as an unknown of its own."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import of_shifts, ratio
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.prediction import Prediction, adjusted_values
from adjust.diagnosis.score import Linear
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey, Target, VectorParameter
from adjust.testing.distributions import chi2

_ALPHA = 1e-4
_FLAT = 0.1
_STEP = 1e-4  # m of sag


def bent_targets(case: Case) -> Iterator[Hypothesis]:
    """The sag of a flat target as an unknown of its own, where the score of a sag is clear."""
    linear = case.linear
    if linear is None:
        return
    flat = [t for t in case.survey.targets if np.ptp(t.x_in_target[:, 2]) < _FLAT * np.ptp(t.x_in_target[:, :2])]
    limit = linear.scale * float(chi2.isf(_ALPHA / max(len(flat), 1), 2))
    for given in flat:
        target, clear = given.target_id, _drop(linear, given)
        if (given.warp is not None and given.warp.free) or clear < limit:
            continue
        warp = VectorParameter(("warp_x", "warp_y"), np.zeros(2), free=("warp_x", "warp_y"))
        survey = replace(
            case.survey,
            targets=tuple(replace(t, warp=warp) if t.target_id == target else t for t in case.survey.targets),
        )
        hypothesis = Hypothesis(
            "target bent",
            f"target {target} is bent",
            "let the adjustment find its sag: warp = { free = true }",
            Place("target", (target,), "warp"),
            survey,
            (SetKey(("targets", target, "warp", "free"), True),),
            evidence=ratio(linear, clear), parameters=2, looked_at=len(flat),
        )  # fmt: skip
        yield replace(hypothesis, follow=_sag_told(hypothesis, target))


def _sag_told(hypothesis: Hypothesis, target: str) -> Callable[[Adjustment], list[Hypothesis]]:
    def told(result: Adjustment) -> list[Hypothesis]:
        sag = result.estimates[("warp", target)]
        text = ", ".join(
            f"{1e3 * v:+.3f} mm +- {1e3 * s:.3f} mm along {axis}"
            for v, s, axis in zip(np.asarray(sag.value), np.sqrt(np.diag(sag.cov)), "xy", strict=True)
        )
        return [replace(hypothesis, cause=f"target {target} is bent: sag {text}")]

    return told


def _drop(linear: Linear, target: Target) -> float:
    """Of v'Pv, by the score of a sag along x and along y."""
    survey, values = linear.result.survey, adjusted_values(linear.result)
    low, span = target.x_in_target.min(axis=0), np.maximum(np.ptp(target.x_in_target, axis=0), 1e-12)
    u = (target.x_in_target - low)[:, :2] / span[:2]
    sags = [_STEP * 4.0 * u[:, k] * (1.0 - u[:, k]) for k in range(2)]
    flat, *bent = (Prediction(_with_sag(survey, target, s), values) for s in (0.0 * sags[0], *sags))
    shifts = {}
    for i, block in enumerate(survey.image_blocks):
        if block.target_id == target.target_id:
            uv = [p.uv(block) for p in (flat, *bent)]
            if not any(x is None for x in uv):
                shifts[i] = np.moveaxis((np.array(uv[1:]) - np.array(uv[0])) / _STEP, 0, -1)
    return of_shifts(linear, shifts).drop


def _with_sag(survey: Survey, target: Target, sag: FloatArray) -> Survey:
    x = target.x_in_target + np.outer(sag, [0.0, 0.0, 1.0])
    return replace(survey, targets=tuple(
        replace(t, x_in_target=x) if t.target_id == target.target_id else t for t in survey.targets))  # fmt: skip
