"""What a project demands of its results, and whether they meet it with their uncertainty (ISO 14253-1).

A result conforms where its deviation from nominal *plus* its expanded uncertainty stays within the tolerance: what is
not proven is not met. A demand on the uncertainty alone is met where the expanded uncertainty stays below it.
"""

from collections.abc import Iterator

import numpy as np
from gtsam import Pose3

from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.result import Adjustment, Estimate
from adjust.testing.distributions import norm, student
from survey.project.project import DEMANDED, POSITION, ROTATION, Tolerance
from survey.solution.quantities import PROBABILITY, Scale


@frozen
class Verdict:
    """How one result stands to one demand; SI units or px.

    allowed, found: the limit and what has to stay below it. of_value: whether it is about the value (with its
    uncertainty) and not about the uncertainty alone.
    """

    tolerance: str
    result: tuple[str, ...]
    quantity: str
    unit: str
    allowed: float
    found: float
    of_value: bool

    @property
    def met(self) -> bool:
        """Whether the demand is met."""
        return bool(self.found <= self.allowed)


def coverage(adjustment: Adjustment, scale: Scale) -> float:
    """Factor from a sigma to the expanded uncertainty at 95 %: normal, or Student's t where sigma0 was estimated."""
    if scale.sigmas == "a_priori":
        return float(norm.ppf(0.5 + PROBABILITY / 2))
    return float(student.ppf(0.5 + PROBABILITY / 2, adjustment.redundancy))


def verdicts(adjustment: Adjustment, tolerances: tuple[Tolerance, ...], scale: Scale) -> tuple[Verdict, ...]:
    """Every demand against every result it is about. Raises SurveyError for one that is about nothing."""
    k = coverage(adjustment, scale) * scale.factor
    out: list[Verdict] = []
    for tolerance in tolerances:
        found = [v for e in _about(adjustment, tolerance) for v in _judge(tolerance, e, k)]
        if not found:
            raise SurveyError(
                f"tolerance {tolerance.name!r}: none of the {tolerance.of} {' '.join(tolerance.ids)} has a result "
                f"{tolerance.quantity!r}; correct 'of', 'ids' or 'component'"
            )
        out += found
    return tuple(out)


def _about(adjustment: Adjustment, tolerance: Tolerance) -> Iterator[Estimate]:
    seen = set()
    for name, estimate in adjustment.estimates.items():
        if name[0] in DEMANDED[tolerance.of] and (not tolerance.ids or name[1] in tolerance.ids):
            seen.add(name[1])
            yield estimate
    missing = [i for i in tolerance.ids if i not in seen]
    if missing:
        raise SurveyError(f"tolerance {tolerance.name!r}: there is no result for {', '.join(missing)}; correct 'ids'")


def _judge(tolerance: Tolerance, estimate: Estimate, k: float) -> Iterator[Verdict]:
    u, unit, value = _uncertainty(tolerance.quantity, estimate)
    if u is None:
        return
    shared = (tolerance.name, estimate.name, tolerance.quantity, unit)
    if tolerance.expanded is not None:
        yield Verdict(*shared, tolerance.expanded, k * u, False)
    if tolerance.within is not None and value is not None:
        yield Verdict(*shared, tolerance.within, abs(value - (tolerance.nominal or 0.0)) + k * u, True)


def _uncertainty(quantity: str, estimate: Estimate) -> tuple[float | None, str, float | None]:
    """Standard uncertainty in the worst direction, its unit, and the value of a single component."""
    pose = isinstance(estimate.value, Pose3)
    if quantity in (POSITION, ROTATION):
        if quantity == ROTATION and not pose:
            return None, "rad", None
        block = estimate.cov[3:, 3:] if pose and quantity == POSITION else estimate.cov[:3, :3]
        if not pose and estimate.name[0] != "point":
            return None, "m", None
        return float(np.sqrt(max(0.0, np.linalg.eigvalsh(block)[-1]))), "m" if quantity == POSITION else "rad", None
    if pose or quantity not in estimate.components:
        return None, "", None
    i = estimate.components.index(quantity)
    return float(np.sqrt(estimate.cov[i, i])), estimate.units[i], float(np.asarray(estimate.value)[i])
