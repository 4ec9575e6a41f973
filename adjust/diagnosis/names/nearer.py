"""Which of many changes of known coordinates bring these nearer to where readings alone put their points.

One start without any of the coordinates, and all changes against it at once, up to a shift and a turn about the plumb
line: only what that leaves is worth a start of its own.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.hypothesis import Hypothesis
from adjust.diagnosis.memory import own_start
from adjust.model.errors import SurveyError
from adjust.model.survey import Datum, FloatArray, PointParameter, Survey
from adjust.start.positions import given_points
from adjust.start.readings.sights import horizon_axes

_NEARER = 0.5
"""Of what the coordinates miss as they stand, all of them or the typical one: no more may be left."""
_FEWEST = 3
_SIDED = "direction", "angle", "azimuth"
"""Kinds of readings that tell a network from its mirror image."""


def nearer(survey: Survey, tried: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Those of the hypotheses, of surveys with other coordinates, that do; all where readings alone do not tell."""
    mine = [(h, h.survey) for h in tried if isinstance(h.survey, Survey)]
    alone = _from_readings(survey) if mine else {}
    names = [n for n in _known(survey) if n in alone]
    if len(names) < _FEWEST:
        return list(tried)
    every = [[given_points(s)[n] for n in names] for s in (survey, *(s for _, s in mine))]
    axes = horizon_axes(survey)
    missed = _missed(np.array(every) @ axes.T, np.array([alone[n] for n in names]) @ axes.T)
    of_all, typical = np.sqrt(np.mean(missed**2, axis=1)), np.median(missed, axis=1)
    far = (of_all > _NEARER * of_all[0]) & (typical > _NEARER * typical[0])  # of what is not known neither is true
    return [h for (h, _), away in zip(mine, far[1:], strict=True) if not away]


def _known(survey: Survey) -> list[str]:
    """Points that are held, have a prior or were observed."""
    firm = {p.point_id for p in survey.points if p.x_in_world.treatment != "free" or p.x_in_world.held}
    firm |= {ref.point_id or "" for c in survey.coordinates if c.used for ref in c.positions if ref.frame is None}
    return [p.point_id for p in survey.points if p.point_id in firm]


def _from_readings(survey: Survey) -> dict[str, FloatArray]:
    """Start values of the points without any coordinates; of none where they are not in the axes of the horizon."""
    kinds = {r.kind for r in survey.readings}
    if survey.image_blocks or not kinds.intersection(_SIDED) or not all(s.levelled for s in survey.setups):
        return {}
    points = tuple(replace(p, x_in_world=PointParameter()) for p in survey.points)
    try:
        start = own_start(replace(survey, points=points, coordinates=(), datum=Datum("inner")))
    except (SurveyError, RuntimeError):
        return {}
    return {n: np.asarray(x, dtype=float) for n, x in start.points.items()}


def _missed(places: FloatArray, alone: FloatArray) -> FloatArray:
    """(s, n) m, what each of s ways to place n points (s, n, 3) misses the one (n, 3), turned and shifted onto it."""
    about = places - places.mean(axis=1, keepdims=True)
    there = alone - alone.mean(axis=0)
    z, w = about[..., 0] + 1j * about[..., 1], there[:, 0] + 1j * there[:, 1]
    turn = (z.conj() * w).sum(axis=1, keepdims=True)
    turn /= np.maximum(np.abs(turn), np.finfo(float).tiny)
    return np.asarray(np.hypot(np.abs(turn * z - w), np.abs(about[..., 2] - there[:, 2])))
