"""A target that is bent: its sag as an unknown of its own."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import of_shape
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.prediction import Linear
from adjust.model.boards import BENT, deformation
from adjust.model.result import Adjustment
from adjust.model.survey import VectorParameter
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_ALPHA = 1e-4
_FLAT = 0.1


def bent_targets(case: Case, linear: Linear) -> Iterator[Hypothesis]:
    """The sag of a flat target as an unknown of its own, where the score of a sag is clear."""
    flat = [t for t in case.survey.targets if np.ptp(t.x_in_target[:, 2]) < _FLAT * np.ptp(t.x_in_target[:, :2])]
    limit = linear.scale * float(chi2.isf(sidak(_ALPHA, len(flat)), 2))
    for given in flat:
        if given.warp is not None and given.warp.free:
            continue
        target = given.target_id
        clear = of_shape(linear, target, deformation(given.x_in_target, BENT)).drop
        if clear < limit:
            continue
        warp = VectorParameter(BENT, np.zeros(2), free=BENT)
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
            evidence=linear.ratio(clear), parameters=2, looked_at=len(flat), scored=True,
        )  # fmt: skip
        yield hypothesis.told(partial(_sag, target))


def _sag(target: str, result: Adjustment) -> str:
    sag = result.estimates[("warp", target)]
    text = ", ".join(
        f"{1e3 * v:+.3f} mm +- {1e3 * s:.3f} mm along {axis}"
        for v, s, axis in zip(np.asarray(sag.value), np.sqrt(np.diag(sag.cov)), "xy", strict=True)
    )
    return f"target {target} is bent: sag {text}"
