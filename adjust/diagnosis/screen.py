"""A survey evaluated at rough values, without adjusting: which of its observations fit what the others say.

The closed forms of the start are robust: what one set-up or one pair says wrongly leaves the rest where it belongs.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import gtsam
import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.memory import own_start
from adjust.graph.assembly import AdjustmentGraph, StartValues, values_of
from adjust.graph.building import GraphBuilder
from adjust.model.errors import SurveyError
from adjust.model.frozen import frozen
from adjust.model.memory import remembered
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.observations.terrestrial import equations as k
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.observations.terrestrial.layout import ReadingArrays
from adjust.precision.precision import adjusted_motion, residual_of
from adjust.spatial.averaging import circular_median, circular_medians
from adjust.start.positions import given_points

_MEDIAN = 0.455  # of chi-square with one degree of freedom
_MISSED = 25.0
"""Square over its sigma, and over the variance factor of rough values, from which a reading does not fit."""
_AT_ONCE = 200_000  # readings that are predicted in one go


@frozen(eq=False)
class Fit:
    """How observations fit rough values.

    readings: (N,) squares over sigmas of all readings. others: (k,) mean squares over sigmas of the components of what
    is neither a reading nor an image point.
    """

    readings: FloatArray
    others: FloatArray

    @cached_property
    def scale(self) -> float:
        """Variance factor of the rough values: they miss by more than noise; of the typical observation."""
        every = np.concatenate([self.readings, self.others])
        return max(1.0, float(np.median(every)) / _MEDIAN) if len(every) else 1.0

    @cached_property
    def missed(self) -> BoolArray:
        """Which readings (N,) do not fit."""
        return np.asarray(self.readings > _MISSED * self.scale)

    def misfit(self, scale: float = 1.0) -> float:
        """Sum of squares, each bounded, over a variance factor."""
        return float(np.minimum(np.concatenate([self.readings, self.others]) / scale, CAP).sum())


@frozen(eq=False)
class Screen(Fit):
    """A graph at its start values. ``start``: these; orientations of set-ups are medians of their directions."""

    graph: AdjustmentGraph
    start: StartValues

    def alternatives(self, sets: Sequence[IntArray], **changed: Any) -> list[FloatArray]:
        """Squares over sigmas of each set of readings (rows) if they were others, and all else stayed where it is.

        changed: fields of the arrays of readings, of all sets one after the other. Directions of a set-up share a turn.
        """
        batch = self.graph.terrestrial
        if batch is None or not sets:
            return [np.zeros(len(rows)) for rows in sets]
        every, a = np.concatenate(sets), batch.layout.arrays
        observed = changed.pop("observed", a.observed[every])
        read = replace(a.of(every), **changed)
        predicted = k.predict(read, batch.geometry, batch.sign, batch.curve)[0] if changed else batch.predicted[every]
        miss = k.wrapped(read.kind, predicted, observed)
        ends = np.cumsum([0, *(len(rows) for rows in sets)])
        for rows, i, j in zip(sets, ends[:-1].tolist(), ends[1:].tolist(), strict=True):
            directions = i + np.flatnonzero(read.kind[i:j] == k.DIRECTION)
            for setup in np.unique(read.orientation[directions]).tolist():
                of = directions[read.orientation[directions] == setup]
                rest = self._directions.get(setup, rows[:0])
                both = np.concatenate([batch.residual[rest[~np.isin(rest, rows)]], miss[of]])
                miss[of] = _turned(miss[of], circular_median(both[np.isfinite(both)]))
        return np.split(_finite((miss / batch.sigma[every]) ** 2), ends[1:-1])

    @cached_property
    def _directions(self) -> dict[int, IntArray]:
        """Rows of the directions of each set-up, by its number."""
        return {} if self.graph.terrestrial is None else _directions(self.graph.terrestrial.layout.arrays)

    @cached_property
    def motions(self) -> dict[str, FloatArray]:
        """By pair the logarithm (6,) or (3,) of its motion as everything else has it."""
        pairs = [o for o in self.graph.others if o.kind == "pair"]
        return {o.ids[0]: adjusted_motion(o.observed, residual_of(o, self.graph.start)) for o in pairs}

    def pairs_of(self, survey: Survey) -> FloatArray:
        """(p,) squares over sigmas of the pairs of a survey, in their order; zero of what is no factor."""
        at = {o.ids[0]: self.others[i] for i, o in enumerate(self.graph.others) if o.kind == "pair"}
        return np.array([at.get(p.pair_id, 0.0) for p in survey.pairs])

    def drop(self, rows: IntArray, after: FloatArray) -> float:
        """How much less everything misfits when these readings do as in ``after`` (n,), squares over sigmas."""
        found = []
        for scales, whole in self._scales:
            own, now = (np.minimum(s / scales[rows], CAP).sum() for s in (self.readings[rows], after))
            found.append(improvement(whole, whole - float(own) + float(now), len(self.readings)))
        return max(found)

    @cached_property
    def _scales(self) -> list[tuple[FloatArray, float]]:
        """Variance factors (N,) of the rough values, and the misfit by them: all alike; angles and the rest apart.

        Places that are off by so much miss angles by more of their sigmas than distances. Where all have one factor,
        more than half of the angles may be misread.
        """
        alike = np.full(len(self.readings), self.scale)
        kind = self.graph.terrestrial.layout.arrays.kind if self.graph.terrestrial is not None else np.zeros(0)
        angles, apart = np.isin(kind, (k.DIRECTION, k.ANGLE, k.ZENITH, k.AZIMUTH)), alike.copy()
        for rows in (angles, ~angles):
            if rows.any():
                apart[rows] = max(1.0, float(np.median(self.readings[rows])) / _MEDIAN)
        return [(s, float(np.minimum(self.readings / s, CAP).sum())) for s in (alike, apart)]

    def afresh(self, surveys: Sequence[Survey]) -> list[Fit | None]:
        """The same readings with other values, or between points with other given coordinates, each at its own start.

        None where there is no start. All are predicted together, as far as they are between points of the world.
        """
        batch, own = self.graph.terrestrial, self.graph.survey
        refs = own.reading_refs
        others_move = bool(self.graph.others) and any(s.points is not own.points for s in surveys)
        poses = any(u.kind == "pose" for u in self.graph.unknowns.by_key.values())
        if batch is None or others_move or poses or own.image_blocks or any(r.frame is not None for r in refs):
            return [screen(s) for s in surveys]
        at_once = max(1, _AT_ONCE // len(own.readings))
        out = list[Fit | None]()
        for i in range(0, len(surveys), at_once):
            some = surveys[i : i + at_once]
            starts = [_given(s) or _start(s) for s in some]
            known = [(s, start) for s, start in zip(some, starts, strict=True) if start is not None]
            found = iter(self._between_points(batch, known, [str(r.point_id) for r in refs]) if known else [])
            out += [None if start is None else next(found) for start in starts]
        return out

    def _between_points(
        self, batch: TerrestrialBatch, known: Sequence[tuple[Survey, StartValues]], ids: Sequence[str]
    ) -> list[Fit]:
        """ids: of the points of the batch's positions."""
        a, plumb = batch.layout.arrays, batch.parameters.vertical.at(self.graph.start)
        held, points = self.graph.unknowns.held_points, list[dict[str, Any]]()
        for survey, start in known:
            given = {p.point_id: p.x_in_world.value for p in survey.points if p.point_id in held}
            points.append({**start.points, **given})
        each = np.array([[x[i] for i in ids] for x in points], dtype=float).reshape(len(points), -1)
        different, which = np.unique(each, axis=0, return_inverse=True)
        X, n = different.reshape(-1, 3), len(different)
        first = np.repeat(len(ids) * np.arange(n), len(a.kind))
        every = a.of(np.tile(np.arange(len(a.kind)), n))
        ends = {name: np.where((at := getattr(every, name)) >= 0, at + first, at) for name in ("at", "to", "second")}
        every = replace(every, **ends)
        geometry = replace(batch.geometry, X=X, horizon=plumb.horizon(X))
        predicted = k.predict(every, geometry, batch.sign, batch.curve)[0]
        observed = np.array([[r.value for r in survey.readings] for survey, _ in known])
        predicted = predicted.reshape(n, -1)[which.ravel()]
        miss = k.wrapped(a.kind, predicted, observed)
        for rows in _directions(a).values():
            miss[:, rows] = _turned(miss[:, rows], _medians(miss[:, rows])[:, None])
        e = miss / batch.sigma
        for chunk in batch.layout.chunks:
            if chunk.whitener is not None:
                e[:, chunk.rows] = miss[:, chunk.rows] @ chunk.whitener.T
        return [Fit(_finite(row**2), self._others_at(start)) for row, (_, start) in zip(e, known, strict=True)]

    def _others_at(self, start: StartValues) -> FloatArray:
        values = self.graph.start
        if self.graph.others:
            values = gtsam.Values(values)
            for name, unknown in self.graph.unknowns.by_name.items():
                if name[0] == "point":
                    values.update(unknown.key, np.asarray(start.points[name[1]], dtype=float))
        return _others(self.graph, values)


def _directions(a: ReadingArrays) -> dict[int, IntArray]:
    rows = np.flatnonzero(a.kind == k.DIRECTION)
    return {int(i): rows[a.orientation[rows] == i] for i in np.unique(a.orientation[rows])}


def _turned(miss: FloatArray, by: Any) -> FloatArray:
    """Misses of directions once their set-up is turned."""
    return k.wrapped(np.full(miss.shape, k.DIRECTION), miss, by)


def _medians(miss: FloatArray) -> FloatArray:
    """(n,) circular medians of the finite ones of each row."""
    if np.isfinite(miss).all():
        return circular_medians(miss)
    return np.array([circular_median(row[np.isfinite(row)]) for row in miss])


def _others(graph: AdjustmentGraph, values: gtsam.Values) -> FloatArray:
    found = [(2.0 * o.factor.error(values), max(1, len(o.components))) for o in graph.others]
    return _finite(np.array([square / n for square, n in found]))


def _finite(squares: FloatArray) -> FloatArray:
    return np.where(np.isfinite(squares), squares, np.inf)


def _given(survey: Survey) -> StartValues | None:
    """The start of points alone, which :func:`find_start` takes as they come; None where one does not."""
    known = given_points(survey)
    whole = all(p.point_id in known and np.isfinite(known[p.point_id]).all() for p in survey.points)
    return StartValues({}, {}, known, {}) if whole else None


def _start(survey: Survey) -> StartValues | None:
    try:
        return own_start(survey)
    except (SurveyError, RuntimeError):
        return None


def screen(survey: Survey, start: StartValues | None = None) -> Screen | None:
    """The survey at given or at its own start values; None where none can be found."""
    start = start or _start(survey)
    if start is None:
        return None
    try:
        vectors = {n: v for n, v in start.vectors.items() if n[0] != "orientation"}
        graph = GraphBuilder(survey, start.lenses).build(replace(start, vectors=vectors))
    except (SurveyError, RuntimeError):  # as of the start
        return None
    readings = np.zeros(0) if graph.terrestrial is None else graph.terrestrial.unweighted(graph.start)
    return Screen(_finite(readings**2), _others(graph, graph.start), graph, start)


def screen_without(survey: Survey, rows: frozenset[int]) -> Screen | None:
    """The survey at the start that is found without some of its readings, which may have spoilt it; None as before."""
    start = _start(remembered(_without, survey, rows))
    return None if start is None else screen(survey, start)


def _without(survey: Survey, rows: frozenset[int]) -> Survey:
    return replace(survey, readings=tuple(r for i, r in enumerate(survey.readings) if i not in rows))


@lru_cache(maxsize=2)
def at_best(case: Case) -> Screen | None:
    """At the adjustment where there is one that left out what contradicts, else at the start."""
    if case.result is not None and case.result.global_test is not None and case.result.global_test.passed:
        return screen(case.survey, values_of(case.result)) or screen(case.survey)
    return screen(case.survey)


def improvement(before: float, after: float, n: int) -> float:
    """How many times less than before the bounded misfits of n observations exceed their noise, which is about n."""
    return (before - n) / (max(after - n, 0.0) + 5.0 + 0.02 * n)
