"""Observations that the search for gross errors left out: those that fit as soon as they are read as they were meant.

The rest of the survey predicts them, with the sigma of that; nothing is adjusted.
"""

from collections.abc import Iterator
from dataclasses import replace
from typing import TypeVar

import numpy as np
from gtsam import Pose3, Rot3

from adjust.diagnosis.hypothesis import ChangeReadings, Edit, Hypothesis, Place
from adjust.diagnosis.ranking import Candidate
from adjust.diagnosis.units.conventions import MISREADINGS, SLIPS
from adjust.diagnosis.units.pairs import CONVENTIONS, edits_of, mended
from adjust.model.observations import Distance, Pair, Reading
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.survey import FloatArray, Survey
from adjust.testing.distributions import chi2

_T = TypeVar("_T", Distance, Reading)
_ALPHA, _FITS = 1e-4, 1e-3
"""Levels at which an observation is wrong as it stands, shared by all ways to read it, and at which it fits."""
_MOST = 3
_ANGLES = ("direction", "angle", "azimuth", "zenith")


def misread_singles(survey: Survey, result: Adjustment) -> tuple[Candidate, ...]:
    """Of each observation in use that the adjustment left out, the way to read it in which it fits, if there is one.

    survey: as it was given. The one that is farthest off as it stands comes first.
    """
    given = {("pair", p.pair_id): i for i, p in enumerate(survey.pairs) if p.used}
    given |= {("distance", d.distance_id): i for i, d in enumerate(survey.distances) if d.used}
    given |= {(r.kind, r.reading_id): i for i, r in enumerate(survey.readings) if r.used}
    found = []
    for o in result.other_residuals:
        row = given.get((o.kind, o.ids[0])) if o.ids and not o.used else None
        if row is not None:
            found += _best(survey, result, o, row)
    return tuple(sorted(found, key=lambda c: -c.statistic)[:_MOST])


def _best(survey: Survey, result: Adjustment, o: ObservationResidual, row: int) -> list[Candidate]:
    own = np.abs(o.residual / o.standardized)
    if not np.isfinite(own).all() or not (own > 0.0).all():
        return []
    ways = list(_of_pair(survey, row) if o.kind == "pair" else _of_value(survey, o.kind, row))
    before = float(np.sum((o.residual / own) ** 2))
    limit, fits = (float(chi2.isf(p, len(own))) for p in (_ALPHA / max(1, len(ways)), _FITS))
    scale = max(1.0, result.sigma0) ** 2 if np.isfinite(result.sigma0) else 1.0
    after = [float(np.sum((_miss(o, value) / own) ** 2)) for value, _ in ways]
    if not after or before < scale * limit or min(after) > scale * fits:
        return []
    least = int(np.argmin(after))
    share = 1.0 - min(1.0, after[least] / before)
    return [Candidate(ways[least][1], share, (before - after[least]) / scale, limit, 1.0, result.sigma0)]


def _miss(o: ObservationResidual, value: FloatArray) -> FloatArray:
    """(k,) adjusted minus observed, with another value observed: logarithms of motions, differences of numbers."""
    if len(value) == 6:
        return np.asarray(Pose3.Logmap(Pose3.Expmap(value).between(Pose3.Expmap(o.adjusted))))
    if len(value) == 3:
        return np.asarray(Rot3.Logmap(Rot3.Expmap(value).between(Rot3.Expmap(o.adjusted))))
    miss = o.adjusted - value
    return np.asarray((miss + np.pi) % (2.0 * np.pi) - np.pi) if o.kind in _ANGLES else miss


def _of_pair(survey: Survey, row: int) -> Iterator[tuple[FloatArray, Hypothesis]]:
    """Its motion in the conventions in which it may have been written, as a logarithm."""
    rows = np.array([row])
    for convention in CONVENTIONS:
        changed = mended(survey, rows, convention)
        if changed is not None:
            pair: Pair = changed.pairs[row]
            m = pair.b_from_a
            value = Pose3.Logmap(m) if isinstance(m, Pose3) else Rot3.Logmap(m)
            yield np.asarray(value), Hypothesis(
                convention.name, f"pair {pair.pair_id}: its values {convention.said}", f"in pairs.csv "
                f"{convention.remedy}", Place("pair", (pair.pair_id,)), changed, edits_of(survey, rows, convention),
            )  # fmt: skip


def _of_value(survey: Survey, kind: str, row: int) -> Iterator[tuple[FloatArray, Hypothesis]]:
    """A reading or distance with its decimal point moved, in another unit, sense or from another zero."""
    if kind == "distance":
        distance = survey.distances[row]
        for factor, offset, name, said in _ways("slope_distance"):
            ids, value = (distance.distance_id,), factor * distance.value + offset
            yield np.array([value]), _misread("distances", ids, distance, name, said, factor, offset, replace(
                survey, distances=_with(survey.distances, row, value)))  # fmt: skip
        return
    reading = survey.readings[row]
    for factor, offset, name, said in _ways(kind):
        ids, value = (reading.reading_id,), factor * reading.value + offset
        yield np.array([value]), _misread("terrestrial", ids, reading, name, said, factor, offset, replace(
            survey, readings=_with(survey.readings, row, value)))  # fmt: skip


def _ways(kind: str) -> Iterator[tuple[float, float, str, str]]:
    yield from ((f, 0.0, "slipped decimal", "") for f in SLIPS)
    for m in MISREADINGS:
        if kind in m.kinds and m.factor not in SLIPS:
            yield m.factor, m.offset, m.name, m.said


def _with(every: tuple[_T, ...], row: int, value: float) -> tuple[_T, ...]:
    return tuple(replace(o, value=value) if i == row else o for i, o in enumerate(every))


def _misread(
    table: str, ids: tuple[str, ...], o: Distance | Reading, name: str, said: str, factor: float, offset: float,
    changed: Survey,
) -> Hypothesis:  # fmt: skip
    what = f"{'distance' if table == 'distances' else 'reading'} {ids[0]}"
    slip = f"its decimal point has slipped: {o.value:.9g} for {factor * o.value:.9g} (SI)"
    edits: tuple[Edit, ...] = (ChangeReadings(ids, factor, offset, table),)
    return Hypothesis(
        name, f"{what}: {f'its values {said}' if said else slip}", f"write {factor * o.value + offset:.9g} (SI) in "
        f"{table}.csv", Place("reading", ids, "value"), changed, edits,
    )  # fmt: skip
