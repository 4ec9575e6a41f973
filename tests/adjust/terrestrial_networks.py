"""Surveys with total station readings, and the readings once more in a few plain lines of matrices."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from gtsam import Pose3, Rot3

from adjust.graph.assembly import StartValues
from adjust.model.observations import PositionRef, Reading
from adjust.model.result import Adjustment
from adjust.model.survey import (
    INSTRUMENT,
    Bearings,
    Datum,
    FloatArray,
    Instrument,
    Point,
    PointParameter,
    Setup,
    Survey,
    VectorParameter,
    Vertical,
    tilt_axes,
)

ANGLES = ("direction", "angle", "azimuth")
Truth = Mapping[tuple[str, ...], Any]


def plain_axes(survey: Survey, tilt: FloatArray, x: FloatArray) -> FloatArray:
    """Rows: zero of bearings, right hand of it seen from above (clockwise), up; at x."""
    round_ = survey.vertical.radius is not None
    return _axes(survey, tuple(tilt.tolist()), tuple(x.tolist()) if round_ else (0.0, 0.0, 0.0))


@lru_cache(16)
def _axes(survey: Survey, tilt: tuple[float, ...], x: tuple[float, ...]) -> FloatArray:
    """The same; on planes they are everywhere."""
    up0 = np.asarray(survey.vertical.up_in_world, dtype=float)
    R = Rot3.Expmap(np.array(tilt) @ tilt_axes(up0)).matrix()
    axis = np.eye(3)["xyz".index(survey.bearings.zero)]
    zero = axis - (axis @ up0) * up0
    zero = R @ (zero / np.linalg.norm(zero))
    up = R @ up0
    if survey.vertical.radius is not None:
        up = np.array(x) + survey.vertical.radius * up
        up = up / np.linalg.norm(up)
    north = zero - (zero @ up) * up
    north /= np.linalg.norm(north)
    return np.array([north, np.cross(north, up), up])


@lru_cache(4)
def _setups(survey: Survey) -> dict[str, Setup]:
    return {s.setup_id: s for s in survey.setups}


def plain_reading(survey: Survey, r: Reading, truth: Truth, x: Mapping[PositionRef, FloatArray]) -> float:
    """The error-free value of a reading, from the geometry alone."""
    tilt = np.asarray(truth.get(("vertical",), survey.vertical.tilt.values), dtype=float)
    setup = _setups(survey).get(r.setup_id or "")
    p = np.zeros(4)
    if setup is not None and setup.instrument_id is not None:
        p = np.asarray(truth.get(("instrument", setup.instrument_id),
                       next(i for i in survey.instruments if i.instrument_id == setup.instrument_id).parameters.values))
    c = np.asarray(truth.get(("centring", r.setup_id), np.zeros(3)), dtype=float)
    F = plain_axes(survey, tilt, x[r.at])
    if setup is not None and not setup.levelled:
        R = truth[("world_from_station", r.at.frame.frame_id)].rotation().matrix()
        zero, right = (R[:, 0], -R[:, 1]) if survey.bearings.zero == "x" else (R[:, 1], R[:, 0])
        F = np.array([zero, right, R[:, 2]])
    right = F[1]
    origin = x[r.at] + r.instrument_height * F[2] + c[0] * F[0] - c[1] * right + c[2] * F[2]

    def sight(target: PositionRef, height: float) -> FloatArray:
        return x[target] + height * plain_axes(survey, tilt, x[target])[2] - origin

    def bearing(d: FloatArray) -> float:
        angle = np.arctan2(d @ right, d @ F[0])
        return float(angle if survey.bearings.clockwise else -angle)

    d = sight(r.to, r.target_height)
    level = np.hypot(d @ F[0], d @ F[1])
    if r.kind == "direction":
        return bearing(d) - float(np.asarray(truth[("orientation", r.setup_id)])[0])
    if r.kind == "azimuth":
        return bearing(d)
    if r.kind == "angle":
        return bearing(sight(r.second, r.second_height)) - bearing(d)
    if r.kind == "zenith":
        bend = p[2] * level / (2.0 * survey.vertical.radius) if survey.vertical.radius else 0.0
        return float(np.arctan2(level, d @ F[2]) - bend + p[3])
    if r.kind == "slope_distance":
        return float(p[0] + (1.0 + p[1]) * np.linalg.norm(d))
    if r.kind == "horizontal_distance":
        return float(p[0] + (1.0 + p[1]) * level)

    def height(target: PositionRef) -> float:
        up = plain_axes(survey, tilt, np.zeros(3))[2]
        if survey.vertical.radius is None:
            return float(up @ x[target])
        return float(np.linalg.norm(x[target] + survey.vertical.radius * up) - survey.vertical.radius)

    return height(r.to) - height(r.at) + r.target_height - r.instrument_height - c[2]


def positions_of(survey: Survey, truth: Truth) -> dict[PositionRef, FloatArray]:
    out = {}
    for r in survey.readings:
        for ref in (r.at, r.to, r.second):
            if ref is not None:
                x = np.zeros(3) if ref.frame else truth[("point", ref.point_id)]
                if ref.frame is not None:
                    if ref.point_id is not None:
                        target = next(t for t in survey.targets if t.target_id == ref.frame.frame_id)
                        x = target.x_in_target[target.point_ids.index(ref.point_id)]
                    kind = {"station": "world_from_station", "target": "carrier_from_target"}[ref.frame.kind]
                    x = truth[(kind, ref.frame.frame_id)].transformFrom(x)
                out[ref] = np.asarray(x, dtype=float)
    return out


def measured(survey: Survey, truth: Truth, seed: int | None) -> Survey:
    """The survey with readings of the truth, with noise by their sigmas and covariances where a seed is given."""
    x = positions_of(survey, truth)
    rng = np.random.default_rng(seed)
    errors = {}
    if seed is not None:
        errors = {r.reading_id: r.sigma * rng.standard_normal() for r in survey.readings}
        for block in survey.reading_covariances:
            joint = np.linalg.cholesky(block.cov) @ rng.standard_normal(len(block.cov))
            errors |= dict(zip(block.reading_ids, joint, strict=True))
    readings = tuple(
        replace(r, value=plain_reading(survey, r, truth, x) + errors.get(r.reading_id, 0.0)) for r in survey.readings
    )
    return replace(survey, readings=readings)


def P(name: str) -> PositionRef:
    return PositionRef(name)


def polar_network(
    seed: int, *, n: int = 8, stations: int = 4, bearings: Bearings | None = None, vertical: Vertical | None = None,
    instrument: VectorParameter | None = None, setup: Setup | None = None, datum: Datum | None = None, held: int = 2,
    extra: bool = True, plane: bool = False,
) -> tuple[Survey, dict[tuple[str, ...], Any]]:  # fmt: skip
    """Points in a hall of 60 m; ``stations`` of them set up, each seeing all others, with every kind of reading."""
    rng = np.random.default_rng(seed)
    x = rng.uniform((0, 0, 0), (60, 40, 12), (n, 3))
    if plane:
        x[:, 2] = 0.0
    truth: dict[tuple[str, ...], Any] = {("point", f"P{i}"): x[i] for i in range(n)}
    keep = ("z",) if plane else ()
    points = tuple(
        Point(f"P{i}", PointParameter(q, "held") if i < held else PointParameter(q, held=keep)) for i, q in enumerate(x)
    )
    parameter = instrument or VectorParameter(INSTRUMENT, np.zeros(4))
    kinds = [("direction", 1e-5), ("horizontal_distance", 2e-4)]
    if not plane:
        kinds = [("direction", 1e-5), ("zenith", 2e-5), ("slope_distance", 2e-4)]
    readings: list[Reading] = []
    setups = []
    for s in range(stations):
        name = f"S{s}"
        setups.append(replace(setup or Setup("", "T"), setup_id=name))
        truth["orientation", name] = np.array([rng.uniform(0, 6)])
        hi = 0.0 if plane else rng.uniform(1.4, 1.7)
        for t in range(n):
            if t == s:
                continue
            ht = 0.0 if plane else rng.uniform(0.0, 0.3)
            for kind, sigma in kinds:
                readings.append(Reading(f"{kind}{s}-{t}", kind, P(f"P{s}"), P(f"P{t}"), 0.0, sigma, name,
                                        instrument_height=hi, target_height=ht))  # fmt: skip
    if extra:
        more = [("azimuth", 3e-5), ("horizontal_distance", 1e-4)] + ([] if plane else [("height_difference", 1e-4)])
        for j, (kind, sigma) in enumerate(more):
            a, b = f"P{n - 1 - j}", f"P{n - 3 - j}"
            readings.append(Reading(f"{kind}x", kind, P(a), P(b), 0.0, sigma, instrument_height=0.0 if plane else 1.5))
        readings.append(Reading("anglex", "angle", P("P0"), P(f"P{n - 1}"), 0.0, 2e-5, "S0", P(f"P{n - 2}"),
                                0.0 if plane else 1.5, 0.0, 0.0 if plane else 0.2))  # fmt: skip
    survey = Survey(
        points=points, instruments=(Instrument("T", parameter),), setups=tuple(setups), readings=tuple(readings),
        bearings=bearings or Bearings(), vertical=vertical or Vertical(), datum=datum or Datum(),
    )  # fmt: skip
    return survey, truth


def start_near(survey: Survey, truth: Truth, seed: int, points: float = 0.0) -> StartValues:
    """Start values at the truth, points off by ``points`` m; no orientations."""
    rng = np.random.default_rng(seed)
    return StartValues(
        {}, {k: v for k, v in truth.items() if isinstance(v, Pose3)},
        {k[1]: np.asarray(v) + points * rng.standard_normal(3) for k, v in truth.items() if k[0] == "point"},
        {k: np.asarray(v) for k, v in truth.items() if k[0] in ("instrument", "vertical", "centring")},
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class DenseReadings:
    """A (N, n) unwhitened, by differences of the plain readings; v (N,), C (N, N), used (N,), columns by unknown."""

    A: FloatArray
    v: FloatArray
    C: FloatArray
    used: np.ndarray
    place: dict[tuple[str, ...], slice]


def wrapped(v: FloatArray) -> FloatArray:
    """Angles in [-pi, pi)."""
    return np.asarray((v + np.pi) % (2.0 * np.pi) - np.pi)


def concerns(r: Reading, name: tuple[str, ...]) -> bool:
    """Whether an unknown may change a reading."""
    if name[0] == "point":
        return any(ref is not None and ref.point_id == name[1] for ref in (r.at, r.to, r.second))
    return r.setup_id == name[1] if name[0] in ("orientation", "centring") else True


def dense(survey: Survey, result: Adjustment) -> DenseReadings:
    """The linear system of all readings at the solution, from plain matrices and five-point differences."""
    truth: dict[tuple[str, ...], Any] = {n: e.value for n, e in result.estimates.items()}
    angle = np.array([r.kind in ANGLES for r in survey.readings])

    def readings(values: Truth, rows: Sequence[int]) -> FloatArray:
        x = positions_of(survey, values)
        out = np.zeros(len(survey.readings))
        out[rows] = [plain_reading(survey, survey.readings[i], values, x) for i in rows]
        return out

    def difference(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.where(angle, wrapped(a - b), a - b)

    at, columns, place = readings(truth, range(len(survey.readings))), [], {}
    for name, estimate in result.estimates.items():
        first = len(columns)
        rows = [i for i, r in enumerate(survey.readings) if concerns(r, name)]
        mine = np.zeros(len(at))
        mine[rows] = at[rows]
        for i, status in enumerate(estimate.status):
            if status == "held":
                continue
            total, step = np.zeros(len(at)), 1e-3
            for k, weight in ((1, 8.0), (-1, -8.0), (2, -1.0), (-2, 1.0)):
                value = np.array(estimate.value, dtype=float)
                value[i] += k * step
                total += weight * difference(readings({**truth, name: value}, rows), mine)
            columns.append(total / (12.0 * step))
        if len(columns) > first:
            place[name] = slice(first, len(columns))
    number = {r.reading_id: i for i, r in enumerate(survey.readings)}
    C = np.diag([r.sigma**2 for r in survey.readings])
    for block in survey.reading_covariances:
        rows = [number[i] for i in block.reading_ids]
        C[np.ix_(rows, rows)] = block.cov
    v = difference(at, np.array([r.value for r in survey.readings]))
    return DenseReadings(np.array(columns).T, v, C, np.array([r.used for r in survey.readings]), place)
