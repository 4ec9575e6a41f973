"""What is not observed at the same time: an offset or a drift between clocks, rows read one after the other; gears.

The unit of time is the interval between epochs; speeds are those of the observations themselves, by differences of
neighbouring epochs. What is tried are clocks as unknowns (:mod:`adjust.diagnosis.time.clocks`).
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING

import numpy as np
from gtsam import Pose3, Rot3

from adjust.diagnosis.case import Case
from adjust.diagnosis.effects.effect import Effect, Shifts, of_others, of_shifts
from adjust.diagnosis.hypothesis import Hypothesis, Place
from adjust.diagnosis.prediction import Linear
from adjust.diagnosis.sequences import hand_poses
from adjust.diagnosis.time.clocks import Freed, as_unknowns, keyed, spoken
from adjust.model.frozen import frozen
from adjust.model.names import grouped
from adjust.model.observations import ImageBlock
from adjust.model.result import Adjustment, ParameterName
from adjust.model.rewriting import with_rows
from adjust.model.survey import Clock, FloatArray, Survey
from adjust.statistics.score import Score, drift_times

if TYPE_CHECKING:
    from scipy.interpolate import CubicSpline

_FEWEST = 6
_STEP = 1e-3  # intervals
_CLEAR = 4.0  # sigmas


def clocks(case: Case, linear: Linear) -> Iterator[Effect]:
    """Of cameras, of tables, of measured poses of stations; gear ratios of tables."""
    yield from _of_cameras(case, linear)
    yield from _of_tables(case, linear)
    yield from _of_hands(case, linear)


# -- cameras ---------------------------------------------------------------------------------------------------------


@lru_cache(maxsize=4)
def _motion(survey: Survey) -> dict[int, tuple[int, int, FloatArray, FloatArray]]:
    """By block: its number in the course of its camera and target, their length, speed and acceleration (n, 2) px.

    Of points that the whole course shows by splines, of others by the images before and after; zero where unknown.
    """
    out = {}
    for blocks in grouped(((b.camera_id, b.target_id), i) for i, b in enumerate(survey.image_blocks)).values():
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


@frozen
class _Late:
    """How cameras are late. weight: how much later each point of an image is by one unit; components: of a clock."""

    name: str
    weight: Callable[[int, int, ImageBlock, int], FloatArray]
    components: tuple[str, ...]
    text: str
    remedy: str
    unit: str


_TOGETHER = "trigger the cameras together, or hold the target still at every epoch, and measure again"
_LATE = (
    _Late("cameras not simultaneous", lambda k, n, b, height: np.ones(len(b.uv)), ("offset",),
          "camera {} does not expose when the others do: its clock is late", _TOGETHER, "throughout"),
    _Late("clock drift", lambda k, n, b, height: np.full(len(b.uv), drift_times(n)[k]), ("offset", "drift"),
          "camera {} does not expose when the others do, and less and less so: its clock drifts", _TOGETHER,
          "over all epochs"),
    _Late("rolling shutter", lambda k, n, b, height: (b.uv[:, 1] + 0.5) / height - 0.5, ("line_time",),
          "the rows of camera {} are read one after the other while things move",
          "hold still what moves, or take a camera with a global shutter", "from the first row to the last"),
)  # fmt: skip


def _of_cameras(case: Case, linear: Linear) -> Iterator[Effect]:
    cameras = {c.camera_id: () if c.clock is None else c.clock.parameters.free for c in case.survey.cameras}
    survey = linear.result.survey
    moving = [c for c in cameras if sum(survey.image_blocks[i].camera_id == c for i in _motion(survey)) >= _FEWEST - 2]
    for late in _LATE:
        possible = moving if late.components == ("line_time",) else moving[1:]
        which = [c for c in possible if late.components[-1] not in cameras[c]]
        if not which:
            continue
        first = of_shifts(linear, _shifts(survey, which, late))
        sigmas = np.sqrt(np.maximum(np.diag(first.cov), 1e-300) * linear.scale)
        clear = [c for c, t, s in zip(which, first.theta, sigmas, strict=True) if abs(t) > _CLEAR * s]
        if clear:
            yield _late_cameras(case, linear, late, clear)


def _weighted(
    survey: Survey, cameras: Sequence[str], late: _Late
) -> Iterator[tuple[int, int, FloatArray, FloatArray, FloatArray]]:
    """Image blocks of these cameras with a course: position, number of the camera, weights (n, 1), speed and bend."""
    for i, (k, n, speed, bend) in _motion(survey).items():
        b = survey.image_blocks[i]
        if b.camera_id in cameras:
            w = late.weight(k, n, b, survey.cameras_by_id[b.camera_id].image_size[1])
            yield i, cameras.index(b.camera_id), w[:, None], speed, bend


def _shifts(survey: Survey, cameras: Sequence[str], late: _Late) -> Shifts:
    """By block the shifts (n, 2, k) px that an interval of each of k cameras makes."""
    out = {}
    for i, k, w, speed, _ in _weighted(survey, cameras, late):
        out[i] = np.zeros((len(speed), 2, len(cameras)))
        out[i][:, :, k] = w * speed
    return out


def _late_cameras(case: Case, linear: Linear, late: _Late, cameras: Sequence[str]) -> Effect:
    """Image points moved along their tracks to where they were in time: a clock as an unknown costs many times more."""
    survey = case.survey
    freed: Freed = {("camera_clock", c): late.components for c in cameras}

    def scored(at: Linear) -> Score:
        return of_shifts(at, _shifts(at.result.survey, cameras, late))

    def mended(_: Adjustment, theta: FloatArray) -> Survey:
        blocks = {}
        for i, k, w, speed, bend in _weighted(survey, cameras, late):
            b, by = survey.image_blocks[i], theta[k] * w
            blocks[i] = replace(b, uv=b.uv - by * speed + 0.5 * by**2 * bend)
        return with_rows(survey, "image_blocks", blocks)

    first, (factor, of_time) = scored(linear), spoken(survey)
    worst = cameras[int(np.argmax(np.abs(first.theta)))]

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        sizes = zip(cameras, factor * theta, factor * sigmas, strict=True)
        each = ", ".join(f"camera {c}: {t:+.3g} +- {s:.2g} {of_time}" for c, t, s in sizes)
        return f"{late.text.format(worst)} ({each}, {late.unit})"

    plain = Hypothesis(late.name, "", late.remedy, Place("camera", (worst,), "clock"), survey, (), 1.0, 0)

    def modelled(tried: Hypothesis) -> Hypothesis:
        """With such a clock as an unknown, for what tracks do not tell."""
        return as_unknowns(case, replace(plain, evidence=tried.evidence), freed)

    further = None if late.components == ("line_time",) else modelled
    return Effect(keyed(survey, plain, freed), first, scored, mended, said, further=further)


def _modelled(
    case: Case, place: Place, owner: ParameterName, known: Clock | None, remedy: str, texts: tuple[str, str], n: int,
    score: Callable[[FloatArray], Score],
) -> Iterator[Effect]:  # fmt: skip
    """The offset and the drift of a clock as its unknowns, where they are none yet. texts: the causes of either.

    score: of n observations that are late, each by so much (n,).
    """

    def effect(name: str, freed: Freed, text: str, first: Score) -> Effect:
        hypothesis = Hypothesis(name, "", remedy, place, case.survey, (), 1.0, 0)
        return Effect(hypothesis, first, lambda _: first, lambda *_: case.survey, lambda *_: text,
                      model=lambda h: as_unknowns(case, h, freed))  # fmt: skip

    free = () if known is None else known.parameters.free
    if "offset" not in free:
        yield effect("clock offset", {owner: ("offset",)}, texts[0], score(np.ones(n)))
    if "drift" not in free:
        yield effect("clock drift", {owner: ("offset", "drift")}, texts[1], score(drift_times(n)))


# -- tables and hands ------------------------------------------------------------------------------------------------


def _of_tables(case: Case, linear: Linear) -> Iterator[Effect]:
    for table in case.survey.tables:
        mine = [r for r in case.survey.table_readings if r.table_id == table.table_id]
        if len(mine) < _FEWEST:
            continue
        angles = np.array([r.angles for r in mine])
        speed = spline(angles)(np.arange(len(mine)), 1)
        ids: list[tuple[str, ...]] = [(r.table_id, r.epoch_id) for r in mine]

        def score(late: FloatArray, ids: Sequence[tuple[str, ...]] = ids, speed: FloatArray = speed) -> Score:
            return of_others(linear, "table", dict(zip(ids, (late[:, None] * speed)[:, :, None], strict=True)))

        yield from _modelled(
            case, Place("table", (table.table_id,), "clock"), ("table_clock", table.table_id), table.clock,
            "read the table while it stands still, and measure again",
            (f"table {table.table_id}: its readings are late", f"table {table.table_id}: its clock drifts"), len(mine),
            score,
        )  # fmt: skip
        for k in range(angles.shape[1]):
            D = -np.eye(angles.shape[1])[k] * angles
            yield _gear_effect(case, linear, table.table_id, k, dict(zip(ids, D, strict=True)))


def _gear_effect(case: Case, linear: Linear, table_id: str, axis: int, D: dict[tuple[str, ...], FloatArray]) -> Effect:
    readings = case.survey.table_readings

    def scored(at: Linear) -> Score:
        return of_others(at, "table", {i: d[:, None] for i, d in D.items()})

    def mended(_: Adjustment, theta: FloatArray) -> Survey:
        mine = {i: r for i, r in enumerate(readings) if (r.table_id, r.epoch_id) in D}
        new = {i: replace(r, angles=r.angles - theta[0] * D[r.table_id, r.epoch_id]) for i, r in mine.items()}
        return with_rows(case.survey, "table_readings", new)

    def said(theta: FloatArray, sigmas: FloatArray) -> str:
        return (f"table {table_id}: axis {axis + 1} turns by {theta[0]:+.6f} +- {sigmas[0]:.6f} of its readings more "
                "than they say: its gear ratio, or the lines of its encoder")  # fmt: skip

    place = Place("table", (table_id,), "axis1_deg")
    hypothesis = Hypothesis("gear ratio", "", "correct table_angles.csv", place, case.survey, (), 1.0, 0)
    return Effect(hypothesis, scored(linear), scored, mended, said)


def _of_hands(case: Case, linear: Linear) -> Iterator[Effect]:
    known = {s.station_id: s.clock for s in case.survey.stations}
    for station, poses in hand_poses(case.survey).items():
        rows = [i for i, _ in poses.values()]
        if len(rows) < _FEWEST or station not in known:
            continue
        yield from _modelled(
            case, Place("station", (station,), "clock"), ("pose_clock", station), known[station],
            "stop the motion at every epoch, or read pose and image at the same time, and measure again",
            (f"the poses of {station} are late", f"the poses of {station} are ever later against the images"),
            len(rows), partial(_of_path, case.survey, linear, rows),
        )  # fmt: skip


def _of_path(survey: Survey, linear: Linear, rows: Sequence[int], w: FloatArray) -> Score:
    """Of measured poses that are late, each by so much of the change."""
    pairs = [survey.pairs[i] for i in rows]
    path = [p.b_from_a for p in pairs if isinstance(p.b_from_a, Pose3)]
    speed = [a.between(b) for a, b in zip(_at(path, -_STEP * w), _at(path, _STEP * w), strict=True)]
    shifts = {p.pair_id: Pose3.Logmap(d)[:, None] / (2.0 * _STEP) for p, d in zip(pairs, speed, strict=True)}
    ids = {o.ids: shifts[o.ids[0]] for o in linear.system.precision.graph.others
           if o.kind == "pair" and o.ids[0] in shifts}  # fmt: skip
    return of_others(linear, "pair", ids)


def _at(path: Sequence[Pose3], dt: FloatArray) -> list[Pose3]:
    """Poses of a path at dt (n,) intervals after each of them: cubic splines of their places and of their turns."""
    from scipy.spatial.transform import Rotation, RotationSpline  # here: what stands still needs none

    R = np.array([p.rotation().matrix() for p in path])
    times = np.arange(len(path)) + dt
    turns = RotationSpline(np.arange(len(path)), Rotation.from_matrix(R))
    places = spline(np.array([p.translation() for p in path]))
    return [Pose3(Rot3(M), t) for M, t in zip(turns(times).as_matrix(), places(times), strict=True)]


def spline(values: FloatArray) -> "CubicSpline":
    """Through values (n, ...) at 0, 1, 2 ..."""
    from scipy.interpolate import CubicSpline  # here: it takes longer to load than a small survey to diagnose

    return CubicSpline(np.arange(len(values)), values)
