"""A target that is bent: its sag as an unknown of its own."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.model.result import Adjustment
from adjust.model.survey import VectorParameter

_MOST = 2  # targets


def bent_targets(case: Case) -> Iterator[Hypothesis]:
    """The sag of a flat target as an unknown of its own."""
    for target, share in _suspects(case):
        given = next(t for t in case.survey.targets if t.target_id == target)
        if given.warp is not None and given.warp.free:
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
            evidence=0.5 * share, parameters=2,
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


def _suspects(case: Case) -> list[tuple[str, float]]:
    """The flat targets with the largest misfit beyond noise, and that misfit over its square root of count."""
    share: dict[str, float] = {}
    for block, value in zip(case.survey.image_blocks, case.block_misfit, strict=True):
        if block.target_id is not None:
            share[block.target_id] = share.get(block.target_id, 0.0) + float(value) - 2.0 * len(block.uv)
    ranked = sorted(share.items(), key=lambda item: -item[1])[:_MOST]
    return [(name, value**0.5) for name, value in ranked if value > 0.0]
