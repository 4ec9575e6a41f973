"""Unknowns that are taken for constant and are not: another value from some epoch, or row, on; a drift with time."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from gtsam import Pose3

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect
from adjust.diagnosis.hypothesis import (
    CENTRE,
    FOCAL,
    Edit,
    Hypothesis,
    LeaveOut,
    Place,
    block_keys,
    crop_keys,
    found_by,
    motion_text,
)
from adjust.diagnosis.prediction import Linear, Prediction, adjusted_values
from adjust.model.observations import FrameRef, ImageBlock, Pair
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import with_rows
from adjust.model.survey import FloatArray, IntArray, Survey
from adjust.statistics.normal import DENSE
from adjust.statistics.score import Part, Score, drift_times

_FEWEST = 4
_ELIMINATIONS = 12.5
"""Eliminations of the whole system that all courses together may cost in surveys of many unknowns."""
_ROWS = 20_000
"""Of courses that are looked at together."""
_BOUND = 50.0  # of the square of one image point
_MOVED = {  # name of the unknown: of the mistake, kind of the thing, what happened to it
    "station_from_camera": ("camera moved", "camera", "camera {} was moved on its station"),
    "carrier_from_target": ("target moved", "target", "target {} was moved"),
    "mount_from_station": ("station moved", "station", "station {} was moved on its table"),
    "world_from_table": ("table moved", "table", "table {}, or all that stands still around it, was moved"),
    "world_from_station": ("station moved", "station", "station {} was bumped"),
    "station_body": ("station moved", "station", "station {} was moved on its table"),
    "target_body": ("target moved", "target", "target {}, which stands for the world, was moved"),
    "point": ("point moved", "point", "point {} was moved, or exchanged for another one"),
    "orientation": ("set-up turned", "setup", "the instrument of set-up {} was turned or bumped"),
}


@dataclass(frozen=True, eq=False)
class _Course:
    """An unknown, or some components of it, through time, as an adjustment has it. labels: of its parts."""

    linear: Linear
    name: ParameterName
    components: tuple[str, ...]
    kind: str  # of observation: image, pair, reading
    labels: tuple[str, ...]
    parts: tuple[Part, ...]

    @property
    def estimated(self) -> list[str]:
        """Those of its components that are."""
        columns = self.linear.system.columns
        known = [columns.components[i] for i in self.linear.columns(self.name)]
        return [c for c in self.components if c in known]

    @property
    def is_pose(self) -> bool:
        """Whether it is a motion."""
        return self.name[0].endswith("_body") or isinstance(self.linear.result.estimates[self.name].value, Pose3)


def steps(case: Case, linear: Linear) -> Iterator[Effect]:
    """The best step of every unknown that is the same for several epochs, and the drift of every lens."""
    for courses in _alike(_affordable(case, linear)):
        for course, found in zip(courses, linear.steps([c.parts for c in courses]), strict=True):
            if found:
                cut = max(found, key=lambda t: found[t].drop)
                yield _step(case.survey, course, cut, found[cut], len(found))
            if course.name[0] == "lens":
                yield _drift(case.survey, course, linear.drift(course.parts))


def _affordable(case: Case, linear: Linear) -> Iterator[_Course]:
    """Those of several epochs, as many as columns of the covariance matrix cost no more than some adjustments."""
    n, tree = len(linear.system.columns), linear.system.precision.tree
    room = min(float(n), tree.cliques.columns_for(_ELIMINATIONS)) if n > DENSE else np.inf
    for course in _courses(linear):
        room -= sum(B.shape[1] for _, B in course.parts)
        if not case.few("what moved from some epoch on, of things that fit better than others", int(room < 0.0), 0):
            return
        if len(course.parts) >= _FEWEST:
            yield course


def _alike(courses: Iterator[_Course]) -> Iterator[list[_Course]]:
    """Together those with derivatives by as many numbers, as long as they have no more rows than make it worth it."""
    some, n = list[_Course](), 0
    for course in courses:
        if some and (n > _ROWS or course.parts[0][1].shape[1] != some[0].parts[0][1].shape[1]):
            yield some
            some, n = [], 0
        some.append(course)
        n += sum(len(rows) for rows, _ in course.parts)
    if some:
        yield some


def _courses(
    linear: Linear, only: ParameterName | None = None, components: tuple[str, ...] | None = None
) -> Iterator[_Course]:
    """Of all unknowns, or of one; of a lens by parts of its components, or of some of these alone."""
    survey, columns = linear.result.survey, linear.system.columns
    ptr, row_of = linear.system.ptr, linear.system.row_of
    first_reading = len(ptr) - 1 - len(survey.readings)
    pairs = {i: survey.pairs[k].pair_id for k, i in enumerate(_other_rows(linear, "pair"))}
    readings = {first_reading + k: r.reading_id for k, r in enumerate(survey.readings)}

    def course(name: ParameterName, kind: str, ids: Mapping[int, str], rows: IntArray) -> _Course:
        numbers = [i for i in np.unique(row_of[rows]).tolist() if i in ids]
        of = [np.arange(ptr[i], ptr[i + 1]) for i in numbers]
        parts = tuple(linear.parts(columns.at[name], of))
        return _Course(linear, name, (), kind, tuple(ids[i] for i in numbers), parts)

    yield from _of_held(linear, only)
    for name in _worst_first(linear) if only is None else [only] if only in columns.at else []:
        at = columns.at[name]
        if name[0] not in (*_MOVED, "lens") or not len(at) or len(name) > 2 or _is_the_world(survey, name):
            continue
        rows = linear.rows_of(at)
        if (rows < ptr[linear.system.n_image]).any():
            yield from _of_images(linear, name, rows, components)
        elif name[0] == "world_from_station":
            yield course(name, "pair", pairs, rows)
        elif name[0] == "orientation":
            yield course(name, "reading", readings, rows)


def _worst_first(linear: Linear) -> list[ParameterName]:
    """The unknowns; of many those first whose observations fit least."""
    at = linear.system.columns.at
    if len(linear.system.columns) <= DENSE:
        return list(at)
    some = [name for name in at if len(at[name]) and (name[0] in _MOVED or name[0] == "lens")]
    misfit = dict(zip(some, linear.mean_squares([at[name] for name in some]).tolist(), strict=True))
    return sorted(misfit, key=lambda name: -misfit[name])


def _is_the_world(survey: Survey, name: ParameterName) -> bool:
    """Whether a table stands before one target alone: moving either is the same to all observations."""
    return name[0] == "world_from_table" and len(_standing(survey)) == 1 and not survey.points


def _standing(survey: Survey) -> list[str]:
    return [t.target_id for t in survey.targets if t.motion == "fixed" and t.station_id is None]


def _of_images(
    linear: Linear, name: ParameterName, rows: IntArray, only: tuple[str, ...] | None
) -> Iterator[_Course]:
    blocks = linear.result.survey.image_blocks
    ptr = 2 * linear.result.image_residuals.block_ptr
    epochs = list(dict.fromkeys(b.epoch_id for b in blocks))
    number = {e: k for k, e in enumerate(epochs)}
    of = np.repeat([number[b.epoch_id] for b in blocks], np.diff(ptr))
    images = rows[rows < ptr[-1]]
    known = np.unique(of[images])
    by_epoch = [images[of[images] == k] for k in known]
    parts = (FOCAL, CENTRE, FOCAL + CENTRE) if name[0] == "lens" else ((),)
    for components in parts if only is None else (only,):
        columns = linear.columns(name, components)
        if len(columns):
            labels = tuple(epochs[k] for k in known)
            yield _Course(linear, name, components, "image", labels, tuple(linear.parts(columns, by_epoch)))


def _of_held(linear: Linear, only: ParameterName | None) -> Iterator[_Course]:
    """Bodies whose poses are held: the targets that tell the datum, the mounts of stations; by differences."""
    survey, free = linear.result.survey, linear.system.columns.at
    still = [t.target_id for t in survey.targets if t.motion == "fixed"]
    turned = [s.station_id for s in survey.stations if s.motion == "table"]
    held = [("target_body", t) for t in still if ("carrier_from_target", t) not in free]
    held += [("station_body", s) for s in turned if ("mount_from_station", s) not in free]
    on_table = {r.epoch_id for r in survey.table_readings}
    for name in held if only is None else [n for n in held if n == only]:
        by_epoch: dict[str, list[Part]] = {}
        cameras = {c.camera_id for c in survey.cameras if c.station_id == name[1]}
        mine = {i for i, b in enumerate(survey.image_blocks) if b.target_id == name[1] or
                (name[0] == "station_body" and b.camera_id in cameras and b.epoch_id in on_table)}  # fmt: skip
        for i in sorted(mine):
            D = linear.prediction.by_motion(survey.image_blocks[i], name)
            if D is not None:
                by_epoch.setdefault(survey.image_blocks[i].epoch_id, []).extend(linear.image_parts({i: D}))
        parts = tuple((np.concatenate([r for r, _ in p]), np.concatenate([B for _, B in p])) for p in by_epoch.values())
        yield _Course(linear, name, (), "image", tuple(by_epoch), parts)


def _other_rows(linear: Linear, kind: str) -> list[int]:
    """Numbers in the linear system of all observations of a kind, in the order of the survey."""
    kinds = linear.system.precision.graph.of_others(lambda o: o.kind, lambda _: "pair")
    return [linear.system.n_image + i for i, k in enumerate(kinds) if k == kind]


def _step(survey: Survey, course: _Course, cut: int, first: Score, looked_at: int) -> Effect:
    since, thing = course.labels[cut], course.name[1]
    later = course.labels[cut:]
    name, kind, what = _MOVED.get(course.name[0], ("", "camera", ""))
    if course.name[0] == "lens":
        name = "images shifted" if course.components == CENTRE else "focus touched"
    place = Place(kind, (thing,), epochs=later if course.kind == "image" else ())
    before = "before epoch" if course.kind == "image" else f"before {course.kind}"

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        if course.name[0] == "lens":
            by = _sizes(course.estimated, theta, sigmas)
            why = "focus or zoom was touched" if name == "focus touched" else "another crop of the sensor"
            return f"camera {thing}: from epoch {since} on its lens is another one by {by} px: {why}"
        tables = [t.table_id for t in survey.tables] if len(_standing(survey)) == 1 else []
        alike = f" (or table {tables[0]}: its images cannot tell)" if name == "target moved" and tables else ""
        return f"{what.format(thing)} {before} {since}{_amount(course.name[0], theta, sigmas)}{alike}"

    keys = _lens_keys(survey, course, since, first)
    change = found_by(keys, f"leave out what was observed from {since} on, or give it a name of its own there")
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
    survey: Survey, course: _Course, cut: int, first: Score, looked_at: int, result: Adjustment, theta: FloatArray
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


def _drift(survey: Survey, course: _Course, first: Score) -> Effect:
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


def _at(linear: Linear, course: _Course, score: Callable[[Sequence[Part]], Score]) -> Score:
    """The score of the same course at another adjustment; what that has left out is no part of it."""
    for again in _courses(linear, course.name, course.components):
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


def _lens_keys(survey: Survey, course: _Course, since: str, first: Score) -> tuple[Edit, ...]:
    """What lets a lens be another one since then; none of other things."""
    if course.name[0] != "lens":
        return ()
    if course.components == CENTRE:
        return crop_keys(survey, course.name[1], since, 1.0, first.theta) if len(course.estimated) == 2 else ()
    return block_keys(survey, course.name[1], course.estimated, (since,))


def _edits(survey: Survey, course: _Course, later: Sequence[str]) -> tuple[Edit, ...]:
    """What was observed of it since then, left out."""
    if course.kind == "pair":
        return (LeaveOut(tuple(f"pairs:{p}" for p in later)),)
    if course.kind == "reading":
        return ()
    thing, chosen = course.name[1], set(later)
    owner = {
        "station_from_camera": "camera_id",
        "lens": "camera_id",
        "carrier_from_target": "target_id",
        "target_body": "target_id",
    }
    field = owner.get(course.name[0])
    rows = [b for b in survey.image_blocks if b.epoch_id in chosen and (not field or getattr(b, field) == thing)]
    if course.name[0] in ("carrier_from_target", "target_body"):
        return (LeaveOut(tuple(dict.fromkeys(f"target:{b.camera_id}/{b.epoch_id}/{thing}" for b in rows))),)
    if field:
        return (LeaveOut(tuple(dict.fromkeys(f"image:{b.camera_id}/{b.epoch_id}" for b in rows))),)
    return (LeaveOut(tuple(f"epoch:{e}" for e in later)),) if course.name[0] != "point" else ()


def _altered(result: Adjustment, course: _Course, theta: FloatArray) -> Pose3 | FloatArray:
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
    untied = [i for i in chosen if estimate.status[i] != "tied"]
    before = value.copy()
    value[untied] += theta
    for i in chosen:
        if i not in untied:  # tied components keep their ratio
            value[i] *= value[untied[0]] / before[untied[0]]
    return value


def _mended(
    survey: Survey, result: Adjustment, course: _Course, weights: Mapping[str, float], theta: FloatArray
) -> Survey:
    """What was observed under another value of the unknown, as it would have been under the first one."""
    if course.kind == "image":
        return _mended_images(survey, result, course, weights, theta)
    if course.kind == "pair":
        return with_rows(survey, "pairs", _mended_pairs(survey, course, weights, theta))
    late = {i: r for i, r in enumerate(survey.readings) if r.reading_id in weights}
    return with_rows(survey, "readings", {i: replace(r, value=r.value + float(theta[0])) for i, r in late.items()})


def _mended_images(
    survey: Survey, result: Adjustment, course: _Course, weights: Mapping[str, float], theta: FloatArray
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


def _concerns(block: ImageBlock, course: _Course) -> bool:
    if course.name[0] in ("lens", "station_from_camera"):
        return block.camera_id == course.name[1]
    return course.name[0] not in ("carrier_from_target", "target_body") or block.target_id == course.name[1]


def _mended_pairs(survey: Survey, course: _Course, weights: Mapping[str, float], theta: FloatArray) -> dict[int, Pair]:
    """``a_late = a exp(theta)``: measured was ``b_from_a exp(theta)``, or ``exp(-theta) a_from_b``."""
    out = {}
    for i, pair in enumerate(survey.pairs):
        if pair.pair_id not in weights:
            continue
        motion = type(pair.b_from_a).Expmap(theta if isinstance(pair.b_from_a, Pose3) else theta[:3])
        at_a = _is(pair.a, course.name[1])
        m: Any = pair.b_from_a
        out[i] = replace(pair, b_from_a=m.compose(motion.inverse()) if at_a else motion.compose(m))
    return out


def _is(ref: FrameRef, station: str) -> bool:
    return ref.kind == "station" and ref.frame_id == station
