"""Observations that the search for gross errors left out: those that fit as soon as they are read as they were meant.

The rest of the survey predicts them, with the sigma of that; nothing is adjusted. Of one that fits in no way, and is
much too far off for noise or a wrong sigma, that is said.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.diagnosis import Candidate
from adjust.diagnosis.hypothesis import ChangeReadings, Edit, Hypothesis, Place
from adjust.diagnosis.units.conventions import MISREADINGS, UNIT_OF_LENGTHS, Misreading, Written, misreadings, slips
from adjust.diagnosis.units.lengths import all_read_by, gross_error
from adjust.diagnosis.units.motions import CONVENTIONS, edits_of, mended, miss
from adjust.model.observations import Distance, Reading, position_text
from adjust.model.result import Adjustment, ObservationResidual
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.observations.terrestrial.equations import wrapped
from adjust.observations.terrestrial.layout import KINDS
from adjust.testing.criteria import sidak
from adjust.testing.distributions import chi2

_ALPHA, _FITS = 1e-4, 1e-3
"""Levels at which an observation is wrong as it stands, shared by all ways to read it, and at which it fits."""
_MOST = 3
_FAR = 1e3
"""Sigmas, as the rest predicts it, from which an observation is between other points, or its value is another one's."""


def misread_singles(survey: Survey, result: Adjustment, written: Written) -> tuple[Candidate, ...]:
    """Of each observation in use that the adjustment left out, the way to read it in which it fits, if there is one.

    survey: as it was given. written: how its project writes it. The one that is farthest off as it stands comes first.
    """
    given = {("pair", p.pair_id): i for i, p in enumerate(survey.pairs) if p.used}
    given |= {("distance", d.distance_id): i for i, d in enumerate(survey.distances) if d.used}
    given |= {(r.kind, r.reading_id): i for i, r in enumerate(survey.readings) if r.used}
    found = []
    for o in result.other_residuals:
        row = given.get((o.kind, o.ids[0])) if o.ids and not o.used else None
        if row is not None:
            found += _best(survey, result, o, row, written)
    common = _of_all_distances(survey, found)
    return common or tuple(sorted(found, key=lambda c: -c.statistic)[:_MOST])


def far_off(survey: Survey, result: Adjustment) -> tuple[Candidate, ...]:
    """The distance, or coordinates of one point, left out by the adjustment that alone is thousands of sigmas off.

    Not beside readings, whose names may be the wrong ones.
    """
    if survey.readings:
        return ()
    given = {("distance", d.distance_id) for d in survey.distances if d.used}
    given |= {("coordinates", position_text(c.positions[0])) for c in survey.coordinates if c.used}
    out = [o for o in result.other_residuals if not o.used and (o.kind, *o.ids[:1]) in given]
    sigmas = [float(np.nan_to_num(np.max(np.abs(o.standardized), initial=0.0), posinf=0.0)) for o in out]
    far = [(s, o) for s, o in zip(sigmas, out, strict=True) if s > _FAR * max(1.0, result.sigma0)]
    found = gross_error(survey, far[0][1].kind, far[0][1].ids, far[0][0]) if len(far) == 1 else None
    if found is None:
        return ()
    limit = float(chi2.isf(sidak(_ALPHA, len(out)), 1))
    return (Candidate(found, 1.0, far[0][0] ** 2, limit, 1.0, result.sigma0),)


def _of_all_distances(survey: Survey, found: Sequence[Candidate]) -> tuple[Candidate, ...]:
    """One candidate where each distance of the survey fits in the same other unit; else none."""
    used = {d.distance_id: i for i, d in enumerate(survey.distances) if d.used}
    edits = {i: (e.factor, c) for c in found for e in c.hypothesis.edits
             if isinstance(e, ChangeReadings) and e.table == "distances" for i in e.ids}  # fmt: skip
    factors = {factor for factor, _ in edits.values()}
    ways = [m for m in MISREADINGS if m.name == UNIT_OF_LENGTHS and factors == {m.factor}]
    if not ways or len(used) < 2 or edits.keys() != used.keys():
        return ()
    first = next(c for _, c in edits.values())
    h = all_read_by(survey, {i: survey.distances[i] for i in used.values()}, ways[0])
    share = min(c.explained for _, c in edits.values())
    return (replace(first, hypothesis=h, explained=share, statistic=sum(c.statistic for _, c in edits.values())),)


def _best(
    survey: Survey, result: Adjustment, o: ObservationResidual, row: int, written: Written
) -> list[Candidate]:
    own = np.abs(o.residual / o.standardized)
    if not np.isfinite(own).all() or not (own > 0.0).all():
        return []
    ways = list((_of_pair if o.kind == "pair" else _of_value)(survey, o, row, written))
    before = float(np.sum((o.residual / own) ** 2))
    limit, fits = (float(chi2.isf(p, len(own))) for p in (sidak(_ALPHA, len(ways)), _FITS))
    scale = max(1.0, result.sigma0) ** 2 if np.isfinite(result.sigma0) else 1.0
    after = [float(np.sum((v / own) ** 2)) for v, _ in ways]
    if not after or before < scale * limit or min(after) > scale * fits:
        return []
    least = int(np.argmin(after))
    share = 1.0 - min(1.0, after[least] / before)
    return [Candidate(ways[least][1], share, (before - after[least]) / scale, limit, 1.0, result.sigma0)]


def _of_pair(
    survey: Survey, o: ObservationResidual, row: int, written: Written
) -> Iterator[tuple[FloatArray, Hypothesis]]:
    """What it misses by (k,) in the conventions in which its motion may have been written."""
    rows = np.array([row])
    for convention in CONVENTIONS:
        changed = mended(survey, rows, convention, written)
        if changed is not None:
            pair = changed.pairs[row]
            yield miss(pair.b_from_a, o.adjusted), Hypothesis(
                convention.name, f"pair {pair.pair_id}: its values {convention.said}", f"in pairs.csv "
                f"{convention.remedy}", Place("pair", (pair.pair_id,)), changed, edits_of(survey, rows, convention),
            )  # fmt: skip


def _of_value(
    survey: Survey, o: ObservationResidual, row: int, written: Written
) -> Iterator[tuple[FloatArray, Hypothesis]]:
    """The same (1,) of a reading or distance: decimal point moved, in another unit, sense or from another zero."""
    of: Distance | Reading = survey.distances[row] if o.kind == "distance" else survey.readings[row]
    kind = of.kind if isinstance(of, Reading) else "slope_distance"
    ways = slips(kind, of.value)
    known = misreadings(written, "terrestrial" if isinstance(of, Reading) else "distances")
    ways += [m for m in known if kind in m.kinds and m.factor not in [slip.factor for slip in ways]]
    for way in ways:
        value = way.mend(np.array([of.value]))
        other = replace(of, value=float(value[0]))
        changed = with_rows(survey, "readings" if isinstance(of, Reading) else "distances", {row: other})
        yield wrapped(np.array([KINDS[kind]]), o.adjusted, value), _misread(of, way, changed)


def _misread(o: Distance | Reading, way: Misreading, changed: Survey) -> Hypothesis:
    named, table, name = (f"reading {o.reading_id}", "terrestrial", o.reading_id) if isinstance(o, Reading) else (
        f"distance {o.distance_id}", "distances", o.distance_id)  # fmt: skip
    edits: tuple[Edit, ...] = (ChangeReadings((name,), way.factor, way.offset, table),)
    return Hypothesis(
        way.name, f"{named}: {way.text('its')}", f"write {way.factor * o.value + way.offset:.9g} (SI) in {table}.csv",
        Place("reading", (name,), "value"), changed, edits,
    )  # fmt: skip
