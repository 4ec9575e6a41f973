"""Constants that shift readings: the height of an instrument or a target, the offset of a reflector (prism constant).

Each is estimated as the median of what single readings say, and must explain nearly all of them. Heights in another
unit are told by the values alone: an instrument's axis lies in its housing, so that it stands neither within three
millimetres of its point nor a hundred metres above it.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from adjust.diagnosis.case import CAP, Case
from adjust.diagnosis.hypothesis import ChangeReadings, Hypothesis, Place
from adjust.diagnosis.screen import at_best
from adjust.diagnosis.weights.impossible import SURE
from adjust.model.errors import listed
from adjust.model.observations import Reading, position_text
from adjust.model.rewriting import Fields, with_rows
from adjust.model.survey import BoolArray, FloatArray, IntArray, Survey
from adjust.observations.terrestrial.batch import TerrestrialBatch
from adjust.statistics.score import LinearScores

_CLEARLY = 3.0
_FEWEST, _MOST = 3, 4
_LARGEST = 10.0
"""m: what no height of an instrument or a target, and no reflector's constant, is wrong by."""
_HEIGHTS = ("instrument_height", "target_height", "second_height")
_UNITS = {1e3: ("are metres, read as millimetres", 2e-4, 3e-3), 1e-3: ("are millimetres, read as metres", 100.0, 1e5)}
"""By the factor that mends them: heights in another unit, and from where to where (m) they then stand."""
_SEEN = 1e-4
"""Share of a constant's column that no unknown takes over, below which it does not show."""


@dataclass(frozen=True, eq=False)
class _Constant:
    """rows: of the readings that a change by 1 m changes by ``by`` (n,)."""

    name: str
    text: str
    place: Place
    rows: IntArray
    by: FloatArray
    remedy: str


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
    judged = _by_scores(case, constants) or [_evidence(before.scale, batch, c) for c in constants]
    found = [(e, c, d) for c, (e, d) in zip(constants, judged, strict=True) if e > _CLEARLY and abs(d) < _LARGEST]
    for evidence, constant, metres in sorted(found, key=lambda f: (-f[0], -len(f[1].rows)))[:_MOST]:
        changed = _changed(survey, constant, metres)
        amount = -metres if constant.name == "prism constant" else metres
        yield Hypothesis(
            constant.name, f"{constant.text} is wrong by about {-1e3 * amount:+.1f} mm",
            f"{constant.remedy} by {1e3 * amount:+.1f} mm", constant.place, changed, (), evidence, 1, len(constants),
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
    ptr, sigma = linear.system.ptr, np.array([r.sigma for r in case.survey.readings])
    first = int(ptr[len(ptr) - 1 - len(sigma)])
    columns = [c.by / sigma[c.rows] for c in constants]
    g, M = linear.apart([(first + c.rows, b[:, None]) for c, b in zip(constants, columns, strict=True)])
    m = np.diagonal(M)
    sure = m > _SEEN * np.array([b @ b for b in columns])
    metres = np.where(sure, -g / np.where(sure, m, 1.0), 0.0)
    drop = np.where(sure, g**2 / np.where(sure, m, 1.0), 0.0)
    return [(float(result.omega / max(result.omega - d, 1.0)), float(x)) for d, x in zip(drop, metres, strict=True)]


def _constants(survey: Survey, A: FloatArray) -> Iterator[_Constant]:
    """Those that enough readings show. A: (N, 9) derivatives of all readings by positions."""
    kinds, setups = (np.array([getattr(r, of) for r in survey.readings]) for of in ("kind", "setup_id"))
    targets = np.array([str(r.to.point_id) for r in survey.readings])
    up_to, up_at, along = A[:, 5], A[:, 2], np.ones(len(A))  # by the heights of the two ends' positions, and by lengths
    tilted = np.isin(kinds, ("zenith", "slope_distance", "height_difference"))
    lengths = np.isin(kinds, ("slope_distance", "horizontal_distance"))

    def of(name: str, text: str, place: Place, which: BoolArray, by: FloatArray, remedy: str) -> Iterator[_Constant]:
        rows = np.flatnonzero(which)
        if len(rows) >= _FEWEST:
            yield _Constant(name, text, place, rows, by[rows], remedy)

    for setup_id in dict.fromkeys(s for s in setups.tolist() if s):
        mine = setups == setup_id
        yield from of("instrument height", f"the instrument's height at set-up {setup_id}",
                      Place("setup", (setup_id,), "instrument_height_m"), mine & tilted, up_at,
                      "change instrument_height of its rows in terrestrial.csv")  # fmt: skip
        yield from of("prism constant", f"the reflector's constant at set-up {setup_id}",
                      Place("setup", (setup_id,), "value"), mine & lengths, along,
                      "change the distances of its rows in terrestrial.csv")  # fmt: skip
    for target in dict.fromkeys(targets.tolist()):
        yield from of("target height", f"the target's height on point {target}",
                      Place("point", (target,), "target_height_m"), (targets == target) & tilted, up_to,
                      "change target_height of its rows in terrestrial.csv")  # fmt: skip
    yield from of("prism constant", "the reflector's constant of all distances", Place("instrument", (), ""), lengths,
                  along, "give an instrument's distance_offset, or change all distances")  # fmt: skip


def _evidence(scale: float, batch: TerrestrialBatch, constant: _Constant) -> tuple[float, float]:
    """How many times smaller the misfit of its readings becomes, and the constant's change (m)."""
    rows = constant.rows
    sigma, miss = batch.sigma[rows], -batch.residual[rows]  # observed minus predicted
    weight = np.abs(constant.by) / sigma
    if not (weight > 0).any() or not np.isfinite(miss).all():
        return 0.0, 0.0
    some = weight > 0
    metres = float(np.quantile(miss[some] / constant.by[some], 0.5, weights=weight[some], method="inverted_cdf"))
    old = np.minimum((miss / sigma) ** 2 / scale, CAP).sum()
    new = np.minimum(((miss - constant.by * metres) / sigma) ** 2 / scale, CAP).sum()
    return float(old / (new + 0.1 * len(rows) + 1.0)), metres


def _changed(survey: Survey, constant: _Constant, metres: float) -> Survey:
    """With the constant as it probably was; its readings then fit without it."""
    heights = {"instrument height": "instrument_height", "target height": "target_height"}
    field, by = (heights[constant.name], metres) if constant.name in heights else ("value", -metres)
    mine = {i: survey.readings[i] for i in constant.rows.tolist()}
    new: dict[int, Fields] = {i: {field: getattr(r, field) + by} for i, r in mine.items()}
    return with_rows(survey, "readings", {i: replace(r, **new[i]) for i, r in mine.items()})
