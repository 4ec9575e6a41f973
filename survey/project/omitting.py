"""A survey less what people left out: marked as not used, sets parted, joint readings taken apart."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from adjust.model.observations import CoordinateDifferences, Coordinates, Observation
from adjust.model.survey import BoolArray, IntArray, Survey
from survey.project.observed import IMAGES, SPOTS, Hits
from survey.project.project import SpotBlock


def without(survey: Survey, spots: Sequence[SpotBlock], hits: Hits) -> tuple[Survey, tuple[SpotBlock, ...]]:
    """The survey with everything hit marked as not used, and the spots less those hit."""
    masks, gone = hits.of(IMAGES), hits.of(SPOTS)
    blocks = tuple(replace(b, used=b.mask & ~masks[i]) if i in masks else b for i, b in enumerate(survey.image_blocks))
    changed: dict[str, Any] = {
        name: tuple(part for i, o in enumerate(getattr(survey, name)) for part in _parted(o, hits.masks.get((name, i))))
        for name in {name for name, _ in hits.masks} - {IMAGES, SPOTS}
    }
    less = replace(survey, image_blocks=blocks, **changed)
    if "readings" in changed:
        less = _with_joint_readings_apart(less)
    kept = [_fewer(spot, ~gone[i]) if i in gone else spot for i, spot in enumerate(spots)]
    return less, tuple(spot for spot in kept if spot.spot_ids)


def _parted(item: Observation, out: BoolArray | None) -> tuple[Observation, ...]:
    """What is left out marked as not used: of a set its rows, as one of their own."""
    if out is None or not item.used:
        return (item,)
    if out.all() or not isinstance(item, Coordinates | CoordinateDifferences):
        return (replace(item, used=False),)
    return _subset(item, np.flatnonzero(~out), True), _subset(item, np.flatnonzero(out), False)


def _subset(item: Coordinates | CoordinateDifferences, rows: IntArray, used: bool) -> Observation:
    axes = (3 * rows[:, None] + np.arange(3)).ravel()
    values, cov = item.values[rows], item.cov[np.ix_(axes, axes)]
    if isinstance(item, Coordinates):
        return replace(item, positions=tuple(item.positions[i] for i in rows), values=values, cov=cov, used=used)
    at, to = (tuple(refs[i] for i in rows) for refs in (item.at, item.to))
    return replace(item, at=at, to=to, values=values, cov=cov, used=used)


def _fewer(spot: SpotBlock, kept: BoolArray) -> SpotBlock:
    ids = tuple(one for one, keep in zip(spot.spot_ids, kept, strict=True) if keep)
    return replace(spot, spot_ids=ids, uv=spot.uv[kept], cov=spot.cov[kept])


def _with_joint_readings_apart(survey: Survey) -> Survey:
    """Readings with a joint covariance are all used or none: each of those left out gets one of its own."""
    left = {r.reading_id for r in survey.readings if r.used}
    parts = [part for c in survey.reading_covariances
             for part in ((c.of(left), *(c.of({name}) for name in c.reading_ids if name not in left))
                          if left.intersection(c.reading_ids) else (c,))]  # fmt: skip
    return replace(survey, reading_covariances=tuple(parts))
