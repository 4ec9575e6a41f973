"""Observations that could be added to a design, and what each of them tells about the unknowns that are there."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.linalg import qr

from adjust.design.exact import exact
from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.observations import (
    Alignment,
    CoordinateDifferences,
    Coordinates,
    Distance,
    ImageBlock,
    LaserSpot,
    Level,
    OnSurface,
    Pair,
    Reading,
    TableReading,
)
from adjust.model.result import ParameterName
from adjust.model.rewriting import Fields
from adjust.model.survey import BoolArray, FloatArray, IntArray, Point, Survey
from adjust.observations.factors import ObservationFactor
from adjust.statistics.outliers.candidates import FIELDS
from adjust.statistics.rows import Columns, ItemRows, points_apart, survey_rows

_RANK = 1e-10


@frozen(eq=False)
class Candidate:
    """Something to measure in addition: an epoch with its images and reading, a beacon, a distance, a pair, readings.

    image_blocks of world points count the survey's points first, then ``points``, which are new. What only this
    candidate observes (a new beacon, the angles of a new epoch) comes with it as new unknowns.
    """

    name: str
    kind: str
    image_blocks: tuple[ImageBlock, ...] = ()
    table_readings: tuple[TableReading, ...] = ()
    pairs: tuple[Pair, ...] = ()
    distances: tuple[Distance, ...] = ()
    coordinates: tuple[Coordinates, ...] = ()
    points: tuple[Point, ...] = ()
    readings: tuple[Reading, ...] = ()
    coordinate_differences: tuple[CoordinateDifferences, ...] = ()
    levels: tuple[Level, ...] = ()
    alignments: tuple[Alignment, ...] = ()
    laser_spots: tuple[LaserSpot, ...] = ()
    on_surfaces: tuple[OnSurface, ...] = ()


_IN_ORDER = FIELDS | {"reading": "readings"}


def with_candidates(survey: Survey, candidates: Sequence[Candidate]) -> Survey:
    """The survey with all of these measured too."""
    n, blocks, points = len(survey.points), list(survey.image_blocks), list(survey.points)
    for c in candidates:
        shift = len(points) - n
        points += c.points
        for b in c.image_blocks:
            moved = np.where(b.point_idx >= n, b.point_idx + shift, b.point_idx) if b.target_id is None else b.point_idx
            blocks.append(replace(b, point_idx=moved))
    lists: Fields = {
        name: getattr(survey, name) + tuple(x for c in candidates for x in getattr(c, name))
        for name in (*_IN_ORDER.values(), "table_readings")
    }
    return replace(survey, points=tuple(points), image_blocks=tuple(blocks), **lists)


@frozen(eq=False)
class Observed:
    """The rows (k,) of one observation.

    kind, number: image block ``survey.image_blocks[number]``, or ``graph.others[number]`` under its kind, or
    ``survey.readings[number]`` under kind "reading".
    """

    kind: str
    number: int
    rows: IntArray


@frozen(eq=False)
class DesignMatrix:
    """All observations of a survey at given values: A (m, n), zero in the rows of what is not used."""

    graph: AdjustmentGraph
    columns: Columns
    A: sparse.csr_matrix
    observations: tuple[Observed, ...]


def design_matrix(survey: Survey, start: StartValues) -> DesignMatrix:
    """Whitened rows of every observation of the survey at ``start``; nothing is condensed or hidden.

    So sets of observations can be weighed against each other. Raises SurveyError where a value is missing.
    """
    graph = GraphBuilder(survey, start.lenses).build(start)
    graph.prepare(graph.start, jacobians=False)

    def of_item(item: ObservationFactor) -> ItemRows:
        linear = item.factor.linearize(graph.start)
        A, b = linear.jacobian()
        return list(linear.keys()), A, -b

    found = survey_rows(graph, graph.start, points_apart, of_item)
    used = np.repeat(found.used, np.diff(found.ptr)).astype(float)
    blocks = np.cumsum([0, *(len(b.uv) for b in survey.image_blocks)])
    kinds = [("image", i) for i in range(len(survey.image_blocks))]
    kinds += list(zip(graph.of_others(lambda o: o.kind, lambda _: "pair"), range(graph.n_others), strict=True))
    kinds += [("reading", i) for i in range(len(survey.readings))]
    ends = pairwise([*found.ptr[blocks].tolist(), *found.ptr[found.n_image + 1 :].tolist()])
    parts = tuple(Observed(kind, i, np.arange(a, b)) for (kind, i), (a, b) in zip(kinds, ends, strict=True))
    return DesignMatrix(graph, found.columns, (sparse.diags(used) @ found.A).tocsr(), parts)


@frozen(eq=False)
class Informed:
    """What candidates tell about the unknowns of the design: whitened rows, their own new unknowns eliminated.

    names: the unknowns that any of them touches or that are wanted, n components in all. J: of every candidate (k, n);
    its information on them is J' J.
    """

    names: tuple[ParameterName, ...]
    J: tuple[FloatArray, ...]


def inform(
    survey: Survey, start: StartValues, candidates: Sequence[Candidate], wanted: Sequence[ParameterName]
) -> Informed:
    """Rows of all candidates at ``start``, which has a value for what they bring along.

    Raises SurveyError where two candidates share a new unknown, so that neither can be judged alone.
    """
    whole = with_candidates(survey, candidates)
    design = design_matrix(exact(whole, start), start)
    columns, by_name = design.columns, design.graph.unknowns.by_name
    base = set(_names_of(survey, start))
    owned: list[list[IntArray]] = [[] for _ in candidates]
    for part, owner in zip(design.observations, _owners(survey, candidates, design), strict=True):
        if owner is not None:
            owned[owner].append(part.rows)
    own = [design.A[np.concatenate(rows or [np.zeros(0, dtype=np.int64)])] for rows in owned]
    private = np.ones(len(columns), dtype=np.bool_)
    private[columns.of([n for n in columns.at if n in base])] = False
    _check_apart(columns, own, private, candidates)
    touched = np.zeros(len(columns), dtype=np.bool_)
    for A in own:
        touched[A.indices] = True
    names = tuple(n for n in columns.at if n in base and (touched[columns.at[n]].any() or n in set(wanted)))
    first = np.cumsum([0, *(by_name[n].dim for n in names)])
    free = (k + columns.free[n] for k, n in zip(first[:-1], names, strict=True))
    place = np.concatenate([np.zeros(0, dtype=np.int64), *free])
    J = []
    for A in own:
        told = _eliminated(A, columns.of(names), private)
        J.append(np.zeros((len(told), int(first[-1]))))
        J[-1][:, place] = told
    return Informed(names, tuple(J))


def _names_of(survey: Survey, start: StartValues) -> tuple[ParameterName, ...]:
    return tuple(GraphBuilder(survey, start.lenses).build(start).unknowns.by_name)


def _owners(survey: Survey, candidates: Sequence[Candidate], design: DesignMatrix) -> list[int | None]:
    """For each of the design's observations the candidate that brings it, None for what is planned anyway."""
    images: list[int | None] = [None] * len(survey.image_blocks)
    ordered: dict[str, list[int | None]] = {k: [None] * len(getattr(survey, name)) for k, name in _IN_ORDER.items()}
    readings: dict[tuple[str, ...], int] = {}
    points: dict[tuple[str, ...], int] = {}
    for i, c in enumerate(candidates):
        images += [i] * len(c.image_blocks)
        for kind, name in _IN_ORDER.items():
            ordered[kind] += [i] * len(getattr(c, name))
        readings |= {(r.table_id, r.epoch_id): i for r in c.table_readings}
        points |= {("point", p.point_id): i for p in c.points}
    others = design.graph.others
    # readings are not among the others and count from 0
    first = {kind: next((k for k, o in enumerate(others) if o.kind == kind), 0) for kind in ordered}
    out: list[int | None] = []
    for part in design.observations:
        if part.kind == "image":
            out.append(images[part.number])
        elif part.kind == "table":
            out.append(readings.get(others[part.number].ids))
        elif part.kind == "prior":
            out.append(points.get(others[part.number].ids))
        else:  # kinds that no candidate brings are of the design
            out.append(ordered[part.kind][part.number - first[part.kind]] if part.kind in ordered else None)
    return out


def _check_apart(
    columns: Columns, own: Sequence[sparse.csr_matrix], private: BoolArray, candidates: Sequence[Candidate]
) -> None:
    holder = np.full(len(columns), -1)
    for i, A in enumerate(own):
        mine = np.unique(A.indices[private[A.indices]])
        if (taken := mine[holder[mine] >= 0]).size:
            raise SurveyError(
                f"candidates {candidates[int(holder[taken[0]])].name!r} and {candidates[i].name!r} both bring the "
                f"new unknown {' '.join(columns.names[taken[0]])}; make one candidate of them, or give them ids of "
                "their own"
            )
        holder[mine] = i


def _eliminated(told: sparse.csr_matrix, columns: IntArray, private: BoolArray) -> FloatArray:
    """Rows over ``columns`` that are left when the candidate's own unknowns are eliminated, at most as many as these.

    The rows are turned so that the own unknowns appear in the first ones alone (orthogonal elimination, by rank where
    the candidate does not determine them).
    """
    A = told.toarray()
    if not len(A):
        return np.zeros((0, len(columns)))
    own = np.flatnonzero(private & (A != 0).any(axis=0))
    both = np.hstack([A[:, own], A[:, columns]])
    used = np.flatnonzero((both != 0).any(axis=0))
    if len(both) > len(used):
        small = qr(both[:, used], mode="r")[0][: len(used)]
        both = np.zeros((len(small), both.shape[1]))
        both[:, used] = small
    J = both[:, len(own) :]
    if len(own):
        scale = np.linalg.norm(both[:, : len(own)], axis=0)
        U, R, _ = qr(both[:, : len(own)] / scale, pivoting=True)
        diagonal = np.abs(np.diag(R))
        J = U[:, int(np.sum(diagonal > _RANK * diagonal[0])) :].T @ J
    return np.asarray(J)
