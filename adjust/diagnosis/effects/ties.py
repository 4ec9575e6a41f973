"""Whether lenses that are shared are the same: the difference that a camera's own parameters would have.

The score at the solution gives it with its covariance, without another adjustment (:mod:`adjust.diagnosis.score`).
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Hypothesis, Place, SetKey
from adjust.diagnosis.score import Linear, Score
from adjust.frames.lens_states import lenders
from adjust.model.result import Adjustment
from adjust.model.survey import FloatArray, Survey
from adjust.testing.distributions import chi2, fisher
from adjust.testing.significance import LEVEL, Significance

_ALPHA = 1e-4


@dataclass(frozen=True, eq=False)
class SharedLens:
    """What ``camera`` shares with ``lender``: names (k,) with units, by how much its own would differ, cov a priori.

    test: whether they differ, as ``significant``.
    """

    camera: str
    lender: str
    names: tuple[str, ...]
    units: tuple[str, ...]
    difference: FloatArray
    cov: FloatArray
    test: Significance

    def said(self) -> str:
        """The parameters that differ by more than three sigmas, or all, in words."""
        sigmas = np.sqrt(np.maximum(np.diag(self.cov), 0.0))
        clear = np.abs(self.difference) > 3.0 * sigmas
        return ", ".join(
            f"{name} {d:+.3g} +- {s:.2g}{'' if unit == '1' else ' ' + unit}" for name, unit, d, s, shown in
            zip(self.names, self.units, self.difference, sigmas, clear | ~clear.any(), strict=True) if shown
        )  # fmt: skip


def shared_lenses(result: Adjustment, estimated_sigma0: bool) -> tuple[SharedLens, ...]:
    """Of every camera that shares parameters; F with sigma0 of the adjustment in which they are free, or chi-square.

    The statistic is ``(drop / k) / ((v'Pv - drop) / (r - k))`` where v'Pv falls by ``drop`` (Koch 1999, 4.2.1).
    """
    shared = lenders(result.survey)
    if not shared or result.precision is None:
        return ()
    linear, out = Linear(result), []
    level = LEVEL if result.global_test is None else result.global_test.alpha
    for camera, (lender, parameters) in shared.items():
        found = result.estimates["lens", camera]
        names = tuple(x for x in found.components if x in parameters)
        score = _score(linear, camera, lender, names)
        k, left = score.seen, result.redundancy - score.seen
        if not k or (estimated_sigma0 and left <= 0):
            continue
        statistic, freedom, p = _tested(score, result.omega, left if estimated_sigma0 else None)
        test = Significance("lens_shared", names, statistic, freedom, p, p < level)
        units = tuple(found.units[found.components.index(x)] for x in names)
        out.append(SharedLens(camera, lender, names, units, score.theta, score.cov, test))
    return tuple(out)


def _tested(score: Score, omega: float, left: int | None) -> tuple[float, tuple[int, ...], float]:
    """Statistic, degrees of freedom and p-value; left: redundancy without the tie, None where sigma0 is known."""
    k = score.seen
    if left is None:
        return score.drop, (k,), float(chi2.sf(score.drop, k))
    statistic = score.drop / k / ((omega - score.drop) / left)
    return statistic, (k, left), float(fisher.sf(statistic, k, left))


def untied(case: Case) -> Iterator[Hypothesis]:
    """Every camera with a lens of its own that shares parameters which clearly differ."""
    linear, shared = case.linear, lenders(case.survey)
    if linear is None:
        return
    for camera, (lender, parameters) in shared.items():
        score = _score(linear, camera, lender, parameters)
        if score.seen and score.drop > linear.scale * float(chi2.isf(_ALPHA / len(shared), score.seen)):
            hypothesis = Hypothesis(
                "lens not shared", f"camera {camera}: its lens is not that of camera {lender}",
                f"give it parameters of its own: parameters = [] in cameras.{camera}.lens.shared",
                Place("camera", (camera,), "shared"), _freed(case.survey, camera),
                (SetKey(("cameras", camera, "lens", "shared", "parameters"), ()),),
                evidence=linear.ratio(score.drop), parameters=score.seen, looked_at=len(shared),
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


def _score(linear: Linear, camera: str, lender: str, parameters: tuple[str, ...]) -> Score:
    """Of a change of these parameters in the images of one camera alone."""
    ptr = 2 * linear.result.image_residuals.block_ptr
    rows = [np.arange(ptr[i], ptr[i + 1]) for i, b in enumerate(linear.result.survey.image_blocks)
            if b.camera_id == camera]  # fmt: skip
    columns = linear.columns(("lens", lender), parameters)
    return linear.of_parts(linear.parts(columns, rows) if len(columns) else [])
