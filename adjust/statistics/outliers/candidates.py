"""Which part of a survey an observation of a linear system is, and the survey without some of them."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from adjust.graph.assembly import AdjustmentGraph
from adjust.model.frozen import frozen
from adjust.model.observations import ImageBlock, ReadingCovariance
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import BoolArray, IntArray, Survey

FIELDS = {
    "pair": "pairs", "distance": "distances", "coordinates": "coordinates", "level": "levels",
    "alignment": "alignments", "laser": "laser_spots", "surface": "on_surfaces",
    "coordinate_difference": "coordinate_differences",
}  # fmt: skip
"""Of a survey that hold the factors of a kind, one each in their order."""
_READINGS = "readings"


@frozen(eq=False)
class Candidates:
    """Observations that can be left out. place: by observation (field of the survey, index); images by their row.

    n_image, n: observations in all. image_ptr: (B + 1,) rows of the image blocks.
    """

    place: Mapping[int, tuple[str, int]]
    n_image: int
    n: int
    image_ptr: tuple[int, ...]

    @property
    def mask(self) -> BoolArray:
        """Which observations (n,) can be left out at all."""
        out = np.zeros(self.n, dtype=np.bool_)
        out[list(self.place)] = True
        out[: self.n_image] = True
        return out

    def of(self, field: str, rows: IntArray) -> tuple[int, ...]:
        """The observations that are these rows (k,) of a field of the survey."""
        index = {place: o for o, place in self.place.items()}
        return tuple(index[field, i] for i in rows.tolist())


def candidates(graph: AdjustmentGraph, images: bool = True) -> Candidates:
    """Of a graph; priors stay, for they are part of what is asked for. images: image points are counted, and first."""
    survey = graph.survey
    ptr = np.cumsum([0] + [len(b.uv) for b in survey.image_blocks if images])
    tables: dict[tuple[str, ...], int] = {(r.table_id, r.epoch_id): i for i, r in enumerate(survey.table_readings)}
    n_image, place, rows = int(ptr[-1]), dict[int, tuple[str, int]](), dict[str, list[int]]()
    for i, kind in enumerate(graph.of_others(lambda o: o.kind, lambda _: "pair")):
        rows.setdefault(kind, []).append(n_image + i)
    for kind, mine in rows.items():
        if kind == "table":
            place |= {o: ("table_readings", tables[graph.other(o - n_image).ids]) for o in mine}
        elif kind in FIELDS:
            if len(mine) != (n := len(getattr(survey, FIELDS[kind]))):
                raise ValueError(f"{len(mine)} factors of kind {kind} for {n} observations")
            place |= {o: (FIELDS[kind], k) for k, o in enumerate(mine)}
    first = n_image + graph.n_others
    place |= {first + i: (_READINGS, i) for i in range(len(survey.readings))}
    return Candidates(place, n_image, first + len(survey.readings), tuple(ptr.tolist()))


def without(survey: Survey, found: Candidates, rejected: Iterable[int]) -> Survey:
    """The survey with these observations out of use: predicted and tested, and as given for everything else."""
    out = np.zeros(found.n, dtype=np.bool_)
    out[list(rejected)] = True
    changed: Fields = {"image_blocks": _blocks(survey, found, out)}
    by_field: dict[str, set[int]] = {}
    for row in np.flatnonzero(out[found.n_image :]).tolist():
        field, i = found.place[row + found.n_image]
        by_field.setdefault(field, set()).add(i)
    for field, numbers in by_field.items():
        every = enumerate(getattr(survey, field))
        changed[field] = tuple(replace(x, used=False) if i in numbers else x for i, x in every)
    if _READINGS in by_field:
        lost = {survey.readings[i].reading_id for i in by_field[_READINGS]}
        joint = survey.reading_covariances
        changed["reading_covariances"] = tuple(part for c in joint for part in _parts(c, lost))
    return replace(survey, **changed)


def _blocks(survey: Survey, found: Candidates, out: BoolArray) -> tuple[ImageBlock, ...]:
    if not found.n_image:
        return survey.image_blocks
    gone = np.split(out[: found.n_image], found.image_ptr[1:-1])
    each = zip(survey.image_blocks, gone, strict=True)
    return tuple(replace(b, used=b.mask & ~mine) if mine.any() else b for b, mine in each)


def _parts(c: ReadingCovariance, lost: set[str]) -> list[ReadingCovariance]:
    """The covariance of what is left, and that of what is out: all readings of one covariance are used, or none."""
    parts = c.of(set(c.reading_ids) - lost), c.of(lost)
    return [part for part in parts if part.reading_ids]


def as_given(survey: Survey, given: Survey) -> Survey:
    """The survey with those image points in use that are so in the one it was made of: to be screened anew."""
    before = {b.place: b for b in given.image_blocks}
    same = {i: before[b.place] for i, b in enumerate(survey.image_blocks)
            if b.place in before and np.array_equal(before[b.place].point_idx, b.point_idx)}  # fmt: skip
    blocks = {i: replace(survey.image_blocks[i], used=b.used) for i, b in same.items()}
    return with_rows(survey, "image_blocks", blocks)
