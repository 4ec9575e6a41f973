"""Whitened rows of all observations at given values, before anything is solved: what each of them tells about what.

Nothing is condensed or hidden, so that sets of observations can be weighed against each other.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy import sparse

from adjust.graph.assembly import AdjustmentGraph, StartValues
from adjust.graph.building import GraphBuilder
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.observations.factors import ObservationFactor
from adjust.statistics.system import Columns, ItemRows, points_apart, survey_rows


@dataclass(frozen=True, eq=False)
class Observed:
    """The rows (k,) of one observation.

    kind, number: image block ``survey.image_blocks[number]``, or ``graph.others[number]`` under its kind, or
    ``survey.readings[number]`` under kind "reading".
    """

    kind: str
    number: int
    rows: IntArray


@dataclass(frozen=True, eq=False)
class DesignMatrix:
    """All observations of a survey at given values: A (m, n), zero in the rows of what is not used."""

    graph: AdjustmentGraph
    columns: Columns
    A: sparse.csr_matrix
    observations: tuple[Observed, ...]

    def normal(self) -> FloatArray:
        """Normal matrix (n, n) of all observations."""
        return np.asarray((self.A.T @ self.A).toarray())


def design_matrix(survey: Survey, start: StartValues) -> DesignMatrix:
    """Linearise every observation of the survey at ``start``. Raises SurveyError where a value is missing."""
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
    ends = _ranges([*found.ptr[blocks].tolist(), *found.ptr[found.n_image + 1 :].tolist()])
    parts = tuple(Observed(kind, i, rows) for (kind, i), rows in zip(kinds, ends, strict=True))
    return DesignMatrix(graph, found.columns, (sparse.diags(used) @ found.A).tocsr(), parts)


def _ranges(ends: Sequence[int]) -> list[IntArray]:
    return [np.arange(a, b) for a, b in pairwise(ends)]
