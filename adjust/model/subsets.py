"""Positions that observations name: other ones in their place, or a survey less what concerns some of them."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from adjust.model.observations import PositionRef
from adjust.model.survey import Survey

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

Item = TypeVar("Item", bound="DataclassInstance")


def with_positions(item: Item, new: Callable[[PositionRef], PositionRef]) -> Item:
    """An observation with other positions in the place of those that it names."""
    changed: dict[str, PositionRef | tuple[PositionRef, ...]] = {}
    for name in item.__dataclass_fields__:
        value = getattr(item, name)
        if isinstance(value, PositionRef):
            changed[name] = new(value)
        elif isinstance(value, tuple) and value and isinstance(value[0], PositionRef):
            changed[name] = tuple(map(new, value))
    return replace(item, **changed)


def only_between(survey: Survey, keep: Callable[[PositionRef], bool]) -> Survey:
    """Only the distances, coordinates, differences, readings and surfaces all of whose positions are to be kept."""

    def all_kept(refs: Iterable[PositionRef | None]) -> bool:
        return all(ref is None or keep(ref) for ref in refs)

    readings = tuple(r for r in survey.readings if all_kept((r.at, r.to, r.second)))
    left = {r.reading_id for r in readings}
    covariances = (item.of(left) for item in survey.reading_covariances)
    vertical = survey.vertical
    if not readings and not survey.levels:  # nothing is left that could tell its tilt
        vertical = replace(vertical, tilt=replace(vertical.tilt, free=(), prior=None))
    return replace(
        survey,
        vertical=vertical,
        distances=tuple(d for d in survey.distances if all_kept((d.a, d.b))),
        coordinates=tuple(c for c in survey.coordinates if all_kept(c.positions)),
        coordinate_differences=tuple(d for d in survey.coordinate_differences if all_kept((*d.at, *d.to))),
        on_surfaces=tuple(o for o in survey.on_surfaces if all_kept((o.position,))),
        readings=readings,
        reading_covariances=tuple(c for c in covariances if len(c.reading_ids) > 1),
    )


def with_points(survey: Survey, kept: Sequence[int]) -> Survey:
    """The survey with these of its world points (positions in ``points``), less all that was observed of the others."""
    if len(kept) == len(survey.points):
        return survey
    new = np.full(len(survey.points), -1, dtype=np.int64)
    new[list(kept)] = np.arange(len(kept))
    blocks = []
    for block in survey.image_blocks:
        if block.target_id is None:
            left = block.part(new[block.point_idx] >= 0)
            block = replace(left, point_idx=new[left.point_idx])
        blocks += [block] if len(block.uv) else []
    ids = {survey.points[i].point_id for i in kept}
    less = only_between(survey, lambda ref: ref.frame is not None or ref.point_id in ids)
    return replace(less, points=tuple(survey.points[i] for i in kept), image_blocks=tuple(blocks))


def in_use(survey: Survey) -> Survey:
    """The survey less the image points and table readings that are not used: for what predicts nothing of them."""
    blocks = tuple(b.in_use() for b in survey.image_blocks if b.n_used)
    return replace(survey, image_blocks=blocks, table_readings=tuple(r for r in survey.table_readings if r.used))


def points_read(survey: Survey) -> set[str]:
    """Ids of the world points that used readings and coordinate differences reach."""
    refs = [r for x in survey.readings if x.used for r in (x.at, x.to, x.second) if r is not None]
    refs += [r for d in survey.coordinate_differences if d.used for r in (*d.at, *d.to)]
    return {r.point_id for r in refs if r.frame is None and r.point_id is not None}
