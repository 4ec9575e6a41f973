"""What is not observed at the same time: an offset or a drift between clocks, rows read one after the other; gears.

The unit of time is the interval between epochs; speeds are those of the observations themselves, by differences of
neighbouring epochs. A value that was read dt late is ``f(t + dt) = f + dt f' + dt^2 f''/2``.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from gtsam import Pose3, Rot3

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, Shifts, of_others, of_shifts
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.score import Linear, Score, drift_times
from adjust.diagnosis.sequences import hand_poses, with_pairs
from adjust.model.observations import ImageBlock, TableReading
from adjust.model.survey import FloatArray, Survey

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_FEWEST = 6
_STEP = 1e-3  # intervals
_CLEAR = 4.0  # sigmas


def clocks(case: Case) -> Iterator[Effect]:
    """Of cameras, of tables, of measured poses of stations; gear ratios of tables."""
    linear = case.linear
    if linear is None:
        return
    yield from _of_cameras(case, linear)
    yield from _of_tables(case, linear)
    yield from _of_hands(case, linear)


# -- cameras ---------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=2)
def _motion(survey: Survey) -> dict[int, tuple[int, int, FloatArray, FloatArray]]:
    """By block: its number in the course of its camera and target, their length, speed and acceleration (n, 2) px.

    Of points that the whole course shows by splines, of others by the images before and after; zero where unknown.
    """
    courses: dict[tuple[str, str | None], list[int]] = {}
    for i, b in enumerate(survey.image_blocks):
        courses.setdefault((b.camera_id, b.target_id), []).append(i)
    out = {}
    for blocks in courses.values():
        if len(blocks) < _FEWEST:
            continue
        uv = np.full((len(blocks), 1 + max(int(survey.image_blocks[i].point_idx.max()) for i in blocks), 2), np.nan)
        for k, i in enumerate(blocks):
            uv[k, survey.image_blocks[i].point_idx] = survey.image_blocks[i].uv
        speed, bend = _smooth(uv)
        for k, i in enumerate(blocks):
            rows = survey.image_blocks[i].point_idx
            if speed[k, rows].any():
                out[i] = k, len(blocks), speed[k, rows], bend[k, rows]
    return out


def _smooth(uv: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Speed and acceleration of tracks (e, n, 2) at e epochs."""
    whole, e = np.isfinite(uv).all(axis=(0, 2)), np.arange(len(uv))
    speed, bend = np.zeros(uv.shape), np.zeros(uv.shape)
    speed[1:-1], bend[1:-1] = 0.5 * (uv[2:] - uv[:-2]), uv[2:] - 2.0 * uv[1:-1] + uv[:-2]
    if whole.any():
        course = spline(uv[:, whole])
        speed[:, whole], bend[:, whole] = course(e, 1), course(e, 2)
    unknown = ~np.isfinite(speed.sum(axis=2) + bend.sum(axis=2))
    speed[unknown], bend[unknown] = 0.0, 0.0
    return speed, bend


def _always(_: int, n: int, block: ImageBlock, height: int) -> FloatArray:
    return np.ones(len(block.uv))


def _with_time(k: int, n: int, block: ImageBlock, height: int) -> FloatArray:
    return np.full(len(block.uv), drift_times(n)[k])


def _with_row(_: int, n: int, block: ImageBlock, height: int) -> FloatArray:
    return np.asarray((block.uv[:, 1] + 0.5) / height - 0.5)


def _of_cameras(case: Case, linear: Linear) -> Iterator[Effect]:
    cameras = [c.camera_id for c in case.survey.cameras]
    motion = _motion(linear.result.survey)
    blocks = linear.result.survey.image_blocks
    moving = [c for c in cameras if sum(blocks[i].camera_id == c for i in motion) >= _FEWEST - 2]
    for name, weight, which in (
        ("cameras not simultaneous", _always, moving[1:]), ("clock drift", _with_time, moving[1:]),
        ("rolling shutter", _with_row, moving),
    ):  # fmt: skip
        if not which:
            continue
        first = of_shifts(linear, _late(linear.result.survey, which, weight))
        sigmas = np.sqrt(np.maximum(np.diag(first.cov), 1e-300) * linear.scale)
        clear = [c for c, t, s in zip(which, first.theta, sigmas, strict=True) if abs(t) > _CLEAR * s]
        if clear:
            yield _camera_effect(case, linear, name, weight, clear)


def _late(survey: Survey, cameras: Sequence[str], weight: Any) -> Shifts:
    """By block the shifts (n, 2, k) px that an interval of each of k cameras makes."""
    heights = {c.camera_id: c.image_size[1] for c in survey.cameras}
    out = {}
    for i, (k, n, speed, _) in _motion(survey).items():
        block = survey.image_blocks[i]
        if block.camera_id in cameras:
            D = np.zeros((len(speed), 2, len(cameras)))
            w = weight(k, n, block, heights[block.camera_id])
            D[:, :, cameras.index(block.camera_id)] = w[:, None] * speed
            out[i] = D
    return out


def _in_time(survey: Survey, cameras: Sequence[str], weight: Any, theta: FloatArray) -> Survey:
    """The image points as they are theta intervals earlier; images of which no speed is known go."""
    heights = {c.camera_id: c.image_size[1] for c in survey.cameras}
    motion, blocks = _motion(survey), []
    for i, block in enumerate(survey.image_blocks):
        if block.camera_id not in cameras:
            blocks.append(block)
        elif i in motion:
            k, n, speed, bend = motion[i]
            dt = theta[cameras.index(block.camera_id)] * weight(k, n, block, heights[block.camera_id])[:, None]
            blocks.append(replace(block, uv=block.uv - dt * speed + 0.5 * dt**2 * bend))
        else:
            blocks.append(replace(block, used=np.zeros(len(block.uv), dtype=np.bool_)))
    return replace(survey, image_blocks=tuple(blocks))


def _camera_effect(case: Case, linear: Linear, name: str, weight: Any, cameras: list[str]) -> Effect:
    first = of_shifts(linear, _late(linear.result.survey, cameras, weight))
    worst = cameras[int(np.argmax(np.abs(first.theta)))]

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        each = [f"{c} {t:+.3f} +- {s:.3f}" for c, t, s in zip(cameras, theta, sigmas, strict=True)]
        text = f"({', '.join(each)} intervals between epochs)"
        if name == "rolling shutter":
            return f"the rows of camera {worst} are read one after the other while things move {text}"
        drift = name == "clock drift"
        return (f"camera {worst} does not expose when the others do{', and less and less so' if drift else ''}: its "
                f"clock {'drifts' if drift else 'is late'} {text}")  # fmt: skip

    remedy = ("hold still what moves, or take a camera with a global shutter" if name == "rolling shutter" else
              "trigger the cameras together, or hold the target still at every epoch, and measure again")  # fmt: skip
    hypothesis = Hypothesis(name, "", remedy, Place("camera", (worst,)), case.survey, (), 1.0, 0)
    return Effect(hypothesis, first, lambda at: of_shifts(at, _late(at.result.survey, cameras, weight)),
                  lambda _, theta: _in_time(case.survey, cameras, weight, theta), said)  # fmt: skip


# -- tables and hands ------------------------------------------------------------------------------------------------


def _of_tables(case: Case, linear: Linear) -> Iterator[Effect]:
    for table in case.survey.tables:
        mine = [r for r in case.survey.table_readings if r.table_id == table.table_id]
        if len(mine) < _FEWEST:
            continue
        angles = np.array([r.angles for r in mine])
        speed = spline(angles)(np.arange(len(mine)), 1)
        ids = [(r.table_id, r.epoch_id) for r in mine]
        times = drift_times(len(mine))[:, None]
        for name, D, text in (
            ("clock offset", speed, "its readings are late by {:+.4f} +- {:.4f} intervals between epochs"),
            ("clock drift", times * speed, "its clock drifts by {:+.4f} +- {:.4f} intervals over the session"),
            *((f"gear ratio of axis {k + 1}", -np.eye(angles.shape[1])[k] * angles,
               f"axis {k + 1} turns by {{0:+.6f}} +- {{1:.6f}} of its readings more than they say: its gear ratio, or "
               "the lines of its encoder") for k in range(angles.shape[1])),
        ):  # fmt: skip
            yield _table_effect(case, linear, table.table_id, name, dict(zip(ids, D, strict=True)), text)


def _table_effect(
    case: Case, linear: Linear, table_id: str, name: str, D: dict[tuple[str, ...], FloatArray], text: str
) -> Effect:
    shifts = {i: d[:, None] for i, d in D.items()}

    def mended(r: TableReading, theta: float) -> TableReading:
        d = D.get((r.table_id, r.epoch_id))
        return r if d is None else replace(r, angles=r.angles - theta * d)

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        return f"table {table_id}: {text.format(theta[0], sigmas[0])}"

    kind = "gear ratio" if name.startswith("gear ratio") else name
    hypothesis = Hypothesis(
        kind, "", "correct table_angles.csv" if kind == "gear ratio" else "read the table while it stands still, and "
        "measure again", Place("table", (table_id,), "axis1_deg"), case.survey, (), 1.0, 0,
    )  # fmt: skip
    return Effect(
        hypothesis, of_others(linear, "table", shifts), lambda at: of_others(at, "table", shifts),
        lambda _, theta: replace(case.survey, table_readings=tuple(
            mended(r, float(theta[0])) for r in case.survey.table_readings)),
        said,
    )  # fmt: skip


def _of_hands(case: Case, linear: Linear) -> Iterator[Effect]:
    for station, poses in hand_poses(case.survey).items():
        rows = [i for i, _ in poses.values()]
        if len(rows) < _FEWEST:
            continue
        path = [p for i in rows if isinstance(p := case.survey.pairs[i].b_from_a, Pose3)]
        times = drift_times(len(rows))
        for name, w, text in (
            ("clock offset", np.ones(len(rows)), "are late by {:+.3f} +- {:.3f} intervals between epochs"),
            ("clock drift", times, "drift by {:+.3f} +- {:.3f} intervals over the session against the images"),
        ):  # fmt: skip
            yield _hand_effect(case, linear, station, name, (rows, path, w), text)


def _at(path: Sequence[Pose3], dt: FloatArray) -> list[Pose3]:
    """Poses of a path at dt (n,) intervals after each of them: cubic splines of their places and of their turns."""
    from scipy.spatial.transform import Rotation, RotationSpline  # here: what stands still needs none

    R = np.array([p.rotation().matrix() for p in path])
    times = np.arange(len(path)) + dt
    turns = RotationSpline(np.arange(len(path)), Rotation.from_matrix(R))
    places = spline([p.translation() for p in path])
    return [Pose3(Rot3(M), t) for M, t in zip(turns(times).as_matrix(), places(times), strict=True)]


def spline(values: Any) -> "CubicSpline":
    """Through values (n, ...) at 0, 1, 2 ..."""
    from scipy.interpolate import CubicSpline  # here: it takes longer to load than a small survey to diagnose

    return CubicSpline(np.arange(len(values)), np.array(values))


def _hand_effect(
    case: Case, linear: Linear, station: str, name: str, course: tuple[list[int], list[Pose3], FloatArray], text: str
) -> Effect:
    """course: rows of the pairs, their poses, and by how much of the change each is late."""
    pairs, (rows, path, w) = case.survey.pairs, course
    speed = [(a.between(b)) for a, b in zip(_at(path, -_STEP * w), _at(path, _STEP * w), strict=True)]
    shifts = {pairs[i].pair_id: Pose3.Logmap(d)[:, None] / (2.0 * _STEP) for i, d in zip(rows, speed, strict=True)}

    def scored(at: Linear) -> Score:
        ids = {o.ids: shifts[o.ids[0]] for o in at.system.precision.graph.others
               if o.kind == "pair" and o.ids[0] in shifts}  # fmt: skip
        return of_others(at, "pair", ids)

    def mended(theta: FloatArray) -> Survey:
        at = zip(rows, _at(path, -theta[0] * w), strict=True)  # of the ends a spline knows little: they go
        return with_pairs(case.survey, {i: replace(pairs[i], b_from_a=m, used=i not in (rows[0], rows[-1]))
                                        for i, m in at})  # fmt: skip

    hypothesis = Hypothesis(
        name, "", "stop the motion at every epoch, or read pose and image at the same time, and measure again",
        Place("station", (station,)), case.survey, (), 1.0, 0,
    )  # fmt: skip
    return Effect(hypothesis, scored(linear), scored, lambda _, theta: mended(theta),
                  lambda theta, sigmas: f"the poses of {station} {text.format(theta[0], sigmas[0])}")  # fmt: skip
