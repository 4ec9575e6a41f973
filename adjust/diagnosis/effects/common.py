"""What all distances of a group, or all observed coordinates, have in common: a constant, a scale, another frame."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, of_others
from adjust.diagnosis.hypothesis import ChangeColumns, ChangeReadings, Edit, Hypothesis, Place
from adjust.diagnosis.prediction import Linear
from adjust.model.names import grouped
from adjust.model.observations import position_text
from adjust.model.result import Adjustment
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.spatial.rigid import inverse, rotation_exp, rotation_log, skew
from adjust.statistics.score import Score

_FEWEST = 3
_LARGEST = 0.05
"""Of a scale, and of a constant over the lengths; a larger one is a unit."""
_PPM = 1e6
_COLUMNS = ("x_mm", "y_mm", "z_mm")
IN_ORDER, EXCHANGED = (0, 1, 2), (1, 0, 2)
"""Columns of coordinates as they stand, and north first."""
_FRAME = "frame of coordinates"
_IN_WORLD = "give them in the frame of the world, or let them define it and hold nothing else"
Said = Callable[[FloatArray, FloatArray], str]


def common(case: Case, linear: Linear) -> Iterator[Effect]:
    """Of every group of distances a constant and a scale, of all coordinates a scale and another frame."""
    survey = case.survey
    groups = grouped((d.group, i) for i, d in enumerate(survey.distances) if d.used)
    for group, rows in groups.items():
        for scale in (False, True) if len(rows) >= _FEWEST else ():
            effect = _of_distances(survey, linear, group, rows, scale)
            length = 1.0 if scale else float(np.median([survey.distances[i].value for i in rows]))
            if (abs(effect.first.theta) < _LARGEST * length).all():
                yield effect
    rows = whole_points(survey)
    if len(rows) >= _FEWEST:
        scaled = _scaled(survey, linear, rows)
        yield from [scaled] if (abs(scaled.first.theta) < _LARGEST).all() else []
        yield _elsewhere(survey, linear, rows)


def _of_distances(survey: Survey, linear: Linear, group: str, rows: list[int], scale: bool) -> Effect:
    observed = [survey.distances[i] for i in rows]
    by = np.array([d.value if scale else 1.0 for d in observed])
    ids = {d.distance_id: np.array([[x]]) for d, x in zip(observed, by.tolist(), strict=True)}
    what, unit, in_unit = ("a scale", "ppm", _PPM) if scale else ("a constant", "mm", 1e3)
    source = "the length standard or its temperature" if scale else "the zero of the instrument, or the ends of bars"

    def mended(_: Adjustment, theta: FloatArray) -> Survey:
        new = {i: replace(d, value=d.value - theta[0] * x) for i, d, x in zip(rows, observed, by.tolist(), strict=True)}
        return with_rows(survey, "distances", new)

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        size = f"{in_unit * theta[0]:+.4g} +- {in_unit * sigmas[0]:.2g} {unit}"
        return f"all distances of group {group} have {what} in common, by {size}"

    def edits(theta: FloatArray) -> tuple[Edit, ...]:
        factor, offset = (1.0 - float(theta[0]), 0.0) if scale else (1.0, -float(theta[0]))
        return (ChangeReadings(tuple(ids), factor, offset, "distances"),)

    hypothesis = Hypothesis(
        "scale of distances" if scale else "constant of distances", "",
        f"take that off value_mm of distances.csv, and find where it comes from: {source}",
        Place("reading", tuple(ids), "value_mm"), survey,
    )  # fmt: skip
    return _effect(linear, hypothesis, "distance", ids, mended, said, edits)


def _scaled(survey: Survey, linear: Linear, rows: list[int]) -> Effect:
    points = _points(survey, rows)

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        size = f"{_PPM * theta[0]:+.4g} +- {_PPM * sigmas[0]:.2g} ppm"
        return f"all coordinates in coordinates.csv have a scale in common, by {size}"

    return _of_coordinates(
        survey, linear, rows, "scale of coordinates", "take that off all of them in coordinates.csv, and find where it "
        "comes from: a map projection, or the length standard", {n: x[:, None] for n, x in points.items()}, said,
        lambda theta: ((1.0 - theta[0]) * np.eye(3), np.zeros(3)),
    )  # fmt: skip


def _elsewhere(survey: Survey, linear: Linear, rows: list[int]) -> Effect:
    """Columns: turns about the axes of the world, then shifts."""
    points = _points(survey, rows)
    return _of_coordinates(
        survey, linear, rows, _FRAME, _IN_WORLD, {n: np.hstack([-skew(x), np.eye(3)]) for n, x in points.items()},
        lambda theta, _: _elsewhere_text(theta), lambda theta: (rotation_exp(-theta[:3]), -theta[3:]),
    )  # fmt: skip


def _elsewhere_text(theta: FloatArray, exchanged: bool = False) -> str:
    turn = "(" + ", ".join(f"{x:.4g}" for x in np.degrees(theta[:3])) + ")"
    shift = "(" + ", ".join(f"{x:.6g}" for x in 1e3 * theta[3:]) + ")"
    where = f"in another frame, turned by {turn} deg and shifted by {shift} mm"
    if exchanged:
        return f"the coordinates in coordinates.csv stand, with x and y exchanged, {where}"
    return f"the coordinates in coordinates.csv stand {where}"


def whole_points(survey: Survey) -> list[int]:
    """Coordinates in use of which all three were observed; none where some are sets of several points."""
    rows = [i for i, c in enumerate(survey.coordinates) if c.used and np.isfinite(np.diag(c.cov)).all()]
    return rows if all(len(survey.coordinates[i].positions) == 1 for i in rows) else []


def in_another_frame(
    survey: Survey, rows: list[int], world_from_given: FloatArray, columns: Sequence[int] = IN_ORDER
) -> Hypothesis:
    """Coordinates ``rows``, one point each, in a frame that is known (4, 4), of their columns in this order."""
    given_from_world = inverse(world_from_given)
    matrix, offset = world_from_given[:3, :3][:, columns], world_from_given[:3, 3]
    theta = np.concatenate([rotation_log(given_from_world[:3, :3]), given_from_world[:3, 3]])
    points = tuple(_points(survey, rows))
    return Hypothesis(
        _FRAME, _elsewhere_text(theta, columns != IN_ORDER), _IN_WORLD, Place("point", points, "x_mm"),
        _moved(survey, rows, matrix, offset),
        (ChangeColumns("coordinates", _COLUMNS, matrix, 1e3 * offset, {"point_id": points}),),
    )  # fmt: skip


def _moved(survey: Survey, rows: list[int], matrix: FloatArray, offset: FloatArray) -> Survey:
    new = {i: replace(c, values=c.values @ matrix.T + offset) for i in rows for c in [survey.coordinates[i]]}
    return with_rows(survey, "coordinates", new)


def _points(survey: Survey, rows: list[int]) -> dict[str, FloatArray]:
    return {position_text(c.positions[0]): c.values[0] for c in (survey.coordinates[i] for i in rows)}


def _of_coordinates(
    survey: Survey, linear: Linear, rows: list[int], name: str, remedy: str, shifts: dict[str, FloatArray], said: Said,
    back: Callable[[FloatArray], tuple[FloatArray, FloatArray]],
) -> Effect:  # fmt: skip
    """back: by a size the matrix and the offset (m) that take the change off."""

    def mended(_: Adjustment, theta: FloatArray) -> Survey:
        return _moved(survey, rows, *back(theta))

    def edits(theta: FloatArray) -> tuple[Edit, ...]:
        matrix, offset = back(theta)
        return (ChangeColumns("coordinates", _COLUMNS, matrix, 1e3 * offset, {"point_id": tuple(shifts)}),)

    hypothesis = Hypothesis(name, "", remedy, Place("point", tuple(shifts), "x_mm"), survey)
    return _effect(linear, hypothesis, "coordinates", shifts, mended, said, edits)


def _effect(
    linear: Linear, hypothesis: Hypothesis, kind: str, shifts: dict[str, FloatArray],
    mended: Callable[[Adjustment, FloatArray], Survey], said: Said, edits: Callable[[FloatArray], tuple[Edit, ...]],
) -> Effect:  # fmt: skip
    """shifts: of the observed, by the first of the ids of an observation."""

    def score(at: Linear) -> Score:
        others = at.system.precision.graph.others
        return of_others(at, kind, {o.ids: shifts[o.ids[0]] for o in others if o.kind == kind and o.ids[0] in shifts})

    def edited(theta: FloatArray, sigmas: FloatArray) -> tuple[FloatArray, Fields]:
        return theta, {"cause": said(theta, sigmas), "edits": edits(theta)}

    return Effect(hypothesis, score(linear), score, mended, said, known=edited)
