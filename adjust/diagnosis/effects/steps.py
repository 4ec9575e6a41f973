"""Unknowns that are taken for constant and are not: another value from some epoch, or row, on; a drift with time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.courses import MOVED, Course, affordable, alike, courses, standing
from adjust.diagnosis.effects.effect import Effect
from adjust.diagnosis.hypothesis import (
    Edit,
    Hypothesis,
    LeaveOut,
    Place,
    block_keys,
    crop_keys,
    found_by,
    motion_text,
    split_setup,
)
from adjust.diagnosis.prediction import Linear, Prediction, adjusted_values
from adjust.lenses.models import CENTRE
from adjust.model.observations import ImageBlock, Pair
from adjust.model.result import Adjustment
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, Survey
from adjust.statistics.score import Part, Score, drift_times

_BOUND = 50.0  # of the square of one image point
_OF_CAMERAS, _OF_TARGETS = ("lens", "station_from_camera"), ("carrier_from_target", "target_body")


def steps(case: Case, linear: Linear) -> Iterator[Effect]:
    """The best step of every unknown that is the same for several epochs, and the drift of every lens."""
    for some in alike(affordable(case, linear)):
        for course, found in zip(some, linear.steps([c.parts for c in some]), strict=True):
            if found:
                cut = max(found, key=lambda t: found[t].drop)
                yield _step(case.survey, course, cut, found[cut], len(found))
            if course.name[0] == "lens":
                yield _drift(case.survey, course, linear.drift(course.parts))


def _step(survey: Survey, course: Course, cut: int, first: Score, looked_at: int) -> Effect:
    since, thing = course.labels[cut], course.name[1]
    later = course.labels[cut:]
    name, kind, what = MOVED.get(course.name[0], ("", "camera", ""))
    if course.name[0] == "lens":
        name = "images shifted" if course.components == CENTRE else "focus touched"
    place = Place(kind, (thing,), epochs=later if course.kind == "image" else ())
    before = "before epoch" if course.kind == "image" else f"before {course.kind}"

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        if course.name[0] == "lens":
            by = _sizes(course.estimated, theta, sigmas)
            why = "focus or zoom was touched" if name == "focus touched" else "another crop of the sensor"
            return f"camera {thing}: from epoch {since} on its lens is another one by {by} px: {why}"
        tables = [t.table_id for t in survey.tables] if len(standing(survey)) == 1 else []
        alike = f" (or table {tables[0]}: its images cannot tell)" if name == "target moved" and tables else ""
        return f"{what.format(thing)} {before} {since}{_amount(course.name[0], theta, sigmas)}{alike}"

    keys = _lens_keys(survey, course, since, first)
    remedy = f"leave out what was observed from {since} on, or give it a name of its own there"
    if course.kind == "reading":
        remedy = f"give the directions from {since} on a set-up of their own: another orientation"
    change = found_by(keys, remedy)
    hypothesis = Hypothesis(name, "", change, place, survey, keys or _edits(survey, course, later), 1.0, 1, looked_at)
    chosen = frozenset(later)
    return Effect(
        hypothesis, first,
        lambda linear: _at(linear, course, lambda parts: linear.of_parts(parts[cut:])),
        lambda result, theta: _mended(survey, result, course, dict.fromkeys(chosen, 1.0), theta),
        said, _composed if course.is_pose else np.add,
        nearer=lambda result, theta: _nearer(survey, course, cut, first, looked_at, result, theta),
    )  # fmt: skip


def _nearer(
    survey: Survey, course: Course, cut: int, first: Score, looked_at: int, result: Adjustment, theta: FloatArray
) -> Effect | None:
    """The same step before another epoch, if its images, each as before and as after, say so; None else."""
    if course.kind != "image":
        return None
    prediction = Prediction(survey, adjusted_values(result))
    altered = {course.name: _altered(result, course, theta)}
    number = {label: k for k, label in enumerate(course.labels)}
    gain = np.zeros(len(number))  # of v'Pv, where an epoch is after the step
    for block in survey.image_blocks:
        if block.epoch_id in number and _concerns(block, course):
            before, after = (prediction.squares(block, a) for a in ({}, altered))
            if before is not None and after is not None:
                gain[number[block.epoch_id]] += float(np.fmin(before, _BOUND).sum() - np.fmin(after, _BOUND).sum())
    since = np.cumsum(gain[::-1])[::-1]
    best = 1 + int(np.argmax(since[1:]))
    return None if best == cut else _step(survey, course, best, replace(first, theta=theta), looked_at)


def _drift(survey: Survey, course: Course, first: Score) -> Effect:
    thing, weights = course.name[1], dict(zip(course.labels, drift_times(len(course.labels)), strict=True))

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        by = _sizes(course.estimated, theta, sigmas)
        return f"camera {thing}: its lens drifts from epoch {course.labels[0]} to {course.labels[-1]} by {by} px"

    n = len(course.labels)
    edits: tuple[Edit, ...] = ()
    if course.kind == "image" and n >= 6:
        edits = block_keys(survey, thing, course.estimated, (course.labels[n // 3], course.labels[2 * n // 3]))
    hypothesis = Hypothesis(
        "lens drifts", "", "let the camera warm up, or adjust its lens by blocks of epochs: lens.drift",
        Place("camera", (thing,), "lens"), survey, edits, 1.0, 0,
    )  # fmt: skip
    return Effect(hypothesis, first, lambda linear: _at(linear, course, linear.drift),
                  lambda result, theta: _mended(survey, result, course, weights, theta), said)  # fmt: skip


def _at(linear: Linear, course: Course, score: Callable[[Sequence[Part]], Score]) -> Score:
    """The score of the same course at another adjustment; what that has left out is no part of it."""
    for again in courses(linear, course.name, course.components):
        if again.components == course.components and again.labels == course.labels:
            return score(again.parts)
    return Score(np.zeros(0), np.zeros((0, 0)), 0.0, 0)


def _sizes(names: Sequence[str], theta: FloatArray, sigmas: FloatArray) -> str:
    return ", ".join(f"{n} {t:+.2f} +- {s:.2f}" for n, t, s in zip(names, theta, sigmas, strict=False))


def _composed(first: FloatArray, more: FloatArray) -> FloatArray:
    """Two motions in turn, as one tangent."""
    if len(first) != 6:
        return np.asarray(first + more)
    return np.asarray(Pose3.Logmap(Pose3.Expmap(first).compose(Pose3.Expmap(more))))


def _amount(kind: str, theta: FloatArray, sigmas: FloatArray) -> str:
    if kind == "orientation":
        return f" by {np.degrees(theta[0]) * 3600.0:+.1f} +- {np.degrees(sigmas[0]) * 3600.0:.1f} arcsec"
    if kind == "point":
        return f" by ({', '.join(f'{1e3 * t:+.2f}' for t in theta)}) mm"
    return f" {motion_text(Pose3.Expmap(theta))}" if len(theta) == 6 else ""


def _lens_keys(survey: Survey, course: Course, since: str, first: Score) -> tuple[Edit, ...]:
    """What lets a lens be another one since then; none of other things."""
    if course.name[0] != "lens":
        return ()
    if course.components == CENTRE:
        return crop_keys(survey, course.name[1], since, 1.0, first.theta) if len(course.estimated) == 2 else ()
    return block_keys(survey, course.name[1], course.estimated, (since,))


def _edits(survey: Survey, course: Course, later: Sequence[str]) -> tuple[Edit, ...]:
    """What was observed of it since then, left out."""
    if course.kind == "pair":
        return (LeaveOut(tuple(f"pairs:{p}" for p in later)),)
    if course.kind == "reading":
        return split_setup(survey, course.name[1], later)
    rows = [b for b in survey.image_blocks if b.epoch_id in later and _concerns(b, course)]
    if course.name[0] in _OF_TARGETS:
        return (LeaveOut(tuple(dict.fromkeys(f"target:{b.camera_id}/{b.epoch_id}/{b.target_id}" for b in rows))),)
    if course.name[0] in _OF_CAMERAS:
        return (LeaveOut(tuple(dict.fromkeys(f"image:{b.camera_id}/{b.epoch_id}" for b in rows))),)
    return (LeaveOut(tuple(f"epoch:{e}" for e in later)),) if course.name[0] != "point" else ()


def _altered(result: Adjustment, course: Course, theta: FloatArray) -> Pose3 | FloatArray:
    """The value of the unknown, changed by theta, which counts its free components alone."""
    if course.name[0].endswith("_body"):
        return Pose3.Expmap(theta)
    estimate = result.estimates[course.name]
    free = [i for i, s in enumerate(estimate.status) if s != "held"]
    if isinstance(estimate.value, Pose3):
        xi = np.zeros(6)
        xi[free] = theta
        return estimate.value.compose(Pose3.Expmap(xi))
    value = np.array(estimate.value)
    chosen = [i for i in free if not course.components or estimate.components[i] in course.components]
    tied = [i for i in chosen if estimate.status[i] == "tied"]
    untied = [i for i in chosen if i not in tied]
    value[untied] += theta
    if tied:  # they keep their ratio
        value[tied] *= value[untied[0]] / np.asarray(estimate.value)[untied[0]]
    return value


def _mended(
    survey: Survey, result: Adjustment, course: Course, weights: Mapping[str, float], theta: FloatArray
) -> Survey:
    """What was observed under another value of the unknown, as it would have been under the first one."""
    if course.kind == "image":
        return _mended_images(survey, result, course, weights, theta)
    if course.kind == "pair":
        late = {i: p for i, p in enumerate(survey.pairs) if p.pair_id in weights}
        return with_rows(survey, "pairs", {i: _mended_pair(p, course.name[1], theta) for i, p in late.items()})
    read = {i: r for i, r in enumerate(survey.readings) if r.reading_id in weights}
    return with_rows(survey, "readings", {i: replace(r, value=r.value + float(theta[0])) for i, r in read.items()})


def _mended_images(
    survey: Survey, result: Adjustment, course: Course, weights: Mapping[str, float], theta: FloatArray
) -> Survey:
    prediction, blocks = Prediction(survey, adjusted_values(result)), dict[int, ImageBlock]()
    values: dict[float, Pose3 | FloatArray] = {}
    for i, block in enumerate(survey.image_blocks):
        w = weights.get(block.epoch_id, 0.0)
        if w and _concerns(block, course):
            altered = values.setdefault(w, _altered(result, course, w * theta))
            now, then = prediction.uv(block), prediction.uv(block, {course.name: altered})
            if now is not None and then is not None:
                blocks[i] = replace(block, uv=block.uv - then + now)
    return with_rows(survey, "image_blocks", blocks)


def _concerns(block: ImageBlock, course: Course) -> bool:
    if course.name[0] in _OF_CAMERAS:
        return block.camera_id == course.name[1]
    return course.name[0] not in _OF_TARGETS or block.target_id == course.name[1]


def _mended_pair(pair: Pair, station: str, theta: FloatArray) -> Pair:
    """``a_late = a exp(theta)``: measured was ``b_from_a exp(theta)``, or ``exp(-theta) a_from_b``."""
    m: Any = pair.b_from_a
    motion = type(m).Expmap(theta if isinstance(m, Pose3) else theta[:3])
    at_a = (pair.a.kind, pair.a.frame_id) == ("station", station)
    return replace(pair, b_from_a=m.compose(motion.inverse()) if at_a else motion.compose(m))
