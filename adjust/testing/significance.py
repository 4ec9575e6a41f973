"""Whether estimated terms of a model differ from zero: one test for all of them.

Terms that only mean something together (a cosine and a sine, bends along both edges) are tested together: with values
x (k,) and covariance C, ``x' inv(C) x`` is chi-square with k degrees of freedom where sigma0 is known, and
``x' inv(C) x / (k sigma0^2)`` Fisher's F(k, f) where it comes from f redundant observations (Koch 1999, 4.2.1).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from adjust.model.boards import BENT
from adjust.model.clocks import CLOCK, CLOCKS
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Estimate, ParameterName
from adjust.model.survey import FloatArray
from adjust.model.tables import harmonic
from adjust.testing.distributions import chi2, fisher

LEVEL = 0.05
"""Error probability where the adjustment has no global test."""
_BOARD = {"bend": (*BENT, "warp_xy"), "stretch": ("scale_x", "scale_y", "shear"), "expansion": ("expansion",)}


@frozen
class Significance:
    """The test of one term. statistic: F, or chi-square where sigma0 is known and ``freedom`` has one number."""

    term: str
    components: tuple[str, ...]
    statistic: float
    freedom: tuple[int, ...]
    p: float
    significant: bool


def significance(
    adjustment: Adjustment, term: str, components: tuple[str, ...], square: float, k: int, redundancy: int | None
) -> Significance:
    """Of ``x' inv(C) x``, k degrees of freedom; redundancy: of the sigma0^2 that is in C, None where it is known."""
    level = LEVEL if adjustment.global_test is None else adjustment.global_test.alpha
    if redundancy is None:
        p = float(chi2.sf(square, k))
        return Significance(term, components, square, (k,), p, p < level)
    p = float(fisher.sf(square / k, k, redundancy))
    return Significance(term, components, square / k, (k, redundancy), p, p < level)


def terms_of(estimate: Estimate) -> Mapping[str, Sequence[str]]:
    """The terms of an estimate that may be zero, with their components that are estimated; none for most."""
    known: Mapping[str, Sequence[str]] = _harmonics(estimate.components)
    if estimate.name[0] == "warp":
        known = _BOARD
    elif estimate.name[0] in CLOCKS:
        known = {f"clock_{name}": (name,) for name in CLOCK}
    free = {c for c, status in zip(estimate.components, estimate.status, strict=True) if status not in ("held", "tied")}
    return {term: kept for term, names in known.items() if (kept := [n for n in names if n in free])}


def _harmonics(components: Sequence[str]) -> Mapping[str, Sequence[str]]:
    """The pairs of components of a table's geometry that are harmonics."""
    out: dict[str, list[str]] = {}
    for name in components:
        if (found := harmonic(name)) is not None:
            out.setdefault(found.term, []).append(name)
    return out


def significances(adjustment: Adjustment, estimate: Estimate, estimated_sigma0: bool) -> tuple[Significance, ...]:
    """The tests of all terms of an estimate, with sigma0 of the adjustment or with one."""
    values, out = np.asarray(estimate.value, dtype=float), []
    for term, names in terms_of(estimate).items():
        at = [estimate.components.index(name) for name in names]
        out.append(_judged(adjustment, term, tuple(names), values[at], estimate.cov[np.ix_(at, at)], estimated_sigma0))
    return tuple(out)


def _judged(
    adjustment: Adjustment, term: str, names: tuple[str, ...], x: FloatArray, cov: FloatArray, estimated_sigma0: bool
) -> Significance:
    """Whether x (k,) with this covariance a priori is zero."""
    factor, redundancy = (adjustment.sigma0**2, adjustment.redundancy) if estimated_sigma0 else (1.0, None)
    square = float(x @ np.linalg.solve(factor * cov, x))
    return significance(adjustment, term, names, square, len(x), redundancy)


def significance_of_changes(
    adjustment: Adjustment, of: ParameterName, term: str, estimated_sigma0: bool
) -> Significance | None:
    """Whether something changes at all, or images are cropped otherwise than is given: of all such estimates together.

    of: how their names begin. None where none is estimated.
    """
    found = [(n, e) for n, e in adjustment.estimates.items() if n[:2] == of and (of[0] not in CLOCKS or len(n) > 2)]
    names = [n for n, e in found if not set(e.status) <= {"held"}]
    if not names or adjustment.precision is None:
        return None
    parts = []
    crops = {c.camera_id: c.lens.crops for c in adjustment.survey.cameras} if of[0] == "lens_crop" else {}
    for name, estimate in found:
        given = crops[name[1]][name[2]].parameters.values if crops else np.zeros(len(estimate.components))
        free = [s != "held" for s in estimate.status]
        parts.append((np.asarray(estimate.value, dtype=float) - given)[free])
    cov = np.asarray(adjustment.precision.joint(names))
    return _judged(adjustment, term, found[0][1].components, np.concatenate(parts), cov, estimated_sigma0)
