"""Distances that fit the start values by far worse than anything else: in another unit, or between other points.

Least squares that begin with them can lead nowhere: they pull apart what all the others hold together.
"""

import numpy as np

from adjust.graph.building import GraphBuilder
from adjust.graph.divergence import misfits
from adjust.model.survey import BoolArray, Survey
from adjust.start import Start, find_start

_BY_FAR = 1e4
"""Square over its sigma, over that of the worst of all others, of images of the typical one, as many of them agree
only roughly at the start: a hundred times as many sigmas."""


def distances_that_stand_out(survey: Survey) -> tuple[BoolArray, Start] | None:
    """Which (n,) of the distances do, fewer than half of them or all, and the start values; None where none does.

    All of them only among as many others, which hold the survey together without.

    Raises SurveyError where there are no start values.
    """
    start = find_start(survey)
    graph = GraphBuilder(survey, start.lenses).build(start)
    every = misfits(graph, graph.start)
    mine = {m.owner.removeprefix("distance "): m.square for m in every if m.owner.startswith("distance ")}
    images = [m.square for m in every if m.owner.startswith("camera ")]
    others = [m.square for m in every if not m.owner.startswith(("distance ", "camera "))]
    rest = max([float(np.median(images or [0.0])), *others])
    square = np.array([mine.get(d.distance_id, 0.0) for d in survey.distances])
    worst = np.argsort(-square, kind="stable")
    all_of_them = [len(square)] if len(images) + len(others) >= len(square) else []
    for k in (*range(1, (len(square) + 1) // 2), *all_of_them):
        if square[worst[k - 1]] > _BY_FAR * max([rest, 1.0, *square[worst[k : k + 1]]]):
            return np.isin(np.arange(len(square)), worst[:k]), start
    return None
