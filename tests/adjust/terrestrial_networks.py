"""Surveys with total station readings, and the readings once more in a few plain lines of matrices."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from gtsam import Pose3, Rot3

from adjust.graph import StartValues
from adjust.model import (
    Bearings,
    Datum,
    FloatArray,
    Instrument,
    Point,
    PointParameter,
    PoseParameter,
    Setup,
    Station,
    Survey,
    VectorParameter,
    Vertical,
    tilt_axes,
)
from adjust.observations import FrameRef, PositionRef, Reading, ReadingCovariance

ANGLES = ("direction", "angle", "azimuth")
EARTH = 6.38e6


def plain_axes(survey: Survey, tilt: FloatArray, x: FloatArray) -> FloatArray:
    """Rows: zero of bearings, right hand of it seen from above (clockwise), up; at x."""
    up0 = np.asarray(survey.vertical.up_in_world, dtype=float)
    R = Rot3.Expmap(tilt @ tilt_axes(up0)).matrix()
    axis = np.eye(3)["xyz".index(survey.bearings.zero)]
    zero = axis - (axis @ up0) * up0
    zero = R @ (zero / np.linalg.norm(zero))
    up = R @ up0
    if survey.vertical.radius is not None:
        up = x + survey.vertical.radius * up
        up = up / np.linalg.norm(up)
    north = zero - (zero @ up) * up
    north /= np.linalg.norm(north)
    return np.array([north, np.cross(north, up), up])


def plain_reading(survey: Survey, r: Reading, truth: Mapping[tuple[str, ...], object], x: Mapping[PositionRef, FloatArray]) -> float:
    """The error-free value of a reading, from the geometry alone."""
    tilt = np.asarray(truth.get(("vertical",), survey.vertical.tilt.values), dtype=float)
    setup = next((s for s in survey.setups if s.setup_id == r.setup_id), None)
    p = np.zeros(4)
    if setup is not None and setup.instrument_id is not None:
        p = np.asarray(truth.get(("instrument", setup.instrument_id),
                       next(i for i in survey.instruments if i.instrument_id == setup.instrument_id).parameters.values))
    c = np.asarray(truth.get(("centring", r.setup_id), np.zeros(3)), dtype=float)
    F = plain_axes(survey, tilt, x[r.at])
    if setup is not None and not setup.levelled:
        R = truth[("world_from_station", r.at.frame.frame_id)].rotation().matrix()
        north, left, up = (R[:, 1], -R[:, 0], R[:, 2]) if survey.bearings.zero == "y" else (R[:, 0], R[:, 1], R[:, 2])
        F = np.array([R[:, 0], -R[:, 1], R[:, 2]]) if survey.bearings.zero == "x" else np.array([R[:, 1], R[:, 0], R[:, 2]])
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


def positions_of(survey: Survey, truth: Mapping[tuple[str, ...], object]) -> dict[PositionRef, FloatArray]:
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


def measured(survey: Survey, truth: Mapping[tuple[str, ...], object], seed: int | None) -> Survey:
    """The survey with readings of the truth, with noise by their sigmas and covariances where a seed is given."""
    x = positions_of(survey, truth)
    rng = np.random.default_rng(seed)
    errors = {}
    if seed is not None:
        errors = {r.reading_id: r.sigma * rng.standard_normal() for r in survey.readings}
        for block in survey.reading_covariances:
            errors |= dict(zip(block.reading_ids, np.linalg.cholesky(block.cov) @ rng.standard_normal(len(block.cov)), strict=True))
    readings = tuple(
        replace(r, value=plain_reading(survey, r, truth, x) + errors.get(r.reading_id, 0.0)) for r in survey.readings
    )
    return replace(survey, readings=readings)


def P(name: str) -> PositionRef:
    return PositionRef(name)


def polar_network(
    seed: int, *, n: int = 8, stations: int = 4, bearings: Bearings = Bearings(), vertical: Vertical = Vertical(),
    instrument: VectorParameter | None = None, setup: Setup = Setup("", "T"), datum: Datum = Datum(), held: int = 2,
    extra: bool = True, plane: bool = False,
) -> tuple[Survey, dict[tuple[str, ...], object]]:  # fmt: skip
    """Points in a hall of 60 m; ``stations`` of them set up, each seeing all others, with every kind of reading."""
    rng = np.random.default_rng(seed)
    x = rng.uniform((0, 0, 0), (60, 40, 12), (n, 3))
    if plane:
        x[:, 2] = 0.0
    truth: dict[tuple[str, ...], object] = {("point", f"P{i}"): x[i] for i in range(n)}
    keep = ("z",) if plane else ()
    points = tuple(Point(f"P{i}", PointParameter(x[i], "held") if i < held else PointParameter(x[i], held=keep)) for i in range(n))
    parameter = instrument or VectorParameter(("distance_offset", "distance_scale", "refraction", "vertical_index"), np.zeros(4))
    readings: list[Reading] = []
    setups = []
    for s in range(stations):
        name = f"S{s}"
        setups.append(replace(setup, setup_id=name))
        truth["orientation", name] = np.array([rng.uniform(0, 6)])
        hi = 0.0 if plane else rng.uniform(1.4, 1.7)
        for t in range(n):
            if t == s:
                continue
            ht = 0.0 if plane else rng.uniform(0.0, 0.3)
            common = {"at": P(f"P{s}"), "to": P(f"P{t}"), "setup_id": name, "instrument_height": hi, "target_height": ht}
            kinds = [("direction", 1e-5), ("horizontal_distance", 2e-4)] if plane else [("direction", 1e-5), ("zenith", 2e-5), ("slope_distance", 2e-4)]
            for kind, sigma in kinds:
                readings.append(Reading(f"{kind}{s}-{t}", kind, value=0.0, sigma=sigma, **common))
    if extra:
        kinds = [("azimuth", 3e-5), ("horizontal_distance", 1e-4)] + ([] if plane else [("height_difference", 1e-4)])
        for j, (kind, sigma) in enumerate(kinds):
            a, b = f"P{n - 1 - j}", f"P{n - 3 - j}"
            readings.append(Reading(f"{kind}x", kind, P(a), P(b), 0.0, sigma, instrument_height=0.0 if plane else 1.5))
        readings.append(Reading("anglex", "angle", P("P0"), P(f"P{n - 1}"), 0.0, 2e-5, second=P(f"P{n - 2}"), setup_id="S0",
                                instrument_height=0.0 if plane else 1.5, second_height=0.0 if plane else 0.2))
    return Survey(points=points, instruments=(Instrument("T", parameter),), setups=tuple(setups), readings=tuple(readings),
                  bearings=bearings, vertical=vertical, datum=datum), truth  # fmt: skip


def start_near(survey: Survey, truth: Mapping[tuple[str, ...], object], seed: int, points: float = 0.0) -> StartValues:
    """Start values at the truth, points off by ``points`` m; no orientations."""
    rng = np.random.default_rng(seed)
    return StartValues(
        {}, {k: v for k, v in truth.items() if isinstance(v, Pose3)},
        {k[1]: np.asarray(v) + points * rng.standard_normal(3) for k, v in truth.items() if k[0] == "point"},
        {k: np.asarray(v) for k, v in truth.items() if k[0] in ("instrument", "vertical", "centring")},
    )  # fmt: skip
