"""Clocks as unknowns: the survey in which they are, what of a project says so, and what they were found to be."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial

import numpy as np

from adjust.diagnosis.case import Case
from adjust.diagnosis.hypothesis import Edit, Hypothesis, SetKey
from adjust.diagnosis.trial import misfit_of
from adjust.frames.runs import within_motion
from adjust.model.clocks import INTERVALS, clock_text, clocks_of, epoch_times
from adjust.model.errors import SurveyError
from adjust.model.result import Adjustment, ParameterName
from adjust.model.survey import Camera, Clock, Station, Survey, Table, VectorParameter

Freed = Mapping[ParameterName, tuple[str, ...]]
"""Which components of which clocks are unknown."""
_TABLES = {"camera_clock": "cameras", "table_clock": "tables", "pose_clock": "stations"}
_JITTER = 0.3  # intervals
_ENOUGH = 0.5  # share of the misfit beyond noise


def with_clocks(survey: Survey, freed: Freed, jitter: float = 0.0) -> Survey | None:
    """The survey in which these clocks are unknown, with the others as they are; None where it tells none of them.

    jitter: sigma of the times of single epochs, in intervals between epochs.
    """
    sigma = jitter * interval(survey)

    def clocked(owner: Camera | Table | Station, kind: str, name: str) -> Clock | None:
        free = freed.get((kind, name))
        if free is None:
            return owner.clock
        given = owner.clock or Clock(VectorParameter((), np.zeros(0)))
        old = given.parameters
        names = (*old.names, *(x for x in free if x not in old.names))
        values = np.append(old.values, np.zeros(len(names) - len(old.names)))
        free = tuple(x for x in names if x in (*old.free, *free))
        return Clock(replace(old, names=names, values=values, free=free), max(given.jitter, sigma))

    try:
        return within_motion(replace(
            survey,
            cameras=tuple(replace(c, clock=clocked(c, "camera_clock", c.camera_id)) for c in survey.cameras),
            tables=tuple(replace(t, clock=clocked(t, "table_clock", t.table_id)) for t in survey.tables),
            stations=tuple(replace(s, clock=clocked(s, "pose_clock", s.station_id)) for s in survey.stations),
        ))  # fmt: skip
    except SurveyError:
        return None


def interval(survey: Survey) -> float:
    """The typical time between epochs, s; 1 where no times are known."""
    steps = np.diff(sorted(epoch_times(survey).of.values()))
    return float(np.median(steps)) if len(steps) else 1.0


def spoken(survey: Survey) -> tuple[float, str]:
    """What a time between epochs is multiplied by for people, and its unit."""
    timed = epoch_times(survey).unit != INTERVALS
    return (1e3 * interval(survey), "ms") if timed else (1.0, "intervals between epochs")


def edits(survey: Survey, freed: Freed, jitter: float = 0.0) -> tuple[Edit, ...]:
    """The keys of a project that make them so."""
    clocks, timed = dict(clocks_of(survey)), epoch_times(survey).unit != INTERVALS
    out: list[Edit] = []
    for name, free in freed.items():
        old, path = clocks.get(name), (_TABLES[name[0]], name[1], "clock")
        before = () if old is None else old.parameters.free
        out.append(SetKey((*path, "free"), (*before, *(x for x in free if x not in before))))
        if jitter > 0.0:
            sigma = float(f"{1e3 * jitter * interval(survey):.3g}") if timed else jitter
            out.append(SetKey((*path, "jitter_ms" if timed else "jitter_intervals"), sigma))
    return tuple(out)


def found(result: Adjustment, freed: Freed) -> str:
    """What the adjustment says of these clocks."""
    parts = []
    for name, free in freed.items():
        estimate = result.estimates[name]
        values, sigmas = np.asarray(estimate.value, dtype=float), result.sigma0 * np.sqrt(np.diag(estimate.cov))
        for component in free:
            i = estimate.components.index(component)
            unit, factor = _UNITS.get((component, estimate.units[i]), ("intervals", 1.0))
            parts.append(f"{clock_text(name)}: {component.replace('_', ' ')} {factor * values[i]:+.3g} +- "
                         f"{factor * sigmas[i]:.2g} {unit}")  # fmt: skip
    return ", ".join(parts)


_UNITS = {
    ("offset", "s"): ("ms", 1e3), ("drift", "1"): ("ppm", 1e6), ("line_time", "s"): ("us a row", 1e6),
    ("line_time", INTERVALS): ("intervals a row", 1.0),
}  # fmt: skip


def as_unknowns(
    case: Case, of: Hypothesis, freed: Freed, jitter: float = 0.0, noted: list[bool] | None = None
) -> Hypothesis:
    """A hypothesis with clocks as unknowns for its survey, and what they are found to be in its cause.

    Where offsets of cameras leave more than noise, the same is tried with times of their own for single epochs.
    noted: is told of every trial whether it takes most of the misfit away.
    """
    survey = with_clocks(case.survey, freed, jitter)
    free, own = sum(map(len, freed.values())), 0
    if survey is not None and jitter > 0.0:  # times of single epochs
        seen = ((b.camera_id, b.epoch_id) for b in survey.image_blocks)
        own = len({(c, e) for c, e in seen if ("camera_clock", c) in freed})
    tried: Survey | Callable[[], None] = survey or (lambda: None)
    hypothesis = replace(keyed(case.survey, of, freed, jitter), survey=tried, parameters=free + own)
    return replace(hypothesis, follow=partial(_followed, case, hypothesis, of, freed, jitter, noted))


def keyed(survey: Survey, of: Hypothesis, freed: Freed, jitter: float = 0.0) -> Hypothesis:
    """A hypothesis with the keys of a project that make these clocks unknown for its edits, and in its change."""
    new = edits(survey, freed, jitter)
    keys = ", ".join(dict.fromkeys(f"{e.path[-1]} = {_toml(e.value)}" for e in new if isinstance(e, SetKey)))
    owners = ", ".join(map(clock_text, freed))
    change = f"{of.change}; or let the adjustment find it: clock = {{ {keys} }} of {owners}"
    return replace(of, edits=new, change=change)


def _toml(value: object) -> str:
    return "[" + ", ".join(f'"{x}"' for x in value) + "]" if isinstance(value, tuple) else str(value)


def _followed(
    case: Case, tried: Hypothesis, of: Hypothesis, freed: Freed, jitter: float, noted: list[bool] | None,
    result: Adjustment,
) -> list[Hypothesis]:  # fmt: skip
    own = "" if jitter == 0.0 else ", and each epoch at a time of its own about that"
    here = replace(tried, follow=None, cause=f"{of.cause} ({found(result, freed)}{own})")
    images = any(name[0] == "camera_clock" and "offset" in free for name, free in freed.items())
    left = misfit_of(result, tried.survey if isinstance(tried.survey, Survey) else case.survey)
    if noted is not None:
        noted.append(left.excess < _ENOUGH * misfit_of(case.result, case.survey).excess)
    if jitter > 0.0 or not images or left.is_noise():
        return [here]
    return [here, as_unknowns(case, of, freed, _JITTER, noted)]
