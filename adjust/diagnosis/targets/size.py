"""A target of another size than its owner says: its places, seen by cameras that the rest determines, tell it."""

from collections.abc import Iterator

import numpy as np

from adjust.diagnosis.bodies.series import placed_views
from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, ScaleKey
from adjust.diagnosis.prediction import Altered
from adjust.model.rewriting import with_changed
from adjust.model.survey import FloatArray, Survey

KNOWN = (  # factor from what is said to what is meant, and how that comes about
    (25.4, "inches were taken for millimetres"),
    (1.0 / 25.4, "millimetres were taken for inches"),
    (10.0, "centimetres were taken for millimetres"),
    (0.1, "millimetres were taken for centimetres"),
    (1000.0, "metres were taken for millimetres"),
    (0.001, "millimetres were taken for metres"),
    (25.4 / 25.0, "an inch was rounded to 25 mm"),
    (25.0 / 25.4, "25 mm were taken for an inch"),
    (0.97, "printed to fit the page, at 97 %"),
    (1.0 / 0.97, "measured on a print that was made to fit the page"),
    (210.0 / 215.9, "printed on A4 for US letter"),
    (0.8, "the side of a marker is eight tenths of the square that was given for it"),
    (1.25, "the side of the square is ten eighths of the marker that was given for it"),
    (0.5, "two squares were measured for one"),
    (2.0, "one square was measured for two"),
    (np.sqrt(2.0), "the diagonal was meant, or A4 was enlarged to A3"),
    (np.sqrt(0.5), "the side was meant, or A3 was reduced to A4"),
)
_CLEAR = 5.0  # sigmas
_PLAIN = 1e4
"""Evidence after which no other target is looked at: each costs start values of the survey without it."""
_NEAR = 0.003


def wrong_sizes(case: Case) -> Iterator[Hypothesis]:
    """For each target that the rest contradicts: its size as the rest says it, and the nearest known cause."""
    if len({b.target_id for b in case.survey.image_blocks}) < 2:
        return
    for owner, values in case.without_each("target_id"):
        found = _ratio(case, values, owner)
        if found is not None and abs(found[0] - 1.0) > _CLEAR * found[1] and found[0] > 0.0:
            yield from _hypotheses(case.survey, owner, *found)
            if ((found[0] - 1.0) / found[1]) ** 2 > _PLAIN:
                return


def _hypotheses(survey: Survey, target: str, ratio: float, sigma: float) -> Iterator[Hypothesis]:
    clear = ((ratio - 1.0) / sigma) ** 2
    factor, why = well_known(ratio, sigma)
    if why:
        yield _hypothesis(survey, target, factor, why, 1, clear)
    yield _hypothesis(survey, target, ratio, "", 2, 0.9 * clear)


def well_known(ratio: float, sigma: float) -> tuple[float, str]:
    """The nearest factor that explains itself, and how it comes about; the ratio and "" where none is near."""
    if not ratio > 0.0:
        return ratio, ""
    near = max(_NEAR, _CLEAR * sigma / ratio)
    known = [(f, f": {why}") for f, why in KNOWN if abs(np.log(ratio / f)) < near]
    return min(known, key=lambda item: abs(np.log(ratio / item[0])), default=(ratio, ""))


def _hypothesis(survey: Survey, target: str, factor: float, why: str, parameters: int, clear: float) -> Hypothesis:
    return Hypothesis(
        "target scaled",
        f"target {target} is {factor:.6g} times as large as its definition says{why}",
        f"multiply its square or marker size by {factor:.6g}",
        Place("target", (target,), "square_mm"),
        reshaped(survey, target, factor * np.eye(3)),
        (ScaleKey(("targets", target), factor),),
        evidence=clear, parameters=parameters, looked_at=len(KNOWN),
    )  # fmt: skip


def reshaped(survey: Survey, target: str, A: FloatArray) -> Survey:
    """The survey with the points of a target times A (3, 3)."""
    return with_changed(survey, "targets", target, x_in_target=survey.targets_by_id[target].x_in_target @ A.T)


def _ratio(case: Case, values: Altered, target: str) -> tuple[float, float] | None:
    """True size over said size, with its sigma: with it the places of the target's origin agree.

    A view of a target that is believed too small by 1/s has it too near by 1/s: where cameras at c_i with rotations R_i
    see it at t_i, the places c_i + s R_i t_i of one origin are one (least squares over s, robust by medians of pairs).
    """
    c, a = placed_views(case, values, target)
    if len(c) < 3:
        return None
    i, j = np.triu_indices(len(c), 1)
    dc, da = c[i] - c[j], a[i] - a[j]
    length = np.einsum("nk,nk->n", da, da)
    good = length > 0.01 * float(length.max())
    each = -np.einsum("nk,nk->n", dc, da)[good] / length[good]
    if len(each) < 3:
        return None
    ratio = float(np.median(each))
    spread = 1.4826 * float(np.median(np.abs(each - ratio)))
    return ratio, max(spread / np.sqrt(len(c)), 1e-5)
