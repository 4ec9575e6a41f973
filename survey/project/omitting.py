"""A survey less what people left out: marked as not used, sets parted, joint readings taken apart."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from adjust.model.observations import CoordinateDifferences, Coordinates, Observation, ReadingCovariance
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
    """Readings with a joint covariance are all used or none: those left out get their own sigma, the others theirs."""
    used = {r.reading_id: r.used for r in survey.readings}
    alone: dict[str, float] = {}
    joint = []
    for item in survey.reading_covariances:
        flags = [used[name] for name in item.reading_ids]
        if all(flags) or not any(flags):
            joint.append(item)
            continue
        kept = [i for i, flag in enumerate(flags) if flag]
        single = [i for i in range(len(flags)) if i not in kept or len(kept) == 1]
        alone |= {item.reading_ids[i]: float(np.sqrt(item.cov[i, i])) for i in single}
        if len(kept) > 1:
            names = tuple(item.reading_ids[i] for i in kept)
            joint.append(ReadingCovariance(names, item.cov[np.ix_(kept, kept)]))
    readings = tuple(replace(r, sigma=alone[r.reading_id]) if r.reading_id in alone else r for r in survey.readings)
    return replace(survey, readings=readings, reading_covariances=tuple(joint))
