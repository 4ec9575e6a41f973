"""Constants that shift readings: the height of an instrument or a target, the offset of a reflector (prism constant).

Each is estimated as the median of what single readings say, and must explain nearly all of them. Heights in another
unit are told by the values alone: an instrument's axis lies in its housing, so that it stands neither within three
millimetres of its point nor a hundred metres above it.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import ChangeReadings, Hypothesis, Place
from adjust.diagnosis.screen import Screen, at_best, screen, screen_without
from adjust.diagnosis.weights.impossible import SURE
from adjust.model.errors import listed
from adjust.model.frozen import frozen
from adjust.model.observations import Reading, position_text
from adjust.model.result import Adjustment
from adjust.model.rewriting import Fields, with_rows
from adjust.model.subsets import with_only
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.statistics.score import LinearScores

_CLEARLY = 3.0
_FEWEST, _MOST = 3, 4
_SCALE, _INSTRUMENT, _TARGET = "scale of distances", "instrument height", "target height"
_LARGEST = 10.0
"""m: what no height of an instrument or a target, and no reflector's constant, is wrong by."""
_LARGEST_SCALE = 0.01
"""The same of scales: beyond that it is another unit."""
_HEIGHTS = ("instrument_height", "target_height", "second_height")
_UNITS = {1e3: ("are metres, read as millimetres", 2e-4, 3e-3), 1e-3: ("are millimetres, read as metres", 100.0, 1e5)}
"""By the factor that mends them: heights in another unit, and from where to where (m) they then stand."""
_LINEAR, _EXACT, _BELOW = 0.02, 1e-5, 0.05
"""m: changes of heights above which sights turn in another proportion, of the last step, and of what stands below."""
_ROUNDS, _SUSPECTS = 5, 3
_CLEAR_DROP, _NOISE = 9.0, 5.0
"""Of v'Pv, by which a size is clearly another one; its sigmas, within which that then leaves nothing but noise."""
_SEEN = 1e-4
"""Share of a constant's column that no unknown takes over, below which it does not show."""


@frozen(eq=False)
class _Constant:
    """rows: of the readings that a change by 1 m (of a scale: by 1) changes by ``by`` (n,)."""

    name: str
    text: str
    place: Place
    rows: IntArray
    by: FloatArray
    remedy: str

    @property
    def field(self) -> str:
        """Of its readings that is changed."""
        return {_INSTRUMENT: "instrument_height", _TARGET: "target_height"}.get(self.name, "value")

    @property
    def largest(self) -> float:
        """What it is not wrong by."""
        return _LARGEST_SCALE if self.name == _SCALE else _LARGEST

    def amount(self, size: float) -> str:
        """The change of what stands there, in words."""
        return f"{-1e6 * size:+.0f} ppm" if self.name == _SCALE else \
            f"{1e3 * (-size if self.field == 'value' else size):+.1f} mm"  # fmt: skip

    def edit(self, survey: Survey, size: float) -> ChangeReadings:
        """The same of ``terrestrial.csv``."""
        ids = tuple(survey.readings[i].reading_id for i in self.rows.tolist())
        if self.name == _SCALE:
            return ChangeReadings(ids, 1.0 - size)
        return ChangeReadings(ids, 1.0, -size if self.field == "value" else size, field=self.field)


def misread_heights(case: Case) -> Iterator[Hypothesis]:
    """Heights in another unit, by their values alone."""
    yield from doubtful_heights(case.survey)


def doubtful_heights(survey: Survey) -> Iterator[Hypothesis]:
    """Heights of instruments, with those of their targets; or of targets alone: where all of these are in that unit."""
    for factor, (unit, least, most) in _UNITS.items():
        given = {f: {i: h for i, r in enumerate(survey.readings) if (h := getattr(r, f))} for f in _HEIGHTS}
        first, *others = _HEIGHTS
        odd = {first: {i: h for i, h in given[first].items() if least <= abs(h) <= most}}
        for field in others:
            theirs = {i: h for i, h in given[field].items() if i in odd[first] or not odd[first]}
            if all(least <= abs(h) <= most for h in theirs.values()):
                odd[field] = theirs
        if odd := {field: heights for field, heights in odd.items() if heights}:
            yield _in_unit(survey, odd, factor, unit)


def _in_unit(survey: Survey, odd: Mapping[str, Mapping[int, float]], factor: float, unit: str) -> Hypothesis:
    """odd: by field the heights (m) that are wrong, by their rows."""
    field, readings = next(iter(odd)), survey.readings
    first, of_instruments = next(iter(odd[field].values())), field == "instrument_height"
    some = [readings[i] for i in odd[field]]
    names = [r.setup_id or position_text(r.at) if of_instruments else position_text(r.to) for r in some]
    place = Place("setup" if of_instruments else "point", tuple(dict.fromkeys(names)), field)
    new = dict[int, Reading]()
    for name, heights in odd.items():
        changes: dict[int, Fields] = {i: {name: factor * h} for i, h in heights.items()}
        new |= {i: replace(new.get(i, readings[i]), **change) for i, change in changes.items()}
    return Hypothesis(
        "unit of heights", f"{listed(place.ids, 6)}: a height of {1e3 * first:.6g} mm of "
        f"{'instruments' if of_instruments else 'targets'}: heights {unit}",
        f"multiply {', '.join(odd)} by {factor:g} in {len(new)} rows of terrestrial.csv, or name the columns by their "
        "unit", place, with_rows(survey, "readings", new),
        tuple(ChangeReadings(tuple(readings[i].reading_id for i in rows), factor, field=f) for f, rows in odd.items()),
        SURE, 0,
    )  # fmt: skip


def wrong_heights(case: Case) -> Iterator[Hypothesis]:
    """Constants for which most of their readings speak, the clearest first."""
    survey = case.survey
    if not survey.readings:
        return
    before = at_best(case)
    batch = None if before is None else before.graph.terrestrial
    if before is None or batch is None:
        return
    constants = list(_constants(survey, batch.A))
    judged = _by_scores(case, constants) or _by_misses(case, before, batch, constants)
    found = [(e, c, d) for c, (e, d) in zip(constants, judged, strict=True) if e > _CLEARLY and abs(d) < c.largest]
    for evidence, constant, metres in sorted(found, key=lambda f: (-f[0], -len(f[1].rows)))[:_MOST]:
        yield _hypothesis(survey, constant, metres, len(constants), evidence)


def _hypothesis(survey: Survey, constant: _Constant, metres: float, looked_at: int, evidence: float) -> Hypothesis:
    forgotten, below = _given(survey, constant, metres)
    return Hypothesis(
        constant.name, f"{constant.text} is wrong by about {constant.amount(-metres)}{forgotten}",
        f"{constant.remedy} by {constant.amount(metres)}", constant.place, _changed(survey, constant, metres),
        (constant.edit(survey, metres),), evidence, 1 + below, looked_at,
        partial(_finer, survey, constant, metres, looked_at, evidence),
    )  # fmt: skip


def _by_scores(case: Case, constants: list[_Constant]) -> list[tuple[float, float]]:
    """The same by the score test at the solution (Rao 1948), where there is one that left nothing out.

    With the whitened column b of a constant, ``g = b' e`` and ``m = b' (I - A Q A') b``: g^2 / m is what v'Pv falls by,
    and -g / m the constant.
    """
    result = case.result
    if result is None or not constants or len(result.survey.readings) != len(case.survey.readings):
        return []
    if not all(r.used for r in result.survey.readings):
        return []
    linear: LinearScores | None = case.linear
    if linear is None or linear.result is not result:
        linear = LinearScores(result)
    return [(linear.ratio(drop), metres) for drop, metres in _scores(linear, constants)]


def _scores(linear: LinearScores, constants: Sequence[_Constant]) -> list[tuple[float, float]]:
    """By how much v'Pv falls, and the constant; 0 of what does not show."""
    ptr, sigma = linear.system.ptr, np.array([r.sigma for r in linear.result.survey.readings])
    first = int(ptr[len(ptr) - 1 - len(sigma)])
    columns = [c.by / sigma[c.rows] for c in constants]
    g, M = linear.apart([(first + c.rows, b[:, None]) for c, b in zip(constants, columns, strict=True)])
    m = np.diagonal(M)
    sure = m > _SEEN * np.array([b @ b for b in columns])
    metres = np.where(sure, -g / np.where(sure, m, 1.0), 0.0)
    drop = np.where(sure, g**2 / np.where(sure, m, 1.0), 0.0)
    return list(zip(drop.tolist(), metres.tolist(), strict=True))


def _finer(
    survey: Survey, constant: _Constant, metres: float, looked_at: int, evidence: float, result: Adjustment
) -> list[Hypothesis]:
    """The same with the size that the adjustment with it shows, where that is clearly another one."""
    drop, more = _scores(LinearScores(result), [constant])[0]
    promising = result.omega - drop < result.redundancy + _NOISE * float(np.sqrt(2.0 * max(result.redundancy, 1)))
    if drop < _CLEAR_DROP or not promising or not all(r.used for r in result.survey.readings):
        return []
    return [replace(_hypothesis(survey, constant, metres + more, looked_at, evidence), follow=None)]


def _constants(survey: Survey, A: FloatArray) -> Iterator[_Constant]:
    """Those that enough readings show. A: (N, 9) derivatives of all readings by positions."""
    kinds, setups = (np.array([getattr(r, of) for r in survey.readings]) for of in ("kind", "setup_id"))
    targets = np.array([str(r.to.point_id) for r in survey.readings])
    up_to, up_at, along = A[:, 5], A[:, 2], np.ones(len(A))  # by the heights of the two ends' positions, and by lengths
    tilted = np.isin(kinds, ("zenith", "slope_distance", "height_difference"))
    lengths = np.isin(kinds, ("slope_distance", "horizontal_distance"))
    values = np.array([r.value for r in survey.readings])

    def of(name: str, text: str, place: Place, which: BoolArray, by: FloatArray, remedy: str) -> Iterator[_Constant]:
        rows = np.flatnonzero(which)
        if len(rows) >= _FEWEST:
            yield _Constant(name, text, place, rows, by[rows], remedy)

    for setup_id in dict.fromkeys(s for s in setups.tolist() if s):
        mine = setups == setup_id
        yield from of(_INSTRUMENT, f"the instrument's height at set-up {setup_id}",
                      Place("setup", (setup_id,), "instrument_height_m"), mine & tilted, up_at,
                      "change instrument_height of its rows in terrestrial.csv")  # fmt: skip
        yield from of("prism constant", f"the reflector's constant at set-up {setup_id}",
                      Place("setup", (setup_id,), "value"), mine & lengths, along,
                      "change the distances of its rows in terrestrial.csv")  # fmt: skip
        yield from of(_SCALE, f"the scale of the distances of set-up {setup_id}",
                      Place("setup", (setup_id,), "value"), mine & lengths, values,
                      "change the distances of its rows in terrestrial.csv")  # fmt: skip
    for target in dict.fromkeys(targets.tolist()):
        yield from of(_TARGET, f"the target's height on point {target}",
                      Place("point", (target,), "target_height_m"), (targets == target) & tilted, up_to,
                      "change target_height of its rows in terrestrial.csv")  # fmt: skip
    yield from of("prism constant", "the reflector's constant of all distances", Place("instrument", (), ""), lengths,
                  along, "give an instrument's distance_offset, or change all distances")  # fmt: skip
    yield from of(_SCALE, "the scale of all distances", Place("instrument", (), ""), lengths, values,
                  "give an instrument's distance_scale, or change all distances")  # fmt: skip


def _given(survey: Survey, constant: _Constant, metres: float) -> tuple[str, bool]:
    """That a height was forgotten, in words; whether it would be below zero, which is one thing more to believe."""
    if constant.field == "value":
        return "", False
    heights = [getattr(survey.readings[i], constant.field) for i in constant.rows.tolist()]
    none = constant.name == _INSTRUMENT and not any(heights) and metres > 0.0
    return ": it stands there as 0, and was forgotten" if none else "", min(heights) + metres < -_BELOW


def _by_misses(
    case: Case, before: Screen, batch: TerrestrialBatch, constants: Sequence[_Constant]
) -> list[tuple[float, float]]:
    """The same by what the readings miss where everything else stays where it is.

    An instrument takes its point along, so that sights to that by others say the same as the heights of their targets.
    """
    judged = [_evidence(before, batch, c) for c in constants]
    of_targets = {c.place.ids[0]: j for c, j in zip(constants, judged, strict=True) if c.name == _TARGET}
    points = {r.setup_id: str(r.at.point_id) for r in case.survey.readings if r.at.frame is None}
    for i, c in enumerate(constants):
        none = c.name == _INSTRUMENT and not any(case.survey.readings[k].instrument_height for k in c.rows)
        told = of_targets.get(points.get(c.place.ids[0], "")) if none else None
        judged[i] = judged[i] if told is None else max(judged[i], (told[0], -told[1]))
    if case.result is None:
        for i, found in _apart(case.survey, before, constants):
            judged[i] = found if found[0] > _CLEARLY else judged[i]
    return judged


def _apart(
    survey: Survey, before: Screen, constants: Sequence[_Constant]
) -> Iterator[tuple[int, tuple[float, float]]]:
    """At the start without what an instrument's height is in, which may have spoilt all others, or told all of them.

    Of those that stand there as 0, then of those whose readings miss most.
    """
    some = [i for i, c in enumerate(constants) if c.name == _INSTRUMENT]
    given = {i: any(survey.readings[k].instrument_height for k in constants[i].rows) for i in some}
    worst = {i: -float(np.median(before.readings[constants[i].rows])) for i in some}
    for i in sorted(some, key=lambda i: (given[i], worst[i]))[:_SUSPECTS]:
        apart = screen_without(survey, frozenset(constants[i].rows.tolist()))
        if apart is not None and apart.graph.terrestrial is not None:
            own = replace(constants[i], by=apart.graph.terrestrial.A[constants[i].rows, 2])
            yield i, _evidence(apart, apart.graph.terrestrial, own)


def _evidence(before: Screen, batch: TerrestrialBatch, constant: _Constant) -> tuple[float, float]:
    """How many times smaller the misfit of its readings becomes, and the constant's change (m).

    A height that is off by so much that sights no longer turn in proportion is found in steps.
    """
    rows, scale = constant.rows, before.scale
    sigma, miss = batch.sigma[rows], -batch.residual[rows]  # observed minus predicted
    if not np.isfinite(miss).all():
        return 0.0, 0.0
    metres, left = _one_step(scale, sigma, miss, constant.by)
    if constant.field != "value" and _LINEAR < abs(metres) < _LARGEST:
        part = with_only(before.graph.survey, "readings", (before.graph.survey.readings[i] for i in rows.tolist()))
        own = replace(constant, rows=np.arange(len(rows)))
        for _ in range(_ROUNDS):
            found = screen(_changed(part, own, metres), before.start)
            again = None if found is None else found.graph.terrestrial
            if again is None or not np.isfinite(again.residual).all():
                break
            by = again.A[:, 2 if constant.name == _INSTRUMENT else 5]
            more, left = _one_step(scale, sigma, -again.residual, by)
            metres += more
            if abs(more) < _EXACT:
                break
    old = np.minimum((miss / sigma) ** 2 / scale, CAP).sum()
    return float(old / (left + 0.1 * len(rows) + 1.0)), metres


def _one_step(scale: float, sigma: FloatArray, miss: FloatArray, by: FloatArray) -> tuple[float, float]:
    """The change of a constant that most of its readings speak for, and their bounded misfit after it."""
    weight = np.abs(by) / sigma
    some = weight > 0
    if not some.any():
        return 0.0, float(np.minimum((miss / sigma) ** 2 / scale, CAP).sum())
    metres = float(np.quantile(miss[some] / by[some], 0.5, weights=weight[some], method="inverted_cdf"))
    return metres, float(np.minimum(((miss - by * metres) / sigma) ** 2 / scale, CAP).sum())


def _changed(survey: Survey, constant: _Constant, metres: float) -> Survey:
    """With the constant as it probably was; its readings then fit without it."""
    field, by = constant.field, np.full(len(constant.rows), metres) if constant.field != "value" else (
        -metres * constant.by)  # fmt: skip
    mine = {i: survey.readings[i] for i in constant.rows.tolist()}
    new: dict[int, Fields] = {i: {field: getattr(mine[i], field) + d} for i, d in zip(mine, by.tolist(), strict=True)}
    return with_rows(survey, "readings", {i: replace(r, **new[i]) for i, r in mine.items()})
