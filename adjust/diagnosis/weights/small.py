"""Sigmas of angles that residuals contradict by as much as one unit is larger than another: radians, read as degrees.

Possible ones all the same, so that only the residuals tell; and these only together, for a survey with far too small
sigmas looks like one with gross errors everywhere, and a search for these leaves out whatever checks the rest.
"""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.screen import Screen, at_best
from adjust.diagnosis.units.conventions import ANGLES
from adjust.diagnosis.units.motions import miss
from adjust.diagnosis.weights.impossible import Sigmas, units_of_angles, with_sigmas
from adjust.model.names import grouped
from adjust.model.survey import Survey

_LEAST = 10.0
"""Factor from which a unit is looked for; what is nearer to one is a matter of the instrument."""
_EVIDENCE = 2.0
"""Sigmas that are large enough fit anything, so what else there is to try is tried first."""


def small_sigmas(case: Case) -> Iterator[Hypothesis]:
    """Those of all angles of readings, and of the rotations of pairs, where it could be the likelier explanation."""
    survey = case.survey
    every = [some for some in (_of_readings(survey), _of_pairs(survey)) if some]
    found = at_best(case) if every else None
    if found is None:
        return
    for some in every:
        misfit, n = _misfit(found, survey, some), sum(s.count for s in some)
        for factor, unit in units_of_angles(some, case.written, True).items():
            if factor > _LEAST and misfit - n > 2.0 * n * float(np.log(factor)):
                said = f"their residuals are about {factor:.2g} times what they say: these sigmas {unit}"
                yield replace(with_sigmas(survey, some, factor, said, factor), evidence=_EVIDENCE)


def _of_readings(survey: Survey) -> list[Sigmas]:
    every = survey.readings
    angles = grouped(((r.kind, r.group), i) for i, r in enumerate(every) if r.used and r.kind in ANGLES)
    whole = {g: len(rows) for g, rows in grouped((r.group, r) for r in every if r.used).items()}
    return [
        Sigmas("readings", kind, group, tuple(rows), tuple(every[i].reading_id for i in rows),
               float(np.median([every[i].sigma for i in rows])), len(rows) == whole[group])
        for (kind, group), rows in angles.items()
    ]  # fmt: skip


def _of_pairs(survey: Survey) -> list[Sigmas]:
    every = survey.pairs
    groups = grouped((p.group, i) for i, p in enumerate(every) if p.used)
    return [
        Sigmas("pairs", "the rotation of pairs", group, tuple(rows), tuple(every[i].pair_id for i in rows),
               float(np.median([np.sqrt(every[i].cov[0, 0]) for i in rows])), False, "rotation")
        for group, rows in groups.items()
    ]  # fmt: skip


def _misfit(found: Screen, survey: Survey, some: list[Sigmas]) -> float:
    """Sum of squares of the components concerned, each bounded."""
    if some[0].field == "readings":
        squares = [found.readings[list(s.rows)] for s in some]
    else:
        pairs = (survey.pairs[i] for s in some for i in s.rows if survey.pairs[i].pair_id in found.motions)
        squares = [miss(p.b_from_a, found.motions[p.pair_id])[:3] ** 2 / np.diagonal(p.cov)[:3] for p in pairs]
    return float(np.minimum(np.concatenate(squares), CAP).sum())
