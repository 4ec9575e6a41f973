"""Sigmas and values that look like another unit, or like a decimal point that has slipped."""

from collections.abc import Callable, Iterable, Iterator

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Finding, Hypothesis
from adjust.diagnosis.names.given import wrong_given
from adjust.diagnosis.units.conventions import ANGLES, LENGTH_RATIOS, SLIPS
from adjust.diagnosis.units.heights import doubtful_heights
from adjust.diagnosis.units.readings import misread_readings
from adjust.diagnosis.weights.impossible import doubtful_sigmas
from adjust.diagnosis.weights.sigmas import ODD, id_of, kind_of, odd_among
from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.observations import Distance, Reading
from adjust.model.result import Adjustment
from adjust.model.subsets import positions_of
from adjust.model.survey import Survey

_NEAR, _OFF = 0.02, 0.1
"""Of a length and of a turn: what start values miss by at most, and what no right value does."""
_THOUSAND = (1e3, 1e-3)
_CLEAR = 20.0
"""Misfit before over misfit after of a single value: ten sigmas off, and then none."""


def valued(case: Case, expected: Adjustment | None) -> Iterator[Finding]:
    """All of them. expected: its survey has all observations as the start values predict them."""
    odd = list(_in_another_unit(case))
    yield from odd
    if any(f.kind == "suspicious unit" and f.level == "problem" for f in odd):
        return  # the start values are spoilt by it
    slips = list(_slips(case.survey, expected.survey)) if expected is not None else []
    given = max(_tried(wrong_given, case), key=lambda h: h.evidence, default=None)  # which many readings contradict
    read = None if slips else max(_tried(misread_readings, case), key=lambda h: h.evidence, default=None)
    if (best := given or read) is not None:
        slips = [_Slip(best.place.ids[0], best.cause, frozenset())]
    for slip in _joined(case.survey, slips):
        yield Finding("problem", "slipped decimal", (slip.name,), slip.said, "write it as it was read")


@frozen
class _Slip:
    """An observation by its name, what is wrong, and the points that it concerns."""

    name: str
    said: str
    points: frozenset[str]


def _joined(survey: Survey, slips: list[_Slip]) -> list[_Slip]:
    """Several at one point whose coordinates are observed are one: these, for the start values came from them."""
    seen = {ref.point_id for c in survey.coordinates for ref in c.positions if ref.frame is None}
    common = sorted(frozenset.intersection(*(s.points for s in slips)) & seen) if len(slips) > 1 else []
    if not common:
        return slips
    said = f"point {common[0]}: the decimal point of its coordinates has slipped, or that of all lengths to it"
    return [_Slip(common[0], said, frozenset(common))]


def _tried(make: Callable[[Case], Iterable[Hypothesis]], case: Case) -> list[Hypothesis]:
    return [h for h in make(case) if h.name == "slipped decimal" and h.evidence > _CLEAR]


def _slips(given: Survey, predicted: Survey) -> Iterator[_Slip]:
    """Lengths and angles that fit as soon as their decimal point is moved, and do not as they stand."""
    there: tuple[Distance | Reading, ...] = (*predicted.distances, *predicted.readings)
    every: tuple[Distance | Reading, ...] = (*given.distances, *given.readings)
    known = {(type(o), id_of(o)): o.value for o in there}
    for o in (o for o in every if o.used and (type(o), id_of(o)) in known):
        to, kind = known[type(o), id_of(o)], kind_of(o)
        factor, unit = (1e3, "mm") if isinstance(o, Distance) else (1.0, "m")
        if kind in ANGLES:
            to, factor, unit = to % (2.0 * np.pi), 180.0 / np.pi, "deg"
        if said := _slipped(f"{kind} {id_of(o)}", o.value, to, factor, unit):
            ends = (ref for ref in positions_of(o)[:2] if ref.frame is None)
            yield _Slip(id_of(o), said, frozenset(str(ref.point_id) for ref in ends))


def _slipped(what: str, value: float, predicted: float, factor: float, unit: str) -> str:
    """What is wrong; nothing where the value fits as it stands, or by no factor."""
    if abs(value - predicted) < _OFF * abs(predicted):
        return ""
    ways = SLIPS if unit == "deg" else (*SLIPS, *_THOUSAND)
    by = next((by for by in ways if abs(by * value - predicted) < _NEAR * abs(predicted)), None)
    how = "it is in another unit" if by in _THOUSAND else "its decimal point has slipped"
    return "" if by is None else (f"{what}: {how}: {factor * value:.10g} {unit}, by what the rest says "
                                  f"{factor * by * value:.10g} {unit}")  # fmt: skip


def _in_another_unit(case: Case) -> Iterator[Finding]:
    """Sigmas and values that look like another unit. A target may be as thin as a height of a millimetre says."""
    survey, known = case.survey, set[str]()
    for h in (*doubtful_heights(survey), *doubtful_sigmas(survey)):
        kind = "suspicious sigma" if h.name == "unit of sigmas" else "suspicious unit"
        known.update(h.place.ids)
        yield Finding("weak" if h.place.kind == "point" else "problem", kind, h.place.ids, h.cause, h.change)
    every: tuple[Reading | Distance, ...] = (*survey.readings, *survey.distances)
    for kind, found in grouped((kind_of(o), o) for o in every).items():
        odd = [id_of(o) for o in odd_among(found)[1]]
        if not known.issuperset(odd):
            yield Finding("problem", "suspicious sigma", tuple(odd), f"{kind} {listed(odd, 6)}: the sigma is more than "
                          f"{ODD:.0f} times off that of the others", "check its unit")  # fmt: skip
    yield from _lengths(survey)


def _lengths(survey: Survey) -> Iterator[Finding]:
    """Distances that stand to the others of their set-up as a unit to another."""
    lengths = [(r.setup_id, r.value) for r in survey.readings if r.kind in ("slope_distance", "horizontal_distance")]
    typical = {s: float(np.median(found)) for s, found in grouped(lengths).items() if len(found) >= 3}
    if len(typical) < 2:
        return
    usual = float(np.median(list(typical.values())))
    for setup_id, length in typical.items():
        ratio = length / usual
        if not 0.02 < ratio < 50.0:
            near = min(LENGTH_RATIOS, key=lambda said: abs(float(np.log(LENGTH_RATIOS[said] * ratio))))
            yield Finding("problem", "suspicious unit", (setup_id,), f"distances of set-up {setup_id} are {ratio:.3g} "
                          f"times those of the others: perhaps they {near}", "check value_m and value_mm")  # fmt: skip
