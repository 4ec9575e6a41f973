"""A target that is stretched, sheared or bent: the change that takes the misfit away, by Gauss-Newton over adjustments.

The reduced residual of an adjustment (all other unknowns eliminated) has a derivative by a parameter that no graph
knows: the difference of two adjustments (variable projection; Golub and Pereyra 1973). Two or three steps suffice.
"""

from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.targets.size import reshaped
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey, VectorParameter

_STEP = 1e-4
_MOST = 2  # targets
_ROUNDS = 2
_TOO_FAR = 0.5
_SINGULAR = 1e-3


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


def stretched_targets(case: Case) -> Iterator[Hypothesis]:
    """One direction scaled against the other, or not at right angles to it."""
    if case.result is None:
        return
    for target, share in _suspects(case):
        for name, what, shape in _SHAPES:
            yield _stretched(case, target, share, name, what, shape)


def _stretch(a: float) -> FloatArray:
    return np.diag([1.0 + a, 1.0, 1.0])


def _shear(a: float) -> FloatArray:
    return np.array([[1.0, a, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


_SHAPES = (
    ("target stretched", "its columns stand {:.6g} times as far from each other against its rows as they should",
     _stretch),
    ("target sheared", "its rows and columns are not at right angles: they lean by {:.6g} of their length", _shear),
)  # fmt: skip


def _stretched(
    case: Case, target: str, share: float, name: str, what: str, shape: Callable[[float], FloatArray]
) -> Hypothesis:
    found: list[float] = []

    def made() -> Survey | None:
        size = _best(case, lambda a: reshaped(case.survey, target, shape(a)))
        if size is None:
            return None
        found.append(size)
        return reshaped(case.survey, target, shape(size))

    hypothesis = Hypothesis(
        name, f"target {target}: {name.split()[1]}", "measure it in both directions, and give its points in a file of "
        "kind \"points\"", Place("target", (target,)), made, evidence=share,
    )  # fmt: skip

    def told(_: Adjustment) -> list[Hypothesis]:
        value = 1.0 + found[-1] if shape is _stretch else found[-1]
        return [replace(hypothesis, cause=f"target {target}: {what.format(value)}")]

    return replace(hypothesis, follow=told)


def _best(case: Case, changed: Callable[[float], Survey]) -> float | None:
    """The value for which the adjustment of ``changed(value)`` fits best; None where it changes nothing."""
    value, step = 0.0, _STEP
    try:
        for _ in range(_ROUNDS):
            r = _residuals(case, changed(value))
            J = (_residuals(case, changed(value + step)) - r) / step
            both = (np.abs(r) < CAP) & np.isfinite(J)
            if not both.any() or float(np.linalg.norm(J[both])) < _SINGULAR * np.sqrt(both.sum()):
                return None
            value -= float(J[both] @ r[both]) / float(J[both] @ J[both])
            if abs(value) > _TOO_FAR:
                return None
    except SurveyError:
        return None
    return value


def _residuals(case: Case, survey: Survey) -> FloatArray:
    """(2 N,) image residuals of all points over their sigmas, those that are left out as predicted; nan without."""
    result = case.run(survey)
    names = {(b.camera_id, b.epoch_id, b.target_id, b.group): i for i, b in enumerate(result.survey.image_blocks)}
    ptr, out = result.image_residuals.block_ptr, []
    for block in survey.image_blocks:
        k = names.get((block.camera_id, block.epoch_id, block.target_id, block.group))
        sigma = np.sqrt(np.einsum("nii->ni", block.cov))
        rows = np.full_like(block.uv, np.nan) if k is None else result.image_residuals.residuals[ptr[k] : ptr[k + 1]]
        out.append((rows / sigma).ravel())
    return np.concatenate(out)


def _suspects(case: Case) -> list[tuple[str, float]]:
    """The flat targets with the largest misfit beyond noise, and that misfit over its square root of count."""
    share: dict[str, float] = {}
    for block, value in zip(case.survey.image_blocks, case.block_misfit, strict=True):
        if block.target_id is not None:
            share[block.target_id] = share.get(block.target_id, 0.0) + float(value) - 2.0 * len(block.uv)
    ranked = sorted(share.items(), key=lambda item: -item[1])[:_MOST]
    return [(name, value**0.5) for name, value in ranked if value > 0.0]
